"""LeRobot's robot ``mjstack_follower``: one world of a task in the place of a real arm."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from lerobot.cameras import CameraConfig
from lerobot.motors import MotorCalibration
from lerobot.robots import Robot, RobotConfig

from mjstack.adapters.lerobot.env import LerobotVectorEnv, MjstackEnv
from mjstack.errors import ArgumentError

_TICKS = 4095 / (2.0 * np.pi)  # of a servo's encoder [1/rad]


@CameraConfig.register_subclass("mjstack")
@dataclass(kw_only=True)
class MjstackCameraConfig(CameraConfig):
    """A camera of the scene, by its name among the robot's cameras."""


@RobotConfig.register_subclass("mjstack_follower")
@dataclass(kw_only=True)
class MjstackFollowerConfig(RobotConfig):
    """The world; fields as of `MjstackEnv`.

    Attributes:
        seed: Number of the start.
        cameras: As of a real arm, of type ``mjstack``.
    """

    task: str | None = None
    robot: str = "so101"
    fps: int = 30
    seed: int = 0
    cameras: dict[str, CameraConfig] = field(default_factory=dict)
    overrides: list[str] = field(default_factory=list)
    config_dir: str | None = None


class MjstackFollower(Robot):
    """An arm that moves by one control step with each action, as fast as LeRobot sends them.

    It has names, units and features of the real follower, and its ``robot_type``.
    """

    config_class = MjstackFollowerConfig
    name = "so_follower"  # its recordings are to be merged with those of the real one

    def __init__(self, config: MjstackFollowerConfig) -> None:
        """Compose the world, which `connect` makes.

        Raises:
            MjstackError: It cannot be composed, or there is no follower of such a robot.
        """
        super().__init__(config)
        self.config = config
        self.cameras = config.cameras
        sizes = [
            f"scene.cameras.{name}.size=[{camera.height},{camera.width}]"
            for name, camera in config.cameras.items()
        ]
        world = MjstackEnv(
            task=config.task,
            robot=config.robot,
            fps=config.fps,
            cameras=[*config.cameras],
            overrides=["sim=native", *sizes, *config.overrides],
            config_dir=config.config_dir,
        )
        self._cfg = world.compose()
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

    @property
    def is_calibrated(self) -> bool:
        """Always: its zeros are the middles of its joints' ranges."""
        return True

    def connect(self, calibrate: bool = True) -> None:
        """Make the world, and start it."""
        self._world = world = LerobotVectorEnv(self._cfg, 1, endless=True)
        self._seen, _ = world.reset(seed=self.config.seed)
        self.calibrate()

    def calibrate(self) -> None:
        """Say what a calibration of these joints would have found. A file of a real arm's, which
        may have the same ``id``, is not touched.
        """
        assert self._world is not None
        half = 0.5 * _TICKS * np.diff(self._world.inner.index.ctrl_range)[:, 0]
        self.calibration = {
            name: MotorCalibration(k, 0, 0, round(2047.5 - ticks), round(2047.5 + ticks))
            for k, (name, ticks) in enumerate(zip(self._cfg.robot.joints, half, strict=True), 1)
        }

    def configure(self) -> None:
        """Nothing: ``actuator`` among the overrides chooses the servos."""

    def get_observation(self) -> dict[str, Any]:
        """The joints in degrees, the gripper from 0 to 100, and images."""
        joints = dict(zip(self.action_features, self._seen["agent_pos"][0].tolist(), strict=True))
        return joints | {name: image[0] for name, image in self._seen.get("pixels", {}).items()}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Move by one control step.

        Raises:
            ArgumentError: A joint is missing, or the targets are radians.
        """
        assert self._world is not None
        if missing := self.action_features.keys() - action.keys():
            expected = f"a target for each of {', '.join(self.action_features)}"
            raise ArgumentError("action", f"none for {', '.join(sorted(missing))}", expected)
        targets = {name: float(action[name]) for name in self.action_features}
        self._seen, *_ = self._world.step(np.array([[*targets.values()]], np.float32))
        return targets

    def disconnect(self) -> None:
        """Close the world."""
        if self._world is not None:
            self._world.close()
            self._world = None
