"""Success of any task that has a check: every object is where it belongs."""

import torch
from torch import Tensor

from mjstack.config.fields import Count, Fraction
from mjstack.managers.view import EnvView
from mjstack.tasks.check import make_check
from mjstack.tasks.parts import Condition, HeldSuccess, released


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
        check = make_check(env.cfg)
        view = check.view(env)
        asked: list[Condition] = [check.placed]
        if open_fraction is not None:
            asked.append(released(*check.objects, open_fraction=open_fraction))

        def holds() -> Tensor:
            step = view.step()
            return torch.cat([condition(step) for condition in asked], dim=1).all(1)

        super().__init__(env, holds, steps)
