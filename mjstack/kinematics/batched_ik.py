"""Inverse kinematics of many worlds at once, on the worlds' device, and the chain of links that it
reads from a compiled model.
"""

from typing import Any

import mujoco
import numpy as np
import torch
import warp as wp
from numpy import ndarray
from numpy.typing import ArrayLike
from torch import Tensor

from mjstack.config.schema import RobotCfg
from mjstack.errors import ArgumentError, ConfigError, MjstackError
from mjstack.kinematics.ik_kernels import HINGE, SLIDE, Chain, forward_kernel, solve_kernel
from mjstack.robots.bodies import ancestors, forward_kinematics
from mjstack.robots.posture import posture
from mjstack.scene.index import approach_body, joint_limits, locked_home
from mjstack.sim.warp_setup import torch_stream_scope

# m: with a gain, an iterate this close to the target replaces a closer one that came before
_NEAR = 0.00002
# [m/rad] at the target, more with distance. A larger one is calmer near a stretched arm, but slow.
_DAMPING = 0.005
# CUDA threads per block. Few, because a world is one thread, and many processors share the worlds.
_BLOCK_DIM = 32
_MAX_STEP = 0.3  # [rad, m] largest change of any joint per iteration
# [rad, m] off home, of each ik joint: every start has its own branch of solutions
_STARTS = (0.0, -0.6, 0.6)
_DIGITS = 12  # of a chain's numbers: the rest is rounding


