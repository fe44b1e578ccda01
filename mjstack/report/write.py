"""Write report.json, and files that may fail."""

import json
import logging
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from mjstack.files import write_atomic
from mjstack.interrupt import check_interrupt
from mjstack.report.figure import Figure
from mjstack.report.record import GateResult, Report, Status

log = logging.getLogger(__name__)

SCHEMA = 3


def write_report(report: Report) -> None:
    """Replace report.json in one step.

    Raises:
        OSError: It cannot be written.
    """
    data = {
        "schema": SCHEMA,
        "status": report.status,
        "resumes": report.resumes,
        "provenance": report.provenance,
        "gates": [_gate_json(gate) for gate in report.gates],
        "pictures": report.pictures,
    }
    # A gate may return NumPy scalars. A number that is not finite becomes its name: JSON has none.
    text = json.dumps(data, default=lambda value: value.item())
    finite = json.loads(text, parse_constant=lambda name: str(float(name)))
    text = json.dumps(finite, indent=2) + "\n"
    write_atomic(report.folder / "report.json", text)


def _gate_json(gate: GateResult) -> dict[str, Any]:
    data = asdict(gate)
    del data["figures"]
    return data | {"metrics": gate.metrics, "thresholds": gate.thresholds}


def read_report(folder: Path, overrides: Sequence[str] = ()) -> Report | None:
    """The results and the provenance of a report that a run has left, without its tables; None if
    there is none that can be read.
    """
    report = Report(folder=folder, overrides=list(overrides))
    try:
        data = json.loads((folder / "report.json").read_text())
        report.gates = [
            GateResult(
                name=gate["name"],
                status=Status(gate["status"]),
                reason=gate["reason"],
                seconds=float(gate.get("seconds", 0.0)),
                figures=[Figure(name, value) for name, value in gate.get("metrics", {}).items()],
                notes=dict(gate.get("notes", {})),
            )
            for gate in data["gates"]
        ]
        report.status = Status(data["status"])
        report.resumes = str(data["resumes"])
        report.provenance = dict(data.get("provenance", {}))
    except Exception:  # it may hold anything
        return None
    return report


def safely_write(
    path: Path, write: Callable[..., object], *args: object, stops: bool = True
) -> str:
    """Write a file by a call with a path beside it and ``args``, complete or not at all; a failure
    takes no result back. It is not written if the command was asked to stop, unless ``stops`` is
    false.

    Returns:
        Empty, or one line that says why there is no such file. run.log has the traceback.
    """
    if stops:
        check_interrupt()
    begun = path.with_name(f".{path.name}")
    try:
        write(begun, *args)
        begun.replace(path)
    except Exception as error:
        log.exception("%s was not written", path.name)
        reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
        return f"{path.name} was not written: {reason}"
    finally:
        begun.unlink(missing_ok=True)
    return ""
