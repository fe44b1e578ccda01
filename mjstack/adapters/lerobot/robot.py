"""LeRobot's robot ``mjstack_follower``: one world of a task in the place of a real arm."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from lerobot.cameras import CameraConfig
from lerobot.motors import MotorCalibration
from lerobot.robots import Robot, RobotConfig

from mjstack.adapters.lerobot.env import LerobotVectorEnv, MjstackEnv

_TICKS = 4095 / (2.0 * np.pi)  # of a servo's encoder [1/rad]


@CameraConfig.register_subclass("mjstack")
@dataclass(kw_only=True)
class MjstackCameraConfig(CameraConfig):
    """A camera of the scene, by its name among the robot's cameras."""


@RobotConfig.register_subclass("mjstack_follower")
@dataclass(kw_only=True)
class MjstackFollowerConfig(RobotConfig):
    """The world: the SO-101 at 30 Hz, unless overrides say otherwise.

    Attributes:
        seed: Number of the start.
        cameras: As of a real arm, of type ``mjstack``.
        overrides: As of `MjstackEnv`.
        config_dir: A folder with more choices, as of `MjstackEnv`.
    """

    seed: int = 0
    cameras: dict[str, CameraConfig] = field(default_factory=dict)
    overrides: list[str] = field(default_factory=list)
    config_dir: str | None = None


class MjstackFollower(Robot):
    """An arm that moves by one control step with each action, as fast as LeRobot sends them.

    It has names, units and features of the real follower, and its ``robot_type``. Its zeros are the
    middles of its joints' ranges, so it always is calibrated.
    """

    config_class = MjstackFollowerConfig
    name = "so_follower"  # its recordings are to be merged with those of the real one
    is_calibrated = True

    def __init__(self, config: MjstackFollowerConfig) -> None:
        """Compose the world, which `connect` makes.

        Raises:
            MjstackError: It cannot be composed.
        """
        super().__init__(config)
        self.cameras = config.cameras
        sizes = [f"scene.cameras.{k}.size=[{c.height},{c.width}]" for k, c in self.cameras.items()]
        overrides = ["sim=native", *sizes, *config.overrides]
        world = MjstackEnv(
            cameras=[*self.cameras], overrides=overrides, config_dir=config.config_dir
        )
        self._cfg = world.compose()
        self._seed = config.seed
        self._world: LerobotVectorEnv | None = None
        self._seen: dict[str, Any] = {}

    @property
    def action_features(self) -> dict[str, type]:
        """A target for each joint, as the real follower names it."""
        return {f"{name}.pos": float for name in self._cfg.robot.joints}

    @property
    def observation_features(self) -> dict[str, Any]:
        """The measured joints, and the shape of each camera's images."""
        shapes = {name: (c.height, c.width, 3) for name, c in self.cameras.items()}
        return {**self.action_features, **shapes}

    @property
    def is_connected(self) -> bool:
        """Whether there is a world."""
        return self._world is not None

    def connect(self, calibrate: bool = True) -> None:
        """Make the world, and start it.

        Raises:
            MjstackError: There is no follower of such a robot, or no such world.
        """
        self._world = LerobotVectorEnv(self._cfg, 1, endless=True)
        self._seen, _ = self._world.reset(seed=self._seed)
        half = 0.5 * _TICKS * np.diff(self._world.inner.index.ctrl_range)[:, 0]
        self.calibration = {
            name: MotorCalibration(k, 0, 0, round(2047.5 - ticks), round(2047.5 + ticks))
            for k, (name, ticks) in enumerate(zip(self._cfg.robot.joints, half, strict=True), 1)
        }

    def configure(self) -> None:
        """Nothing: overrides choose servos, and files of a real arm's calibration stay as they are,
        though they may have the same ``id``.
        """

    calibrate = configure

    def get_observation(self) -> dict[str, Any]:
        """The joints in degrees, the gripper from 0 to 100, and images."""
        joints = dict(zip(self.action_features, self._seen["agent_pos"][0].tolist(), strict=True))
        return joints | {name: image[0] for name, image in self._seen.get("pixels", {}).items()}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Move by one control step.

        Raises:
            ArgumentError: A joint is missing, or the targets are radians.
        """
        targets = {name: float(action[name]) for name in self.action_features if name in action}
        assert self._world is not None
        self._seen, *_ = self._world.step(np.array([[*targets.values()]], np.float32))
        return targets

    def disconnect(self) -> None:
        """Close the world."""
        if self._world is not None:
            self._world.close()
            self._world = None
