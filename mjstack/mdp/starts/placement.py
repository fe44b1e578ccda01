"""Where cubes can stand: on the table, apart from each other, clear of the arm and of what is
fixed.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import mujoco
import numpy as np
import torch

from mjstack.config.schema import Config
from mjstack.errors import ParameterError
from mjstack.rng import uniform
from mjstack.scene import SceneIndex, table_top

_TRIALS = 20_000  # imaginary worlds that try a region before it is used
_SHARE = 2_000  # of them at a time
_FIRST = 3  # candidates that are tried first
# [m] between a cube and the arm at its start, noise included: it is the arm that moves away
_ARM_ROOM = 0.001


class Placement:
    """Tests places of both cubes in a region around their nominal ones.

    Shapes are rounded up: a cube of any yaw is a disc of half its diagonal; a geom of the arm,
    wherever noise puts it, or of what is fixed to the world, such as a wall of the box, is the box
    along the axes that holds it. So what passes is free, and some free places are not used.
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
            gap: Free room between cubes, and around what is fixed to the world [m], for fingers.
            pose: Where the robot's joints are [rad, m].
            noise: How far each arm joint may be from there [rad].
        """
        scene = cfg.scene
        half = scene.cube_half
        self._radius = math.sqrt(2.0) * half
        self._apart = 2.0 * self._radius + gap
        self._half = half
        self._height = table_top(scene) + half
        nominal = torch.tensor([scene.red_xy, scene.blue_xy], dtype=torch.float64)
        center = torch.tensor(scene.table_center[:2]).double()
        room = torch.tensor(scene.table_half[:2]).double() - self._radius
        data = mujoco.MjData(model)
        data.qpos[index.robot_qpos] = pose
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        obstacles = [
            self._around(_arm_boxes(cfg, data, index, noise), min(gap, _ARM_ROOM)),
            self._around(_fixed_boxes(data), gap),
        ]
        around = np.concatenate(obstacles)
        near = np.zeros(len(around), dtype=bool)
        for xy in (scene.red_xy, scene.blue_xy):
            away = np.abs(around[:, :2] - xy) - around[:, 2:4] - region
            near |= np.linalg.norm(np.maximum(away, 0.0), axis=1) < around[:, 4]
        rectangles = torch.from_numpy(around[near])
        self._tensors = [nominal, torch.tensor(region).double(), center, room, rectangles]

    def _around(self, boxes: tuple[np.ndarray, np.ndarray], clear: float) -> np.ndarray:
        """What a box asks of a cube on the table: to have its centre some distance from a
        rectangle.

        Returns:
            Centre and half sizes of the rectangle in x and y, and the distance [m], shape ``(m,
            5)``, of the boxes that are low enough to matter.
        """
        centers, halves = boxes
        above = np.maximum(np.abs(centers[:, 2] - self._height) - halves[:, 2] - self._half, 0.0)
        matters = (above < clear) | (above == 0.0)
        distance = self._radius + np.sqrt(np.maximum(clear**2 - above**2, 0.0))
        return np.column_stack((centers[:, :2], halves[:, :2], distance))[matters]

    def to(self, device: torch.device, dtype: torch.dtype) -> None:
        """Moves the constants to where worlds are placed."""
        self._tensors = [t.to(device, dtype) for t in self._tensors]

    def choose(self, draws: torch.Tensor) -> torch.Tensor:
        """The first candidates that fit.

        Args:
            draws: Numbers in [-1, 1), shape ``(n, 2, candidates, 2)``: red and blue, x and y.

        Returns:
            Offsets from the nominal places [m], shape ``(n, 2, 2)``; 0 for both cubes where nothing
            fits.
        """
        return self._choose(draws)[0]

    def require_room(self, name: str, value: object, candidates: int) -> None:
        """Tries the region on many imaginary worlds.

        Raises:
            ParameterError: In some of them no candidate fits.
        """
        world = torch.arange(_TRIALS)
        zero = torch.zeros_like(world)
        draws = uniform(
            seed=0, world=world, episode=zero, step=zero, stream=0, size=4 * candidates
        ).double()
        draws = draws.view(_TRIALS, 2, candidates, 2)
        hard = draws[
            ~self._choose(draws[:, :, :_FIRST])[1]
        ]  # the first few do for most worlds, which saves time
        lacking = sum(int((~self._choose(share)[1]).sum()) for share in hard.split(_SHARE))
        if lacking:
            raise ParameterError(
                name,
                value,
                f"a region with a free place for both cubes; {candidates} draws found none in"
                f" {lacking} of {_TRIALS} trials",
                "Make the region smaller, the gap smaller, or move the cubes (scene.red_xy,"
                " scene.blue_xy)",
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
            raise ParameterError(
                name,
                value,
                "cubes that stay on the table, apart from each other and clear of the arm",
            )

    def _choose(self, draws: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        nominal, region, center, room, rectangles = self._tensors
        offsets = draws * region
        places = nominal[None, :, None] + offsets
        free = ((places - center).abs() <= room).all(-1)
        if rectangles.shape[0]:
            away = (
                (places[..., None, :] - rectangles[:, :2]).abs() - rectangles[:, 2:4]
            ).clamp_min(0.0)
            free &= (away.square().sum(-1) >= rectangles[:, 4].square()).all(-1)
        x, y = (places[:, 0, :, None] - places[:, 1, None]).unbind(-1)
        fits = (x.square() + y.square() >= self._apart**2) & free[:, 0, :, None] & free[:, 1, None]
        first = (
            fits.flatten(1).to(torch.uint8).argmax(1)
        )  # red's first candidate that goes with one of blue's
        rows = torch.arange(draws.shape[0], device=draws.device)
        candidates = draws.shape[2]
        red = first // candidates
        blue = first % candidates
        both = fits.flatten(1).any(1)
        chosen = torch.stack((offsets[rows, 0, red], offsets[rows, 1, blue]), dim=1)
        return torch.where(both[:, None, None], chosen, 0.0), both


def _arm_boxes(
    cfg: Config, data: mujoco.MjData, index: SceneIndex, noise: float
) -> tuple[np.ndarray, np.ndarray]:
    """Centres and half sizes of boxes that hold the arm's colliding geoms, wherever noise puts
    them, shape ``(n, 3)`` each.
    """
    model = data.model
    body = model.geom_bodyid
    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    fixed = model.body_weldid[body] == 0
    geoms = np.flatnonzero(collides & ~fixed & ~np.isin(body, list(index.bodies.values())))
    joints = [model.joint(name).id for name in cfg.robot.arm_joints]
    dofs = model.jnt_dofadr[joints]
    centers, halves = _boxes(data, geoms)
    jac = np.empty((3, model.nv))
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    for k, g in enumerate(geoms):
        corners = centers[k] + signs * halves[k]
        moved = np.zeros(3)
        for corner in corners:
            mujoco.mj_jac(model, data, jac, None, corner, body[g])
            moved = np.maximum(moved, noise * np.abs(jac[:, dofs]).sum(axis=1))
        # What a Jacobian leaves out: at most half the square of the angle, all joints together,
        # times the longest lever.
        lever = np.linalg.norm(data.xanchor[joints][None] - corners[:, None], axis=2).max()
        halves[k] += moved + 0.5 * (noise * len(joints)) ** 2 * lever
    return centers, halves


def _fixed_boxes(data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
    """The same of what collides and is fixed to the world, floor and table left out."""
    model = data.model
    geoms = []
    for g in range(model.ngeom):
        geom = model.geom(g)
        collides = bool(geom.contype[0] or geom.conaffinity[0])
        if (
            geom.name in ("floor", "table")
            or not collides
            or model.body_weldid[model.geom_bodyid[g]] != 0
        ):
            continue
        if (
            geom.type[0] != mujoco.mjtGeom.mjGEOM_PLANE
        ):  # without end; the floor is the only one in a scene
            geoms.append(g)
    return _boxes(data, np.array(geoms, dtype=int))


def _boxes(data: mujoco.MjData, geoms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres and half sizes of the boxes along the world's axes that hold some geoms, shape ``(n,
    3)`` each.
    """
    model = data.model
    rotation = data.geom_xmat[geoms].reshape(-1, 3, 3)
    centers = data.geom_xpos[geoms] + np.einsum("nij,nj->ni", rotation, model.geom_aabb[geoms, :3])
    return centers, np.einsum("nij,nj->ni", np.abs(rotation), model.geom_aabb[geoms, 3:])
