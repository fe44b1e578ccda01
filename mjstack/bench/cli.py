"""Command lines of the benchmark scripts: one harness, and what each measures."""

from __future__ import annotations

import argparse
import itertools
import json
import statistics
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from rich.console import Console

from mjstack.bench import env_step, ik, physics
from mjstack.bench.baseline import RolloutBaseline
from mjstack.bench.timing import Measurement
from mjstack.config import load_config
from mjstack.config.schema import Backend, Config
from mjstack.envs import build_env
from mjstack.episodes.context import RunContext
from mjstack.errors import ConfigError, MjstackError
from mjstack.report.provenance import collect_provenance
from mjstack.report.table import Table
from mjstack.sim import resolve_device

Progress = Callable[[str], None]
Work = Callable[[argparse.Namespace, Progress], tuple[Table, object]]


def bench_env_step(argv: Sequence[str] | None = None) -> None:
    """Entry point of scripts/bench_env_step.py."""
    numbers = {
        "steps": (10, "control steps per repetition"),
        "repetitions": (9, "measured repetitions"),
        "cpu-nworld": (64, "most worlds of MJWarp where it has no GPU"),
    }
    _main(env_step.__doc__, numbers, _env_step, argv)


def bench_physics(argv: Sequence[str] | None = None) -> None:
    """Entry point of scripts/bench_physics.py."""
    numbers = {
        "steps": (20, "control steps per repetition"),
        "repetitions": (5, "measured repetitions"),
    }
    _main(physics.measure_arrangements.__doc__, numbers, _physics, argv)


def bench_ik(argv: Sequence[str] | None = None) -> None:
    """Entry point of scripts/bench_ik.py."""
    numbers: dict[str, tuple[int | list[int], str]] = {
        "nworld": ([256, 2048, 8192], "numbers of worlds"),
        "iterations": ([4, 8, 16, 40], "iterations per solve"),
        "block-dim": ([32], "CUDA threads per block"),
        "repetitions": (20, f"measurements of {ik.SOLVES} solves each"),
    }
    _main(ik.__doc__, numbers, _ik, argv)


