"""The time of images alone, in each arrangement of the renderer and with each part of the scene."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

from mjstack.bench.timing import WARM_UP, timed
from mjstack.config.schema import Backend
from mjstack.envs import build_env, without_images
from mjstack.envs.buffers import Advance
from mjstack.episodes.context import RunContext
from mjstack.errors import ConfigError
from mjstack.sim import resolve_backend
from mjstack.sim.graph import StepGraph

# Values of constants of `mjstack.sim.mjwarp_cameras`
ARRANGEMENTS: dict[str, dict[str, Any]] = {
    "MJWarp's order of rays, blocks of 64": {"TILE": 1, "BLOCK_DIM": 64},
    "MJWarp's order of rays, blocks of 32": {"TILE": 1, "BLOCK_DIM": 32},
    "squares of 8 x 8 pixels, blocks of 64": {"TILE": 8, "BLOCK_DIM": 64},
    "squares of 8 x 8 pixels, blocks of 32": {"TILE": 8, "BLOCK_DIM": 32},
    "squares of 4 x 4 pixels, blocks of 32": {"TILE": 4, "BLOCK_DIM": 32},
    "collision geoms alone": {"VISIBLE_GROUPS": (0, 3)},
    "a tenth of the worlds": {},
}
PART = list(ARRANGEMENTS)[-1]


def measure_cameras(
    context: RunContext, *, draws: int, repetitions: int, advance: Advance
) -> dict[str, list[float]]:
    """Draw the cameras of random starts over and over, in turns with each arrangement.

    Args:
        context: The run, with cameras.
        draws: Images of each camera and world in a repetition.
        repetitions: Measured repetitions of each arrangement.
        advance: Told about progress.

    Returns:
        Milliseconds of one draw of all cameras and worlds in each repetition, by arrangement.

    Raises:
        ConfigError: There are no cameras, or the backend is not MJWarp.
    """
    cfg = context.cfg
    if not cfg.scene.cameras:
        raise ConfigError("cameras", None, "some, such as cameras=front")
    backend, device = resolve_backend(cfg)
    if backend is not Backend.mjwarp:
        raise ConfigError("sim.backend", backend, "mjwarp", "Add sim=mjwarp")
    env = build_env(without_images(cfg), model=context.model, backend=backend, device=device)
    env.reset(seed=cfg.seed)
    sim = env.sim
    graphs = {}
    for number, (name, values) in enumerate(ARRANGEMENTS.items(), 1):
        with constants(values):
            cameras = sim.make_cameras(cfg.scene.cameras)
            mask = env.world % 10 == 0 if name == PART else None
            draw = partial(cameras.draw, cameras.allocate(), dict.fromkeys(cfg.scene.cameras, mask))
            graph = StepGraph(draw, sim.device, cfg.graph, name=name)
            for _ in range(WARM_UP):
                graph()
            graphs[name] = graph
        advance("arrangements", number, len(ARRANGEMENTS))
    times: dict[str, list[float]] = {name: [] for name in graphs}
    for repetition in range(repetitions):
        for name, graph in graphs.items():
            seconds = timed(sim, partial(_repeat, graph, draws))
            times[name].append(1e3 * seconds / draws)
        advance("repetitions", repetition + 1, repetitions)
    env.close()
    return times


def _repeat(graph: StepGraph, count: int) -> None:
    for _ in range(count):
        graph()


@contextmanager
def constants(values: dict[str, Any]) -> Iterator[None]:
    """Give constants of the renderer other values."""
    from mjstack.sim import mjwarp_cameras  # loads Warp

    before = {name: getattr(mjwarp_cameras, name) for name in values}
    try:
        for name, value in values.items():
            setattr(mjwarp_cameras, name, value)
        yield
    finally:
        for name, value in before.items():
            setattr(mjwarp_cameras, name, value)