def build_chain(
    model: mujoco.MjModel, robot: RobotCfg
) -> tuple[Chain, tuple[int, ...], tuple[int, ...]]:
    """Read the bodies of a compiled model from the world to each site: the chain, in Warp arrays on
    the current device, and kinds and movers of its links, see `solve_kernel`.
    """
    # Columns of the joint targets: the joint of each, those that move, and their limits
    columns = {model.joint(name).id: (column, -1) for column, name in enumerate(robot.joints)}
    moved = [robot.arm_joints.index(name) for name in robot.ik_joints]
    coupling = posture(model, tuple(robot.joints))
    for row, (address, leader) in enumerate(zip(coupling.follows, coupling.leader, strict=True)):
        joint = int(np.flatnonzero(model.jnt_qposadr == address)[0])
        if joint not in columns or columns[joint][0] in moved:
            columns[joint] = (int(leader), row)
    moved = [column for column in moved if column not in coupling.coupled]
    limits = np.tile(np.array([[-np.inf], [np.inf]], dtype=np.float32), len(robot.joints))
    for side, values in enumerate(joint_limits(model, robot)):
        limits[side, moved] = _round_inwards(values[moved], 1.0 - 2.0 * side)

    # Joints from the world to the jaws, and from there to each site
    sites = [model.site(name).id for name in robot.grasp_sites]
    first, second = ({*ancestors(model, model.site_bodyid[site])} for site in sites)
    shared = sorted(first & second)
    trunk, *forks = (
        [joint for joint in sorted(columns) if model.jnt_bodyid[joint] in bodies]
        for bodies in (shared, first - second, second - first)
    )
    joints = [*trunk, *forks[0], *forks[1]]
    kinds = tuple(model.jnt_type[joints].tolist())
    for joint, kind in zip(joints, kinds, strict=True):
        if kind not in (HINGE, SLIDE):
            type_ = mujoco.mjtJoint(kind).name.removeprefix("mjJNT_").lower()
            problem = f"joint '{model.joint(joint).name}' is of type {type_}"
            raise MjstackError(f"{problem}, expected hinge or slide", "Name no other joints")
    rigid = [body for body in shared if not trunk or body >= model.jnt_bodyid[trunk[-1]]]
    body = approach_body(model, robot)
    if body not in rigid:
        names = ", ".join(model.body(b).name for b in rigid) or "none"
        expected = (
            f"a body that carries both grasp sites and that every joint before them moves: {names}"
        )
        raise ConfigError("robot.approach_body", model.body(body).name, expected)
    column, rows = ([columns[joint][k] for joint in joints] for k in (0, 1))
    link = {c: k for k, (c, row) in enumerate(zip(column, rows, strict=True)) if row < 0}
    mover = tuple(link.get(c, -1) if c in moved else -1 for c in column)
    if max(mover, default=-1) < 0 or {*moved} & {*column[len(trunk) :]}:
        expected = f"joints that move both grasp sites, {' and '.join(robot.grasp_sites)}"
        raise ConfigError("robot.ik_joints", robot.ik_joints, expected)

    # Frames with these joints at 0, at their anchors, turned as their bodies; the last: the world
    qpos = model.qpos0.copy()
    qpos[model.jnt_qposadr[joints]] = 0.0
    data = forward_kinematics(model, qpos)
    back = (model.jnt_type == SLIDE) * model.qpos0[model.jnt_qposadr]
    anchors = np.vstack((data.xanchor - back[:, None] * data.xaxis, np.zeros(3)))
    quats = data.xquat[[*model.jnt_bodyid, 0]]
    turns = data.xmat[model.jnt_bodyid].reshape(-1, 3, 3)

    def seen(joint: int, pos: ndarray, quat: ndarray) -> list[float]:
        """A pose in the world seen from a joint's frame, quaternion as Warp has it."""
        at, turn, x, q = (np.empty(n) for n in (3, 4, 3, 4))
        mujoco.mju_negPose(at, turn, anchors[joint], quats[joint])
        mujoco.mju_mulPose(x, q, at, turn, pos, quat)
        return [*x.round(_DIGITS), *np.roll(q, -1).round(_DIGITS)]

    before = [-1, *trunk[:-1], *(j for fork in forks for j in [trunk[-1], *fork][: len(fork)])]
    poses = [seen(b, anchors[j], quats[j]) for b, j in zip(before, joints, strict=True)]
    ends = (
        seen([*trunk, *fork][-1], data.site_xpos[site], quats[-1])[:3]
        for fork, site in zip(forks, sites, strict=True)
    )
    approach = turns[trunk[-1]].T @ data.xmat[body].reshape(3, 3) @ robot.approach_axis

    # The chain
    chain = Chain()
    chain.trunk = len(trunk)
    chain.fork = len(trunk) + len(forks[0])
    chain.end = len(joints)
    chain.first_site, chain.second_site = (wp.vec3(*end) for end in ends)
    chain.approach = wp.vec3(*(approach / np.linalg.norm(approach)).round(_DIGITS))
    chain.frame = wp.array(poses, dtype=wp.transform)
    axes = np.einsum("nji,nj->ni", turns[joints], data.xaxis[joints]).round(_DIGITS)
    chain.axis = wp.array(axes, dtype=wp.vec3)
    chain.kind = wp.array(kinds, dtype=int)
    chain.column = wp.array([max(c, 0) for c in column], dtype=int)
    chain.low = wp.array(limits[0, column], dtype=float)
    chain.high = wp.array(limits[1, column], dtype=float)
    chain.row = wp.array(rows, dtype=int)
    chain.table_low = wp.array(coupling.low, dtype=float)
    chain.table_step = wp.array(coupling.step, dtype=float)
    chain.table_value = wp.array2d(coupling.value, dtype=float)
    return chain, kinds, mover


def _round_inwards(limits: ndarray, sign: float) -> ndarray:
    """Limits as float32 that are not outside of the given ones; sign is 1 for low ones, else -1."""
    rounded = limits.astype(np.float32)
    inwards = np.nextafter(rounded, np.float32(sign * np.inf))
    return np.where(sign * rounded < sign * limits, inwards, rounded)


