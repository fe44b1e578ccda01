"""Where objects can stand: on the table, apart, clear of what is fixed, and in the arm's reach."""

import itertools
import math
from collections.abc import Sequence
from functools import lru_cache

import mujoco
import numpy as np
import torch
from numpy import ndarray
from torch import Tensor

from mjstack.config.schema import Config, ObjectCfg, SceneCfg
from mjstack.errors import ParameterError
from mjstack.managers.view import EnvView
from mjstack.rng import uniform
from mjstack.robots.bodies import forward_kinematics, solid_geoms, world_boxes
from mjstack.scene.index import gripper_targets
from mjstack.scene.phases import nominal_xy, object_targets, source_names, target_xy

SCHEMA = 2
"""How objects that may meet are placed: 1 was one after the other, 2 is all together."""
GAP = 0.01
"""Free room around an object, unless a term has another [m]."""
_TRIALS = 20_000  # imaginary worlds that try a region before it is used
_SHARE = 2_000  # of them at a time
_FIRST = 3  # candidates that are tried first
# [m] between an object and the arm at its start, noise included: it is the arm that moves away
_ARM_ROOM = 0.001
_GRID = 0.02  # [m] between the positions whose reach is tried
_ROOMY: set[tuple] = set()  # regions that have room, by all that `require_room` depends on
_PLANE = mujoco.mjtGeom.mjGEOM_PLANE
_UNDER = 1e-5  # m: a box is under an object if its top is this much higher at most


def may_meet(scene: SceneCfg, region: Sequence[float], gap: float) -> bool:
    """Whether free objects in a region around their nominal positions, of these half-widths [m],
    can be closer together than a gap [m].
    """
    for a, b in itertools.combinations(scene.free.values(), 2):
        away = np.abs(np.subtract(a.xy, b.xy)) - 2.0 * np.array(region)
        if np.linalg.norm(away.clip(min=0.0)) < a.footprint + b.footprint + gap:
            return True
    return False


