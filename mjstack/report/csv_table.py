"""Rows of a table for programs."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import asdict, fields
from typing import Any


def to_csv(kind: type, rows: Sequence[Any]) -> str:
    """All columns of all rows; what is not known is empty.

    Args:
        kind: The dataclass of a row, for the header of a table without any.
        rows: Its instances.
    """
    out = io.StringIO()
    writer = csv.DictWriter(out, [field.name for field in fields(kind)], lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(row) for row in rows)
    return out.getvalue()
