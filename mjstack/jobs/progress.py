"""Shows how far a job is: a bar on a terminal, a line now and then elsewhere."""

import math
import time

from rich import progress
from rich.console import Console
from rich.markup import escape

from mjstack.interrupt import check_interrupt
from mjstack.report.record import GateResult, Status

STATUS_COLOR: dict[str, str] = {
    Status.passed: "green",
    Status.failed: "red",
    Status.skipped: "yellow",
    Status.interrupted: "red",
}


class ProgressBar:
    """A bar per gate with rate and time left on a terminal; a line now and then elsewhere.

    A job reports its progress where nothing is half done, so it is interrupted there.
    """

    def __init__(self, console: Console) -> None:
        self._progress = progress.Progress(
            *("{task.description}", progress.BarColumn(), progress.MofNCompleteColumn()),
            *("{task.fields[rate]}", progress.TimeElapsedColumn(), progress.TimeRemainingColumn()),
            console=console,
            transient=True,
            disable=not console.is_terminal,
            get_time=time.monotonic,
            speed_estimate_period=math.inf,  # reports may be minutes apart
        )
        self._gate = ""
        self._unit = ""
        self._progress.add_task("", visible=False, rate="")
        (self._task,) = self._progress.tasks
        self._spoke = time.monotonic()

    def __enter__(self) -> "ProgressBar":
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def print_line(self, line: str) -> None:
        """Print a line of text above the bar."""
        self._progress.console.print(line, markup=False)

    def start(self, gate: str) -> None:
        """Begin something with a name."""
        check_interrupt()
        self._gate = gate
        self._unit = ""
        self._spoke = time.monotonic()
        self._show(gate, 1, "starting (MJWarp compiles at its first use)")

    def advance(self, unit: str, done: int, total: int) -> None:
        """Show how much of something is done."""
        check_interrupt()
        if unit != self._unit or done <= 1 or done < self._task.completed:
            self._unit = unit
            self._show(f"{self._gate}: {unit}", total)
        self._progress.update(self._task.id, completed=done)
        clock = time.monotonic()
        if self._progress.disable and clock - self._spoke <= 15.0:
            return
        speed = self._task.speed or 0.0  # a sum over all reports
        rate = f"{speed:.1f}/s" if speed > 0.0 else ""
        self._progress.update(self._task.id, rate=rate)
        if self._progress.disable and speed > 0.0:
            self._spoke = clock
            left = (total - done) / speed
            self.print_line(f"{self._gate}: {unit} {done}/{total}, {rate}, {left:.0f} s left")

    def finish(self, result: GateResult) -> None:
        """Print a gate's result."""
        self._progress.update(self._task.id, visible=False)
        color = STATUS_COLOR[result.status]
        self._progress.console.print(
            f"[{color}]{result.status:>4}[/] {result.name} ({result.seconds:.1f} s):"
            f" {escape(result.reason or 'ok')}"
        )
        check_interrupt()

    def _show(self, text: str, total: int, rate: str = "") -> None:
        """Begin the bar anew."""
        self._progress.reset(self._task.id, total=total, description=text, visible=True, rate=rate)
