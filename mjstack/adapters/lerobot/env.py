"""LeRobot's environment ``mjstack``: worlds of a task as one batched vector environment."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig

from mjstack.config import load_config
from mjstack.config.schema import Config
from mjstack.drivers.lerobot import GROUP, LerobotWords
from mjstack.envs import Env, driven_config
from mjstack.episodes.rollout import reset_worlds
from mjstack.episodes.stage import Stage
from mjstack.errors import ArgumentError, ConfigError
from mjstack.managers.state import in_one_pass
from mjstack.policy import load_policy
from mjstack.policy.lerobot import IMAGES, SEEN, STATE
from mjstack.rng import check_seed
from mjstack.robots.units import LEROBOT
from mjstack.sim import StateRenderer
from mjstack.sim.cameras import with_outputs
from mjstack.sim.sizes import resolve_sizes

Info = dict[str, Any]
TIMINGS = {30: "hz30", 50: "default"}  # by control rate [Hz]
_FILMED = 10  # worlds that are drawn at a time, as many as LeRobot films


@EnvConfig.register_subclass("mjstack")
@dataclass
class MjstackEnv(EnvConfig):
    """A task of mjstack. Starts are ``reset=randomized`` unless the overrides say otherwise.

    Attributes:
        task: Its task; null for the default one.
        fps: Control rate [Hz], 30 or 50.
        robot: Its robot.
        cameras: Cameras whose images the policy sees, such as ``[front,wrist]``.
        observation_height: Pixels of their images.
        observation_width: The same.
        units: ``lerobot``: degrees, and 0 to 100 for the gripper; ``si``: rad and m.
        overrides: More overrides of mjstack's configuration, which win.
        config_dir: A folder with more choices, such as ``push/conf``.
        policy: Folder of a policy of mjstack's, or of its export, whose observation is then
            ``environment_state``; that of the configuration without.
    """

    task: str | None = None
    fps: int = 30
    robot: str = "so101"
    cameras: list[str] = field(default_factory=list)
    observation_height: int = 128
    observation_width: int = 128
    units: str = LEROBOT
    overrides: list[str] = field(default_factory=list)
    config_dir: str | None = None
    policy: str | None = None
    gym_kwargs = None  # nothing is made through Gymnasium's registry

    def compose(self) -> Config:
        """Mjstack's configuration. Without cameras it has one for films."""
        for key, choices in (("fps", TIMINGS), ("units", (LEROBOT, "si"))):
            if getattr(self, key) not in choices:
                expected = f"one of {', '.join(map(str, choices))}"
                raise ConfigError(f"env.{key}", getattr(self, key), expected)
        cameras = self.cameras or ["front"]
        sizes = (self.observation_height, self.observation_width) if self.cameras else (240, 240)
        overrides = [
            *([] if self.task is None else [f"task={self.task}"]),
            *(f"robot={self.robot}", f"timing={TIMINGS[self.fps]}"),
            *("observation=state", "reset=randomized", f"cameras=[{','.join(cameras)}]"),
            *(f"scene.cameras.{name}.size=[{sizes[0]},{sizes[1]}]" for name in cameras),
        ]
        return load_config([*overrides, *self.overrides], config_dir=self.config_dir)

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, VectorEnv]]:
        """Make one vector environment of all worlds, and describe its features."""
        cfg = self.compose()
        if self.policy is not None:
            policy = load_policy(self.policy, config_dir=self.config_dir)
            policy.check_fit(cfg)
            cfg = replace(cfg, observation={GROUP: policy.observation})
        worlds = LerobotVectorEnv(cfg, n_envs, self.cameras, self.units)
        kinds = {STATE: FeatureType.STATE, SEEN: FeatureType.ENV}
        keys = {STATE: "agent_pos", SEEN: "environment_state"}
        self.features = {"action": PolicyFeature(FeatureType.ACTION, (len(cfg.robot.joints),))}
        self.features_map = {"action": "action"}
        for name, array in worlds.words.observe().items():
            key = keys.get(name, name)
            self.features[key] = PolicyFeature(kinds.get(name, FeatureType.VISUAL), array.shape[1:])
            self.features_map[key] = name
        return {self.type: {0: worlds}}


