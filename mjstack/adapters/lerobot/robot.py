"""LeRobot's robot ``mjstack_follower``: one world of a task in the place of a real arm."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from lerobot.cameras import CameraConfig
from lerobot.motors import MotorCalibration
from lerobot.robots import Robot, RobotConfig

from mjstack.adapters.lerobot.env import LerobotVectorEnv, MjstackEnv
from mjstack.policy.lerobot import IMAGES, STATE

_TICKS = 4095 / (2.0 * np.pi)  # of a servo's encoder [1/rad]
_ENDLESS = "task.episode_steps=1000000"  # nine hours


@CameraConfig.register_subclass("mjstack")
@dataclass(kw_only=True)
class MjstackCameraConfig(CameraConfig):
    """A camera of the scene, by its name among the robot's cameras."""


@RobotConfig.register_subclass("mjstack_follower")
@dataclass(kw_only=True)
class MjstackFollowerConfig(RobotConfig):
    """The world: the SO-101 at 30 Hz, unless overrides say otherwise; fields as of `MjstackEnv`.

    Attributes:
        seed: Number of the start.
        cameras: As of a real arm, of type ``mjstack``.
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
    is_connected = False
    action_features: Any = None  # these two are each instance's
    observation_features: Any = None

    def __init__(self, config: MjstackFollowerConfig) -> None:
        """Compose the world, which `connect` makes."""
        super().__init__(config)
        self.cameras = config.cameras
        sizes = [f"scene.cameras.{k}.size=[{c.height},{c.width}]" for k, c in self.cameras.items()]
        self._cfg = MjstackEnv(
            cameras=[*self.cameras],
            overrides=["sim=native", _ENDLESS, *sizes, *config.overrides],
            config_dir=config.config_dir,
        ).compose()
        self._seed = config.seed
        self.action_features = {f"{name}.pos": float for name in self._cfg.robot.joints}
        shapes = {name: (c.height, c.width, 3) for name, c in self.cameras.items()}
        self.observation_features = {**self.action_features, **shapes}

    def connect(self, calibrate: bool = True) -> None:
        """Make the world, and start it."""
        self._world = LerobotVectorEnv(self._cfg, 1, [*self.cameras])
        self._world.reset(seed=[self._seed])
        self.is_connected = True
        half = 0.5 * _TICKS * np.diff(self._world.inner.index.servo_range)[:, 0]
        self.calibration = {
            name: MotorCalibration(k, 0, 0, round(2047.5 - ticks), round(2047.5 + ticks))
            for k, (name, ticks) in enumerate(zip(self._cfg.robot.joints, half, strict=True), 1)
        }

    def calibrate(self) -> None:
        """Do nothing: a real arm's file of the same ``id`` stays as it is."""

    configure = calibrate

    def get_observation(self) -> dict[str, Any]:
        """The joints in degrees, the gripper from 0 to 100, and images."""
        seen = self._world.words.observe()
        joints = dict(zip(self.action_features, seen[STATE][0].tolist(), strict=True))
        return joints | {name: seen[f"{IMAGES}.{name}"][0] for name in self.cameras}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Move by one control step; an ArgumentError if a joint is missing, or for radians."""
        targets = {name: float(action[name]) for name in self.action_features if name in action}
        self._world.step(np.array([[*targets.values()]], np.float32))
        return targets

    def disconnect(self) -> None:
        """Close the world."""
        if self.is_connected:
            self._world.close()
        self.is_connected = False
