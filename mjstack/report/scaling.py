"""The scaling table and its curves: a row per backend and number of worlds."""

import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from mjstack.report.picture import figure
from mjstack.report.table import Table

PASS = "pass"
NOT_RUN = "not run"
RATE = "physics.world_steps_per_s.median"

Row = dict[str, Any]
"""One run of the job: ``nworld``, ``backend``, ``status`` (pass, fail, out of memory or not run),
``reason``, ``seconds`` with the start of its process, ``hardware``, ``git_commit``, and every
metric of its gates by name. A figure that was not measured, or is void, is missing."""

# By backend: colour, label, and height at which failed runs are marked (share of the axis).
_BACKENDS = {"mjwarp": ("#2a7d2e", "MJWarp", 0.02), "native": ("#2457c7", "native MuJoCo", 0.06)}
_SERIES = (
    (RATE, "-", "o", "physics"),
    ("env_step.env_steps_per_s.median", "--", "s", "env.step"),
)


def crossover(rows: Sequence[Row]) -> float | None:
    """Number of worlds from which MJWarp makes more world-steps/s than native MuJoCo.

    Interpolated between the two numbers of worlds that bracket it, straight in logarithms. Runs
    that failed do not count. None where the rows do not show it.
    """
    rates = {
        (row["backend"], row["nworld"]): row[RATE]
        for row in rows
        if row["status"] == PASS and RATE in row
    }
    both = sorted({n for _, n in rates if ("mjwarp", n) in rates and ("native", n) in rates})
    points = [(n, math.log(rates["mjwarp", n] / rates["native", n])) for n in both]
    for (n0, gap0), (n1, gap1) in pairwise(points):
        if gap0 <= 0.0 < gap1:
            return math.exp(math.log(n0) + (math.log(n1) - math.log(n0)) * -gap0 / (gap1 - gap0))
    return None


def describe_crossover(rows: Sequence[Row]) -> str:
    """The crossover in a sentence."""
    at = crossover(rows)
    if at is None:
        return "Crossover: the runs that passed do not show MJWarp passing native MuJoCo."
    return (
        f"Crossover: from about {at:,.0f} worlds on MJWarp makes more physics steps than native"
        " MuJoCo on all cores."
    )


def scaling_table(rows: Sequence[Row]) -> Table:
    """The columns that a reader compares; "-" where a run has no figure."""
    return Table.of("", _SHOWN, rows)


def save_scaling_curves(path: Path, rows: Sequence[Row], decimation: int, title: str) -> None:
    """Draw throughput and time per step over the number of worlds.

    Args:
        path: The picture.
        rows: The table. A run that did not pass interrupts its curves, whatever it has measured,
            and a cross marks it.
        decimation: Physics steps in an environment step: both are drawn as world-steps/s.
        title: What is shown.
    """
    with figure(path, f"{title} (x: no figure)", 2, figsize=(12, 4.8)) as (_, (rate, cost)):
        for backend, (color, label, height) in _BACKENDS.items():
            mine = sorted(
                (row for row in rows if row["backend"] == backend), key=lambda row: row["nworld"]
            )
            worlds = [row["nworld"] for row in mine]
            # A curve per series
            for name, line, marker, series in _SERIES:
                factor = 1 if name == RATE else decimation
                values = [
                    factor * row.get(name, math.nan) if row["status"] == PASS else math.nan
                    for row in mine
                ]
                if all(math.isnan(value) for value in values):
                    continue
                steps_ms = [1e3 * n / value for n, value in zip(worlds, values, strict=True)]
                style: dict[str, Any] = {"marker": marker, "markersize": 4, "color": color}
                for axes, curve in ((rate, values), (cost, steps_ms)):
                    axes.plot(worlds, curve, line, label=f"{label}, {series}", **style)
            # Runs without a figure
            failed = [row["nworld"] for row in mine if row["status"] != PASS]
            for axes in (rate, cost):
                at_height = axes.get_xaxis_transform()
                axes.plot(failed, [height] * len(failed), "x", color=color, transform=at_height)
        # Axes
        at = crossover(rows)
        ticks = sorted({row["nworld"] for row in rows})
        for axes, name in ((rate, "world-steps/s"), (cost, "ms per physics step of all worlds")):
            axes.set(yscale="log", xlabel="worlds", ylabel=name)
            axes.set_xscale("log", base=2)
            axes.set_xticks(ticks, [f"{n:,}" for n in ticks], rotation=45)
            axes.grid(alpha=0.3)
            if at is not None:
                axes.axvline(at, color="0.4", linestyle=":", label=f"crossover, {at:,.0f} worlds")
            if axes.get_legend_handles_labels()[0]:
                axes.legend(frameon=False, fontsize=8)


_SHOWN = {
    "worlds": "nworld",
    "backend": "backend",
    "succeeded": "succeeded",
    "ms per step": "physics.ms_per_batched_step.median",
    "world-steps/s": RATE,
    "env-steps/s": "env_step.env_steps_per_s.median",
    "managers": "env_step.managers_over_physics.median",
    "managers alone": "env_step.managers_alone_over_physics.median",
    "episode, s": "episode.seconds.median",
    "over bare steps": "episode.bare_ratio.median",
    "GPU memory, MiB": "env_step.gpu_memory_whole_gpu_mib",
    "capture, s": "episode.capture_s",
    "status": "status",
    "reason": "reason",
}
