"""A dataset of demonstrations as tables: what is in it, how good the expert was, and how to load
it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from mjstack.report.markdown import escape_cell, format_value

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
    """What one number of the steps ranges over.

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
        facts: What there is to say of the whole dataset.
        ranges: Of the joints and their commands.
        folder: Where the dataset is.
    """
    lines = [f"# {title}", "", "| what | value |", "| --- | ---: |"]
    lines += [f"| {name} | {escape_cell(format_value(value))} |" for name, value in facts.items()]
    lines += [
        "",
        "| number | unit | smallest | mean | largest |",
        "| --- | --- | ---: | ---: | ---: |",
    ]
    lines += [
        f"| {row.name} | {row.unit} | {row.low:.4f} | {row.mean:.4f} | {row.high:.4f} |"
        for row in ranges
    ]
    lines += [
        "",
        "With pyarrow alone:",
        "",
        "```python",
        LOADING.format(folder=folder).rstrip("\n"),
        "```",
    ]
    return "\n".join(lines) + "\n"
