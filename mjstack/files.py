"""Files that appear complete or not at all, or may hold anything; rows as CSV."""

import csv
import io
import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from mjstack.errors import MjstackError, first_line


@contextmanager
def reading(path: Path, kind: type[MjstackError], fix: str) -> Iterator[None]:
    """Raise one line for a file that is missing or damaged: one of a run's folder, which may be a
    stranger's, can hold anything.

    Args:
        path: The file that is read inside.
        kind: Class of the error.
        fix: What to do about it, a sentence without its full stop.

    Raises:
        MjstackError: Something went wrong inside.
    """
    try:
        yield
    except MjstackError:
        raise
    except Exception as error:
        reason = f"{type(error).__name__}: {first_line(error)}"
        raise kind(f"{path}: cannot be read ({reason}), expected it as written", fix) from error


def write_atomic(path: Path, content: str | bytes) -> None:
    """Write a file beside its place and move it there.

    A full disk or a kill leaves the old file. Files that are written one after the other outlast a
    power cut in this order.

    Raises:
        OSError: The file cannot be written.
    """
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(name, 0o644)
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def write_npz(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write arrays as a compressed npz file in one step.

    Raises:
        OSError: The file cannot be written.
    """
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    write_atomic(path, buffer.getvalue())


def to_csv(rows: Sequence[Mapping[str, object]], columns: Sequence[str] = ()) -> str:
    """Rows as CSV text; a value that is missing or None is an empty cell.

    Args:
        rows: Values by column.
        columns: The first columns. Other keys of the rows follow, in order of appearance.
    """
    columns = list(dict.fromkeys([*columns, *(name for row in rows for name in row)]))
    out = io.StringIO()
    writer = csv.DictWriter(out, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return out.getvalue()
