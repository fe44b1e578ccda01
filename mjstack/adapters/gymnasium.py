"""Gymnasium's interfaces with NumPy arrays: worlds as a `VectorEnv`, or one as an `Env`."""

from typing import Any

import numpy as np
import torch
from numpy import ndarray

from mjstack.envs import Env
from mjstack.errors import ArgumentError, ConfigError, MissingExtra, require_names
from mjstack.rng import check_seed

try:
    import gymnasium
    from gymnasium import spaces
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise MissingExtra("mjstack.adapters.gymnasium", str(error.name), "train") from error

Observation = ndarray | dict[str, ndarray]
Info = dict[str, Any]


class GymnasiumVectorEnv(VectorEnv):
    """All worlds of an environment as a Gymnasium vector environment.

    A world that ends is reset in the same step (``AutoresetMode.SAME_STEP``). ``infos`` then has,
    as in Gymnasium's own vector environments:

    - ``final_obs``: object array ``(num_envs,)``, the last observation of each world that ended,
      None elsewhere;
    - ``final_info``: the ``success`` of the episodes that ended;
    - ``_final_obs`` and ``_final_info``: which worlds they hold for, ``(num_envs,)``, bool.

    In every step it has ``success``, ``(num_envs,)``, bool, as it was before any reset.

    Actions beyond ``action_space`` are passed on as they are;
    ``gymnasium.wrappers.vector.ClipAction`` clips them.

    Attributes:
        inner: The environment.
        group: The observation group that is returned, as one array; None for all and the images,
            in a dict.
    """

    def __init__(self, env: Env, *, group: str | None = "policy") -> None:
        """Take over an environment, and close it when it is closed.

        Raises:
            UnknownName: There is no such observation group.
            ConfigError: With images, a camera does not draw the ends of episodes.
        """
        self.inner = env
        self.group = group
        self.num_envs = env.nworld
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}
        boxes: dict[str, spaces.Space] = {
            name: spaces.Box(-np.inf, np.inf, (dim,), np.float32)
            for name, dim in env.observation_manager.group_dims.items()
        }
        require_names("observation group", [group], boxes)
        boxes |= {name: _image_box(image) for name, image in env.images.items()}
        cameras = env.cameras.cameras if env.cameras is not None else {}
        lacking = [name for name, camera in cameras.items() if not camera.terminal]
        if group is None and lacking:
            expected = "true, because final_obs has the images of all cameras"
            key = f"scene.cameras.{lacking[0]}.terminal"
            raise ConfigError(key, False, expected, "Set it, or choose a group")
        self.single_observation_space = spaces.Dict(boxes) if group is None else boxes[group]
        manager = env.action_manager
        low, high = (bound.float().cpu().numpy() for bound in (manager.low, manager.high))
        self.single_action_space = spaces.Box(low, high, dtype=np.float32)
        self.observation_space = batch_space(self.single_observation_space, env.nworld)
        self.action_space = batch_space(self.single_action_space, env.nworld)

    def reset(
        self, *, seed: int | None = None, options: Info | None = None
    ) -> tuple[Observation, Info]:
        """Start new episodes.

        Args:
            seed: Starts every world anew under this seed. Without one, the worlds go on to their
                next episodes under the seed that they have, at first the configured one.
            options: ``reset_mask``: which worlds to reset, shape ``(num_envs,)``, bool; by default
                all.

        Returns:
            Observations of all worlds, ``(num_envs, dim)``, float32, and an empty dict.

        Raises:
            MjstackError: The seed or an option cannot be used.
        """
        rest = dict(options or {})
        mask = rest.pop("reset_mask", None)
        require_names("reset option", rest, ("reset_mask",))
        if mask is not None:
            mask = torch.as_tensor(mask, device=self.inner.device)
        if seed is not None:  # before any world is reset; Gymnasium takes Python's integers alone
            seed = check_seed(seed, masked=mask is not None)
        obs, _ = self.inner.reset(seed=seed, mask=mask)
        super().reset(seed=seed)
        return _numpy(obs, self.group), {}

    def step(self, actions: ndarray) -> tuple[Observation, ndarray, ndarray, ndarray, Info]:
        """Advance every world by one control interval.

        Args:
            actions: Shape ``(num_envs, action_dim)``, numbers.

        Returns:
            Observations ``(num_envs, dim)``, float32; rewards ``(num_envs,)``, float32;
            terminations and truncations ``(num_envs,)``, bool; and infos, see the class.

        Raises:
            MjstackError: The actions cannot be used, or something went wrong in the worlds.
        """
        action = torch.tensor(_array(actions, self.action_space), device=self.inner.device)
        obs, reward, terminated, truncated, extras = self.inner.step(action)
        success = extras["success"].cpu().numpy()
        infos = {"success": success, "_success": np.ones(self.num_envs, dtype=np.bool_)}
        done = (terminated | truncated).cpu().numpy()
        if done.any():
            final = _numpy(extras["final_obs"], self.group)
            for world in np.flatnonzero(done).tolist():
                info = {"success": bool(success[world])}
                last = {"final_obs": _row(final, world), "final_info": info}
                infos = self._add_info(infos, last, world)
        rewards, ends, cuts = (part.cpu().numpy() for part in (reward, terminated, truncated))
        return _numpy(obs, self.group), rewards, ends, cuts, infos

    def close_extras(self, **kwargs: Any) -> None:
        """Give the simulation's threads and buffers back."""
        self.inner.close()


