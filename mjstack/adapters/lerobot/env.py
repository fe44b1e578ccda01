"""LeRobot's environment ``mjstack``: worlds of a task as one batched vector environment."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig

from mjstack.config import load_config
from mjstack.config.schema import Config
from mjstack.drivers.lerobot import GROUP, LerobotWords
from mjstack.envs import Env, driven_config
from mjstack.episodes.rollout import reset_worlds
from mjstack.episodes.stage import Stage
from mjstack.errors import ArgumentError, ConfigError, UnknownName
from mjstack.policy import load_policy
from mjstack.policy.lerobot import SEEN, STATE
from mjstack.robots.units import LEROBOT
from mjstack.sim import StateRenderer
from mjstack.sim.cameras import with_outputs
from mjstack.sim.sizes import resolve_env_sizes
from mjstack.tasks.check import make_check

SEEN_HERE = SEEN.removeprefix("observation.")
TIMINGS = {30: "hz30", 50: "default"}  # by control rate [Hz]
_ENDLESS = 1 << 30  # control steps
_FILMED = 10  # worlds that are drawn at a time
_FILM = ("cameras=front", "scene.cameras.front.size=[240,240]")


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

    @property
    def gym_kwargs(self) -> dict:
        """None: nothing is made through Gymnasium's registry."""
        return {}

    def compose(self, *more: str) -> Config:
        """Mjstack's configuration, with more overrides.

        Raises:
            MjstackError: A field or an override cannot be used.
        """
        for key, choices in (("fps", TIMINGS), ("units", (LEROBOT, "si"))):
            if getattr(self, key) not in choices:
                expected = f"one of {', '.join(map(str, choices))}"
                raise ConfigError(f"env.{key}", getattr(self, key), expected)
        chosen = {
            "task": self.task,
            "robot": self.robot,
            "timing": TIMINGS[self.fps],
            "observation": "state",
            "reset": "randomized",
        }
        size = f"size=[{self.observation_height},{self.observation_width}]"
        return load_config(
            [
                *(f"{key}={value}" for key, value in chosen.items() if value is not None),
                *([f"cameras=[{','.join(self.cameras)}]"] if self.cameras else []),
                *(f"scene.cameras.{name}.{size}" for name in self.cameras),
                *more,
                *self.overrides,
            ],
            config_dir=self.config_dir,
        )

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, VectorEnv]]:
        """Make one vector environment of all worlds, and describe its features.

        Raises:
            MjstackError: The configuration cannot be used.
        """
        cfg = self.compose()
        film = None if self.cameras else self.compose(*_FILM)
        if self.policy is not None:
            policy = load_policy(Path(self.policy))
            policy.check_fit(cfg)
            cfg = replace(cfg, observation={GROUP: policy.observation})
        worlds = LerobotVectorEnv(cfg, n_envs, units=self.units, film=film)
        kinds = {STATE: ("agent_pos", FeatureType.STATE), SEEN: (SEEN_HERE, FeatureType.ENV)}
        width = len(cfg.robot.joints)
        self.features = {"action": PolicyFeature(FeatureType.ACTION, (width,))}
        self.features_map = {"action": "action"}
        for name, part in worlds.words.observe().items():
            key, kind = kinds.get(name, (name, FeatureType.VISUAL))
            self.features[key] = PolicyFeature(kind, part.shape[1:])
            self.features_map[key] = name
        return {self.type: {0: worlds}}


