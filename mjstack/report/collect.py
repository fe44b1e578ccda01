"""A dataset of demonstrations as tables: its content, the expert's success, and how to load it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from mjstack.report.markdown import format_value
from mjstack.report.table import Table, to_document

LOADING = """\
import json
from pathlib import Path

import pyarrow.parquet as pq

folder = Path("{folder}")
info = json.loads((folder / "meta/info.json").read_text())
episode = pq.read_table(folder / "data", filters=[("episode_index", "==", 0)])
for name in ("observation.state", "action"):
    values = episode[name].combine_chunks().flatten().to_numpy().reshape(len(episode), -1)
    print(name, values.shape, info["features"][name]["names"], info["mjstack"]["units"][name])
"""


@dataclass(frozen=True, kw_only=True, slots=True)
class ColumnRange:
    """Range of one number of the steps.

    Attributes:
        name: Feature and number, such as ``action shoulder_pan.pos``.
        unit: Its unit.
        low: Smallest.
        mean: Mean.
        high: Largest.
    """

    name: str
    unit: str
    low: float
    mean: float
    high: float


def to_markdown(
    title: str, facts: Mapping[str, object], ranges: Sequence[ColumnRange], folder: str
) -> str:
    """Facts, ranges, and the lines that load the first episode.

    Args:
        title: Robot and task.
        facts: Facts on the whole dataset.
        ranges: Of the joints and their targets.
        folder: Where the dataset is.
    """
    known = [[name, format_value(value)] for name, value in facts.items()]
    tables = [Table(title="", header=["fact", "value"], rows=known), Table.of("", _COLUMNS, ranges)]
    loading = [
        "With pyarrow alone:",
        "",
        "```python",
        LOADING.format(folder=folder).rstrip("\n"),
        "```",
    ]
    return to_document(title, tables) + "\n" + "\n".join(loading) + "\n"


_COLUMNS: dict[str, Callable[[ColumnRange], str]] = {
    "number": lambda row: row.name,
    "unit": lambda row: row.unit,
    "smallest": lambda row: f"{row.low:.4f}",
    "mean": lambda row: f"{row.mean:.4f}",
    "largest": lambda row: f"{row.high:.4f}",
}