class LerobotVectorEnv(VectorEnv):
    """Worlds of a task as LeRobot's evaluation steps them.

    All episodes are as long as the task's. The task's check judges them, and `step` says so in
    ``is_success`` of the last step alone; then the worlds stand still until they are reset. The
    reward is 1 for a success there. Actions are absolute joint targets. A slice ``[:10]`` of the
    environment is a list of pictures of these worlds.

    Attributes:
        inner: The environment.
        words: Its observations and targets in LeRobot's names and units.
    """

    def __init__(
        self, cfg: Config, nworld: int, cameras: Sequence[str] = (), units: str = LEROBOT
    ) -> None:
        """Make worlds of a configuration, whose action terms, rewards and terminations do not
        count. Images of ``cameras`` are observed; pictures are those of the scene's first one.
        """
        if units == LEROBOT and not cfg.robot.lerobot_type:
            expected = "a robot that LeRobot has a follower of (robot.lerobot_type)"
            raise ConfigError("robot", cfg.robot.name, expected, "Set units=si, or robot=so101")
        self._stage = stage = Stage(cfg)
        played = replace(
            driven_config(cfg),
            observation={GROUP: replace(cfg.observation[GROUP], noise=False)},
            scene=replace(cfg.scene, cameras=with_outputs(cfg.scene.cameras, ["rgb"], cameras)),
        )
        sim = stage.simulation(nworld, *stage.backend, sizes=resolve_sizes(cfg, driven=False))
        self.inner = env = Env(sim, stage.index, played, check_faults=False)
        self.words = LerobotWords(env, env.observation_manager.groups, env.images, units)
        self._phase = torch.zeros(nworld, dtype=torch.int64, device=env.device)
        self._left = 0  # control steps of the episode
        self._renderer: StateRenderer | None = None

        # Gymnasium's and LeRobot's attributes
        self.num_envs = nworld
        fps = round(cfg.task.control_hz)
        self.metadata = {"autoreset_mode": AutoresetMode.DISABLED, "render_fps": fps}
        self.task = cfg.task.name
        self.task_description = cfg.task.words
        self._max_episode_steps = cfg.task.episode_steps

    def reset(self, *, seed: Any = None, options: Info | None = None) -> tuple[Info, Info]:
        """Start an episode in every world. World k starts as world ``seed[k]`` of any batch of
        mjstack does under the configured seed: the same number is the same start, wherever it
        stands. One number is that of the first world, and the others follow. Without numbers every
        world goes on to its next episode.
        """
        env = self.inner
        if seed is not None:
            if np.ndim(seed) == 0:
                seed = check_seed(seed) + np.arange(env.nworld)
            seed = [*map(check_seed, seed)]
            if len(seed) != env.nworld:
                expected = f"one for each of {env.nworld} worlds"
                raise ArgumentError("seed", f"{len(seed)} numbers", expected)
        reset_worlds(env, None if seed is None else env.cfg.seed, seed)
        self._left = self._max_episode_steps
        self.inner.check.start(env, self._left, [])
        return self._observe(), {}

    def step(self, actions: np.ndarray) -> tuple[Info, np.ndarray, np.ndarray, np.ndarray, Info]:
        """Advance every world by one control step, or none if the episode is over, to joint targets
        in the environment's units, shape ``(num_envs, joints)``. Others are an ArgumentError.
        """
        targets = self.words.targets(np.asarray(actions, np.float32))
        success = np.zeros(self.num_envs, bool)
        if self._left:
            self.inner.step(targets)
            in_one_pass(partial(self.inner.check.update, self._phase))
            self._left -= 1
            if not self._left:
                success = (self.inner.check.result().failed == 0).cpu().numpy()
        ended = np.full(self.num_envs, not self._left)
        reward = success.astype(np.float32)
        return self._observe(), reward, np.zeros_like(ended), ended, {"is_success": success}

    def call(self, name: str, *args: Any, **kwargs: Any) -> Any:
        """A value of every world, by the name that LeRobot has for it."""
        return self if name == "render" else self.get_attr(name)

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """As `call`, for what every world shares."""
        return (getattr(self, name),) * self.num_envs

    def __getitem__(self, worlds: slice) -> list[np.ndarray]:
        """Draw at most ten worlds, each ``(height, width, 3)``, uint8."""
        env = self.inner
        if self._renderer is None:
            film = [*self._stage.cfg.scene.cameras][:1]
            self._renderer = self._stage.color_renderer(_FILMED, [*env.sim.fields], film)
        fields = {name: values[worlds] for name, values in env.sim.fields.items()}
        (image,) = self._renderer.draw(env.sim.qpos[worlds], fields).values()
        return [*image.to("cpu", copy=True).numpy()]

    def close_extras(self, **kwargs: Any) -> None:
        """Give the simulation's threads and buffers back."""
        if self._renderer is not None:
            self._renderer.close()
        self.inner.close()

    def _observe(self) -> Info:
        """Observations by the names that LeRobot expects of an environment."""
        seen = self.words.observe()
        numbers = {"agent_pos": seen.pop(STATE), "environment_state": seen.pop(SEEN)}
        return numbers | {"pixels": {name[len(IMAGES) + 1 :]: seen[name] for name in seen}}
