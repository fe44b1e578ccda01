"""The scaling table: a row per backend and number of worlds, as CSV and as text."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any

from mjstack.report.table import Table, to_document

PASS = "pass"
NOT_RUN = "not run"

Row = dict[str, Any]
"""One run of the job by the names of `COLUMNS`; a figure that was not measured, or is void, is
None."""

_MEASUREMENTS = ("physics", "episode", "env_step")
COLUMNS: dict[str, tuple[str, ...]] = {
    "nworld": (),
    "backend": (),
    "status": (),  # pass, fail, out of memory, timeout, crashed, or not run
    "reason": (),  # in one line; empty for a pass
    "succeeded": ("succeeded",),  # worlds, in the batch gate
    # One physics step of all worlds under a held joint target.
    "ms_per_step": ("physics.ms_per_batched_step.median",),
    "ms_per_step_min": ("physics.ms_per_batched_step.min",),
    "ms_per_step_max": ("physics.ms_per_batched_step.max",),
    "world_steps_per_s": ("physics.world_steps_per_s.median",),
    "world_steps_per_s_min": ("physics.world_steps_per_s.min",),
    "world_steps_per_s_max": ("physics.world_steps_per_s.max",),
    # `env.step` with all managers.
    "ms_per_env_step": ("env_step.ms_per_env_step.median",),
    "env_steps_per_s": ("env_step.env_steps_per_s.median",),
    "env_steps_per_s_min": ("env_step.env_steps_per_s.min",),
    "env_steps_per_s_max": ("env_step.env_steps_per_s.max",),
    "managers_over_physics": ("env_step.managers_over_physics.median",),
    "managers_alone_over_physics": ("env_step.managers_alone_over_physics.median",),
    # The validated episode; bare_ratio is its time over that of bare steps.
    "episode_s": ("episode.seconds.median",),
    "bare_ratio": ("episode.bare_ratio.median",),
    # The most of all measurements.
    "gpu_memory_arrays_mib": tuple(f"{name}.gpu_memory_arrays_mib" for name in _MEASUREMENTS),
    "gpu_memory_whole_gpu_mib": tuple(f"{name}.gpu_memory_whole_gpu_mib" for name in _MEASUREMENTS),
    "gpu_power_mean_w": ("episode.gpu_power_mean_w",),
    "process_peak_mib": ("process_peak_mib",),  # host memory
    "build_s": ("build_and_compile_s",),
    "warm_up_s": ("episode.warm_up_s",),  # an episode's first step, which runs eagerly
    "capture_s": ("episode.capture_s",),
    "seconds": (),  # the whole run, start of its process included
    "hardware": (),
    "git_commit": (),
}
"""Columns of scaling.csv, each with the metrics of a run's gates that it takes; the largest of
several."""


def new_row(nworld: int, backend: str, **values: Any) -> Row:
    """A row that has not run, with some values."""
    empty = dict.fromkeys(COLUMNS) | {"status": NOT_RUN, "reason": ""}
    return empty | {"nworld": nworld, "backend": backend} | values


def take_figures(metrics: Mapping[str, float]) -> Row:
    """The columns that come from metrics; None where none of theirs is there."""
    return {
        column: max((metrics[name] for name in names if name in metrics), default=None)
        for column, names in COLUMNS.items()
        if names
    }


def to_markdown(rows: Sequence[Row], title: str, notes: Sequence[str], picture: str = "") -> str:
    """The table for people, the crossover, and where the rows come from."""
    lines = [describe_crossover(rows), *notes]
    for name in ("hardware", "git_commit"):
        values = sorted({row[name] for row in rows if row[name]})
        lines += [f"{name.removeprefix('git_')}: {value}" for value in values]
    return to_document(title, [Table.of("", _SHOWN, rows)], lines, picture)


def crossover(rows: Sequence[Row]) -> float | None:
    """Number of worlds from which MJWarp makes more world-steps/s than native MuJoCo.

    Interpolated between the two numbers of worlds that bracket it, straight in logarithms. Runs
    that failed do not count. None where the rows do not show it.
    """
    rates = {
        (row["backend"], row["nworld"]): row["world_steps_per_s"]
        for row in rows
        if row["status"] == PASS and row["world_steps_per_s"] is not None
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


def _figure(column: str, form: str = ",.0f") -> Callable[[Row], str]:
    """How a figure is shown; "-" where there is none."""

    def show(row: Row) -> str:
        value = row[column]
        return format(value, form) if isinstance(value, float | int) else "-"

    return show


_SHOWN: dict[str, Callable[[Row], str]] = {
    "worlds": _figure("nworld"),
    "backend": lambda row: row["backend"],
    "succeeded": _figure("succeeded"),
    "ms per step": _figure("ms_per_step", ".4g"),
    "world-steps/s": _figure("world_steps_per_s"),
    "env-steps/s": _figure("env_steps_per_s"),
    "managers": _figure("managers_over_physics", "+.1%"),
    "managers alone": _figure("managers_alone_over_physics", ".1%"),
    "episode, s": _figure("episode_s", ".3g"),
    "over bare steps": _figure("bare_ratio", ".3f"),
    "GPU memory, MiB": _figure("gpu_memory_whole_gpu_mib"),
    "capture, s": _figure("capture_s", ".2f"),
    "status": lambda row: f"{row['status']}: {row['reason']}" if row["reason"] else row["status"],
}
