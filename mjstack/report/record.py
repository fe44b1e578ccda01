"""Results of a run as data: gates and provenance."""

from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path

from mjstack.report.figure import Figure
from mjstack.report.table import Table

Provenance = dict[str, str | int | list[str] | dict[str, str] | None]


class Status(StrEnum):
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
        figures: Measured values, and required ones.
        beyond: Keys of those that broke a rule's threshold.
        notes: Facts in words, by name: the backend, why something was not measured.
        details: Longer findings, a line each, for the report's text.
        tables: Tables for the report's text.
    """

    name: str
    status: Status
    reason: str = ""
    seconds: float = 0.0
    figures: list[Figure] = field(default_factory=list)
    beyond: list[str] = field(default_factory=list)
    notes: dict[str, str] = field(default_factory=dict)
    details: list[str] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)

    @property
    def metrics(self) -> dict[str, float]:
        """Measured values, by key."""
        return {f.key: f.value for f in self.figures if f.value is not None}

    @property
    def thresholds(self) -> dict[str, float]:
        """Required values, by key."""
        return dict(limit for figure in self.figures for limit in figure.thresholds())


@dataclass(kw_only=True, slots=True)
class Report:
    """A whole run: its results so far, and where they come from.

    Attributes:
        folder: Where report.json, report.md, pictures and logs go.
        overrides: The command line.
        resumes: Names a job that goes on with the run; empty if none does.
        provenance: Versions, device, hashes.
        status: How it ended.
        gates: The results.
        pictures: File names.
    """

    folder: Path
    overrides: list[str] = field(default_factory=list)
    resumes: str = ""
    provenance: Provenance = field(default_factory=dict)
    status: Status = Status.interrupted
    gates: list[GateResult] = field(default_factory=list)
    pictures: list[str] = field(default_factory=list)

    @property
    def exit_code(self) -> int:
        """0 pass, 1 a gate failed, 130 interrupted."""
        return {Status.passed: 0, Status.interrupted: 130}.get(self.status, 1)

    def conclude(self) -> None:
        """pass: no gate that was asked for failed, and at least one passed."""
        outcomes = [gate.status for gate in self.gates]
        passed = Status.passed in outcomes and Status.failed not in outcomes
        self.status = Status.passed if passed else Status.failed
