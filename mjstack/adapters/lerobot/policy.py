"""LeRobot's policy ``mjstack``: one that ``job=export job.format=lerobot`` has written."""

from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies import PreTrainedPolicy
from torch import Tensor

from mjstack.drivers.policy import GRID
from mjstack.errors import ArgumentError, ConfigError
from mjstack.policy import Policy, load_policy
from mjstack.policy.lerobot import IMAGES, SEEN, STATE
from mjstack.robots.units import LerobotUnits


@PreTrainedConfig.register_subclass("mjstack")
@dataclass
class MjstackConfig(PreTrainedConfig):
    """config.json of such a policy; the rest is in mjstack's own files beside it.

    Attributes:
        joint_range: Limits of the joint targets [rad, m].
    """

    joint_range: list[list[float]] = field(default_factory=list)
    observation_delta_indices = action_delta_indices = reward_delta_indices = None

    def get_optimizer_preset(self) -> Any:
        """Refuse to be trained by LeRobot."""
        expected = "a policy that LeRobot trains"
        raise ConfigError("policy.type", self.type, expected, "Train it: mjstack job=train")

    get_scheduler_preset = get_optimizer_preset

    def validate_features(self) -> None:
        """Leave that to the environment, which checks the actions' width."""


class MjstackPolicy(PreTrainedPolicy):
    """Joint targets of a network, as `PolicyDriver` gives them.

    All worlds are queried together, every so many steps from `reset` on.
    """

    config_class = MjstackConfig
    name = "mjstack"
    forward = get_optim_params = None  # LeRobot does not train it

    def __init__(self, config: MjstackConfig, policy: Policy) -> None:
        super().__init__(config)
        # As PolicyDriver has it
        self.network = policy.network if "cuda" in config.device else policy.network.double()
        self._execute = policy.execute
        self._seen = STATE if STATE in config.input_features else SEEN
        robot = policy.config["robot"]
        self._units = LerobotUnits(len(robot["arm_joints"]), np.array(config.joint_range))
        relative = any(t.func.endswith("relative") for t in policy.observation.terms.values())
        self._home = np.array(robot["home"]) * relative
        self._queue: deque[Tensor] = deque()

    @classmethod
    def from_pretrained(
        cls, pretrained_name_or_path: str | Path, *, config: MjstackConfig, **kwargs: Any
    ) -> "MjstackPolicy":
        """Load a local folder."""
        return cls(config, load_policy(Path(pretrained_name_or_path))).to(config.device).eval()

    def reset(self) -> None:
        """Begin new episodes."""
        self._queue.clear()

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Joint targets in LeRobot's units, shape ``(n, chunk, joints)``; an ArgumentError for an
        observation of another width.
        """
        seen = batch[self._seen]
        network = self.network
        width = len(network.observation_mean)
        if seen.shape[-1] != width:
            expected = f"{width}: name the policy's folder, --env.policy=FOLDER"
            raise ArgumentError(self._seen, f"{seen.shape[-1]} numbers", expected)
        if self._seen == STATE:
            seen = torch.from_numpy(self._units.to_si(seen.cpu().numpy()) - self._home)
        seen = seen.float().to(network.action_mean)
        images = [
            (255.0 * batch[f"{IMAGES}.{name}"]).round().permute(0, 2, 3, 1).to(seen)
            for name in network.vision.sizes
        ]
        chunk = (torch.round(network(seen, images) * GRID) / GRID).float()
        return torch.from_numpy(self._units.from_si(chunk.cpu().numpy())).to(seen.device)

    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Joint targets of the next step, shape ``(n, joints)``."""
        if not self._queue:
            chunk = self.predict_action_chunk(batch)
            steps = range(self._execute)
            self._queue.extend(chunk[:, min(k, chunk.shape[1] - 1)] for k in steps)
        return self._queue.popleft()