class GymnasiumEnv(gymnasium.Env):
    """The one world of an environment as a Gymnasium environment.

    An episode ends when ``step`` says so; then call ``reset``. ``info`` has ``success``, bool.

    Attributes:
        inner: The environment.
        group: The observation group that is returned, as one array; None for all, in a dict.
    """

    def __init__(self, env: Env, *, group: str | None = "policy") -> None:
        """Take over an environment of one world, and close it when it is closed.

        Raises:
            MjstackError: It has more worlds than one, or no such observation group.
        """
        if env.nworld != 1:
            fix = "Build it with nworld=1, or use GymnasiumVectorEnv"
            raise ArgumentError("env", f"{env.nworld} worlds", "one", fix)
        self.inner = env
        self.group = group
        self._worlds = GymnasiumVectorEnv(env, group=group)
        self.metadata = {"render_modes": [], "render_fps": round(1.0 / env.cfg.timing.decision_dt)}
        self.observation_space = self._worlds.single_observation_space
        self.action_space = self._worlds.single_action_space
        # What the next episode has shown first: it starts in the step that ends one
        self._first: Observation | None = None

    def reset(
        self, *, seed: int | None = None, options: Info | None = None
    ) -> tuple[Observation, Info]:
        """Start a new episode.

        Args:
            seed: Starts with the first episode of this seed. Without one, the next episode under
                the seed that is in use, at first the configured one.
            options: None are known.

        Returns:
            The observation, ``(dim,)``, float32, and an empty dict.

        Raises:
            MjstackError: The seed or an option cannot be used.
        """
        require_names("reset option", options or (), ())
        first = self._first
        if seed is not None or first is None:
            first, _ = self._worlds.reset(seed=seed)
        self._first = None
        super().reset(seed=None if seed is None else check_seed(seed))
        return _row(first, 0), {}

    def step(self, action: ndarray) -> tuple[Observation, float, bool, bool, Info]:
        """Advance the world by one control interval.

        Args:
            action: Shape ``(action_dim,)``, numbers.

        Returns:
            The observation ``(dim,)``, float32, the reward, whether the episode terminated, whether
            it was truncated, and the info, see the class.

        Raises:
            MjstackError: The action cannot be used, the episode has ended, or something went wrong
                in the world.
        """
        if self._first is not None:
            value = "step() after the end of an episode"
            raise ArgumentError("env", value, "reset() first", "Call env.reset()")
        actions = _array(action, self.action_space)[None]
        obs, reward, terminated, truncated, infos = self._worlds.step(actions)
        seen = _row(obs, 0)
        if "final_obs" in infos:
            self._first = obs
            seen = infos["final_obs"][0]
        info = {"success": bool(infos["success"])}
        return seen, float(reward[0]), bool(terminated), bool(truncated), info

    def close(self) -> None:
        """Give the simulation's threads and buffers back."""
        self.inner.close()


def _numpy(obs: dict[str, torch.Tensor], group: str | None) -> Observation:
    # Copies, because images are the environment's own memory.
    arrays = {name: value.to("cpu", copy=True).numpy() for name, value in obs.items()}
    return arrays if group is None else arrays[group]


def _image_box(image: torch.Tensor) -> spaces.Box:
    low, high = {torch.uint8: (0, 255), torch.int32: (-1, 2**31 - 1)}.get(image.dtype, (0, np.inf))
    dtype: Any = str(image.dtype).removeprefix("torch.")
    return spaces.Box(low, high, tuple(image.shape[1:]), dtype)


def _row(obs: Observation, world: int) -> Observation:
    if isinstance(obs, dict):
        return {name: value[world] for name, value in obs.items()}
    return obs[world]


def _array(action: Any, space: spaces.Space) -> ndarray:
    expected = f"an array of numbers of shape {space.shape}"
    try:
        array = np.asarray(action, np.float32)
    except (TypeError, ValueError) as error:
        raise ArgumentError("action", type(action).__name__, expected) from error
    if array.shape != space.shape:
        raise ArgumentError("action", f"shape {array.shape}", expected)
    return array
