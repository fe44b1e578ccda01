"""Action terms: classes that turn a slice of the action into actuator commands."""

from typing import Literal

import numpy as np
import torch
from torch import Tensor

from mjstack.config.fields import Fraction, NotNegative, Positive, Repeats
from mjstack.errors import ParameterError, UnknownName
from mjstack.managers.action import ActionTerm
from mjstack.managers.view import EnvView
from mjstack.math import atan2, norm
from mjstack.mdp.geometry import Pose, robot, zeros
from mjstack.sim.simulation import Columns

_TILT_STEP = 0.03  # rad: how far `EndEffectorDelta` tilts the gripper in a step at most


class _Commands(ActionTerm):
    """Commands of some of the robot's actuators, from actions of -1 to 1."""

    def _set_up(self, env: EnvView, chosen: list[int] | slice, dim: int) -> None:
        self._env = env
        self._ctrl = env.sim.ctrl
        self._columns = Columns(env.index.ctrl[chosen], env.device)
        self._chosen = Columns(np.arange(len(env.index.ctrl))[chosen], env.device)
        adjacent = isinstance(self._columns.at, slice)
        self._out = self._columns.read(self._ctrl) if adjacent else None
        self._low, self._high = robot(env).ctrl_range[chosen].unbind(1)
        self.actuators = self._columns.indices
        self.dim = dim
        self.high = torch.ones(dim, dtype=self._ctrl.dtype, device=env.device)
        self.low = -self.high

    def _write_bounded(self, command: Tensor) -> None:
        """Write commands, kept within the actuators' ranges, which count from the joints' zeros."""
        low, high = self._low, self._high
        if (off := zeros(self._env)) is not None:
            low, high = (end - self._chosen.read(off).to(end) for end in (low, high))
        self._write(torch.clamp(command, low, high, out=self._out))

    def _write(self, command: Tensor) -> None:
        """Write commands, unless they are computed in their place."""
        if self._out is None:
            self._columns.write(self._ctrl, command)


class JointPosition(_Commands):
    """Position commands of some joints, kept within the actuators' ranges.

    ``relative``: a pose of the robot's, home by default, plus ``scale`` times the action.
    ``absolute``: the action itself [rad, m]. ``delta``: the last command plus ``scale`` times the
    action. Actions of the first and the last kind count from -1 to 1.
    """

    def __init__(
        self,
        env: EnvView,
        *,
        joints: str | list[str],
        mode: Literal["relative", "absolute", "delta"] = "relative",
        scale: Positive = 1.0,
        pose: Pose = "home",
    ) -> None:
        """Choose joints.

        Args:
            env: The environment.
            joints: ``arm``, ``gripper``, ``all``, or one or more names of joints.
            mode: See the class.
            scale: Command for an action of 1 [rad, m]; not used by ``absolute``.
            pose: ``home`` or ``start``: what ``relative`` counts from.

        Raises:
            MjstackError: A joint does not exist.
        """
        profile = env.cfg.robot
        names = profile.joints
        parts = {"arm": profile.arm_joints, "gripper": profile.gripper_joints, "all": names}
        if isinstance(joints, str):
            joints = parts.get(joints, [joints])
        for name in joints:
            if name not in names:
                raise UnknownName("action joint", name, [*parts, *names])
        chosen = [names.index(name) for name in joints]
        if not chosen or len(set(chosen)) < len(chosen):
            raise ParameterError("joints", joints, "at least one joint, each once")
        self._set_up(env, chosen, len(chosen))
        self._mode = mode
        self._scale = scale
        self._pose = getattr(robot(env), pose)[chosen]
        if mode == "absolute":
            self.unit = "rad, m"
            self.low, self.high = self._low, self._high
        elif mode == "relative":  # the command of an action beyond 1 is that of 1
            low, high = self._low, self._high
            self._low = torch.clamp(self._pose - scale, low, high)
            self._high = torch.clamp(self._pose + scale, low, high)

    def write_commands(self, action: Tensor) -> None:
        """Write the commands of its joints."""
        if self._mode == "relative":
            action = self._pose + self._scale * action
        elif self._mode == "delta":
            action = self._columns.read(self._ctrl) + self._scale * action.clamp(-1.0, 1.0)
        self._write_bounded(action)