class Placement:
    """Tests positions of all free objects in a region around their nominal ones.

    Shapes are rounded up: an object of any yaw is a disc, of half a box's diagonal. A geom of the
    arm, wherever noise puts it, is the box along the world's axes that holds it. One that is fixed
    to the world, such as a wall, is the box along its own axes if it is upright, or a disc. So what
    passes is free, and some free positions are not used. Nothing under an object is in its way.
    """

    def __init__(
        self,
        env: EnvView,
        *,
        region: Sequence[float],
        gap: float,
        pose: Sequence[float],
        noise: float = 0.0,
    ) -> None:
        """Find what could be in the way of objects in a region of these half-widths in x and y [m],
        with a gap between them and around what is fixed to the world [m], for fingers. The robot's
        joints are at ``pose`` [rad, m], those of the arm as far from there as ``noise`` [rad].
        """
        scene = env.cfg.scene
        model = env.sim.model
        objects = list(scene.free.values())
        radii = [thing.footprint for thing in objects]
        self._apart = [[a + b + gap for b in radii] for a in radii]
        data = forward_kinematics(model, env.index.posture.qpos(np.array(pose)))
        mujoco.mj_comPos(model, data)
        geoms = solid_geoms(model)
        owners = model.geom_bodyid[geoms]
        fixtures = [geom for name in env.index.fixed for geom in env.index.geoms[name]]
        bolted = (model.body_weldid[owners] == 0) | np.isin(geoms, fixtures)
        loose = np.isin(owners, list(env.index.bodies.values()))
        arm = _arm_boxes(env.cfg, data, geoms[~bolted & ~loose], noise)
        # Floor, the only plane in a scene, and table are left out.
        ground = (model.geom_type[geoms] == _PLANE) | (geoms == model.geom("table").id)
        fixed = _fixed_boxes(data, geoms[bolted & ~ground])

        rectangles = []
        top = scene.table_top
        for thing in objects:
            around = np.concatenate(
                [_around(thing, top, arm, min(gap, _ARM_ROOM)), _around(thing, top, fixed, gap)]
            )
            cos, sin = around[:, 5:].T
            turn = np.stack((cos, sin, -sin, cos), axis=1).reshape(-1, 2, 2)
            away = np.abs(((around[:, :2] - thing.xy)[:, None] * turn).sum(2)) - around[:, 2:4]
            away -= (np.abs(turn) * region).sum(2)
            near = np.linalg.norm(np.maximum(away, 0.0), axis=1) < around[:, 4]
            rectangles.append(torch.from_numpy(around[near]))
        half = torch.tensor(scene.table_half[:2]).double()
        self._tensors = [
            torch.tensor([thing.xy for thing in objects], dtype=torch.float64).reshape(-1, 2),
            torch.tensor(region).double(),  # rounded to float32, which every start depends on
            torch.tensor(scene.table_center[:2]).double(),
            half - torch.tensor(radii, dtype=torch.float64)[:, None],
            *rectangles,
        ]

    def to(self, device: torch.device, dtype: torch.dtype) -> None:
        """Move the constants to where worlds are placed."""
        self._tensors = [t.to(device, dtype) for t in self._tensors]

    def require_room(self, xy: object, candidates: int) -> None:
        """Try the region on many imaginary worlds, with so many draws per object and world.

        Raises:
            ParameterError: In some of them no candidate fits; names ``xy`` as the user wrote it.
        """
        count = len(self._apart)
        key = (candidates, str(self._apart), *(t.numpy().tobytes() for t in self._tensors))
        if key in _ROOMY:  # every environment of a run asks the same
            return
        draws = _trials(2 * count * candidates).view(_TRIALS, count, candidates, 2)
        # The first few do for most worlds, which saves time.
        hard = draws[~self.choose(draws[:, :, :_FIRST].double())[1]]
        lacking = sum(int((~self.choose(share.double())[1]).sum()) for share in hard.split(_SHARE))
        if lacking:
            problem = f"{candidates} draws found none in {lacking} of {_TRIALS} trials"
            expected = f"a region with a free position for every object; {problem}"
            fix = "Make the region or the gap smaller, or move the objects (scene.objects.NAME.xy)"
            raise ParameterError("xy", xy, expected, fix)
        _ROOMY.add(key)

    def choose(self, draws: Tensor) -> tuple[Tensor, Tensor]:
        """The first candidates that fit together.

        The first free candidate of each object is tried with those of the others, then the second
        of each, and so on. So all sets of free positions that are apart are equally likely.

        Takes x and y in [-1, 1), shape ``(n, objects, candidates, 2)``. Returns offsets from the
        nominal positions [m], shape ``(n, objects, 2)``, 0 for all objects where nothing fits; and
        whether all objects fit, ``(n,)``.
        """
        nominal, region, center, room, *rectangles = self._tensors
        offsets = draws * region
        places = nominal[None, :, None] + offsets
        free = ((places - center).abs() <= room[:, None]).all(-1)
        for number, around in enumerate(rectangles):
            if around.shape[0]:
                x, y = (places[:, number, :, None, :] - around[:, :2]).unbind(-1)
                cos, sin = around[:, 5:].unbind(-1)
                off = torch.stack((cos * x + sin * y, cos * y - sin * x), dim=-1)
                off = off.abs() - around[:, 2:4]
                distance = off.clamp_min(0.0).square().sum(-1)
                free[:, number] &= (distance >= around[:, 4].square()).all(-1)
        # The free candidates of each object first; the k-th of all objects are tried together
        order = (~free).to(torch.uint8).argsort(dim=2, stable=True)
        usable = free.take_along_dim(order, dim=2).all(1)
        offsets = offsets.take_along_dim(order[..., None], dim=2)
        places = nominal[None, :, None] + offsets
        for k, m in itertools.combinations(range(len(rectangles)), 2):
            x, y = (places[:, k] - places[:, m]).unbind(-1)
            usable &= x.square() + y.square() >= self._apart[k][m] ** 2
        first = usable.to(torch.uint8).argmax(1)
        chosen = offsets[torch.arange(len(first), device=first.device), :, first]
        fits = usable.any(1)
        return torch.where(fits[:, None, None], chosen, 0.0), fits


@lru_cache(maxsize=2)
def _trials(size: int) -> Tensor:
    """Draws of the imaginary worlds, shape ``(_TRIALS, size)``: a check tries several regions."""
    world = torch.arange(_TRIALS)
    return uniform(0, 0, world, torch.zeros_like(world), None, size)


_Boxes = tuple[ndarray, ndarray, ndarray]
"""Upright boxes: centres and half sizes, shape ``(n, 3)`` each; radius around them, and cosine and
sine of their yaw, ``(n, 3)``."""


def _around(thing: ObjectCfg, top: float, boxes: _Boxes, clear: float) -> ndarray:
    """Distance that boxes ask of an object: of its centre from a rectangle. Returns the rectangle's
    centre and half sizes in x and y, the distance [m], and cosine and sine of its yaw, shape ``(m,
    7)``, of the boxes that are low enough to matter.
    """
    centers, halves, turned = boxes
    half = thing.half_height
    center = top + half if thing.pos is None else thing.pos[2]
    above = np.maximum(np.abs(centers[:, 2] - center) - halves[:, 2] - half, 0.0)
    under = centers[:, 2] + halves[:, 2] - (center - half) < _UNDER
    matters = ((above < clear) | (above == 0.0)) & ~under
    distance = thing.footprint + np.sqrt(np.maximum(clear**2 - above**2, 0.0)) + turned[:, 0]
    return np.column_stack((centers[:, :2], halves[:, :2], distance, turned[:, 1:]))[matters]


