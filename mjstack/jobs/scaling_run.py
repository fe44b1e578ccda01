"""One run of the scaling job: the gates, for one backend and number of worlds, in a process."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from mjstack.config.session import search_path_override
from mjstack.errors import MjstackError, is_out_of_memory
from mjstack.files import write_atomic
from mjstack.report.scaling import COLUMNS, NOT_RUN, PASS, Row, new_row, take_figures

RESULT = "run.json"
_START = "from mjstack.__main__ import main; main()"
_REFUSED = re.compile(r"that fit into the \d+ GiB")  # by the memory check, before it started
_GRACE = 20.0  # s, for a process that was asked to stop


class OutOfTime(MjstackError):
    """The job's time is over; the run counts as not run."""


def read_run(folder: Path, nworld: int, backend: str) -> Row:
    """The row of a run, as not run where it has not finished."""
    try:
        row = json.loads((folder / RESULT).read_text())
        if row.keys() == COLUMNS.keys():
            return row
    except (OSError, ValueError, AttributeError):  # not there, or of another version
        pass
    return new_row(nworld, backend)


def is_done(row: Row, retry: bool) -> bool:
    """Whether a run need not be repeated."""
    return row["status"] == PASS or (row["status"] != NOT_RUN and not retry)


def run_process(
    folder: Path,
    nworld: int,
    backend: str,
    overrides: Sequence[str],
    *,
    run_seconds: float,
    job_seconds: float,
) -> Row:
    """Start a run's process, wait for it, and keep its row in its folder.

    Args:
        folder: The run's folder; its report, log and output go there.
        nworld: Number of worlds.
        backend: ``mjwarp`` or ``native``.
        overrides: The run's command line.
        run_seconds: After that it has failed.
        job_seconds: After that it is stopped; the next call of the job repeats it.

    Returns:
        The row, also for a run that failed.

    Raises:
        OutOfTime: The job's time is over.
        KeyboardInterrupt: Ctrl-C; the process has been stopped.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "report.json").unlink(missing_ok=True)  # an earlier try's
    target = str(folder).replace("\\", "\\\\").replace("'", "\\'")
    target_override = f"hydra.run.dir='{target}'"
    command = [
        sys.executable,
        "-c",
        _START,
        *overrides,
        *search_path_override(),
        target_override,
    ]
    began = time.monotonic()
    with (folder / "output.log").open("w") as log:
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT
        )
        code: int | None = None
        try:
            code = process.wait(min(run_seconds, job_seconds))
        except subprocess.TimeoutExpired:
            pass
        finally:
            _stop(process)
    seconds = time.monotonic() - began
    if code is None and job_seconds <= run_seconds:
        raise OutOfTime(f"{backend}, {nworld} worlds: stopped after {seconds:.0f} s")
    if code == 130:
        raise KeyboardInterrupt
    row = read_report(folder, nworld, backend, code) | {"seconds": seconds}
    if code is None:
        row |= {
            "status": "timeout",
            "reason": f"not done after {seconds:.0f} s (job.run_minutes)",
        }
    write_atomic(folder / RESULT, json.dumps(row, indent=2) + "\n")
    return row


def read_report(folder: Path, nworld: int, backend: str, code: int | None) -> Row:
    """The row of a run whose process has ended, from its report as far as it got.

    Args:
        folder: The run's folder.
        nworld: Number of worlds.
        backend: ``mjwarp`` or ``native``.
        code: The process's exit status; None where it was stopped.
    """
    try:
        report = json.loads((folder / "report.json").read_text())
    except (OSError, ValueError):
        report = {"gates": [], "provenance": {}}
    row = new_row(nworld, backend, git_commit=report["provenance"].get("git_commit", ""))
    metrics: dict[str, float] = {}
    for gate in report["gates"]:
        metrics |= gate["metrics"]
        row["hardware"] = gate["notes"].get("backend") or row["hardware"]
    row |= take_figures(metrics)
    if code == 0:
        return row | {"status": PASS}

    # Why it failed: the gates' reasons, or the last line of its output.
    failed = [f"{g['name']}: {g['reason']}" for g in report["gates"] if g["status"] == "fail"]
    output = (folder / "output.log").read_text(errors="replace").strip()
    last = output.splitlines()[-1] if output else "no output"
    status = "fail"
    reason = "; ".join(failed) or last
    no_memory = is_out_of_memory(reason) or _REFUSED.search(reason)
    if no_memory or (code != 2 and is_out_of_memory(output)):
        status = "out of memory"
    elif code == -9:
        status = "out of memory"
        reason = "killed by signal 9, as the system does when memory runs out"
    elif code is not None and code < 0:
        status = "crashed"
        reason = f"killed by signal {-code}; {last}"
    return row | {"status": status, "reason": reason}


def _stop(process: subprocess.Popen) -> None:
    """Ask a process that still runs to stop, as Ctrl-C would, and end it if it does not."""
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