class LerobotVectorEnv(VectorEnv):
    """Worlds of a task as LeRobot's evaluation steps them.

    All episodes are as long as the task's. The task's check judges them, and `step` says so in
    ``is_success`` of the last step alone; then the worlds stand still until they are reset. The
    reward is 1 for a success there. Actions are absolute joint targets.

    Attributes:
        inner: The environment.
        words: Its observations and targets in LeRobot's names and units.
    """

    def __init__(
        self,
        cfg: Config,
        nworld: int,
        *,
        units: str = LEROBOT,
        film: Config | None = None,
        endless: bool = False,
    ) -> None:
        """Make the worlds.

        Args:
            cfg: The configuration. Its action terms, rewards and terminations do not count.
            nworld: How many worlds.
            units: As of `MjstackEnv`.
            film: The same scene with a camera for `draw`, where ``cfg`` has none.
            endless: Whether episodes go on, and nothing judges them.

        Raises:
            MjstackError: The configuration cannot be used.
        """
        if GROUP not in cfg.observation:
            raise UnknownName("observation group", GROUP, cfg.observation)
        if units == LEROBOT and not cfg.robot.lerobot_type:
            expected = "a robot that LeRobot has a follower of (robot.lerobot_type)"
            raise ConfigError("robot", cfg.robot.name, expected, "Set units=si, or robot=so101")
        stage = Stage(cfg)
        played = replace(
            driven_config(cfg),
            observation={GROUP: replace(cfg.observation[GROUP], noise=False)},
            scene=replace(cfg.scene, cameras=with_outputs(cfg.scene.cameras, ["rgb"])),
        )
        self._check = make_check(played)
        sim = stage.simulation(nworld, *stage.backend, sizes=resolve_env_sizes(cfg))
        self.inner = env = Env(sim, stage.index, played, check_faults=False)
        self.words = LerobotWords(env, env.observation_manager, env.images, si=units != LEROBOT)
        self._phase = torch.zeros(nworld, dtype=torch.int64, device=env.device)
        self._steps = _ENDLESS if endless else cfg.task.episode_steps
        self._left = 0  # control steps of the episode
        self._film = film
        self._renderer: StateRenderer | None = None

        # Gymnasium's and LeRobot's attributes
        self.num_envs = nworld
        fps = round(cfg.task.control_hz)
        self.metadata = {"autoreset_mode": AutoresetMode.DISABLED, "render_fps": fps}
        self.single_action_space = spaces.Box(*self.words.from_si(env.index.ctrl_range.T))
        self.action_space = batch_space(self.single_action_space, nworld)
        self._shared = {
            "_max_episode_steps": cfg.task.episode_steps,
            "task_description": cfg.task.instruction or cfg.task.name,
            "task": cfg.task.name,
        }

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode in every world.

        Args:
            seed: A number for each world, or the first of them. World k starts as world ``seed[k]``
                of any batch of mjstack does under the configured seed: the same number is the same
                start, wherever it stands. Without it every world goes on to its next episode.
            options: Not used.
        """
        env = self.inner
        if seed is None:
            env.reset()
            env.sim.forward()
        else:
            n = self.num_envs
            numbers = seed if isinstance(seed, Sequence) else range(int(seed), int(seed) + n)
            if len(numbers) != n:  # a single one would be the start of every world
                raise ArgumentError(
                    "seed", f"{len(numbers)} numbers", f"one for each of {n} worlds"
                )
            reset_worlds(env, env.cfg.seed, numbers)
        self._left = self._steps
        self.words.begins = True
        self._check.start(env, self._left, [])
        return self._observe(), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[dict[str, Any], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advance every world by one control step, or none if the episode is over.

        Args:
            actions: Joint targets in the environment's units, shape ``(num_envs, joints)``.

        Raises:
            MjstackError: The actions have another width, are not finite or in other units.
        """
        targets = self.words.targets(np.asarray(actions, np.float32))
        success = np.zeros(self.num_envs, bool)
        if self._left:
            self.inner.step(targets)
            self._check.update(self._phase)
            self._left -= 1
            if not self._left:
                success = (self._check.result().failed == 0).cpu().numpy()
        ended = np.full(self.num_envs, not self._left)
        infos: dict[str, Any] = {"is_success": success}
        if not self._left:
            infos |= {"final_info": {"is_success": success}, "_final_info": ended}
        reward = success.astype(np.float32)
        return self._observe(), reward, np.zeros_like(ended), ended, infos

    def call(self, name: str, *args: Any, **kwargs: Any) -> Sequence[Any]:
        """A value of every world, by the name that LeRobot has for it. Pictures of ``render`` are
        drawn when they are taken, such as by ``[:10]``.
        """
        return _Pictures(self) if name == "render" else self.get_attr(name)

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """As `call`, for what every world shares.

        Raises:
            AttributeError: There is no such value.
        """
        if name not in self._shared:
            raise AttributeError(name)
        return (self._shared[name],) * self.num_envs

    def draw(self, worlds: Sequence[int]) -> Iterator[np.ndarray]:
        """Pictures of some worlds, each ``(height, width, 3)``, uint8: the first camera's images,
        or those of ``film``.

        Raises:
            MjstackError: This machine cannot draw.
        """
        env = self.inner
        if self._film is None:
            image = next(iter(env.images.values()))
            yield from (image[world].cpu().numpy().copy() for world in worlds)
            return
        # Visual geoms are in the drawn model alone, bodies in both.
        fields = {name: env.sim.fields[name] for name in env.sim.fields if name[:5] == "body_"}
        if self._renderer is None:
            self._renderer = Stage(self._film).color_renderer(_FILMED, [*fields])
        for start in range(0, len(worlds), _FILMED):
            rows = torch.tensor(worlds[start : start + _FILMED], device=env.device)
            changed = {name: values[rows] for name, values in fields.items()}
            for images in self._renderer.draw(env.sim.qpos[rows], changed).values():
                yield from images.cpu().numpy().copy()

    def close_extras(self, **kwargs: Any) -> None:
        """Give the simulation's threads and buffers back."""
        if self._renderer is not None:
            self._renderer.close()
        self.inner.close()

    def _observe(self) -> dict[str, Any]:
        """Observations by the names that LeRobot expects of an environment."""
        images = self.words.observe()
        seen: dict[str, Any] = {"agent_pos": images.pop(STATE), SEEN_HERE: images.pop(SEEN)}
        if images:
            seen["pixels"] = {name.rpartition(".")[2]: image for name, image in images.items()}
        return seen


class _Pictures(Sequence[np.ndarray]):
    """A picture of every world, drawn when it is taken."""

    def __init__(self, worlds: LerobotVectorEnv) -> None:
        self._worlds = worlds

    def __len__(self) -> int:
        return self._worlds.num_envs

    def __getitem__(self, index: Any) -> Any:
        numbers = range(len(self))[index]
        if isinstance(index, slice):
            return list(self._worlds.draw(numbers))
        return next(self._worlds.draw([numbers]))