def _main(
    description: str | None,
    numbers: Mapping[str, tuple[int | list[int], str]],
    work: Work,
    argv: Sequence[str] | None,
) -> None:
    """Parse a command line, do the work, print its table and write its figures.

    Args:
        description: Text of ``--help``.
        numbers: Options that are integers of at least 1, or lists of them: default and help.
        work: Measures; gets the arguments and a function that shows progress.
        argv: The command line, if not the process's.
    """
    parser = argparse.ArgumentParser(
        description=(description or "").partition("Args:")[0],
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    help_text = "as for run.py, such as robot=rebot nworld=1024 (default nworld=256)"
    parser.add_argument("overrides", nargs="*", help=help_text)
    for name, (default, text) in numbers.items():
        many = "+" if isinstance(default, list) else None
        shown = " ".join(map(str, default)) if isinstance(default, list) else default
        parser.add_argument(
            f"--{name}", type=int, nargs=many, default=default, help=f"{text} ({shown})"
        )
    parser.add_argument("--out", type=Path, help="also write the figures to this JSON file")
    args = parser.parse_args(argv)
    console = Console(soft_wrap=True)
    try:
        for name in numbers:
            value = getattr(args, name.replace("-", "_"))
            if min(value if isinstance(value, list) else [value]) < 1:
                raise ConfigError(f"--{name}", value, "an integer of at least 1")
        if args.out is not None and not args.out.absolute().parent.is_dir():
            raise ConfigError("--out", args.out, "a file in a folder that exists")
        with console.status("preparing") as status:
            table, results = work(args, status.update)
    except MjstackError as error:
        Console(stderr=True, soft_wrap=True, markup=False).print(f"mjstack: {error}")
        raise SystemExit(error.exit_code) from error
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    console.print(table.to_console())
    if args.out is not None:
        provenance = collect_provenance(config_yaml="", model_text="", device="", driver="")
        data = {"command": sys.argv, "versions": provenance["versions"], "results": results}
        args.out.write_text(json.dumps(data, indent=2) + "\n")


def _config(args: argparse.Namespace) -> Config:
    return load_config(["nworld=256", *args.overrides])


def _env_step(args: argparse.Namespace, progress: Progress) -> tuple[Table, object]:
    """``env.step`` on both backends; native MuJoCo beside ``mujoco.rollout``."""
    cfg = _config(args)
    results = {}
    for backend in (Backend.native, Backend.mjwarp):
        device = "cpu" if backend is Backend.native else resolve_device(cfg.sim.device)
        slow = backend is Backend.mjwarp and device == "cpu"
        nworld = min(cfg.nworld, args.cpu_nworld) if slow else cfg.nworld
        env = build_env(cfg, nworld=nworld, backend=backend, device=device)
        title = f"{env.sim.description}, {nworld} worlds"
        # mujoco.rollout has one model for all worlds.
        plain = backend is Backend.native and not env.sim.fields
        result = env_step.measure_env_step(
            env,
            steps=args.steps,
            repetitions=args.repetitions,
            baseline=RolloutBaseline(env) if plain else None,
            progress=lambda done, title=title: progress(  # type: ignore[misc]
                f"{title}: repetition {done} of {args.repetitions}"
            ),
        )
        env.close()
        if result.problem:
            raise MjstackError(f"{title}: no figure: {result.problem}.")
        results[title] = result
    figures = list(dict.fromkeys(name for r in results.values() for name in r.samples))
    table = Table(
        title=f"env.step: {cfg.task.name}, {cfg.robot.title}, random actions, with resets",
        header=["median (smallest to largest)", *results],
        rows=[
            [name.replace("_", " "), *(_spread(r.samples.get(name)) for r in results.values())]
            for name in figures
        ],
    )
    ended = [str(r.facts["episodes_ended"]) for r in results.values()]
    table.rows.append(["episodes that ended and were reset", *ended])
    return table, [asdict(result) | {"backend": name} for name, result in results.items()]


def _physics(args: argparse.Namespace, progress: Progress) -> tuple[Table, object]:
    """The captured physics step in each arrangement."""
    cfg = _config(args)
    progress("playing the task up to the grasp")
    times = physics.measure_arrangements(
        RunContext(cfg=cfg),
        steps=args.steps,
        repetitions=args.repetitions,
        progress=lambda done: progress(f"repetition {done} of {args.repetitions}"),
    )
    bare = times[physics.BARE]
    table = Table(
        title=(
            f"a captured physics step: {cfg.robot.title}, {cfg.nworld:,} worlds, from"
            f" {cfg.gate.throughput.from_phase}"
        ),
        header=["arrangement, each with all above it", "ms per step", "over bare"],
        rows=[
            [name, _spread(ms), _spread([a / b for a, b in zip(ms, bare, strict=True)])]
            for name, ms in times.items()
        ],
    )
    return table, {"ms_per_step": times}


def _ik(args: argparse.Namespace, progress: Progress) -> tuple[Table, object]:
    """Batched inverse kinematics, in every combination of the options."""
    cfg = _config(args)
    device = resolve_device(cfg.sim.device)
    cases = list(itertools.product(args.nworld, args.iterations, args.block_dim, (False, True)))
    results = []
    for number, (nworld, iterations, block_dim, gained) in enumerate(cases, 1):
        progress(f"case {number} of {len(cases)}: {nworld} worlds, {iterations} iterations")
        results.append(
            ik.measure_solve(
                cfg,
                device,
                nworld=nworld,
                iterations=iterations,
                block_dim=block_dim,
                gained=gained,
                repetitions=args.repetitions,
            )
        )
    columns: dict[str, Callable[[Measurement], str]] = {
        "worlds": lambda r: f"{r.facts['nworld']:,}",
        "iterations": lambda r: str(r.facts["iterations"]),
        "block": lambda r: str(r.facts["block_dim"]),
        "eager, ms": lambda r: _spread(r.samples["eager_ms"]),
        "in a graph, ms": lambda r: _spread(r.samples.get("graph_ms")),
        "within 0.5 mm": lambda r: f"{100.0 * r.facts['reached']:.2f} %",
        "gains": lambda r: f"{ik.GAIN if r.facts['gained'] else 0.0}",
    }
    title = f"BatchedIk.solve: {cfg.robot.title}, {device}"
    return Table.of(title, columns, results), [asdict(result) for result in results]


def _spread(values: list[float] | None) -> str:
    """Median and range of repetitions; "-" where there are none."""
    if not values:
        return "-"
    return f"{statistics.median(values):.4g} ({min(values):.4g} to {max(values):.4g})"
