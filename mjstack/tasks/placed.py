"""Success of any task that has a check: every object is where it belongs."""

from mjstack.config.fields import Count
from mjstack.managers.view import EnvView
from mjstack.tasks.check import make_check
from mjstack.tasks.parts import HeldSuccess


class Placed(HeldSuccess):
    """Achieved while every object of the task's check has been where it belongs, see
    `EpisodeCheck.placed`, for some steps in a row.
    """

    def __init__(self, env: EnvView, *, steps: Count = 1) -> None:
        """Allocate the streaks.

        Args:
            env: The environment, its task with a check.
            steps: How many steps in a row.

        Raises:
            MjstackError: The task has no check, or the number is out of range.
        """
        check = make_check(env.cfg)
        view = check.view(env)
        super().__init__(env, lambda: check.placed(view.step()).all(1), steps)
