"""Base class of the drivers with feedback: where the objects are, where each phase leads from
there, batched inverse kinematics, and the tilt of a grasp.
"""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import mujoco
import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from mjstack.config.schema import Config
from mjstack.drivers.driver import Assets, Driver, require_actions
from mjstack.envs import Env
from mjstack.errors import ArgumentError
from mjstack.kinematics.batched_ik import BatchedIk
from mjstack.managers.view import EnvView
from mjstack.math import atan2
from mjstack.mdp.geometry import objects_in_hand, place_xy, pose_w, robot, zeros
from mjstack.scene.index import gripper_targets, turn_sign
from mjstack.scene.phases import Phase, Target, build_phases, source_names

_BEYOND = 10.0  # what a roll beyond the joint's range costs, per rad
_BACK = 3.0  # rad: what a roll counts that leads back over the nominal one
_SETTLING = 20  # solutions after which spare joints are where they stay
_FARTHER = 6  # more iterations for an arm that somebody else has moved
STAY = 0.3  # how much a roll made so far weighs against the face that is nearer


class State(NamedTuple):
    """The measured state: joints; speed of the fastest joint of the arm; grasp point, closing and
    approach axis; opening of the gripper; position of every object, and whether all jaws press on
    it.
    """

    q: Tensor
    speed: Tensor
    point: Tensor
    closing: Tensor
    approach: Tensor
    opening: Tensor
    pos: Tensor
    in_hand: Tensor


class CarryTilt:
    """Desired approach axis of every world: at the grasp, as the release pose needs it; from then
    on, as it was at the grasp.

    An arm that grasps near its base can point straight down, and far from it must tilt. An object
    grasped upright would arrive there tilted by the difference, on an edge, and may fall. So a
    virtual copy of the arm tracks the release pose, a few iterations per step, and gives its tilt.
    The open gripper keeps its tilt until it observes the next object, so that it does not turn the
    released one.

    The desired axis turns about the vertical with the arm's first joint: its angle to the vertical
    is kept.
    """

    def __init__(
        self, env: EnvView, phases: Sequence[Phase], ik: BatchedIk, nominal: Tensor
    ) -> None:
        """Allocate for the worlds of a driver with these phases, solver and nominal commands, shape
        ``(phases, nu)``, float32; a ConfigError if the arm's first joint is not vertical.
        """
        self._ik = ik
        self._nominal = nominal
        self._there_ik = _solver(env)
        self._sign = turn_sign(env.sim.model, env.cfg.robot)
        self._keeps = torch.tensor(_keeps(phases), device=env.device)
        self._grasps = torch.tensor([phase.grasped >= 0 for phase in phases], device=env.device)
        self.place = torch.tensor(_places(phases), device=env.device)
        self._there = nominal.new_zeros((ik.nworld, nominal.shape[1]))
        self._last_axis = nominal.new_zeros((ik.nworld, 3))
        self._last_turn = nominal.new_zeros(ik.nworld)
        # Of the nominal plan, with the gripper as upright as it can be
        self._settled = nominal.clone()
        for row in self._settled:
            arm = row.expand(ik.nworld, -1)
            point = self._there_ik.forward(arm)[0].clone()
            for _ in range(_SETTLING):
                arm = self._there_ik.solve(arm, point)[0]
            row.copy_(arm[0])

    def desired_approach(
        self, command: Tensor, phase: Tensor, there: Tensor, fresh: Tensor
    ) -> Tensor:
        """Desired approach axis of the next step, unit vectors, shape ``(nworld, 3)``, float32.
        Fixed shapes, no host read.

        Args:
            command: Joint positions at which the arm starts [rad, m], shape ``(nworld, nu)``,
                float32.
            phase: Number of each world's phase, shape ``(nworld,)``, int64.
            there: Target of the phase ``place[phase]``, where the next object or the held one is
                released [m], shape ``(nworld, 3)``.
            fresh: Worlds that start an episode, shape ``(nworld,)``, bool.
        """
        start = torch.where(fresh[:, None], self._nominal[self.place[phase]], self._there)
        self._there.copy_(self._there_ik.solve(start, there)[0])
        grasps = self._grasps[phase]
        keeps = self._keeps[phase]
        approach = self._ik.forward(command)[2]
        self._last_axis.copy_(torch.where(grasps[:, None], approach, self._last_axis))
        self._last_turn.copy_(torch.where(grasps, command[:, 0], self._last_turn))
        axis = self._there_ik.forward(self._there)[2]
        axis = torch.where(keeps[:, None], self._last_axis, axis)
        since = torch.where(keeps, self._last_turn, self._there[:, 0])
        return _turn_about_z(axis, self._sign * (command[:, 0] - since))

    def release_approach(self, command: Tensor, phase: Tensor, there: Tensor) -> Tensor:
        """Approach axis of the release pose, turned about the vertical to where the arm looks; from
        these arguments alone, which are those of `desired_approach`. Fixed shapes, no host read.
        """
        arm = self._there_ik.solve(self._settled[self.place[phase]], there)[0]
        axis = self._there_ik.forward(arm)[2]
        return _turn_about_z(axis, self._sign * (command[:, 0] - arm[:, 0]))


