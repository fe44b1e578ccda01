"""Time images alone, in each arrangement of the renderer and with each part of the scene.

    python tools/bench_cameras.py robot=so101 nworld=2048 cameras=front sim=mjwarp

The cameras of random starts are rendered over and over, in turns with each arrangement.
"""

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

from common import count, make_parser, run, spread

from mjstack.bench.timing import WARM_UP, timed
from mjstack.config.schema import Backend, Config
from mjstack.envs import Env, build_env, without_images
from mjstack.envs.buffers import Advance
from mjstack.errors import ConfigError
from mjstack.report.table import Table
from mjstack.sim import mjwarp_cameras, resolve_backend
from mjstack.sim.graph import StepGraph

PART = "a tenth of the worlds"
ARRANGEMENTS: dict[str, dict[str, Any]] = {
    "MJWarp's order of rays, blocks of 64": {"TILE": 1, "BLOCK_DIM": 64},
    "MJWarp's order of rays, blocks of 32": {"TILE": 1, "BLOCK_DIM": 32},
    "squares of 8 x 8 pixels, blocks of 64": {"TILE": 8, "BLOCK_DIM": 64},
    "squares of 8 x 8 pixels, blocks of 32": {"TILE": 8, "BLOCK_DIM": 32},
    "squares of 4 x 4 pixels, blocks of 32": {"TILE": 4, "BLOCK_DIM": 32},
    "collision geoms alone": {"VISIBLE_GROUPS": (0, 3)},
    PART: {},
}
"""Values of constants of `mjstack.sim.mjwarp_cameras`, by name."""


def measure(args: argparse.Namespace, cfg: Config, advance: Advance) -> Iterator[Table]:
    """Time a render of all cameras and worlds in each arrangement."""
    if not cfg.scene.cameras:
        raise ConfigError("cameras", None, "some, such as cameras=front")
    backend, device = resolve_backend(cfg)
    if backend is not Backend.mjwarp:
        raise ConfigError("sim.backend", backend, "mjwarp", "Add sim=mjwarp")
    env = build_env(without_images(cfg), backend=backend, device=device)
    env.reset(seed=cfg.seed)
    graphs = {}
    for number, name in enumerate(ARRANGEMENTS, 1):
        graphs[name] = capture(env, cfg, name)
        advance("arrangements", number, len(ARRANGEMENTS))
    times: dict[str, list[float]] = {name: [] for name in graphs}
    for repetition in range(args.repetitions):
        for name, graph in graphs.items():
            seconds = timed(env.sim, partial(repeat, graph, args.draws))
            times[name].append(1e3 * seconds / args.draws)
        advance("repetitions", repetition + 1, args.repetitions)
    env.close()
    images = len(cfg.scene.cameras) * cfg.nworld
    sizes = (f"{name} {c.size[0]} x {c.size[1]}" for name, c in cfg.scene.cameras.items())
    yield Table(
        title=f"images: {cfg.robot.title}, {cfg.nworld:,} worlds, {', '.join(sizes)}",
        header=["arrangement", "ms per render", "images/s"],
        rows=[
            [name, spread(ms), spread([1e3 * images / value for value in ms])]
            for name, ms in times.items()
        ],
    )


def capture(env: Env, cfg: Config, name: str) -> StepGraph:
    """A render of all cameras in an arrangement, warmed up."""
    with constants(ARRANGEMENTS[name]):
        cameras = env.sim.make_cameras(cfg.scene.cameras)
        mask = env.world % 10 == 0 if name == PART else None
        draw = partial(cameras.draw, cameras.allocate(), dict.fromkeys(cfg.scene.cameras, mask))
        graph = StepGraph(draw, env.sim.device, cfg.graph, name=name)
        repeat(graph, WARM_UP)
        return graph


def repeat(graph: StepGraph, number: int) -> None:
    """Replay a graph some times."""
    for _ in range(number):
        graph()


@contextmanager
def constants(values: dict[str, Any]) -> Iterator[None]:
    """Give constants of the renderer other values."""
    before = {name: getattr(mjwarp_cameras, name) for name in values}
    try:
        for name, value in values.items():
            setattr(mjwarp_cameras, name, value)
        yield
    finally:
        for name, value in before.items():
            setattr(mjwarp_cameras, name, value)


if __name__ == "__main__":
    parser = make_parser(__doc__)
    parser.add_argument("--draws", type=count, default=10, help="renders per repetition")
    parser.add_argument("--repetitions", type=count, default=5)
    run(parser, measure)
