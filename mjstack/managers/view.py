"""The environment as terms see it, and what a term may ask of it or say of itself."""

import zlib
from collections.abc import Callable
from typing import Any, Protocol

import torch
from torch import Tensor

from mjstack.config.schema import Config
from mjstack.rng import uniform
from mjstack.scene import SceneIndex
from mjstack.sim import Simulation


class EnvView(Protocol):
    """The part of an environment that a term may read. Any object with these attributes can have
    managers.

    Attributes:
        sim: The worlds. Terms read its views; reset terms and actions write into them.
        index: Where names lie in those views.
        cfg: The configuration.
        nworld: Number of worlds.
        device: Where tensors live.
        seed: Seed of every random number; `Env.reset` may set it.
        key: The same on the device, shape ``(1,)``, int64: what a captured step reads.
        world: Number of each world, shape ``(nworld,)``, int64.
        episode: Episode of each world, shape ``(nworld,)``, int64.
        episode_step: Control steps since each world's last reset, shape ``(nworld,)``, int64.
        action: The policy's last action, shape ``(nworld, action_dim)``.
        previous_action: The one before.
        success: Whether the task is achieved, shape ``(nworld,)``, bool.
        command_delay: How late commands are: ``command_delay.steps``, shape ``(nworld,)``, int64.
        given_places: Positions [m] of places that a file of starts gives instead of the draw, by
            name, shape ``(rows, 2)``; world w has row w.
    """

    sim: Simulation
    index: SceneIndex
    cfg: Config
    nworld: int
    device: torch.device
    seed: int
    key: Tensor
    world: Tensor
    episode: Tensor
    episode_step: Tensor
    action: Tensor
    previous_action: Tensor
    success: Tensor
    command_delay: Any
    given_places: dict[str, Tensor]

    @property
    def check(self) -> Any:
        """The task's check, an `EpisodeCheck`, made where it is asked for first."""

    @property
    def state(self) -> Any:
        """The state of the check's objects, a `Step`."""


def offers(kind: str = "", /, **attributes: Any) -> Callable[[Any], Any]:
    """Mark a term with its kind, and with what others may ask of it.

    Kinds are ``observation term``, ``action term``, ``reset term`` and ``check``; subclasses of
    `ActionTerm` and `EpisodeCheck` have theirs already. The folder of a policy or of a run may name
    a term of an installed package only as that kind.

    Known attributes: ``unit`` of an observation (one, or one per number; ``joint`` and ``joint/s``
    are those of the robot's joints); ``ends_on`` of a termination, ``overflow`` or ``non_finite``,
    where it ends such worlds; of a reset term ``reads_file``, where its parameter ``path`` names a
    file of starts, ``places_objects``, where its parameter ``xy`` is a region, ``joint_noise``,
    where its parameter ``arm`` moves the arm's joints; ``starts_midway``, where worlds start in the
    middle of an episode; ``reads="state"`` of a reward, termination or observation that reads
    neither ``env.success`` nor what another term or manager writes: CUDA may compute it beside
    them. A subclass, or a function that wraps it, has to say so again.

    Example:
        >>> @offers("observation term", unit="m")
        ... def tip_height(env): ...
    """
    if kind:
        attributes["term_kind"] = kind

    def mark(term: Any) -> Any:
        for name, value in attributes.items():
            setattr(term, name, (value, term) if name == "reads" else value)
        return term

    return mark


def uses_fields(*names: str) -> Callable[[Any], Any]:
    """Mark a reset term that writes per-world model fields, so that the simulation is built with
    them.
    """
    return offers("reset term", model_fields=names)


def random_uniform(
    env: EnvView,
    name: str,
    size: int,
    low: float = -1.0,
    high: float = 1.0,
    step: Tensor | None = None,
    dtype: torch.dtype | None = None,
) -> Tensor:
    """Random numbers of every world's current episode, which depend neither on nworld nor on which
    worlds reset.

    Args:
        env: The environment.
        name: Whose numbers they are; two consumers with different names never share a draw.
        size: Numbers per world.
        low: Smallest value.
        high: Upper bound.
        step: Step within the episode, shape ``(nworld,)``; 0 if None, which is right for resets.
        dtype: Of the numbers; that of the simulation's floats if None.

    Returns:
        Shape ``(nworld, size)``.
    """
    dtype = dtype or env.sim.qpos.dtype
    stream = zlib.crc32(name.encode())
    if env.device.type == "cuda":  # one kernel; it loads Warp, which native runs do not need
        from mjstack.sim.draws import draw_uniform

        draw = draw_uniform(env.key, stream, env.world, env.episode, step, size, low, high)
        return draw.to(dtype)
    draw = uniform(env.seed, stream, env.world, env.episode, step, size).to(dtype)
    if (low, high) == (-1.0, 1.0):  # then all of the below is exact, and changes nothing
        return draw
    return low + 0.5 * (high - low) * (draw + 1.0)


def zero_rows(mask: Tensor, *buffers: Tensor) -> None:
    """Write 0 into the masked worlds of buffers, each of shape ``(..., nworld, n)``."""
    for buffer in buffers:
        buffer.masked_fill_(mask[:, None], 0.0)


def episode_draw(env: EnvView, name: str, size: int) -> Tensor:
    """Random numbers of every world that stay the same all episode: every term that names them sees
    the same, and the next episode has others. From -1 to 1, shape ``(nworld, size)``.
    """
    return random_uniform(env, f"episode.{name}", size)
