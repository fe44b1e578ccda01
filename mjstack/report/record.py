"""Results of a run as data: gates and provenance."""

from dataclasses import dataclass, field
from enum import Enum

from mjstack.report.table import Table

Provenance = dict[str, str | int | dict[str, str] | None]


class Status(Enum):
    """How a gate or a run ended."""

    passed = "pass"
    failed = "fail"
    skipped = "skip"
    interrupted = "interrupted"


@dataclass(kw_only=True, slots=True)
class GateResult:
    """One gate's outcome.

    Attributes:
        name: The gate.
        status: pass, fail or skip.
        reason: Why, in one line; empty where a pass needs no word.
        seconds: Wall time.
        thresholds: What was required, by name with unit.
        metrics: What was measured, by name with unit; numbers alone.
        notes: Facts in words, by name: the backend, why something was not measured.
        details: Longer findings, a line each, for the report's text.
        tables: Tables for the report's text.
    """

    name: str
    status: Status
    reason: str = ""
    seconds: float = 0.0
    thresholds: dict[str, float] = field(default_factory=dict)
    metrics: dict[str, float] = field(default_factory=dict)
    notes: dict[str, str] = field(default_factory=dict)
    details: list[str] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)


@dataclass(kw_only=True, slots=True)
class Report:
    """A whole run: its results so far, and where they come from."""

    provenance: Provenance
    status: Status = Status.interrupted
    gates: list[GateResult] = field(default_factory=list)
    pictures: list[str] = field(default_factory=list)

    def conclude(self) -> Status:
        """pass: no gate that was asked for failed, and at least one passed."""
        outcomes = [gate.status for gate in self.gates]
        good = Status.passed in outcomes and Status.failed not in outcomes
        self.status = Status.passed if good else Status.failed
        return self.status
