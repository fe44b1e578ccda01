"""Where cubes can stand: on the table, apart from each other, clear of the arm and of what is fixed, within reach."""

from __future__ import annotations

import math
from collections.abc import Sequence

import mujoco
import numpy as np
import torch

from mjstack.config.schema import Config
from mjstack.errors import ParameterError
from mjstack.kinematics.reach import PointReach
from mjstack.managers.base import EnvView
from mjstack.rng import uniform
from mjstack.scene import SceneIndex, table_top

_TRIALS = 20_000  # imaginary worlds that try a region before it is used
_SHARE = 2_000  # of them at a time
_FIRST = 3  # candidates that are tried first
_GRID = 0.02  # [m] between the places whose reach is tried


class Placement:
    """Tests places of both cubes in a region around their nominal ones.

    Shapes are rounded up: a cube of any yaw is a disc of half its diagonal, a geom of the arm is its bounding sphere, and one
    that is fixed to the world, such as a wall of the box, is a rectangle along x and y. So what passes is free, and some free
    places are not used.
    """

    def __init__(
        self,
        cfg: Config,
        model: mujoco.MjModel,
        index: SceneIndex,
        *,
        region: tuple[float, float],
        gap: float,
        pose: Sequence[float],
        noise: float = 0.0,
    ) -> None:
        """Finds what could be in the way.

        Args:
            cfg: The configuration.
            model: The compiled scene.
            index: Its addresses.
            region: Half-widths of the region in x and y [m].
            gap: Free room around a cube [m], for fingers.
            pose: Where the robot's joints are [rad, m].
            noise: How far each arm joint may be from there [rad].
        """
        scene = cfg.scene
        half = scene.cube_half
        self._radius = math.sqrt(2.0) * half
        self._apart = 2.0 * self._radius + gap
        self._height = table_top(scene) + half
        nominal = torch.tensor([scene.red_xy, scene.blue_xy], dtype=torch.float64)
        center, room = torch.tensor(scene.table_center[:2]).double(), torch.tensor(scene.table_half[:2]).double() - self._radius
        data = mujoco.MjData(model)
        data.qpos[index.robot_qpos] = pose
        mujoco.mj_kinematics(model, data)
        centers, keep = _arm_spheres(cfg, data, index, noise)
        keep += math.sqrt(3.0) * half + gap
        near = np.zeros(len(keep), dtype=bool)
        for xy in (scene.red_xy, scene.blue_xy):
            offset = np.abs(centers - [*xy, self._height]) - [*region, 0.0]
            near |= np.linalg.norm(np.maximum(offset, 0.0), axis=1) < keep
        spheres = torch.from_numpy(np.column_stack((centers, keep))[near])
        walls = torch.from_numpy(_fixed_rectangles(data, self._height - half, self._height + half))
        clear = torch.tensor((self._radius + gap) ** 2).double()
        self._tensors = [nominal, torch.tensor(region).double(), center, room, spheres, walls, clear]

    def to(self, device: torch.device, dtype: torch.dtype) -> None:
        """Moves the constants to where worlds are placed."""
        self._tensors = [t.to(device, dtype) for t in self._tensors]

    def choose(self, draws: torch.Tensor) -> torch.Tensor:
        """The first candidates that fit.

        Args:
            draws: Numbers in [-1, 1), shape ``(n, 2, candidates, 2)``: red and blue, x and y.

        Returns:
            Offsets from the nominal places [m], shape ``(n, 2, 2)``; 0 for both cubes where nothing fits.
        """
        return self._choose(draws)[0]

    def require_room(self, name: str, value: object, candidates: int) -> None:
        """Tries the region on many imaginary worlds.

        Raises:
            ParameterError: In some of them no candidate fits.
        """
        world = torch.arange(_TRIALS)
        zero = torch.zeros_like(world)
        draws = uniform(seed=0, world=world, episode=zero, step=zero, stream=0, size=4 * candidates).double()
        draws = draws.view(_TRIALS, 2, candidates, 2)
        hard = draws[~self._choose(draws[:, :, :_FIRST])[1]]  # the first few do for most worlds, which saves time
        lacking = sum(int((~self._choose(share)[1]).sum()) for share in hard.split(_SHARE))
        if lacking:
            raise ParameterError(
                name,
                value,
                f"a region with a free place for both cubes; {candidates} draws found none in {lacking} of {_TRIALS} trials",
                "Make the region smaller, the gap smaller, or move the cubes (scene.red_xy, scene.blue_xy)",
            )

    def require_all_free(self, name: str, value: object) -> None:
        """Checks the corners of the region, which is small: every draw must fit.

        Raises:
            ParameterError: A cube could leave the table or touch the other.
        """
        corners = torch.tensor([[x, y] for x in (-1.0, 1.0) for y in (-1.0, 1.0)]).double()
        pairs = torch.stack([torch.stack((a, b)) for a in corners for b in corners])
        _, free = self._choose(pairs[:, :, None])
        if not bool(free.all()):
            raise ParameterError(name, value, "cubes that stay on the table, apart from each other and clear of the arm")

    def _choose(self, draws: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        nominal, region, center, room, spheres, walls, clear = self._tensors
        offsets = draws * region
        places = nominal[None, :, None] + offsets
        free = ((places - center).abs() <= room).all(-1)
        if spheres.shape[0]:
            level = torch.full_like(places[..., :1], self._height)
            away = torch.cat((places, level), -1)[..., None, :] - spheres[:, :3]
            free &= (away.square().sum(-1) >= spheres[:, 3].square()).all(-1)
        if walls.shape[0]:
            away = ((places[..., None, :] - walls[:, :2]).abs() - walls[:, 2:]).clamp_min(0.0)
            free &= (away.square().sum(-1) >= clear).all(-1)
        x, y = (places[:, 0, :, None] - places[:, 1, None]).unbind(-1)
        fits = (x.square() + y.square() >= self._apart**2) & free[:, 0, :, None] & free[:, 1, None]
        first = fits.flatten(1).to(torch.uint8).argmax(1)  # red's first candidate that goes with one of blue's
        rows, candidates = torch.arange(draws.shape[0], device=draws.device), draws.shape[2]
        red, blue = first // candidates, first % candidates
        both = fits.flatten(1).any(1)
        chosen = torch.stack((offsets[rows, 0, red], offsets[rows, 1, blue]), dim=1)
        return torch.where(both[:, None, None], chosen, 0.0), both


def reach_distances(env: EnvView, xy: np.ndarray) -> np.ndarray:
    """How far the aperture centre, jaws open, stays from cubes at some places: from their centres, and from above them.

    Args:
        env: The environment.
        xy: Where cubes stand [m], shape ``(n, 2)``.

    Returns:
        Distance [m] at grasp height and at approach height, shape ``(n, 2)``.
    """
    robot, scene = env.cfg.robot, env.cfg.scene
    center = table_top(scene) + scene.cube_half
    points = np.array([[[x, y, center + rise] for rise in (scene.grasp_offset, robot.approach_height)] for x, y in xy])
    reach = PointReach(env.sim.model, robot, robot.gripper_open)
    return reach.solve(points.reshape(-1, 3)).distance.reshape(-1, 2)


def require_reach(env: EnvView, name: str, region: tuple[float, float]) -> None:
    """Tries a grid over each cube's region, as far as it is on the table.

    Raises:
        ParameterError: The arm cannot bring its open jaws to a cube somewhere there, or above it.
    """
    scene = env.cfg.scene
    tolerance = env.cfg.controller.ik_tolerance
    for cube, at in zip(env.index.objects, (scene.red_xy, scene.blue_xy), strict=True):
        axes = []
        for k in (0, 1):
            room = scene.table_half[k] - math.sqrt(2.0) * scene.cube_half  # as `Placement` keeps them, for any yaw
            low, high = (
                np.clip(at[k] + s * region[k], scene.table_center[k] - room, scene.table_center[k] + room) for s in (-1, 1)
            )
            axes.append(np.unique(np.linspace(low, high, max(5, 1 + math.ceil((high - low) / _GRID)))))
        xy = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
        distances = reach_distances(env, xy)
        worst, level = np.unravel_index(distances.argmax(), distances.shape)
        if not distances[worst, level] <= tolerance:
            raise ParameterError(
                name,
                list(region),
                f"a region that the arm reaches; with {cube} at ({xy[worst, 0]:.3f}, {xy[worst, 1]:.3f}) m the point "
                f"{('at the cube', 'above it')[level]} is {1e3 * distances[worst, level]:.1f} mm out of reach",
                "Make the region smaller, or move the cubes (scene.red_xy, scene.blue_xy); job=reachability draws a map",
            )


def _arm_spheres(cfg: Config, data: mujoco.MjData, index: SceneIndex, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Centres ``(n, 3)`` and radii ``(n,)`` of spheres that hold the arm's colliding geoms, wherever noise puts them."""
    model = data.model
    body = model.geom_bodyid
    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    fixed = model.body_weldid[body] == 0
    geoms = np.flatnonzero(collides & ~fixed & ~np.isin(body, list(index.bodies.values())))
    joints = [model.joint(name).id for name in cfg.robot.arm_joints]
    centers = data.geom_xpos[geoms]
    # A joint that is off moves a geom by at most its distance from the joint times the angle.
    levers = np.linalg.norm(data.xanchor[joints][None] - centers[:, None], axis=2)
    return centers, model.geom_rbound[geoms] + noise * levers.sum(1)


def _fixed_rectangles(data: mujoco.MjData, low: float, high: float) -> np.ndarray:
    """Colliding geoms that are fixed to the world, floor and table left out, and are between two heights [m].

    Returns:
        Centre and half sizes of each in x and y [m], shape ``(n, 4)``: the rectangle along the axes that holds it.
    """
    model = data.model
    out = []
    for g in range(model.ngeom):
        geom = model.geom(g)
        collides = bool(geom.contype[0] or geom.conaffinity[0])
        if geom.name in ("floor", "table") or not collides or model.body_weldid[model.geom_bodyid[g]] != 0:
            continue
        if geom.type[0] == mujoco.mjtGeom.mjGEOM_PLANE:  # without end; the floor is the only one in a scene
            continue
        rotation = data.geom_xmat[g].reshape(3, 3)
        center = data.geom_xpos[g] + rotation @ model.geom_aabb[g, :3]
        half = np.abs(rotation) @ model.geom_aabb[g, 3:]
        if center[2] - half[2] < high and center[2] + half[2] > low:
            out.append([*center[:2], *half[:2]])
    return np.array(out).reshape(-1, 4)
