"""Gymnasium's interfaces with NumPy arrays: worlds as a `VectorEnv`, or one as an `Env`. Importing
this registers the ids of the tasks, such as ``mjstack/stack-so101-v0``.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy import ndarray

from mjstack.config import load_config
from mjstack.config.schema import CameraCfg
from mjstack.envs import Env, build_env
from mjstack.errors import ArgumentError, ConfigError, MissingExtra, require_names
from mjstack.files import CONFIG_FOLDER
from mjstack.managers import offers
from mjstack.rng import check_seed
from mjstack.scene import build_model
from mjstack.sim import StateRenderer
from mjstack.sim.cameras import with_outputs

try:
    import gymnasium
    from gymnasium import spaces
    from gymnasium.envs.registration import register
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise MissingExtra("mjstack.adapters.gymnasium", str(error.name), "train") from error

__all__ = ["GymnasiumEnv", "GymnasiumVectorEnv", "make", "register_env"]
Observation = ndarray | dict[str, ndarray]
Info = dict[str, Any]
_MODES = ["rgb_array"]  # of rendering
_MAKER = "mjstack.adapters.gymnasium:make"


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

    With ``render_mode="rgb_array"`` `render` returns a tuple with an image of each world by the
    first camera.

    Attributes:
        inner: The environment.
        group: The observation group that is returned, as one array; None for all and the images,
            in a dict.
        seen: Positions and model fields of the state that `render` shows; None for the present one.
    """

    def __init__(
        self,
        env: Env,
        *,
        group: str | None = "policy",
        render_mode: str | None = None,
        cameras: Mapping[str, CameraCfg] | None = None,
    ) -> None:
        """Take over an environment, and close it when it is closed. The group and the render mode,
        ``rgb_array`` or None, are as of the class; ``cameras`` are those to render by, if not those
        of its configuration.

        Raises:
            MjstackError: The scene has no camera, the environment no such group, or, with images,
                a camera does not draw the ends of episodes.
        """
        self.inner = env
        self.group = group
        self.num_envs = env.nworld
        self.render_mode = render_mode
        self._film = [*(cameras or env.cfg.scene.cameras).items()][:1]
        self._renderer: StateRenderer | None = None
        self.seen: tuple[torch.Tensor, Info] | None = None
        if render_mode == "rgb_array" and not self._film:
            fix = "Build the environment with cameras=front"
            raise ArgumentError("render_mode", repr(render_mode), "a scene with a camera", fix)
        if render_mode not in (None, *_MODES):
            raise ArgumentError("render_mode", repr(render_mode), "None or rgb_array")
        self.metadata = {
            "autoreset_mode": AutoresetMode.SAME_STEP,
            "render_modes": _MODES if self._film else [],
            "render_fps": round(1.0 / env.cfg.timing.decision_dt),
        }
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
        rewards, ends, cuts = (tensor.cpu().numpy() for tensor in (reward, terminated, truncated))
        return _numpy(obs, self.group), rewards, ends, cuts, infos

    def render(self) -> tuple[ndarray, ...]:
        """Images of all worlds; see the class."""
        env = self.inner
        qpos, fields = self.seen or (env.sim.qpos, env.sim.fields)
        if self.render_mode is None:
            fix = "Give it to gymnasium.make"
            raise ArgumentError("render_mode", None, "rgb_array", fix)
        if self._renderer is None:
            cameras = with_outputs(dict(self._film), ["rgb"])
            cfg = replace(env.cfg, scene=replace(env.cfg.scene, cameras=cameras))
            self._renderer = StateRenderer(env.sim.model, cfg, env.nworld, fields=[*fields])
        (images,) = self._renderer.draw(qpos, fields).values()
        return tuple(images.to("cpu", copy=True).numpy())

    def close_extras(self, **kwargs: Any) -> None:
        """Give the simulation's threads and buffers back."""
        for opened in (self._renderer, self.inner):
            if opened is not None:
                opened.close()


