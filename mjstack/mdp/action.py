"""Action terms: classes that turn a slice of the action into actuator commands."""

from __future__ import annotations

import math

import torch

from mjstack.errors import ParameterError, UnknownName
from mjstack.managers.action import ActionTerm
from mjstack.managers.view import EnvView
from mjstack.mdp.geometry import named_pose, robot
from mjstack.scene.index import Columns

MODES = ("relative", "absolute", "delta")
PARTS = ("arm", "gripper", "all")


class JointPosition(ActionTerm):
    """Position commands of some joints, kept within the actuators' ranges.

    ``relative``: a pose of the robot's, home by default, plus ``scale`` times the action.
        ``absolute``: the action itself
    [rad, m]. ``delta``: the last command plus ``scale`` times the action. Actions of the first and
    the last kind count from -1 to 1.
    """

    def __init__(
        self,
        env: EnvView,
        *,
        joints: str | list[str],
        mode: str = "relative",
        scale: float = 1.0,
        pose: str = "home",
    ) -> None:
        """Chooses joints.

        Args:
            env: The environment.
            joints: ``arm``, ``gripper``, ``all``, or names of joints.
            mode: One of `MODES`.
            scale: Command for an action of 1 [rad, m]; not used by ``absolute``.
            pose: ``home`` or ``start``: what ``relative`` counts from.

        Raises:
            MjstackError: A joint or mode does not exist, or the scale is not finite.
        """
        if mode not in MODES:
            raise UnknownName("action mode", mode, MODES)
        _check_scale(scale)
        names = [*env.cfg.robot.arm_joints, *env.cfg.robot.gripper_joints]
        n = len(names)
        n_arm = env.index.n_arm
        if isinstance(joints, str):
            if joints not in PARTS:
                raise UnknownName("action joints", joints, PARTS)
            chosen = (
                list(range(n))
                if joints == "all"
                else list(range(n_arm))
                if joints == "arm"
                else list(range(n_arm, n))
            )
        else:
            for name in joints:
                if name not in names:
                    raise UnknownName("action joint", name, names)
            chosen = [names.index(name) for name in joints]
            if not chosen or len(set(chosen)) < len(chosen):
                raise ParameterError("joints", joints, "at least one joint, each once")
        tensors = robot(env)
        self._ctrl = env.sim.ctrl
        self._mode = mode
        self._scale = scale
        self._columns = Columns(env.index.ctrl[chosen], env.device)
        self._pose = named_pose(env, pose)[chosen]
        self._low, self._high = tensors.ctrl_range[chosen].unbind(1)
        self.dim = len(chosen)
        self.actuators = tuple(env.index.ctrl[chosen].tolist())
        self.low, self.high = (
            (self._low, self._high) if mode == "absolute" else _unit_bounds(self.dim, self._pose)
        )
        self.unit = "rad, m" if mode == "absolute" else "-1 to 1"

    def write_commands(self, action: torch.Tensor) -> None:
        """Writes the commands of its joints."""
        if self._mode == "absolute":
            command = action
        elif self._mode == "relative":
            command = self._pose + self._scale * action.clamp(-1.0, 1.0)
        else:
            command = self._columns.read(self._ctrl) + self._scale * action.clamp(-1.0, 1.0)
        self._columns.write(self._ctrl, torch.clamp(command, self._low, self._high))


class Gripper(ActionTerm):
    """One number for all fingers: -1 is closed, 1 is open, as the robot's profile has them."""

    def __init__(self, env: EnvView) -> None:
        """Reads the profile."""
        tensors = robot(env)
        self._ctrl = env.sim.ctrl
        self._columns = Columns(env.index.ctrl[env.index.n_arm :], env.device)
        self._closed = tensors.gripper_closed
        self._opening = tensors.gripper_open - tensors.gripper_closed
        self.dim = 1
        self.actuators = tuple(env.index.ctrl[env.index.n_arm :].tolist())
        self.low, self.high = _unit_bounds(1, tensors.home)

    def write_commands(self, action: torch.Tensor) -> None:
        """Writes the fingers' commands."""
        self._columns.write(
            self._ctrl, self._closed + 0.5 * (action.clamp(-1.0, 1.0) + 1.0) * self._opening
        )


class EndEffectorDelta(ActionTerm):
    """Moves the commanded grasp point by ``scale`` times the action in x, y and z, by batched
    inverse kinematics.

    It starts from the last command, not from the measured joints, so that the arm does not sag by
    its servo error at every step; and it keeps no target of its own, so that nothing winds up at
    the edge of the reach. The gripper's last command counts too: where a jaw swings, as SO-101's
    does, closing it moves the grasp point, by up to 16 mm there.
    """

    def __init__(self, env: EnvView, *, scale: float, iterations: int = 8) -> None:
        """Builds the solver.

        Args:
            env: The environment.
            scale: Distance for an action of 1 [m per step].
            iterations: Steps of damped least squares per step.

        Raises:
            MjstackError: A parameter is out of range.
        """
        from mjstack.kinematics.batched_ik import (
            BatchedIk,
        )  # loads Warp, which other actions do not need

        _check_scale(scale)
        if iterations < 1:
            raise ParameterError("iterations", iterations, "an integer of at least 1")
        tensors = robot(env)
        self._ctrl = env.sim.ctrl
        self._columns = tensors.ctrl
        self._n_arm = env.index.n_arm
        self._arm = Columns(env.index.ctrl[: env.index.n_arm], env.device)
        self._low, self._high = tensors.ctrl_range.unbind(1)
        self._scale = scale
        self._ik = BatchedIk(
            env.sim.model, env.cfg.robot, env.nworld, env.device, iterations=iterations
        )
        self.dim = 3
        self.actuators = tuple(env.index.ctrl[: env.index.n_arm].tolist())
        self.low, self.high = _unit_bounds(3, tensors.home)

    def write_commands(self, action: torch.Tensor) -> None:
        """Writes the arm's commands."""
        last = self._columns.read(self._ctrl)
        target = self._ik.forward(last)[0] + self._scale * action.clamp(-1.0, 1.0).float()
        command, _ = self._ik.solve(last, target)
        command = command[:, : self._n_arm].to(self._ctrl.dtype)
        self._arm.write(
            self._ctrl, torch.clamp(command, self._low[: self._n_arm], self._high[: self._n_arm])
        )


def _unit_bounds(dim: int, like: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    ones = torch.ones(dim, dtype=like.dtype, device=like.device)
    return -ones, ones


def _check_scale(scale: float) -> None:
    if not (math.isfinite(scale) and scale > 0.0):
        raise ParameterError("scale", scale, "a positive number")