def _fixed_boxes(data: mujoco.MjData, geoms: ndarray) -> _Boxes:
    """Boxes around geoms that are fixed to the world."""
    model = data.model
    centers, halves = world_boxes(data, geoms)
    turned = np.tile([0.0, 1.0, 0.0], (len(geoms), 1))
    axes = data.geom_xmat[geoms].reshape(-1, 3, 3)
    upright = np.abs(axes[:, 2, 2]) > 1.0 - 1e-9
    halves[upright] = model.geom_aabb[geoms[upright], 3:]
    turned[upright, 1:] = axes[upright, :2, 0]
    discs = (mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_SPHERE)
    disc = upright & np.isin(model.geom_type[geoms], discs)
    turned[disc, 0] = halves[disc, 0]
    halves[disc, :2] = 0.0
    return centers, halves, turned


def _arm_boxes(cfg: Config, data: mujoco.MjData, geoms: ndarray, noise: float) -> _Boxes:
    """Boxes that hold the arm's colliding geoms, wherever noise puts them."""
    model = data.model
    joints = [model.joint(name).id for name in cfg.robot.arm_joints]
    dofs = model.jnt_dofadr[joints]
    centers, halves = world_boxes(data, geoms)
    jac = np.empty((3, model.nv))
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    for k, g in enumerate(geoms):
        corners = centers[k] + signs * halves[k]
        moved = np.zeros(3)
        for corner in corners:
            mujoco.mj_jac(model, data, jac, None, corner, model.geom_bodyid[g])
            moved = np.maximum(moved, noise * np.abs(jac[:, dofs]).sum(axis=1))
        # A Jacobian leaves out at most half the square of all joints' angle, times the lever.
        lever = np.linalg.norm(data.xanchor[joints][None] - corners[:, None], axis=2).max()
        halves[k] += moved + 0.5 * (noise * len(joints)) ** 2 * lever
    return centers, halves, np.tile([0.0, 1.0, 0.0], (len(geoms), 1))


def require_reach(env: EnvView, region: Sequence[float]) -> None:
    """Try a grid over each object's region, as far as it is on the table.

    Raises:
        ParameterError: The arm cannot follow a phase at an object somewhere there.
    """
    scene = env.cfg.scene
    center = np.array(scene.table_center[:2])
    for thing, spec in scene.free.items():
        room = np.array(scene.table_half[:2]) - spec.footprint  # as `Placement` has it, for any yaw
        ends = np.array(spec.xy) + np.outer((-1.0, 1.0), region)
        axes = [
            np.unique(np.linspace(low, high, max(5, 1 + math.ceil((high - low) / _GRID))))
            for low, high in np.clip(ends, center - room, center + room).T
        ]
        xy = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
        if failure := out_of_reach(env, thing, xy):
            expected = f"a region that the arm reaches; {failure[1]}"
            fix = f"Make the region smaller, or move the object (scene.objects.{thing}.xy)"
            raise ParameterError(
                "xy", region, expected, f"{fix}; tools/reachability.py draws a map"
            )


def out_of_reach(env: EnvView, name: str, xy: np.ndarray) -> tuple[int, str] | None:
    """The position of an object that is farthest out of reach, by its row in ``xy``, where it may
    stand [m], shape ``(n, 2)``, and a sentence on it; None if the arm reaches them all.
    """
    from mjstack.kinematics.batched_ik import find_reach  # loads Warp

    # How far the grasp point stays from each target at each position
    scene = env.cfg.scene
    targets = object_targets(env.cfg)[name]
    sources = np.tile(nominal_xy(scene), (len(xy), 1, 1))
    sources[:, source_names(scene).index(name)] = xy
    points = np.empty((len(xy), len(targets), 3))
    for column, (_, target) in enumerate(targets):
        points[:, column, :2] = target_xy(target, sources)
        points[:, column, 2] = target.z
    model, robot = env.sim.model, env.cfg.robot
    grips = gripper_targets(model, robot, [phase.width for phase, _ in targets])
    _, left = find_reach(model, robot, points.reshape(-1, 3), np.tile(grips, (len(xy), 1)))
    distances = left.amin(0).view(len(xy), -1).numpy()
    if (distances <= env.cfg.controller.ik_tolerance).all():
        return None

    # The farthest in words
    row, column = (int(k) for k in np.unravel_index(distances.argmax(), distances.shape))
    x, y = xy[row]
    phase, target = targets[column]
    height = target.z - scene.table_top - scene.objects[name].half_height
    where = "at its centre" if abs(height) < 5e-4 else f"{1e3 * height:.0f} mm above its centre"
    point = f"with {name} at ({x:.3f}, {y:.3f}) m the point {where} (phase {phase.name})"
    return row, f"{point} is {1e3 * distances[row, column]:.1f} mm out of reach"