class GymnasiumEnv(gymnasium.Env):
    """The one world of an environment as a Gymnasium environment.

    An episode ends when ``step`` says so; then call ``reset``. ``info`` has ``success``, bool.

    `render` is that of `GymnasiumVectorEnv`, of one world. After the step that ends an episode it
    shows the state before that step.

    Attributes:
        inner: The environment.
        group: The observation group that is returned, as one array; None for all, in a dict.
    """

    def __init__(self, env: Env, **options: Any) -> None:
        """Take over an environment of one world, and close it when it is closed; options and errors
        as of `GymnasiumVectorEnv`. More worlds are an ArgumentError.
        """
        if env.nworld != 1:
            fix = "Build it with nworld=1, or use GymnasiumVectorEnv"
            raise ArgumentError("env", f"{env.nworld} worlds", "one", fix)
        self.inner = env
        self._worlds = GymnasiumVectorEnv(env, **options)
        self.group = self._worlds.group
        self.render_mode = self._worlds.render_mode
        self.metadata = dict(self._worlds.metadata)
        del self.metadata["autoreset_mode"]
        self.observation_space = self._worlds.single_observation_space
        self.action_space = self._worlds.single_action_space
        # What the next episode has shown first: it starts in the step that ends one
        self._first: Observation | None = None

    def reset(
        self, *, seed: int | None = None, options: Info | None = None
    ) -> tuple[Observation, Info]:
        """Start a new episode: the first one of a seed, or the next one as of
        `GymnasiumVectorEnv.reset`. No options are known. Returns the observation, ``(dim,)``,
        float32, and an empty dict.
        """
        require_names("reset option", options or (), ())
        first = self._first
        self._worlds.seen = None
        if seed is not None or first is None:
            first, _ = self._worlds.reset(seed=seed)
        self._first = None
        super().reset(seed=None if seed is None else check_seed(seed))
        return _row(first, 0), {}

    def step(self, action: ndarray) -> tuple[Observation, float, bool, bool, Info]:
        """Advance the world by one control interval, as `GymnasiumVectorEnv.step` does, by an
        action ``(action_dim,)``: observation ``(dim,)``, float32, reward, whether the episode
        terminated, whether it was truncated, and the info, see the class. A MjstackError as there,
        or if the episode has ended.
        """
        if self._first is not None:
            value = "step() after the end of an episode"
            raise ArgumentError("env", value, "reset() first", "Call env.reset()")
        actions = _array(action, self.action_space)[None]
        sim = self.inner.sim
        last_state = sim.qpos.clone(), {name: field.clone() for name, field in sim.fields.items()}
        self._worlds.seen = None
        obs, reward, terminated, truncated, infos = self._worlds.step(actions)
        seen = _row(obs, 0)
        if "final_obs" in infos:
            self._first = obs
            seen = infos["final_obs"][0]
            self._worlds.seen = last_state
        info = {"success": bool(infos["success"])}
        return seen, float(reward[0]), bool(terminated), bool(truncated), info

    def render(self) -> ndarray:
        """An image ``(height, width, 3)``, uint8."""
        return self._worlds.render()[0]

    def close(self) -> None:
        """Give the simulation's threads and buffers back."""
        self._worlds.close()


@offers(metadata={"render_modes": _MODES})  # Gymnasium wraps it for human
def make(
    num_envs: int | None = None,
    *,
    choices: Sequence[str] = (),
    overrides: Sequence[str] = (),
    config_dir: str | os.PathLike | None = None,
    **options: Any,
) -> GymnasiumVectorEnv | GymnasiumEnv:
    """The environment of ``gymnasium.make`` or, with a number of worlds, of ``make_vec``.

    Args:
        num_envs: Number of worlds.
        choices: Overrides of the registered id.
        overrides: More of them, such as ``["reset=randomized", "sim=native"]``.
        config_dir: A folder with more choices, as of `mjstack.make_env`.
        options: ``group`` and ``render_mode`` of `GymnasiumVectorEnv`. Without a camera in the
            scene, it is seen by ``cameras=front``, which changes no observation.

    Raises:
        MjstackError: An override or an option cannot be used.
    """
    all_overrides = [*choices, *overrides, f"nworld={1 if num_envs is None else num_envs}"]
    cfg = filmed = load_config(all_overrides, config_dir=config_dir)
    if options.get("render_mode") and not cfg.scene.cameras:
        filmed = load_config([*all_overrides, "cameras=front"], config_dir=config_dir)
    env = build_env(cfg, model=build_model(filmed))  # with what pictures need
    kind = GymnasiumEnv if num_envs is None else GymnasiumVectorEnv
    return kind(env, cameras=filmed.scene.cameras, **options)


def register_env(
    id: str, overrides: Sequence[str] = (), *, config_dir: str | os.PathLike | None = None
) -> None:
    """Register a task of your own for ``gymnasium.make`` and ``make_vec``.

    Args:
        id: Such as ``mine/push-v0``.
        overrides: Of every environment of this id, such as ``["task=push", "robot=so101"]``.
        config_dir: A folder with more choices, as of `mjstack.make_env`.
    """
    kwargs: dict[str, Any] = {"choices": list(overrides)}
    if config_dir is not None:  # relative to the folder of this call
        kwargs["config_dir"] = os.path.abspath(config_dir)
    register(id, entry_point=_MAKER, vector_entry_point=_MAKER, kwargs=kwargs)


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


for _task in sorted(path.stem for path in CONFIG_FOLDER.glob("task/*.yaml")):
    for _robot in sorted(path.stem for path in CONFIG_FOLDER.glob("robot/*.yaml")):
        register_env(f"mjstack/{_task}-{_robot}-v0", [f"task={_task}", f"robot={_robot}"])
