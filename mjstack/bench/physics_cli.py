"""What each change to the captured physics step is worth, beside a bare replayed
``mujoco_warp.step``.

Every turn plays the same steps of the scripted task, cube in hand, from the same states, for one
arrangement after the other. So the ratios are of one run, one trajectory and one machine's mood.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table

from mjstack.config import load_config
from mjstack.config.schema import Backend
from mjstack.episodes.context import GateContext
from mjstack.episodes.observers import CommandRecorder, Snapshots
from mjstack.episodes.rollout import restore
from mjstack.errors import ConfigError, MjstackError
from mjstack.report.provenance import collect_provenance
from mjstack.sim import LOST_PHYSICS, resolve_device

BARE = "mujoco_warp.step as it is"


def measure_arrangements(
    context: GateContext, *, steps: int, turns: int, progress: Callable[[int], None] | None = None
) -> dict[str, list[float]]:
    """Times every arrangement.

    Args:
        context: The configuration; its worlds run on MJWarp.
        steps: Steps per turn, from the phase ``gate.throughput.from_phase``.
        turns: Measured turns; one before them warms up.
        progress: Told the turns done.

    Returns:
        Milliseconds per batched physics step, one number per turn, by arrangement.

    Raises:
        MjstackError: Physics was lost, or a state is not finite: the figures would be void.
    """
    from mjstack.sim.mjwarp import Arrangement, MjwarpSimulation

    cfg = context.cfg
    arrangements = {
        "and counted, its overflow latched": Arrangement(own_stages=False, scratch=False),
        "temporaries at fixed addresses": Arrangement(own_stages=False),
        "only the stages that are needed": Arrangement(branches=False, sensors_once=False),
        "sensors in the last step of a step alone": Arrangement(branches=False),
        "contacts beside smooth dynamics": Arrangement(),
    }
    device = resolve_device(cfg.sim.device)
    sim = context.simulation(cfg.nworld, Backend.mjwarp, device)
    assert isinstance(sim, MjwarpSimulation)
    first = context.phase_start(cfg.gate.throughput.from_phase)
    snapshots = Snapshots([first - 1])
    recorder = CommandRecorder()
    context.play(sim, cfg.reset, [snapshots, recorder])
    state = snapshots.states[first - 1]
    tape = recorder.recorded.rewind()
    columns = torch.as_tensor(context.index.ctrl, device=sim.device)
    commands = [tape.command() for _ in range(min(first + steps, tape.steps))][first:]
    bare = sim.bare_step()
    decimation = cfg.timing.decimation

    def plain() -> None:
        for _ in range(decimation):
            bare()

    times: dict[str, list[float]] = {name: [] for name in (BARE, *arrangements)}
    for turn in range(turns + 1):
        for name in times:
            if name in arrangements:
                sim.arrange(arrangements[name])
            step: Callable[[], None] = plain if name == BARE else lambda: sim.step(decimation)
            for _ in range(2):  # warm-up and capture
                step()
            restore(sim, state)
            sim.synchronize()
            began = time.perf_counter()
            for command in commands:
                sim.ctrl[:, columns] = command
                step()
            sim.synchronize()
            if turn:
                times[name].append(
                    1e3 * (time.perf_counter() - began) / (len(commands) * decimation)
                )
            if bool(((sim.overflow & LOST_PHYSICS) != 0).any()) or not bool(
                torch.isfinite(sim.qpos).all()
            ):
                raise MjstackError(
                    f"{name}: physics was lost, and a figure would be void. Run gates=[capacity]."
                )
        if turn and progress is not None:
            progress(turn)
    sim.close()
    return times


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point of scripts/bench_physics.py."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "overrides",
        nargs="*",
        help="as for run.py, such as robot=rebot nworld=2048 (default nworld=256)",
    )
    parser.add_argument("--steps", type=int, default=20, help="steps per turn (20)")
    parser.add_argument("--turns", type=int, default=5, help="measured turns (5)")
    parser.add_argument("--out", type=Path, help="also write the figures to this JSON file")
    args = parser.parse_args(argv)
    console = Console(soft_wrap=True)
    try:
        for name in ("steps", "turns"):
            if getattr(args, name) < 1:
                raise ConfigError(f"--{name}", getattr(args, name), "an integer of at least 1")
        if args.out is not None and not args.out.absolute().parent.is_dir():
            raise ConfigError("--out", args.out, "a file in a folder that exists")
        cfg = load_config(["nworld=256", *args.overrides])
        with console.status("playing the task up to the grasp") as status:
            times = measure_arrangements(
                GateContext(cfg=cfg),
                steps=args.steps,
                turns=args.turns,
                progress=lambda turn: status.update(f"turn {turn} of {args.turns}"),
            )
    except MjstackError as error:
        Console(stderr=True, soft_wrap=True, markup=False).print(f"mjstack: {error}")
        raise SystemExit(error.exit_code) from error
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    table = Table(
        title=(
            f"a captured physics step: {cfg.robot.title}, {cfg.nworld:,} worlds, from"
            f" {cfg.gate.throughput.from_phase}"
        )
    )
    table.add_column("arrangement, each with all above it")
    table.add_column("ms per step, median (least to most)", justify="right")
    table.add_column("over bare, turn by turn", justify="right")
    for name, ms in times.items():
        ratio = statistics.median(a / b for a, b in zip(ms, times[BARE], strict=True))
        table.add_row(
            name, f"{statistics.median(ms):.4f} ({min(ms):.4f} to {max(ms):.4f})", f"{ratio:.3f}"
        )
    console.print(table)
    if args.out is not None:
        versions = collect_provenance(config_yaml="", model_text="", device="", driver="")[
            "versions"
        ]
        args.out.write_text(
            json.dumps({"command": sys.argv, "versions": versions, "ms_per_step": times}, indent=2)
            + "\n"
        )
