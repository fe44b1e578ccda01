"""The driver of a policy that LeRobot has trained, and worlds in LeRobot's names and units."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mjstack.config.schema import Config
from mjstack.drivers.driver import Driver
from mjstack.drivers.policy import QueryImages
from mjstack.envs.env import Env
from mjstack.errors import ArgumentError, FolderError
from mjstack.managers.observation import ObservationManager
from mjstack.policy.lerobot import IMAGES, SEEN, STATE
from mjstack.robots.units import LEROBOT, LerobotUnits

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
        self.units = LerobotUnits(env.index.n_arm, env.index.ctrl_range, units)

    def observe(self) -> dict[str, np.ndarray]:
        """What there is to see, by LeRobot's names. What is not finite is 0: the check fails its
        world.
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
    of the configuration without noise as ``environment_state``.
    """

    def __init__(self, env: Env, loaded: tuple[Any, Any, Any], cfg: Config) -> None:
        """Take a policy and its processors, as of `load_lerobot`; a FolderError if the scene does
        not have what they need. ``cfg`` is the configuration with its cameras and observations.
        """
        super().__init__(env.nworld, cfg.task.episode_steps, env.device)
        self._policy, self._before, self._after = loaded
        self._task = [cfg.task.instruction or cfg.task.name] * env.nworld
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
                there = f"{here.get(name, 'missing')}: expected the same"
                problem = (
                    f"policy={cfg.policy}: takes {name} of shape {shape}, and here it is {there}"
                )
                fix = "Set cameras, scene.cameras.NAME.size and observation as in its training"
                raise FolderError(problem, fix)
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
            actions = self._after(self._policy.select_action(self._before(batch)))
        return self._words.targets(actions.float().cpu().numpy())
