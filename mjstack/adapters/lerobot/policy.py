"""LeRobot's policy ``mjstack``: one that ``job=export job.format=lerobot`` has written."""

import copy
from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies import PreTrainedPolicy
from lerobot.processor.factory import make_default_pre_post_processors
from torch import Tensor

from mjstack.drivers.policy import GRID
from mjstack.errors import ArgumentError, ConfigError
from mjstack.policy import PolicyNetwork, Vision
from mjstack.policy.lerobot import IMAGES, SEEN, STATE
from mjstack.robots.units import LerobotUnits

make_mjstack_pre_post_processors = make_default_pre_post_processors  # by this name LeRobot finds it


@PreTrainedConfig.register_subclass("mjstack")
@dataclass
class MjstackConfig(PreTrainedConfig):
    """What config.json of such a policy has beside its features.

    Attributes:
        chunk: Actions of one query.
        execute: Control steps between two queries.
        hidden: Widths of the network's hidden layers.
        channels: Channels of its convolutions.
        features: Numbers that it takes from each image.
        joint_range: Limits of the joint targets [rad, m].
        arm_joints: How many of the joints, the first ones, are the arm's.
        home: What the network's joint positions are relative to [rad, m].
        robot_type: The robot that it was trained for.
        task: The task.
        fps: Its control rate [Hz].
    """

    chunk: int = 1
    execute: int = 1
    hidden: list[int] = field(default_factory=list)
    channels: list[int] = field(default_factory=list)
    features: int = 0
    joint_range: list[list[float]] = field(default_factory=list)
    arm_joints: int = 0
    home: list[float] = field(default_factory=list)
    robot_type: str = ""
    task: str = ""
    fps: int = 30

    @property
    def observation_delta_indices(self) -> None:
        """It sees the current observation."""

    @property
    def action_delta_indices(self) -> list[int]:
        """Steps of a chunk."""
        return list(range(self.chunk))

    @property
    def reward_delta_indices(self) -> None:
        """It uses no rewards."""

    def get_optimizer_preset(self) -> Any:
        """See `get_scheduler_preset`."""
        return self.get_scheduler_preset()

    def get_scheduler_preset(self) -> Any:
        """LeRobot does not train it.

        Raises:
            ConfigError: Always.
        """
        expected = "a policy that LeRobot trains"
        raise ConfigError("policy.type", self.type, expected, "Train it: mjstack job=train")

    def validate_features(self) -> None:
        """Check that the actions are those of the network.

        Raises:
            ArgumentError: They have another width.
        """
        width = self.action_feature.shape[0] if self.action_feature else 0
        if width != len(self.joint_range):
            expected = f"{len(self.joint_range)}, as the policy was trained"
            raise ArgumentError("action", f"{width} numbers", expected, "Set --env.robot")


class MjstackPolicy(PreTrainedPolicy):
    """Joint targets of a network, as `PolicyDriver` gives them.

    All worlds are queried together, every ``execute`` steps from `reset` on.
    """

    config_class = MjstackConfig
    name = "mjstack"

    def __init__(self, config: MjstackConfig, **kwargs: Any) -> None:
        """Make the network, whose weights are loaded afterwards."""
        super().__init__(config)
        config.validate_features()
        inputs = config.input_features
        sizes = {
            key.removeprefix(f"{IMAGES}."): feature.shape[1:]
            for key, feature in inputs.items()
            if key.startswith(IMAGES)
        }
        self._seen = STATE if STATE in inputs else SEEN
        (self._width,) = inputs[self._seen].shape
        vision = Vision(sizes=sizes, channels=config.channels, features=config.features)
        width = len(config.joint_range)
        self.network = PolicyNetwork(self._width, width, config.chunk, config.hidden, vision)
        self._units = LerobotUnits(config.arm_joints, np.array(config.joint_range))
        self._home = np.array(config.home)
        self._exact: PolicyNetwork | None = None
        self._queue: deque[Tensor] = deque()

    def reset(self) -> None:
        """Begin new episodes."""
        self._queue.clear()

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Joint targets in LeRobot's units, shape ``(n, chunk, joints)``.

        Raises:
            ArgumentError: The observation has another width.
        """
        seen = batch[self._seen]
        if seen.shape[-1] != self._width:
            expected = f"{self._width}, as the policy was trained"
            fix = "Name its folder: --env.policy=FOLDER"
            raise ArgumentError(self._seen, f"{seen.shape[-1]} numbers", expected, fix)
        if self._seen == STATE:
            positions = self._units.to_si(seen.cpu().numpy()) - self._home
            seen = torch.from_numpy(positions).float().to(seen.device)
        network = self.network
        if not seen.is_cuda:  # as PolicyDriver has it
            self._exact = network = self._exact or copy.deepcopy(self.network).double()
        dtype = network.action_mean.dtype
        images = [
            (255.0 * batch[f"{IMAGES}.{name}"]).round().permute(0, 2, 3, 1).to(dtype)
            for name in network.vision.sizes
        ]
        chunk = network(seen.to(dtype), images)
        chunk = (torch.round(chunk * GRID) / GRID).float()
        return torch.from_numpy(self._units.from_si(chunk.cpu().numpy())).to(seen.device)

    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Joint targets of the next step, shape ``(n, joints)``."""
        if not self._queue:
            chunk = self.predict_action_chunk(batch)
            last = chunk.shape[1] - 1
            self._queue.extend(chunk[:, min(k, last)] for k in range(self.config.execute))
        return self._queue.popleft()

    def get_optim_params(self) -> Any:
        """See `MjstackConfig.get_scheduler_preset`."""
        return self.config.get_scheduler_preset()

    def forward(self, batch: dict[str, Tensor]) -> Any:
        """See `MjstackConfig.get_scheduler_preset`."""
        return self.config.get_scheduler_preset()
