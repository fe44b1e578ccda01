"""Success of a step: conditions have held for some steps; for any task that has a check, that every
object is where it belongs.
"""

from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor

from mjstack.config.fields import Count, Fraction
from mjstack.managers.state import branches
from mjstack.managers.view import EnvView
from mjstack.tasks.parts import Condition, released


class HeldSuccess:
    """Achieved while conditions have held for some steps in a row."""

    def __init__(self, env: EnvView, conditions: Sequence[Condition], steps: int) -> None:
        """Allocate the streaks.

        Args:
            env: The environment.
            conditions: All have to hold, each shape ``(nworld, n)``, bool.
            steps: How many steps in a row.
        """
        self._conditions = [partial(env.state.value, condition) for condition in conditions]
        self._steps = steps
        self._length = torch.zeros(env.nworld, dtype=torch.int32, device=env.device)

    def __call__(self, env: EnvView) -> Tensor:
        """Process a step; shape ``(nworld,)``, bool."""
        # Mostly the host can see that nothing holds, whatever the other conditions say
        if not self._length.is_cuda and not bool(self._conditions[0]().all(1).any()):
            self._length.zero_()
            return torch.zeros_like(self._length, dtype=torch.bool)
        holds = torch.cat(branches(env.device, *self._conditions), dim=1)
        self._length.add_(1).mul_(holds.all(1))
        return self._length >= self._steps

    def reset(self, mask: Tensor) -> None:
        """Forget the masked worlds."""
        self._length.masked_fill_(mask, 0)


class Placed(HeldSuccess):
    """Achieved while every object of the task's check has been where it belongs, see
    `EpisodeCheck.placed`, for some steps in a row.
    """

    def __init__(
        self, env: EnvView, *, steps: Count = 1, open_fraction: Fraction | None = None
    ) -> None:
        """Allocate the streaks.

        Args:
            env: The environment, its task with a check.
            steps: How many steps in a row.
            open_fraction: How far the gripper must be open, as measured, while no jaw touches an
                object; by default nothing has to be let go of.

        Raises:
            MjstackError: The task has no check, or the number is out of range.
        """
        conditions: list[Condition] = [env.check.placed]
        if open_fraction is not None:
            conditions.append(released(*env.check.objects, open_fraction=open_fraction))
        super().__init__(env, conditions, steps)
