"""Drivers give the actions of every world, step by step, and the phase of each world."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from mjstack.config.schema import Config, TermCfg
from mjstack.drivers.open_loop import JointTrajectory
from mjstack.errors import ArgumentError
from mjstack.scene.phases import Phase


class Driver(ABC):
    """Gives the actions of every world, one step at a time. Fixed shapes, no host read: a captured
    graph may hold it. The actions are those of its environment's terms: joint targets of an expert
    or a plan.

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
    def command(self) -> Tensor:
        """Actions of the next step, shape ``(nworld, action_dim)``."""


def require_actions(cfg: Config, terms: Mapping[str, TermCfg], expected: str) -> None:
    """Check that an environment takes a driver's actions in every control step.

    Args:
        cfg: Its configuration.
        terms: The driver's action terms.
        expected: Words for such actions.

    Raises:
        ArgumentError: It has other action terms, or repeats an action.
    """
    if list(cfg.action.values()) != list(terms.values()):
        targets = terms == cfg.controller.action
        fix = "action=joint_absolute" if targets else "the action terms of its policy.json"
        raise ArgumentError("env", "other actions", expected, f"Build it with {fix}")
    repeats = cfg.timing.policy_decimation
    if repeats > 1:
        expected = "one for each, which a driver gives"
        fix = "Build it with timing.policy_decimation=1"
        raise ArgumentError("env", f"actions for {repeats} control steps", expected, fix)


class OpenLoopDriver(Driver):
    """Plays joint trajectories once, from the start that they were planned for: every world is in
    the same phase.
    """

    def __init__(self, trajectory: JointTrajectory, phases: list[Phase]) -> None:
        """Take the trajectory, which must be on the device, and its phases, if it has any."""
        device = trajectory.knots.device
        super().__init__(len(trajectory.knots), len(trajectory.weights), device, phases)
        self.error = torch.as_tensor(trajectory.waypoint_error, device=device)
        self._trajectory = trajectory
        numbers = [k for k, phase in enumerate(phases) for _ in range(phase.start, phase.stop)]
        self._phase_at = torch.tensor(numbers or [0] * self.steps, device=device)
        self._next = torch.zeros(1, dtype=torch.int64, device=device)

    def command(self) -> Tensor:
        """Commands of the next step, shape ``(nworld, nu)``."""
        out = self._trajectory.command(self._next)
        self.phase.copy_(self._phase_at.index_select(0, self._next).expand_as(self.phase))
        self._next.add_(1).clamp_(max=self.steps - 1)  # past the end the last one holds
        return out
