"""The scaling table: one row per backend and number of worlds, as CSV and as text."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

from mjstack.report.markdown import escape_cell

PASS = "pass"
NOT_RUN = "not run"


@dataclass(kw_only=True, slots=True)
class ScalingRow:
    """What one case found. A figure that was not measured, or that is void, is None.

    Attributes:
        nworld: Number of worlds.
        backend: ``mjwarp`` or ``native``.
        status: pass, fail, out of memory, timeout, crashed, or not run.
        reason: Why, in one line; empty for a pass.
        succeeded: Worlds whose episode succeeded.
        ms_per_step: One batched physics step under a held command [ms], median; ``_min`` and
            ``_max`` as well.
        world_steps_per_s: The same as physics steps of all worlds per second.
        ms_per_env_step: ``env.step`` with all managers [ms], median.
        env_steps_per_s: The same as control intervals of all worlds per second.
        managers_over_physics: What the managers add to physics in ``env.step``, as a fraction of
            it.
        managers_alone_over_physics: The time of the managers alone, likewise.
        episode_s: The validated episode [s], median.
        bare_ratio: That over bare steps of the same commands.
        gpu_memory_arrays_mib: GPU memory that arrays hold [MiB], most of all sections.
        gpu_memory_whole_gpu_mib: GPU memory that is taken on the whole GPU [MiB], likewise.
        gpu_power_mean_w: Mean power during the episodes' steps alone [W].
        process_peak_mib: Host memory [MiB]; of native cases.
        build_s: Building the worlds, compilation included [s].
        warm_up_s: An episode's first step, which runs eagerly [s].
        capture_s: Capturing an episode's graph, its warm-up not included [s].
        seconds: The whole case, start of its process included [s].
        hardware: Backend and hardware.
        git_commit: Which mjstack.
    """

    nworld: int
    backend: str
    status: str = NOT_RUN
    reason: str = ""
    succeeded: float | None = None
    ms_per_step: float | None = None
    ms_per_step_min: float | None = None
    ms_per_step_max: float | None = None
    world_steps_per_s: float | None = None
    world_steps_per_s_min: float | None = None
    world_steps_per_s_max: float | None = None
    ms_per_env_step: float | None = None
    env_steps_per_s: float | None = None
    env_steps_per_s_min: float | None = None
    env_steps_per_s_max: float | None = None
    managers_over_physics: float | None = None
    managers_alone_over_physics: float | None = None
    episode_s: float | None = None
    bare_ratio: float | None = None
    gpu_memory_arrays_mib: float | None = None
    gpu_memory_whole_gpu_mib: float | None = None
    gpu_power_mean_w: float | None = None
    process_peak_mib: float | None = None
    build_s: float | None = None
    warm_up_s: float | None = None
    capture_s: float | None = None
    seconds: float | None = None
    hardware: str = ""
    git_commit: str = ""


COLUMNS = tuple(field.name for field in fields(ScalingRow))


def to_markdown(
    rows: Sequence[ScalingRow], title: str, notes: Sequence[str], picture: str = ""
) -> str:
    """The table for people, what it says about the crossover, and where its rows come from."""
    lines = [f"# {title}", ""]
    lines += [
        "| " + " | ".join(name for name, _ in _COLUMNS) + " |",
        "| ---: | --- " + "| ---: " * (len(_COLUMNS) - 3) + "| --- |",
    ]
    for row in rows:
        lines.append("| " + " | ".join(escape_cell(show(row)) for _, show in _COLUMNS) + " |")
    if picture:
        lines += ["", f"![{title}]({picture})"]
    lines += ["", describe_crossover(rows), ""]
    lines += [f"- {note}" for note in notes]
    for name, values in (
        ("hardware", {row.hardware for row in rows}),
        ("commit", {row.git_commit for row in rows}),
    ):
        lines += [f"- {name}: {value}" for value in sorted(values - {""})]
    return "\n".join(lines) + "\n"


def crossover(rows: Sequence[ScalingRow]) -> float | None:
    """Number of worlds from which MJWarp makes more world-steps/s than native MuJoCo; None where
    the rows do not show it.

    Interpolated between the two numbers of worlds that bracket it, straight in logarithms. Cases
    that failed do not count.
    """
    rates = {
        (row.backend, row.nworld): float(row.world_steps_per_s)
        for row in rows
        if row.status == PASS and isinstance(row.world_steps_per_s, float)
    }
    both = sorted({n for _, n in rates if ("mjwarp", n) in rates and ("native", n) in rates})
    gap = [math.log(rates["mjwarp", n] / rates["native", n]) for n in both]
    for (n0, g0), (n1, g1) in zip(
        zip(both, gap, strict=True), list(zip(both, gap, strict=True))[1:], strict=False
    ):
        if g0 <= 0.0 < g1:
            return math.exp(math.log(n0) + (math.log(n1) - math.log(n0)) * -g0 / (g1 - g0))
    return None


def describe_crossover(rows: Sequence[ScalingRow]) -> str:
    """The crossover in a sentence."""
    at = crossover(rows)
    if at is None:
        return "Crossover: the cases that passed do not show MJWarp passing native MuJoCo."
    return (
        f"Crossover: from about {at:,.0f} worlds on MJWarp makes more physics steps than native"
        " MuJoCo on all cores."
    )


def _number(value: float | None, form: str = ",.0f") -> str:
    return format(value, form) if isinstance(value, float | int) else "-"


_COLUMNS = (
    ("worlds", lambda r: f"{r.nworld:,}"),
    ("backend", lambda r: r.backend),
    ("succeeded", lambda r: _number(r.succeeded)),
    ("ms per step", lambda r: _number(r.ms_per_step, ".4g")),
    ("world-steps/s", lambda r: _number(r.world_steps_per_s)),
    ("env-steps/s", lambda r: _number(r.env_steps_per_s)),
    ("managers", lambda r: _number(r.managers_over_physics, "+.1%")),
    ("managers alone", lambda r: _number(r.managers_alone_over_physics, ".1%")),
    ("episode, s", lambda r: _number(r.episode_s, ".3g")),
    ("over bare steps", lambda r: _number(r.bare_ratio, ".3f")),
    ("GPU memory, MiB", lambda r: _number(r.gpu_memory_whole_gpu_mib)),
    ("capture, s", lambda r: _number(r.capture_s, ".2f")),
    ("status", lambda r: f"{r.status}: {r.reason}" if r.reason else r.status),
)