class Gripper(_Commands):
    """One number for all fingers: -1 is closed, 1 is open, as the robot's profile has them.

    With ``step`` it moves the last command instead: an action of 0 keeps hold of what is held, and
    noise does not drop it at once.
    """

    def __init__(self, env: EnvView, *, step: Fraction = 0.0) -> None:
        """Read the profile.

        Args:
            env: The environment.
            step: Share of the opening for an action of 1 [per step]; 0: the action is absolute.
        """
        self._step = step
        self._set_up(env, slice(env.index.n_arm, None), dim=1)
        self._closed = robot(env).gripper_closed
        self._half_travel = 0.5 * robot(env).gripper_travel

    def write_commands(self, action: Tensor) -> None:
        """Write the fingers' commands."""
        action = action.clamp(-1.0, 1.0)
        if self._step:
            last = (self._columns.read(self._ctrl) - self._closed) / self._half_travel - 1.0
            action = (last + 2.0 * self._step * action).clamp(-1.0, 1.0)
        opening = (action + 1.0) * self._half_travel
        self._write(torch.add(self._closed, opening, out=self._out))


class EndEffectorDelta(_Commands):
    """Moves the commanded grasp point by ``scale`` times the action in x, y and z, by batched
    inverse kinematics. With ``roll`` one more number turns the gripper about its approach axis.
    With ``tilt`` another one says how far it tilts away from the base.

    It starts from the last command, not from the measured joints, so that the arm does not sag by
    its servo error at every step; and it keeps no target itself, so that nothing winds up at
    the edge of the reach. The gripper's last command counts too: where a jaw swings, as SO-101's
    does, closing it moves the grasp point, by up to 16 mm there.
    """

    def __init__(
        self,
        env: EnvView,
        *,
        scale: Positive,
        iterations: Repeats = 8,
        roll: NotNegative = 0.0,
        upright: Fraction = 0.0,
        tilt: NotNegative = 0.0,
    ) -> None:
        """Build the solver.

        Args:
            env: The environment.
            scale: Distance for an action of 1 [m per step].
            iterations: Steps of damped least squares per step.
            roll: Turn of ``robot.roll_joint`` for an action of 1 [rad per step]; 0 for none.
            upright: How strongly the joints that the position leaves free point the gripper down,
                as ``approach_gain`` of `BatchedIk`; 0 leaves them where they are.
            tilt: Angle from straight down for an action of 1 [rad]; for -1 the gripper points down,
                as it always does with 0.

        Raises:
            ParameterError: The robot has no joint that rolls the gripper and nothing else; or the
                gripper is to tilt where ``upright`` is 0.
        """
        # Loads Warp, which other actions do not need.
        from mjstack.kinematics.batched_ik import BatchedIk

        self._n_arm = env.index.n_arm
        self._set_up(env, slice(self._n_arm), dim=3 + bool(roll) + bool(tilt))
        if tilt and not upright:
            raise ParameterError("tilt", tilt, "0, because upright is 0")
        self._tilt = tilt
        self._base = torch.tensor(env.index.base, device=env.device)
        self._all = robot(env).ctrl
        self._scale = scale
        profile = env.cfg.robot
        self._roll = None
        if roll:
            name = profile.roll_joint
            if name is None or name in profile.ik_joints:
                expected = f"0, because robot.roll_joint={name} is not free"
                raise ParameterError("roll", roll, expected)
            self._roll = torch.zeros_like(robot(env).home)  # how far each joint turns
            self._roll[profile.joints.index(name)] = roll
            self._limits = robot(env).ctrl_range.unbind(1)
        self._ik = BatchedIk(
            env.sim.model,
            profile,
            env.nworld,
            env.device,
            iterations=iterations,
            approach_gain=upright,
        )

    def write_commands(self, action: Tensor) -> None:
        """Write the arm's commands."""
        last = self._all.read(self._ctrl)
        action = action.clamp(-1.0, 1.0)
        point, _, approach = self._ik.forward(last)
        desired = None
        if self._tilt:
            desired = self._tilted(point, approach, action[:, -1].float())
        target = point + self._scale * action[:, :3].float()
        if self._roll is not None:
            last = torch.clamp(last + self._roll * action[:, 3:4], *self._limits)
        command, _ = self._ik.solve(last, target, approach=desired)
        self._write_bounded(command[:, : self._n_arm].to(self._ctrl.dtype))

    def _tilted(self, point: Tensor, approach: Tensor, action: Tensor) -> Tensor:
        """The approach axis turned towards the desired tilt, by a step at most, in the vertical
        plane through the base and the grasp point.
        """
        goal = 0.5 * (action + 1.0) * self._tilt
        away = point[:, :2] - self._base
        away /= norm(away)[:, None]
        now = atan2((approach[:, :2] * away).sum(1), -approach[:, 2])
        angle = now + (goal - now).clamp(-_TILT_STEP, _TILT_STEP)
        return torch.cat((torch.sin(angle)[:, None] * away, -torch.cos(angle)[:, None]), dim=1)
