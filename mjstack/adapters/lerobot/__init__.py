"""mjstack in LeRobot's interfaces: an environment, a policy and a robot, which register themselves.

LeRobot's commands find them by ``--env.discover_packages_path=mjstack.adapters.lerobot``, or
``--robot.`` in the place of ``--env.``.
"""

import sys
from types import TracebackType

from mjstack.errors import MjstackError, describe_error
from mjstack.policy.lerobot import require_lerobot

require_lerobot("mjstack.adapters.lerobot")

from mjstack.adapters.lerobot.env import LerobotVectorEnv, MjstackEnv  # noqa: E402
from mjstack.adapters.lerobot.policy import MjstackConfig, MjstackPolicy  # noqa: E402
from mjstack.adapters.lerobot.robot import MjstackFollower  # noqa: E402

__all__ = ["LerobotVectorEnv", "MjstackConfig", "MjstackEnv", "MjstackFollower", "MjstackPolicy"]


def _print_error(kind: type, error: BaseException, trace: TracebackType | None) -> None:
    """Print an error of ours in one line, also where LeRobot wraps it."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, MjstackError):
        cause = cause.__cause__
    if cause is None:
        _print_others(kind, error, trace)
    else:
        print(f"error: {describe_error(cause)}", file=sys.stderr)


_print_others, sys.excepthook = sys.excepthook, _print_error
