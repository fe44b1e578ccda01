"""Drivers give the joint targets of every world, step by step, and the phase of each world."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch

from mjstack.config.schema import Config
from mjstack.drivers.open_loop import JointTrajectory
from mjstack.errors import ArgumentError
from mjstack.scene.phases import Phase


class Driver(ABC):
    """Gives the joint targets of every world, one step at a time. Fixed shapes, no host read: a
    captured graph may hold it.

    Attributes:
        phases: The phases, laid out as a world without a retry goes through them. Empty for a
            driver without phases, such as a policy: a check judges every step of its episode.
        steps: Length of the episode.
        phase: Number of the phase that each world's last command belonged to, shape ``(nworld,)``,
            int64.
        error: Largest distance from a target that inverse kinematics left [m], shape ``(nworld,)``.
        retries: Grasps that were tried again, shape ``(nworld,)``, int32.
    """

    def __init__(
        self, nworld: int, steps: int, device: torch.device, phases: Sequence[Phase] = ()
    ) -> None:
        """Allocate for the worlds; ``steps`` is the length of the episode."""
        self.phases = list(phases)
        self.steps = steps
        self.phase = torch.zeros(nworld, dtype=torch.int64, device=device)
        self.error = torch.zeros(nworld, device=device)
        self.retries = torch.zeros(nworld, dtype=torch.int32, device=device)

    @abstractmethod
    def command(self) -> torch.Tensor:
        """Commands of the next step, shape ``(nworld, nu)``."""


def require_joint_targets(cfg: Config, expected: str) -> None:
    """Check that an environment takes absolute joint targets in every control step.

    Args:
        cfg: Its configuration.
        expected: Words for such actions.

    Raises:
        ArgumentError: It takes other actions, or holds them.
    """
    if list(cfg.action.values()) != list(cfg.controller.action.values()):
        fix = "Build it with action=joint_absolute"
        raise ArgumentError("env", "other actions", expected, fix)
    held = cfg.timing.policy_decimation
    if held > 1:
        expected = "one for each, which a driver gives"
        fix = "Build it with timing.policy_decimation=1"
        raise ArgumentError("env", f"actions for {held} control steps", expected, fix)


class Recorded(Driver):
    """Joint targets of an episode of another driver, to be given again.

    Memory: ``steps * nworld * (4 * nu + 2)`` bytes on the device, 0.85 GB for 2,000 steps of 16,384
    worlds with six joint targets. ``job=replay`` needs none of it: it plays a world from its seed.
    """

    def __init__(self, source: Driver, nu: int) -> None:
        """Allocate for the worlds and steps of a driver, whose commands are nu wide; NaN until they
        are written.
        """
        nworld = len(source.phase)
        device = source.phase.device
        super().__init__(nworld, source.steps, device, source.phases)
        self.error = source.error
        self.retries = source.retries
        shape = (self.steps, nworld, nu)
        self._commands = torch.full(shape, torch.nan, dtype=torch.float32, device=device)
        self._phases = torch.zeros((self.steps, nworld), dtype=torch.int16, device=device)
        self._next = torch.zeros(1, dtype=torch.int64, device=device)

    def append(self, command: torch.Tensor, phase: torch.Tensor) -> None:
        """Take the next step's command, ``(nworld, nu)``, and phase, ``(nworld,)``. No
        host read.
        """
        self._commands.index_copy_(0, self._next, command[None].float())
        self._phases.index_copy_(0, self._next, phase[None].to(torch.int16))
        self._next.add_(1)

    def rewind(self) -> "Recorded":
        """Repeat from the first step on; returns itself."""
        self._next.zero_()
        return self

    def command(self) -> torch.Tensor:
        """Commands of the next step, shape ``(nworld, nu)``."""
        out = self._commands.index_select(0, self._next)[0]
        self.phase.copy_(self._phases.index_select(0, self._next)[0])
        self._next.add_(1).clamp_(max=self.steps - 1)  # past the end the last one holds
        return out


class OpenLoopDriver(Driver):
    """Plays joint trajectories once, from the start that they were planned for: every world is in
    the same phase.
    """

    def __init__(self, trajectory: JointTrajectory, phases: list[Phase]) -> None:
        """Take the trajectory, which must be on the device."""
        device = trajectory.knots.device
        super().__init__(len(trajectory.knots), trajectory.steps, device, phases)
        self.error = torch.as_tensor(trajectory.waypoint_error, device=device)
        self._trajectory = trajectory
        numbers = [
            number for number, phase in enumerate(phases) for _ in range(phase.start, phase.stop)
        ]
        self._phase_at = torch.tensor(numbers, device=device)
        self._next = torch.zeros(1, dtype=torch.int64, device=device)

    def command(self) -> torch.Tensor:
        """Commands of the next step, shape ``(nworld, nu)``."""
        out = self._trajectory.command(self._next)
        self.phase.copy_(self._phase_at.index_select(0, self._next).expand_as(self.phase))
        self._next.add_(1).clamp_(max=self.steps - 1)  # past the end the last one holds
        return out
