"""One run of the scaling job: the gates, for one backend and number of worlds, in a process."""

import json
import shutil
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mjstack.config.session import quoted, search_path_args
from mjstack.errors import is_out_of_memory
from mjstack.files import write_atomic
from mjstack.interrupt import check_interrupt
from mjstack.process import own_command

PASS = "pass"
NOT_RUN = "not run"
RESULT = "run.json"
_POLL = 0.1  # s, between two looks at the process

Row = dict[str, Any]
"""One run of the job: ``nworld``, ``backend``, ``status`` (pass, fail, out of memory or not run),
``reason``, ``seconds`` with the start of its process, ``hardware``, ``git_commit``, and every
metric of its gates by name. A figure that was not measured, or is void, is missing."""


def new_row(nworld: int, backend: str, **values: Any) -> Row:
    """A row that has not run, with some values."""
    empty = {"status": NOT_RUN, "reason": "", "hardware": "", "git_commit": ""}
    return {"nworld": nworld, "backend": backend} | empty | values


def read_run(folder: Path, nworld: int, backend: str) -> Row:
    """The row of a run, as not run where it has not finished."""
    empty = new_row(nworld, backend)
    try:
        row = json.loads((folder / RESULT).read_text())
        figures = [value for name, value in row.items() if name not in empty]
        if (
            all(type(row[name]) is type(value) for name, value in empty.items())
            and (row["nworld"], row["backend"]) == (nworld, backend)
            and all(isinstance(value, int | float) for value in figures)
        ):
            return row
    except Exception:  # not there, or it may hold anything
        pass
    return empty


def run_process(
    folder: Path, row: Row, overrides: Sequence[str], *, run_seconds: float, job_seconds: float
) -> Row:
    """Run the gates in a process and keep the row.

    Args:
        folder: The run's folder, made anew.
        row: The row so far: number of worlds and backend count.
        overrides: The run's command line.
        run_seconds: After that it has failed.
        job_seconds: After that it is stopped, and has not run: the next call of the job repeats it.

    Raises:
        KeyboardInterrupt: The command was interrupted; the process has been stopped.
    """
    if folder.exists():
        shutil.rmtree(folder)  # an earlier try's
    folder.mkdir(parents=True)
    command = own_command([*overrides, *search_path_args(), f"hydra.run.dir={quoted(folder)}"])
    began = time.monotonic()
    with (folder / "output.log").open("w") as log:
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT
        )
        try:
            while (code := process.poll()) is None and (
                time.monotonic() - began < min(run_seconds, job_seconds)
            ):
                check_interrupt()
                time.sleep(_POLL)
        finally:
            process.kill()  # it writes its files in one step each
            process.wait()
    check_interrupt()
    seconds = time.monotonic() - began
    nworld = row["nworld"]
    backend = row["backend"]
    if code is None and job_seconds <= run_seconds:
        stopped = f"{backend}, {nworld} worlds: stopped after {seconds:.0f} s"
        return new_row(nworld, backend, reason=stopped)
    row = read_report(folder, nworld, backend, code) | {"seconds": seconds}
    if code is None:
        row["reason"] = f"not done after {seconds:.0f} s (job.run_minutes)"
    write_atomic(folder / RESULT, json.dumps(row, indent=2) + "\n")
    return row


def read_report(folder: Path, nworld: int, backend: str, code: int | None) -> Row:
    """The row of a run whose process has ended with an exit status (None: it was stopped), from its
    report as far as it got.
    """
    try:
        report = json.loads((folder / "report.json").read_text())
    except (OSError, ValueError):
        report = {"gates": [], "provenance": {}}
    row = new_row(nworld, backend, git_commit=report["provenance"].get("git_commit", ""))
    for gate in report["gates"]:
        row["hardware"] = gate["notes"].get("backend") or row["hardware"]
        row |= {name: n for name, n in gate["metrics"].items() if not isinstance(n, str)}
    if code == 0:
        return row | {"status": PASS}

    # Why it failed: the gates' reasons, or the last line of its output.
    failed = [f"{g['name']}: {g['reason']}" for g in report["gates"] if g["status"] == "fail"]
    output = (folder / "output.log").read_text(errors="replace").strip()
    reason = "; ".join(failed) or (output.splitlines() or ["no output"])[-1]
    if code is not None and code < 0:
        reason = f"killed by signal {-code}; {reason}"
    # The system kills (9) where memory runs out.
    no_memory = code == -9 or is_out_of_memory(reason if code == 2 else f"{reason} {output}")
    return row | {"status": "out of memory" if no_memory else "fail", "reason": reason}
