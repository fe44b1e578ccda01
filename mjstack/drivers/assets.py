"""The scene, the plan and the policy that drivers are made of."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import mujoco

from mjstack.config.schema import Config
from mjstack.drivers.open_loop import OpenLoopPlanner
from mjstack.errors import ConfigError
from mjstack.policy import Policy, load_policy
from mjstack.policy.lerobot import PREFIX, load_lerobot
from mjstack.scene import SceneIndex, build_model
from mjstack.sim import resolve_backend


@dataclass(eq=False)
class Assets:
    """Scene, plan and policy, each built once when it is first needed.

    Attributes:
        cfg: The configuration of scene, robot and phases.
    """

    cfg: Config

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The scene for physics."""
        return build_model(self.cfg)

    @cached_property
    def visual_model(self) -> mujoco.MjModel:
        """The same scene with everything that only pictures need."""
        return build_model(self.cfg, visuals=True)

    @cached_property
    def index(self) -> SceneIndex:
        """Addresses in the model."""
        return SceneIndex(self.model, self.cfg.robot, self.cfg.scene)

    @cached_property
    def planner(self) -> OpenLoopPlanner:
        """The planner, its nominal plan made."""
        return OpenLoopPlanner(self.cfg)

    @cached_property
    def policy(self) -> Policy:
        """The policy of ``controller=policy``.

        Raises:
            MjstackError: There is none, or it cannot be read.
        """
        if self.cfg.policy is None:
            expected = "the folder of a trained policy, which controller=policy plays"
            raise ConfigError("policy", None, expected)
        return load_policy(self.cfg.policy)

    @cached_property
    def lerobot_policy(self) -> tuple[Any, Any, Any] | None:
        """That of ``policy=lerobot:FOLDER``, as of `load_lerobot`; None if the policy is ours."""
        name = self.cfg.policy or ""
        return load_lerobot(name, resolve_backend(self.cfg)[1]) if name.startswith(PREFIX) else None
