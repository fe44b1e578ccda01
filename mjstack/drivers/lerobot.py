"""The driver of a policy that LeRobot has trained."""

import numpy as np
import torch
from torch import Tensor

from mjstack.config.schema import Config
from mjstack.drivers.driver import Driver, require_actions
from mjstack.drivers.policy import QueryImages
from mjstack.envs.env import Env
from mjstack.errors import FolderError
from mjstack.managers.observation import ObservationManager
from mjstack.policy.lerobot import IMAGES, SEEN, STATE, LerobotPolicy
from mjstack.robots.units import LerobotUnits


class LerobotDriver(Driver):
    """Joint targets of a LeRobot policy, for worlds that begin their episodes together.

    It acts on the host, so a captured step cannot hold it. It sees the observation group ``policy``
    of the configuration without noise as ``environment_state``.
    """

    def __init__(self, env: Env, policy: LerobotPolicy, cfg: Config) -> None:
        """Check what the policy needs, and allocate for the environment's worlds.

        Args:
            env: The environment, its worlds started.
            policy: The policy.
            cfg: The configuration with its cameras and observations.

        Raises:
            MjstackError: The scene does not have what the policy needs.
        """
        require_actions(env.cfg, cfg.controller.action, "joint targets, as LeRobot's policies")
        super().__init__(env.nworld, cfg.task.episode_steps, env.device)
        self._env = env
        self._policy = policy
        self._task = cfg.task.instruction or cfg.task.name
        self._units = LerobotUnits(env.index.n_arm, env.index.ctrl_range)
        self._joints = env.index.on(env.device, env.sim.qpos.dtype).qpos
        groups = {"policy": cfg.observation["policy"]} if SEEN in policy.inputs else {}
        for group in groups.values():
            group.noise = False
        self._observations = ObservationManager(env, groups)
        names = [key.removeprefix(f"{IMAGES}.") for key in policy.inputs if IMAGES in key]
        cameras = cfg.scene.cameras
        here: dict[str, tuple[int, ...]] = {STATE: (len(env.index.ctrl),)}
        here |= {f"{IMAGES}.{name}": (3, *camera.size) for name, camera in cameras.items()}
        for width in self._observations.group_dims.values():
            here[SEEN] = (width,)
        for key, shape in policy.inputs.items():
            if here.get(key) != shape:
                raise FolderError(
                    f"policy={policy.folder}: takes {key} of shape {shape}, and here it is"
                    f" {here.get(key, 'missing')}: expected the same",
                    "Set cameras, scene.cameras.NAME.size and observation as in its training",
                )
        self._images = QueryImages(env, cameras, names, policy.period)
        policy.reset()
        self._first = True

    def command(self) -> Tensor:
        """Joint targets of the next step [rad, m], shape ``(nworld, joints)``, float32."""
        env = self._env
        self._images.draw()
        positions = self._units.from_si(self._joints.read(env.sim.qpos).cpu().numpy())
        seen: dict[str, np.ndarray | Tensor] = {STATE: np.nan_to_num(positions)}
        for values in self._observations.compute().values():
            seen[SEEN] = values.nan_to_num().float().cpu()
        seen |= {f"{IMAGES}.{name}": image for name, image in self._images.images.items()}
        targets = self._policy.act(seen, self._task)
        if self._first:
            self._units.check_commands(targets, positions)
            self._first = False
        return torch.from_numpy(self._units.to_si(targets)).to(env.device)
