"""The driver of LeRobot's policies, which ``controller=lerobot`` names."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from mjstack.config.schema import Config
from mjstack.drivers.driver import Assets, Driver
from mjstack.drivers.policy import QueryImages
from mjstack.envs.env import Env
from mjstack.errors import ArgumentError, ConfigError, FolderError
from mjstack.managers.observation import ObservationManager
from mjstack.policy.lerobot import IMAGES, SEEN, STATE, load_lerobot
from mjstack.robots.units import LEROBOT, LerobotUnits
from mjstack.sim import resolve_backend

GROUP = "policy"  # the observation group that is LeRobot's environment_state


class LerobotWords:
    """Observations and joint targets of an environment as LeRobot has them, in its ``units``."""

    def __init__(
        self, env: Env, seen: Mapping[str, Tensor], images: Mapping[str, Tensor], units: str
    ) -> None:
        """Take what there is to see: the observation group, if any, and the cameras' images."""
        self._env = env
        self._seen = seen
        self._images = images
        self._joints = env.index.on(env.device, env.sim.qpos.dtype).qpos
        self.units = LerobotUnits(env.index.n_arm, env.index.servo_range, units)

    def observe(self) -> dict[str, np.ndarray]:
        """The observations, by LeRobot's names. A number that is not finite becomes 0: the check
        fails its world.
        """
        positions = self._joints.read(self._env.sim.qpos)
        seen = {STATE: self.units.from_si(positions.cpu().numpy())}
        for group in self._seen.values():
            seen[SEEN] = group.float().cpu().numpy()
        seen = {name: np.nan_to_num(part, posinf=0.0, neginf=0.0) for name, part in seen.items()}
        for name, image in self._images.items():
            seen[f"observation.{name}"] = image.to("cpu", copy=True).numpy()
        return seen

    def targets(self, actions: np.ndarray) -> Tensor:
        """Joint targets [rad, m], shape ``(nworld, joints)``, float32, of such actions; an
        ArgumentError if they have another width, or are radians where degrees are due.
        """
        env = self._env
        shape = (env.nworld, len(env.index.ctrl))
        if actions.shape != shape:
            expected = f"shape {shape}, a target for each joint"
            raise ArgumentError("action", f"shape {actions.shape}", expected)
        if not env.episode_step.any():
            self.units.check_commands(actions, self.observe()[STATE])
        return torch.tensor(self.units.to_si(actions), device=env.device)


class LerobotDriver(Driver):
    """Joint targets of a LeRobot policy, for worlds that begin their episodes together.

    It acts on the host, so a captured step cannot hold it. It sees the observation group ``policy``
    of the configuration without noise as ``environment_state``. No folder may name it: a LeRobot
    policy is trusted code.
    """

    plays_policy = on_host = True
    noun = "policy"

    def __init__(self, env: Env, cfg: Config) -> None:
        """Load the policy that the configuration names; a FolderError if that cannot be done, or
        the scene does not have what it needs. ``cfg`` has cameras and observations.
        """
        super().__init__(env.nworld, cfg.task.episode_steps, env.device)
        if cfg.policy is None:
            expected = "the folder of a LeRobot policy, which controller=lerobot plays"
            raise ConfigError("policy", None, expected)
        loaded = load_lerobot(cfg.policy, resolve_backend(cfg)[1])
        self._policy, self._preprocess, self._postprocess = loaded
        self._task = [cfg.task.words] * env.nworld
        config = self._policy.config
        inputs = {name: tuple(part.shape) for name, part in config.input_features.items()}
        group = replace(cfg.observation[GROUP], noise=False)
        self._observations = ObservationManager(env, {GROUP: group} if SEEN in inputs else {})
        cameras = cfg.scene.cameras
        names = [name for name in cameras if f"{IMAGES}.{name}" in inputs]
        period = getattr(config, "n_action_steps", 1) if config.n_obs_steps == 1 else 1
        self._images = QueryImages(env, cameras, names, period)
        images = {f"images.{name}": image for name, image in self._images.images.items()}
        self._words = LerobotWords(env, self._observations.groups, images, LEROBOT)
        here = {name: part.shape[1:] for name, part in self._words.observe().items()}
        for name, shape in inputs.items():
            if here.get(name) not in (shape, (*shape[1:], *shape[:1])):  # images are (…, 3) here
                there = f"and here it is {here.get(name, 'missing')}: expected the same"
                problem = f"policy={cfg.policy}: takes {name} of shape {shape}"
                fix = "Set cameras, scene.cameras.NAME.size and observation as in its training"
                raise FolderError(f"{problem}, {there}", fix)
        self._policy.reset()

    def command(self) -> Tensor:
        """Joint targets of the next step [rad, m], shape ``(nworld, joints)``, float32."""
        self._images.draw()
        self._observations.compute()
        batch: dict[str, Any] = {"task": self._task}
        for name, part in self._words.observe().items():
            tensor = torch.from_numpy(part)
            batch[name] = tensor.permute(0, 3, 1, 2) / 255 if name.startswith(IMAGES) else tensor
        with torch.inference_mode():
            actions = self._postprocess(self._policy.select_action(self._preprocess(batch)))
        return self._words.targets(actions.float().cpu().numpy())

    @classmethod
    @override
    def build(cls, env: Env, cfg: Config, assets: Assets) -> Driver:
        return cls.with_params(cfg, env, cfg)
