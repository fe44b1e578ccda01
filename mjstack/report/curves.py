"""Curves over the number of worlds: throughput and time per step, native MuJoCo and MJWarp."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import matplotlib

from mjstack.report.scaling import PASS, ScalingRow, crossover

matplotlib.use("Agg")
import matplotlib.pyplot as plt

COLORS = {"mjwarp": "#2a7d2e", "native": "#2457c7"}
LABELS = {"mjwarp": "MJWarp", "native": "native MuJoCo"}
_SERIES = (
    ("world_steps_per_s", "-", "o", "physics"),
    ("env_steps_per_s", "--", "s", "env.step"),
)


def save_scaling_curves(
    path: Path, rows: Sequence[ScalingRow], decimation: int, title: str
) -> None:
    """Draws both panels.

    Args:
        path: The picture.
        rows: The table. A case that did not pass interrupts its curves, whatever it has measured,
            and a cross marks it.
        decimation: Physics steps in an environment step: both are drawn as world-steps/s.
        title: What is shown.
    """
    figure, (rate, cost) = plt.subplots(1, 2, figsize=(12, 4.8), layout="constrained")
    for backend, color in COLORS.items():
        mine = sorted((row for row in rows if row.backend == backend), key=lambda row: row.nworld)
        if not mine:
            continue
        worlds = [row.nworld for row in mine]
        for name, line, marker, what in _SERIES:
            factor = decimation if name == "env_steps_per_s" else 1
            values = [
                factor * _number(getattr(row, name)) if row.status == PASS else math.nan
                for row in mine
            ]
            if all(math.isnan(value) for value in values):
                continue
            label = f"{LABELS[backend]}, {what}"
            rate.plot(worlds, values, line, marker=marker, markersize=4, color=color, label=label)
            steps = [1e3 * n / value for n, value in zip(worlds, values, strict=True)]
            cost.plot(worlds, steps, line, marker=marker, markersize=4, color=color, label=label)
        failed = [row.nworld for row in mine if row.status != PASS]
        for axes in (rate, cost):
            bottom = [0.02 if backend == "mjwarp" else 0.06] * len(failed)
            axes.plot(failed, bottom, "x", color=color, transform=axes.get_xaxis_transform())
    at = crossover(rows)
    for axes, name, goes in (
        (rate, "world-steps/s", "up"),
        (cost, "ms per physics step of all worlds", "down"),
    ):
        axes.set(xscale="log", yscale="log", xlabel="worlds", ylabel=name, title=f"{name}")
        axes.set_xscale("log", base=2)
        axes.set_xticks(
            sorted({row.nworld for row in rows}),
            [f"{n:,}" for n in sorted({row.nworld for row in rows})],
        )
        axes.tick_params(axis="x", rotation=45)
        axes.grid(alpha=0.3, which="both" if goes == "up" else "major")
        if at is not None:
            axes.axvline(at, color="0.4", linestyle=":", label=f"crossover, {at:,.0f} worlds")
        if axes.get_legend_handles_labels()[0]:
            axes.legend(frameon=False, fontsize=8)
    figure.suptitle(f"{title} (x: no figure)")
    figure.savefig(path, dpi=100)
    plt.close(figure)


def _number(value: float | None) -> float:
    return float(value) if isinstance(value, float | int) else math.nan
