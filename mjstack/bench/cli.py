"""Command lines of the benchmark scripts: one harness, and the measurements of each."""

import argparse
import itertools
import statistics
from collections.abc import Callable, Sequence

import numpy as np

from mjstack.bench import cameras, env_step, ik, physics, solver
from mjstack.config import load_config
from mjstack.config.schema import Backend, Config
from mjstack.envs import build_env, decided_every_step
from mjstack.envs.buffers import Advance
from mjstack.episodes.context import RunContext
from mjstack.errors import ConfigError, MjstackError
from mjstack.report.table import Console, Table
from mjstack.sim import resolve_device

Work = Callable[[argparse.Namespace, Config, Advance], list[Table]]


def main(name: str, argv: Sequence[str] | None = None) -> None:
    """Run a benchmark from its command line, and print its tables.

    Args:
        name: Of the benchmark in `BENCHMARKS`.
        argv: The command line, if not the process's.
    """
    work, description, numbers = BENCHMARKS[name]
    parser = argparse.ArgumentParser(
        description=(description or "").partition("Args:")[0],
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    help_text = "as for run.py, such as robot=rebot nworld=1024 (default nworld=256)"
    parser.add_argument("overrides", nargs="*", help=help_text)
    for option, (default, text) in numbers.items():
        many = "+" if isinstance(default, list) else None
        shown = f"{text} (%(default)s)"
        parser.add_argument(f"--{option}", type=int, nargs=many, default=default, help=shown)
    args = parser.parse_args(argv)
    try:
        for option in numbers:
            value = getattr(args, option.replace("-", "_"))
            if np.min(value) < 1:
                raise ConfigError(f"--{option}", value, "an integer of at least 1")
        console = Console(soft_wrap=True)
        cfg = load_config(["nworld=256", *args.overrides])
        with console.status("preparing") as status:

            def advance(what: str, done: int, total: int) -> None:
                status.update(f"{what}: {done} of {total}")

            tables = work(args, cfg, advance)
    except MjstackError as error:
        Console(stderr=True, soft_wrap=True, markup=False).print(f"mjstack: {error}")
        raise SystemExit(error.exit_code) from error
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    for table in tables:
        console.print(table.to_console())


def _env_step(args: argparse.Namespace, cfg: Config, advance: Advance) -> list[Table]:
    """``env.step`` on both backends."""
    results = {}
    for backend in (Backend.native, Backend.mjwarp):
        device = "cpu" if backend is Backend.native else resolve_device(cfg.sim.device)
        slow = backend is Backend.mjwarp and device == "cpu"
        nworld = min(cfg.nworld, args.cpu_nworld) if slow else cfg.nworld
        every_step = decided_every_step(cfg)
        env = build_env(every_step, nworld=nworld, backend=backend, device=device)
        title = f"{env.sim.description}, {nworld} worlds"
        result = env_step.measure_env_step(
            env, steps=args.steps, repetitions=args.repetitions, advance=advance
        )
        env.close()
        if result.problem:
            raise MjstackError(f"{title}: no figure: {result.problem}.")
        results[title] = result
    figures = [
        [name.replace("_", " "), *(_spread(found.samples[name]) for found in results.values())]
        for name in result.samples
    ]
    ended = [str(found.facts["episodes_ended"]) for found in results.values()]
    table = Table(
        title=f"env.step: {cfg.task.name}, {cfg.robot.title}, random actions, with resets",
        header=["median (smallest to largest)", *results],
        rows=[*figures, ["episodes that ended and were reset", *ended]],
    )
    return [table]


def _physics(args: argparse.Namespace, cfg: Config, advance: Advance) -> list[Table]:
    """The captured physics step in each arrangement: in the task, and under random actions."""
    context = RunContext(cfg=cfg, advance=advance)
    tables = []
    for random in (False, True):
        times = physics.measure_arrangements(
            context, steps=args.steps, repetitions=args.repetitions, random=random
        )
        bare = times[physics.BARE]
        moving = "random actions" if random else f"from {cfg.gate.throughput.from_phase}"
        table = Table(
            title=f"a captured step: {cfg.robot.title}, {cfg.nworld:,} worlds, {moving}",
            header=["arrangement, each with all above it", "ms per step", "bare over it"],
            rows=[
                [name, _spread(ms), _spread([b / a for a, b in zip(ms, bare, strict=True)])]
                for name, ms in times.items()
            ],
        )
        tables.append(table)
    return tables


def _cameras(args: argparse.Namespace, cfg: Config, advance: Advance) -> list[Table]:
    """Images alone, in each arrangement of the renderer."""
    times = cameras.measure_cameras(
        RunContext(cfg=cfg), draws=args.draws, repetitions=args.repetitions, advance=advance
    )
    images = len(cfg.scene.cameras) * cfg.nworld
    shown = ", ".join(f"{name} {c.size[0]} x {c.size[1]}" for name, c in cfg.scene.cameras.items())
    table = Table(
        title=f"images: {cfg.robot.title}, {cfg.nworld:,} worlds, {shown}",
        header=["arrangement", "ms per draw", "images/s"],
        rows=[
            [name, _spread(ms), _spread([1e3 * images / each for each in ms])]
            for name, ms in times.items()
        ],
    )
    return [table]


def _solver(args: argparse.Namespace, cfg: Config, advance: Advance) -> list[Table]:
    """The fused solver beside ``mujoco_warp.solve``."""
    numbers = solver.compare_solvers(RunContext(cfg=cfg, advance=advance), states=args.states)
    tables = solver.report(numbers)
    tables[0].title = f"solvers: {cfg.task.name}, {cfg.robot.title}, {cfg.nworld:,} worlds"
    return tables


def _ik(args: argparse.Namespace, cfg: Config, advance: Advance) -> list[Table]:
    """Batched inverse kinematics, in every combination of the options."""
    device = resolve_device(cfg.sim.device)
    cases = list(itertools.product(args.nworld, args.iterations, args.block_dim, (0.0, _GAIN)))
    rows = []
    for number, (nworld, iterations, block_dim, gain) in enumerate(cases, 1):
        result = ik.measure_solve(
            cfg,
            device,
            nworld=nworld,
            iterations=iterations,
            block_dim=block_dim,
            gain=gain,
            repetitions=args.repetitions,
        )
        times = {name: _spread(result.samples.get(name)) for name in ("eager_ms", "graph_ms")}
        rows.append({**result.facts, **times})
        advance("cases", number, len(cases))
    columns = {
        "worlds": "nworld",
        "iterations": "iterations",
        "block": "block_dim",
        "eager, ms": "eager_ms",
        "in a graph, ms": "graph_ms",
        "share within 0.5 mm": "reached",
        "gains": "gain",
    }
    return [Table.of(columns, rows, f"BatchedIk.solve: {cfg.robot.title}, {device}")]


def _spread(values: list[float] | None) -> str:
    """Median and range of repetitions; "-" where there are none."""
    if not values:
        return "-"
    return f"{statistics.median(values):.4g} ({min(values):.4g} to {max(values):.4g})"


_GAIN = 0.1  # of posture and approach, where they count
Numbers = dict[str, tuple[int | list[int], str]]
_STEPS = "control steps per repetition"
_REPETITIONS = "measured repetitions"
BENCHMARKS: dict[str, tuple[Work, str | None, Numbers]] = {
    "env_step": (
        _env_step,
        env_step.__doc__,
        {
            "steps": (10, _STEPS),
            "repetitions": (9, _REPETITIONS),
            "cpu-nworld": (64, "most worlds of MJWarp where it has no GPU"),
        },
    ),
    "physics": (
        _physics,
        physics.measure_arrangements.__doc__,
        {"steps": (20, _STEPS), "repetitions": (5, _REPETITIONS)},
    ),
    "cameras": (
        _cameras,
        cameras.measure_cameras.__doc__,
        {
            "draws": (10, "images of each camera and world per repetition"),
            "repetitions": (5, _REPETITIONS),
        },
    ),
    "solver": (_solver, solver.__doc__, {"states": (20_000, "states to record at least")}),
    "ik": (
        _ik,
        ik.__doc__,
        {
            "nworld": ([256, 2048, 8192], "numbers of worlds"),
            "iterations": ([4, 8, 16, 40], "iterations per solve"),
            "block-dim": ([32], "CUDA threads per block"),
            "repetitions": (20, f"measurements of {ik.SOLVES} solves each"),
        },
    ),
}
"""By name: what measures, text of ``--help``, and options that are integers of at least 1, or lists
of them, with default and help."""
