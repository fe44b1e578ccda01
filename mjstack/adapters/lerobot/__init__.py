"""mjstack in LeRobot's interfaces: an environment, a policy and a robot, which register themselves.

LeRobot's commands find them by ``--env.discover_packages_path=mjstack.adapters.lerobot``, or
``--robot.`` in the place of ``--env.``.
"""

from mjstack.policy.lerobot import require_lerobot

require_lerobot("mjstack.adapters.lerobot")

from mjstack.adapters.lerobot.env import LerobotVectorEnv, MjstackEnv  # noqa: E402
from mjstack.adapters.lerobot.policy import MjstackConfig, MjstackPolicy  # noqa: E402
from mjstack.adapters.lerobot.robot import MjstackFollower  # noqa: E402

__all__ = ["LerobotVectorEnv", "MjstackConfig", "MjstackEnv", "MjstackFollower", "MjstackPolicy"]
