"""Success of any task that has a check: every object is where it belongs."""

import torch

from mjstack.errors import ParameterError
from mjstack.managers.view import EnvView
from mjstack.tasks.check import make_check


class Placed:
    """Achieved while every object of the task's check has been where it belongs, see
    `EpisodeCheck.placed`, for some steps in a row.
    """

    def __init__(self, env: EnvView, *, steps: int = 1) -> None:
        """Allocates the streaks.

        Args:
            env: The environment, its task with a check.
            steps: How many steps in a row.

        Raises:
            MjstackError: The task has no check, or the number is out of range.
        """
        if steps < 1:
            raise ParameterError("steps", steps, "an integer of at least 1")
        self._check = make_check(env.cfg)
        self._view = self._check.view(env)
        self._steps = steps
        self._length = torch.zeros(env.nworld, dtype=torch.int32, device=env.device)

    def __call__(self, env: EnvView) -> torch.Tensor:
        """Processes a step; shape ``(nworld,)``, bool."""
        self._length.add_(1).mul_(self._check.placed(self._view.step()).all(1))
        return self._length >= self._steps

    def reset(self, mask: torch.Tensor) -> None:
        """Forgets the masked worlds."""
        self._length.masked_fill_(mask, 0)
