"""How a job ended."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from mjstack.report.record import GateResult, Status

STATUS_COLOR = {
    Status.passed: "green",
    Status.failed: "red",
    Status.skipped: "yellow",
    Status.interrupted: "red",
}


@dataclass(kw_only=True, slots=True)
class JobResult:
    """How a job ended."""

    status: Status
    folder: Path
    overrides: list[str]
    gates: list[GateResult] = field(default_factory=list)

    @property
    def exit_code(self) -> int:
        """0 pass, 1 a gate failed, 130 interrupted."""
        return {Status.passed: 0, Status.interrupted: 130}.get(self.status, 1)