def _turn_about_z(vectors: Tensor, angle: Tensor) -> Tensor:
    """Vectors, shape ``(..., 2)`` or ``(..., 3)``, turned about the vertical [rad], ``(...)``."""
    x, y, *z = vectors.unbind(-1)
    cos = torch.cos(angle)
    sin = torch.sin(angle)
    return torch.stack((cos * x - sin * y, sin * x + cos * y, *z), dim=-1)


def _keeps(phases: Sequence[Phase]) -> list[bool]:
    """Whether the tilt of the last grasp is kept in each phase."""
    out = []
    fixed = False
    for phase in phases:
        fixed = fixed and not (phase.spec.observe and phase.spec.gripper == "open")
        out.append(fixed and phase.grasped < 0)
        fixed = fixed or phase.grasped >= 0
    return out


def _places(phases: Sequence[Phase]) -> list[int]:
    """Number of the phase at whose target the next object, or the held one, is released, for each
    phase; after all of them, the last.
    """
    carries = [phase.carried >= 0 for phase in phases] + [False]
    ends = [k for k in range(len(phases)) if carries[k] and not carries[k + 1]] or [len(phases) - 1]
    out = []
    for k in range(len(phases)):
        place = next((end for end in ends if end >= k), ends[-1])
        while place > 0 and phases[place].target is None:  # the target before holds
            place -= 1
        out.append(place)
    return out


