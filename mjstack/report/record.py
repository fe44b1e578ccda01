"""What a run found, as data: gate results, provenance, and the report file."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field
from enum import Enum
from pathlib import Path

from mjstack.files import write_atomic

SCHEMA = 2


Provenance = dict[str, str | int | dict[str, str] | None]


class Status(Enum):
    """How a gate or a run ended."""

    passed = "pass"
    failed = "fail"
    skipped = "skip"
    interrupted = "interrupted"


@dataclass(kw_only=True, slots=True)
class Table:
    """A table for people, all text.

    Attributes:
        title: What it shows.
        header: Names of the columns.
        rows: Cells, as many as there are columns.
    """

    title: str
    header: list[str]
    rows: list[list[str]]


@dataclass(kw_only=True, slots=True)
class GateResult:
    """One gate's outcome.

    Attributes:
        name: The gate.
        status: pass, fail or skip.
        reason: Why, in one line; empty where a pass needs no word.
        seconds: Wall time.
        thresholds: What was required, by name with unit.
        metrics: What was measured, by name with unit.
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
    """A whole run, written after every gate so that nothing finished is lost."""

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

    def write(self, folder: Path) -> None:
        """Replaces report.json and report.md, each in one step."""
        from mjstack.report.markdown import to_markdown

        gates = [{**asdict(gate), "status": gate.status.value} for gate in self.gates]
        data = {
            "schema": SCHEMA,
            "status": self.status.value,
            "provenance": self.provenance,
            "gates": gates,
            "pictures": self.pictures,
        }
        write_atomic(
            folder / "report.json", json.dumps(_finite(data), indent=2, allow_nan=False) + "\n"
        )
        write_atomic(folder / "report.md", to_markdown(self))


def _finite(node: object) -> object:
    """JSON has no NaN: a number that is not finite becomes its name."""
    if isinstance(node, dict):
        return {key: _finite(value) for key, value in node.items()}
    if isinstance(node, list):
        return [_finite(value) for value in node]
    if isinstance(node, float) and not math.isfinite(node):
        return str(node)
    return node
