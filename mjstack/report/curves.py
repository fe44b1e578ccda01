"""Curves over the number of worlds: throughput and time per step, native MuJoCo and MJWarp."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import matplotlib

from mjstack.report.scaling import PASS, Row, crossover

matplotlib.use("Agg")
import matplotlib.pyplot as plt

# By backend: colour, label, and height at which failed runs are marked (share of the axis).
_BACKENDS = {"mjwarp": ("#2a7d2e", "MJWarp", 0.02), "native": ("#2457c7", "native MuJoCo", 0.06)}
_SERIES = (
    ("world_steps_per_s", "-", "o", "physics"),
    ("env_steps_per_s", "--", "s", "env.step"),
)


def save_scaling_curves(path: Path, rows: Sequence[Row], decimation: int, title: str) -> None:
    """Draw both panels.

    Args:
        path: The picture.
        rows: The table. A run that did not pass interrupts its curves, whatever it has measured,
            and a cross marks it.
        decimation: Physics steps in an environment step: both are drawn as world-steps/s.
        title: What is shown.
    """
    figure, (rate, cost) = plt.subplots(1, 2, figsize=(12, 4.8), layout="constrained")
    for backend, (color, label, height) in _BACKENDS.items():
        mine = sorted(
            (row for row in rows if row["backend"] == backend), key=lambda row: row["nworld"]
        )
        worlds = [row["nworld"] for row in mine]
        # A curve per series
        for name, line, marker, series in _SERIES:
            factor = decimation if name == "env_steps_per_s" else 1
            values = [
                factor * row[name] if row["status"] == PASS and row[name] else math.nan
                for row in mine
            ]
            if all(math.isnan(value) for value in values):
                continue
            steps_ms = [1e3 * n / value for n, value in zip(worlds, values, strict=True)]
            for axes, curve in ((rate, values), (cost, steps_ms)):
                text = f"{label}, {series}"
                axes.plot(worlds, curve, line, marker=marker, markersize=4, color=color, label=text)
        # Runs without a figure
        failed = [row["nworld"] for row in mine if row["status"] != PASS]
        for axes in (rate, cost):
            marks = [height] * len(failed)
            axes.plot(failed, marks, "x", color=color, transform=axes.get_xaxis_transform())
    # Axes
    at = crossover(rows)
    ticks = sorted({row["nworld"] for row in rows})
    for axes, name, grid in (
        (rate, "world-steps/s", "both"),
        (cost, "ms per physics step of all worlds", "major"),
    ):
        axes.set(yscale="log", xlabel="worlds", ylabel=name, title=name)
        axes.set_xscale("log", base=2)
        axes.set_xticks(ticks, [f"{n:,}" for n in ticks])
        axes.tick_params(axis="x", rotation=45)
        axes.grid(alpha=0.3, which=grid)
        if at is not None:
            axes.axvline(at, color="0.4", linestyle=":", label=f"crossover, {at:,.0f} worlds")
        if axes.get_legend_handles_labels()[0]:
            axes.legend(frameon=False, fontsize=8)
    figure.suptitle(f"{title} (x: no figure)")
    figure.savefig(path, dpi=100)
    plt.close(figure)