class FeedbackDriver(Driver):
    """Base class of drivers that give joint targets from where the objects of every world are."""

    needs_phases = True
    noun = "expert"

    @classmethod
    @override
    def build(cls, env: Env, cfg: Config, assets: Assets) -> Driver:
        return cls.with_params(cfg, env, assets.planner.nominal)

    def __init__(self, env: EnvView, nominal: np.ndarray, *, clock: bool) -> None:
        """Allocate for the worlds of an environment, whose action terms must take absolute joint
        commands. Redundant joints keep close to the nominal plan's commands at the end of each
        phase, shape ``(phases, nu)``. With a clock worlds go through the phases one by one. A
        MjstackError if the environment takes other actions, or worlds have moved on.
        """
        cfg = env.cfg
        device = env.device
        c = cfg.controller
        require_actions(cfg, c.action, "absolute joint commands, which the expert gives")
        if bool((env.episode_step != 0).any()):  # it begins where the environment's episodes do
            value = "worlds that have moved on"
            raise ArgumentError("env", value, "worlds at their start", "Call env.reset() before")
        self._plan = build_phases(cfg)
        steps = self._plan[-1].stop if clock else cfg.task.episode_steps
        super().__init__(env.nworld, steps, device, self._plan if clock else ())
        self._env = env
        self._cfg = cfg
        self._worlds = torch.arange(env.nworld, device=device)
        self._n_arm = env.index.n_arm
        self._nominal = torch.as_tensor(nominal, dtype=torch.float32, device=device)

        # Targets of the phases, a row per phase: without its own, a phase has the one before
        self._aimed: list[tuple[Phase, Target]] = []
        for phase in self._plan:
            self._aimed.append((phase, phase.target) if phase.target else self._aimed[-1])
        targets = [target for _, target in self._aimed]
        self._target = self._tensor([*t.offset, t.z] for t in targets)
        self._source = self._tensor(t.source for t in targets)
        self._toward = self._tensor(t.toward for t in targets)
        grips = gripper_targets(env.sim.model, cfg.robot, [phase.width for phase in self._plan])
        self._grip = self._tensor(grips.tolist())

        # Inverse kinematics, and where the arm stands
        model = env.sim.model
        body = int(model.body_rootid[model.jnt_bodyid[model.joint(cfg.robot.arm_joints[0]).id]])
        self._base = body, self._tensor(model.body_pos[body].tolist())
        self._ik = _solver(env, c.posture_gain)
        # Where nothing is carried, the gripper points down as far as it can.
        grasped = {phase.grasps for phase in c.phases.values()} - {None}
        self._tilt: CarryTilt | None = None
        if c.approach_gain > 0.0 and grasped:
            self._tilt = CarryTilt(env, self._plan, self._ik, self._nominal)
        # Jaws turn to a face, and to the narrower side of what is oblong in any case.
        objects = cfg.scene.objects
        self._long = [name for name, thing in objects.items() if thing.oblong and name in grasped]
        self._oblong = self._tensor(name in self._long for name in objects)
        self._has_faces = self._tensor(thing.has_faces for thing in objects.values())
        self._aligns = c.yaw_alignment > 0.0 or bool(self._long and cfg.robot.roll_joint)
        self._roll_column, self._roll_sign = self._find_roll() if self._aligns else (0, 1.0)
        rolls = robot(env).ctrl_range[self._roll_column].float()
        self._rolls = (rolls - self._nominal[0, self._roll_column]).unbind(0)

        # Buffers: x, y and yaw of objects and places, and the last command
        self._seen = torch.zeros((env.nworld, len(source_names(cfg.scene)), 3), device=device)
        self._command = torch.zeros((env.nworld, len(cfg.robot.home)), device=device)

    def _tensor(self, values: Iterable[object]) -> Tensor:
        """Numbers or truth values, a row for each phase or thing, on the device."""
        return torch.tensor(list(values), device=self.phase.device)

    def _observe(self, due: Tensor) -> None:
        """Measure objects where due, shape ``(nworld, objects)``, bool; and all places."""
        last = self._seen[:, : due.shape[1]]
        last.copy_(torch.where(due[..., None], self._planar(), last))
        for number, name in enumerate(self._cfg.scene.places, start=due.shape[1]):
            self._seen[:, number, :2] = place_xy(self._env, name).float()

    def _planar(self) -> Tensor:
        """x, y [m] and yaw [rad] of every object now, shape ``(nworld, objects, 3)``."""
        objects = self._cfg.scene.objects
        return torch.stack([measure_planar(self._env, name) for name in objects], dim=1)

    def _aim(self, phase: Tensor) -> Tensor:
        """Target of each world's phase, from its anchor as last seen [m], ``(nworld, 3)``; of
        several, ``(nworld, n, 3)``.
        """
        table = self._target[phase]
        seen = self._last_seen(self._source, phase)[..., :2]
        offset = table[..., :2]
        if any(spec.toward is not None for spec in self._cfg.controller.phases.values()):
            away = self._last_seen(self._toward, phase)[..., :2] - seen
            offset = _turn_about_z(offset, atan2(away[..., 1], away[..., 0]))
        return torch.cat((offset + seen, table[..., 2:]), dim=-1)

    def _last_seen(self, sources: Tensor, phase: Tensor) -> Tensor:
        """x, y [m] and yaw [rad] of each world's source of a phase, shape ``(nworld, 3)``; of
        several phases, ``(nworld, n, 3)``.
        """
        worlds = self._worlds if phase.dim() == 1 else self._worlds[:, None]
        return self._seen[worlds, sources[phase]]

    def _measure(self) -> State:
        """The state now."""
        env = self._env
        tensors = robot(env)
        q = tensors.qpos.read(env.sim.qpos).float()
        if (off := zeros(env)) is not None:  # the joints' truth, whatever their servos believe
            q = q + off.float()
        point, closing, approach = self._ik.forward(q)
        grip = (q[:, self._n_arm :] - tensors.gripper_closed) / tensors.gripper_travel
        pos = [pose_w(env, name)[:, :3].float() for name in self._cfg.scene.objects]
        return State(
            q,
            tensors.qvel.read(env.sim.qvel)[:, : self._n_arm].float().abs().amax(1),
            point - self._sunk(),
            closing,
            approach,
            opening=grip.float().amin(1),
            pos=torch.stack(pos, dim=1),
            in_hand=objects_in_hand(env.index, env.sim),
        )

    def _beyond(self, rolls: Tensor) -> Tensor:
        """Cost of rolls beyond the joint's range, from the nominal one [rad]."""
        low, high = self._rolls
        return _BEYOND * ((low - rolls).clamp(min=0.0) + (rolls - high).clamp(min=0.0))

    def _detour(self, rolls: Tensor, roll: Tensor) -> Tensor:
        """Cost of rolls that lead back over the nominal one, lest they go to and fro."""
        return _BACK * (rolls * roll < -0.01)

    def _solve(
        self, start: Tensor, target: Tensor, phase: Tensor, approach: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Inverse kinematics near the posture of each world's phase; as of `BatchedIk.solve`."""
        posture = self._nominal[phase] if self._cfg.controller.posture_gain > 0.0 else None
        return self._ik.solve(start, target + self._sunk(), posture, approach)

    def _sunk(self) -> Tensor | float:
        """How much lower each world's arm stands than in the model, over x, y, z [m]."""
        if "body_pos" not in self._env.sim.fields:
            return 0.0
        body, nominal = self._base
        return nominal - self._env.sim.fields["body_pos"][:, body].float()

    def _as_read(self, command: Tensor) -> Tensor:
        """A command of the joints' true positions, as their servos count it."""
        off = zeros(self._env)
        return command if off is None else command - off.float()

    def _keep_finite(self, command: Tensor) -> Tensor:
        """Keep the command for the next step. A world whose state is not finite keeps its last one,
        and the check fails it.
        """
        return self._command.copy_(torch.where(torch.isfinite(command), command, self._command))

    def _find_roll(self) -> tuple[int, float]:
        """Column of the joint that rolls the gripper, and which way it turns the closing axis, seen
        from above.
        """
        column = self._cfg.robot.joints.index(str(self._cfg.robot.roll_joint))
        command = self._nominal[:1].expand(self._env.nworld, -1).clone()
        closing = []
        for turn in (0.0, 0.1):
            command[:, column] += turn
            closing.append(self._ik.forward(command)[1][0].double().cpu())
        (x0, y0, _), (x1, y1, _) = closing
        return column, math.copysign(1.0, float(x0 * y1 - y0 * x1))


def _solver(env: EnvView, posture_gain: float = 0.0) -> BatchedIk:
    """Inverse kinematics of an environment's worlds, as its controller has it."""
    c = env.cfg.controller
    return BatchedIk(
        env.sim.model,
        env.cfg.robot,
        env.nworld,
        env.device,
        iterations=c.step_iterations + (0 if c.clock else _FARTHER),
        posture_gain=posture_gain,
        approach_gain=c.approach_gain,
    )


def measure_planar(env: EnvView, name: str) -> Tensor:
    """x, y [m] of an object, and the heading of a face of it, or of the narrower side if it is
    oblong [rad], shape ``(nworld, 3)``, float32.
    """
    pose = pose_w(env, name).float()
    w, x, y, z = pose[:, 3:].unbind(1)
    axis, turn = env.cfg.scene.objects[name].heading
    if axis == 0:
        yaw = atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)) + turn
    elif axis == 1:
        yaw = atan2(1.0 - 2.0 * (x * x + z * z), 2.0 * (x * y - w * z)) + turn
    else:
        yaw = atan2(2.0 * (y * z - w * x), 2.0 * (x * z + w * y)) + turn
    return torch.cat((pose[:, :2], yaw[:, None]), dim=1)


def servo_lag(model: mujoco.MjModel, actuators: Sequence[int]) -> float:
    """Longest time constant of some position servos [s]: damping over stiffness."""
    dof = model.jnt_dofadr[model.actuator_trnid[actuators, 0]]
    damping = model.dof_damping[dof] - model.actuator_biasprm[actuators, 2]
    return max(1e-6, float((damping / model.actuator_gainprm[actuators, 0]).max()))
