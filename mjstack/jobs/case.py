"""One case of the scaling job: the gates, for one backend and number of worlds, in a process of its
own.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from mjstack.errors import MjstackError, is_out_of_memory
from mjstack.files import write_atomic
from mjstack.report.scaling import NOT_RUN, PASS, ScalingRow

RESULT = "case.json"
_START = "from mjstack.__main__ import main; main()"
_NO_ROOM = re.compile(r"that fit into the \d+ GiB")  # refused before it started
_GRACE = 20.0  # s, for a process that was asked to stop


class OutOfTime(MjstackError):
    """The call's time is over; the case counts as not run."""


def read_case(folder: Path, nworld: int, backend: str) -> ScalingRow:
    """The row of a case, as not run where it has not finished."""
    try:
        data = json.loads((folder / RESULT).read_text())
        return ScalingRow(**data)
    except (OSError, ValueError, TypeError):  # not there, or of another version
        return ScalingRow(nworld=nworld, backend=backend)


def run_case(
    folder: Path,
    nworld: int,
    backend: str,
    overrides: Sequence[str],
    *,
    case_seconds: float,
    call_seconds: float,
) -> ScalingRow:
    """Runs a case and keeps its row in its folder.

    Args:
        folder: The case's folder; its report, log and output go there.
        nworld: Number of worlds.
        backend: ``mjwarp`` or ``native``.
        overrides: What the command line of the case says.
        case_seconds: After that it has failed.
        call_seconds: After that it is stopped, and runs again in the next call.

    Returns:
        The row, also for a case that failed.

    Raises:
        OutOfTime: The call's time is over.
        KeyboardInterrupt: Ctrl-C; the process has been stopped.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "report.json").unlink(missing_ok=True)  # an earlier try's
    target = str(folder).replace("\\", "\\\\").replace("'", "\\'")
    command = [sys.executable, "-c", _START, *overrides, f"hydra.run.dir='{target}'"]
    began = time.monotonic()
    limit = min(case_seconds, call_seconds)
    with (folder / "output.log").open("w") as log:
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT
        )
        code: int | None = None
        try:
            code = process.wait(limit)
        except subprocess.TimeoutExpired:
            pass
        finally:
            _stop(process)
    seconds = time.monotonic() - began
    if code is None and call_seconds <= case_seconds:
        raise OutOfTime(f"{backend}, {nworld} worlds: stopped after {seconds:.0f} s")
    if code == 130:
        raise KeyboardInterrupt
    row = _row(folder, nworld, backend, code)
    row.seconds = seconds
    if code is None:
        row.status = "timeout"
        row.reason = f"not done after {seconds:.0f} s (job.case_minutes)"
    write_atomic(folder / RESULT, json.dumps(asdict(row), indent=2) + "\n")
    return row


def _stop(process: subprocess.Popen) -> None:
    """Asks a process that still runs to stop, as Ctrl-C would, and ends it if it does not."""
    if process.poll() is not None:
        return
    try:
        process.wait(1.0)  # a terminal's Ctrl-C has reached it too
        return
    except subprocess.TimeoutExpired:
        pass
    process.terminate() if sys.platform == "win32" else process.send_signal(2)
    try:
        process.wait(_GRACE)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _row(folder: Path, nworld: int, backend: str, code: int | None) -> ScalingRow:
    """Reads the case's report, as far as it got."""
    try:
        report = json.loads((folder / "report.json").read_text())
    except (OSError, ValueError):
        report = {"gates": [], "provenance": {}}
    output = (folder / "output.log").read_text(errors="replace").strip()
    gates = {gate["name"]: gate for gate in report["gates"]}
    row = ScalingRow(
        nworld=nworld, backend=backend, git_commit=str(report["provenance"].get("git_commit", ""))
    )
    row.succeeded = gates.get("batch", {}).get("metrics", {}).get("succeeded")
    for name in ("throughput", "throughput_cuda"):
        if name in gates and gates[name]["status"] != "skip":
            _fill(row, gates[name]["metrics"])
            row.hardware = gates[name]["notes"].get("backend", "")
    failed = [f"{g['name']}: {g['reason']}" for g in report["gates"] if g["status"] == "fail"]
    last = output.splitlines()[-1] if output else "no output"
    if code == 0:
        row.status = PASS
        return row
    row.status = "fail"
    row.reason = "; ".join(failed) or last
    if (
        is_out_of_memory(row.reason)
        or _NO_ROOM.search(row.reason)
        or (code != 2 and is_out_of_memory(output))
    ):
        row.status = "out of memory"
    elif code is not None and code < 0:
        row.status = "out of memory" if code == -9 else "crashed"
        row.reason = f"killed by signal {-code}" + (
            ", as the system does when memory runs out" if code == -9 else f"; {last}"
        )
    return row


def _fill(row: ScalingRow, metrics: dict[str, Any]) -> None:
    """Takes the columns from a throughput gate's metrics. What is missing stays None."""
    get = metrics.get

    def most(name: str) -> float | None:
        found = [
            value
            for section in ("physics", "episode", "env_step")
            if (value := get(f"{section}.{name}")) is not None
        ]
        return max(map(float, found), default=None)

    for column, name in (
        ("ms_per_step", "physics.ms_per_batched_step"),
        ("world_steps_per_s", "physics.world_steps_per_s"),
        ("env_steps_per_s", "env_step.env_steps_per_s"),
    ):
        setattr(row, column, get(f"{name}.median"))
        setattr(row, f"{column}_min", get(f"{name}.min"))
        setattr(row, f"{column}_max", get(f"{name}.max"))
    row.ms_per_env_step = get("env_step.ms_per_env_step.median")
    row.managers_over_physics = get("env_step.managers_over_physics.median")
    row.managers_alone_over_physics = get("env_step.managers_alone_over_physics.median")
    row.episode_s = get("episode.seconds.median")
    row.bare_ratio = get("episode.bare_ratio.median")
    row.gpu_memory_arrays_mib = most("gpu_memory_arrays_mib")
    row.gpu_memory_whole_gpu_mib = most("gpu_memory_whole_gpu_mib")
    row.gpu_power_mean_w = get("episode.gpu_power_mean_w")
    row.process_peak_mib = get("process_peak_mib")
    row.build_s = get("build_and_compile_s")
    row.warm_up_s = get("episode.warm_up_s")
    row.capture_s = get("episode.capture_s")


def is_done(row: ScalingRow, retry: bool) -> bool:
    """Whether a case need not run."""
    return row.status == PASS or (row.status != NOT_RUN and not retry)
