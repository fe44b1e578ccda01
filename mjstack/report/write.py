"""Write report.json and report.md, and draw pictures that may fail."""

import json
import logging
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

from mjstack.files import write_atomic
from mjstack.report.markdown import to_markdown
from mjstack.report.record import Report
from mjstack.report.table import Table, to_document

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
    # JSON has no NaN: a number that is not finite becomes its name.
    finite = json.loads(json.dumps(data), parse_constant=lambda name: str(float(name)))
    text = json.dumps(finite, indent=2) + "\n"
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


def write_tables(
    folder: Path,
    name: str,
    title: str,
    tables: Sequence[Table],
    notes: Sequence[str],
    csv: str,
    draw: Callable[[Path], object] | None = None,
) -> str:
    """Replace ``name.csv``, ``name.md`` and, where ``draw`` is given, ``name.png``.

    Args:
        folder: Where they go.
        name: Of the files.
        title: Heading of the text.
        tables: Of the text.
        notes: Of the text, a line each.
        csv: All rows.
        draw: Draws the picture, which may fail.

    Returns:
        Empty, or one line that says why there is no picture.

    Raises:
        OSError: A file cannot be written.
    """
    picture = folder / f"{name}.png"
    problem = "" if draw is None else safely_draw(picture, draw)
    write_atomic(folder / f"{name}.csv", csv)
    shown = picture.name if picture.exists() else ""
    write_atomic(folder / f"{name}.md", to_document(title, tables, notes, shown))
    return problem