class BatchedIk:
    """Damped least squares for the grasp point, the midpoint of two sites, in float32.

    A solve is one kernel launch with a fixed number of iterations. It neither reads back to the
    host nor allocates, so a CUDA graph can hold it. Results are buffers of the solver, overwritten
    by the next call.

    Arms have more joints than a point needs. By default each solve takes the shortest way. With
    ``posture_gain`` the spare joints go towards a posture, with ``approach_gain`` they turn the
    gripper's approach axis down or to a given direction. Both move the grasp point off its target
    by 20 um at most, and take a step per solve: the next solve continues.

    Joint positions are in the order of the robot's arm joints and then its gripper joints, in
    float32 or float64. Everything is in the world frame. Joints before the sites that the robot's
    profile does not name are where `Posture` has them.

    Example:
        >>> ik = BatchedIk(model, cfg.robot, nworld=64, device="cpu")
        >>> q, distance = ik.solve(q, target)
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        robot: RobotCfg,
        nworld: int,
        device: str | torch.device,
        *,
        iterations: int = 8,
        posture_gain: float = 0.0,
        approach_gain: float = 0.0,
    ) -> None:
        """Read the chain from the model, allocate, and load the kernels.

        Eight iterations follow a target that moves by millimetres; one anywhere in the workspace
        takes up to 40.

        Args:
            model: A compiled model that contains the robot, alone or in a scene. It is not kept.
            robot: The robot's profile.
            nworld: Number of worlds.
            device: Device of the worlds: ``"cpu"`` or ``"cuda:N"``.
            iterations: Steps per solve. With a gain at least 4, because the last two or three, or a
                quarter of many, go for the target alone.
            posture_gain: Share per iteration of the way to the posture, from 0 to 1.
            approach_gain: Turn per iteration where the approach axis is a quarter turn off [rad],
                from 0 to 1.

        Raises:
            MjstackError: A joint is neither hinge nor slide.
            ArgumentError: Fewer than 4 iterations with a gain.
        """
        # Device and settings
        self.nworld = nworld
        self._device = wp.get_device(str(device))
        self.device = wp.device_to_torch(self._device)
        gained = posture_gain > 0.0 or approach_gain > 0.0
        if gained and iterations < 4:
            raise ArgumentError("iterations", iterations, "at least 4 where a gain is not 0")
        # The last iterations have no gain and undo its cost: measured, 2 of 4, 3 of 8, 10 of 40.
        guided = iterations - max(min(3, iterations // 2), iterations // 4) if gained else 0
        near = _NEAR if gained else -1.0
        gains = (posture_gain, approach_gain)
        self._settings = [iterations, guided, _DAMPING, _MAX_STEP, *gains, near]

        self._coupling = posture(model, tuple(robot.joints))
        self._moving = [robot.joints.index(name) for name in robot.ik_joints]

        # The chain and all buffers, each a Warp array and a torch view of it
        with torch_stream_scope(self._device):
            self._chain, *links = build_chain(model, robot)
            self._array = {
                "home": wp.array(np.tile(locked_home(robot), (nworld, 1)), dtype=float),
                "down": wp.full(nworld, wp.vec3(0.0, 0.0, -1.0), dtype=wp.vec3),
                "distance": wp.zeros(nworld, dtype=float),
            }
            for name in ("q", "posture", "solution"):
                self._array[name] = wp.zeros((nworld, len(robot.joints)), dtype=float)
            for name in ("target", "approach", "point", "closing", "pointing"):
                self._array[name] = wp.zeros(nworld, dtype=wp.vec3)
        self._view = {name: wp.to_torch(array) for name, array in self._array.items()}
        # The buffers are filled before torch's stream writes into them.
        wp.synchronize_device(self._device)

        # Kernels are compiled and loaded here: a capture may do neither.
        self._kernel = solve_kernel(*links)
        self.forward(self._view["q"])
        self.solve(self._view["q"], self._view["target"])
        wp.synchronize_device(self._device)

    def forward(self, q: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Forward kinematics, in one launch, of joint positions [rad, m], shape ``(nworld, n_arm +
        n_gripper)``. Returns the grasp point [m]; the closing axis, a unit vector from the first
        grasp site to the second, zero where they meet; and the approach axis, a unit vector from
        the wrist towards the grasped object. Each has shape ``(nworld, 3)``, float32.
        """
        self._copy_in("q", q)
        self._launch(forward_kernel, ["q"], [], ["point", "closing", "pointing"])
        return self._view["point"], self._view["closing"], self._view["pointing"]

    def solve(
        self,
        q: Tensor,
        target: Tensor,
        posture: Tensor | None = None,
        approach: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Move the robot's ik joints towards a target; the other joints stay as given.

        The ik joints end within the range of the joint and of its actuator, wherever they start.
        The result is never farther from the target than the start within that range; with a gain,
        by at most 20 um. A world whose input is not finite keeps its joint positions, and its
        distance is NaN; the others are not affected.

        Args:
            q: Joint positions to start from [rad, m], shape ``(nworld, n_arm + n_gripper)``.
            target: Target of the grasp point [m], shape ``(nworld, 3)``.
            posture: Joint positions that ``posture_gain`` draws the ik joints to [rad, m], of the
                same shape; the robot's home if None. Without a gain it has no effect.
            approach: Desired approach axis of ``approach_gain``, unit vectors, shape ``(nworld,
                3)``; down if None. Without a gain it has no effect.

        Returns:
            The new joint positions, shape ``(nworld, n_arm + n_gripper)``, and the distance that is
            left [m], shape ``(nworld,)``, both float32.

        Raises:
            ArgumentError: A shape is wrong.
        """
        bend = "home" if posture is None else "posture"
        names = ["q", "target", bend, "down" if approach is None else "approach"]
        for name, values in zip(names, (q, target, posture, approach), strict=True):
            if values is not None:
                self._copy_in(name, values)
        self._launch(self._kernel, names, self._settings, ["solution", "distance"])
        self._coupling.project(self._view["solution"], self._moving)
        return self._view["solution"], self._view["distance"]

    def _launch(
        self, kernel: wp.Kernel, names: list[str], settings: list[Any], results: list[str]
    ) -> None:
        """Run a kernel over the worlds, in torch's order."""
        get = self._array.__getitem__
        inputs = [self._chain, *map(get, names), *settings, *map(get, results)]
        with torch_stream_scope(self._device):
            wp.launch(kernel, dim=self.nworld, inputs=inputs, block_dim=_BLOCK_DIM)

    def _copy_in(self, name: str, values: Tensor) -> None:
        """Copy an argument into float32 memory that keeps its address."""
        buffer = self._view[name]
        if values.shape != buffer.shape:  # else copy_ would broadcast it
            shapes = (f"shape {tuple(shape)}" for shape in (values.shape, buffer.shape))
            raise ArgumentError(name, *shapes)
        buffer.copy_(values)


def find_reach(
    model: mujoco.MjModel, robot: RobotCfg, points: ndarray, gripper: ArrayLike
) -> tuple[Tensor, Tensor]:
    """Bring the grasp point as near to points [m], shape ``(n, 3)``, as possible, from home and
    from both sides of it, without collisions. The gripper's joints are at positions [rad, m] of
    shape ``(n_gripper,)`` or ``(n, n_gripper)``. Returns joint positions, shape ``(3, n, nu)``, and
    the distances that are left [m], shape ``(3, n)``.
    """
    q = np.tile(locked_home(robot), (len(_STARTS), len(points), 1))
    q[..., len(robot.arm_joints) :] = gripper
    moving = [robot.joints.index(name) for name in robot.ik_joints]
    q[..., moving] += np.reshape(_STARTS, (-1, 1, 1))
    targets = torch.from_numpy(np.tile(points, (len(_STARTS), 1)))
    ik = BatchedIk(model, robot, len(targets), "cpu", iterations=40)
    solution, distance = ik.solve(torch.from_numpy(q).flatten(0, 1), targets)
    return solution.view(q.shape), distance.view(q.shape[:2])
