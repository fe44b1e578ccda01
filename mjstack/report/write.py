"""Write report.json and report.md, and draw pictures that may fail."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

from mjstack.files import write_atomic
from mjstack.report.markdown import to_markdown
from mjstack.report.record import Report

log = logging.getLogger(__name__)

SCHEMA = 2


def write_report(report: Report, folder: Path) -> None:
    """Replace report.json and report.md, each in one step.

    Called after every result, so that nothing finished is lost.
    """
    gates = [{**asdict(gate), "status": gate.status.value} for gate in report.gates]
    data = {
        "schema": SCHEMA,
        "status": report.status.value,
        "provenance": report.provenance,
        "gates": gates,
        "pictures": report.pictures,
    }
    text = json.dumps(_finite(data), indent=2, allow_nan=False) + "\n"
    write_atomic(folder / "report.json", text)
    write_atomic(folder / "report.md", to_markdown(report))


def safely_draw(path: Path, draw: Callable[..., object], *args: object) -> str:
    """Draw a picture; a failure takes no result back.

    Args:
        path: The picture.
        draw: Called with the path and ``args``.
        args: What is drawn.

    Returns:
        Empty, or one line that says why there is no picture. run.log has the traceback.
    """
    try:
        draw(path, *args)
    except Exception as error:
        log.exception("%s was not drawn", path.name)
        path.unlink(missing_ok=True)  # it may be there in part
        reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
        return f"no picture {path.name}: {reason}"
    return ""


def _finite(node: object) -> object:
    """JSON has no NaN: a number that is not finite becomes its name."""
    if isinstance(node, dict):
        return {key: _finite(value) for key, value in node.items()}
    if isinstance(node, list):
        return [_finite(value) for value in node]
    if isinstance(node, float) and not math.isfinite(node):
        return str(node)
    return node
