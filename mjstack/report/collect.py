"""A dataset of demonstrations as tables: its content, the expert's success, and how to load it."""

from collections.abc import Mapping, Sequence

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


def to_markdown(
    title: str, facts: Mapping[str, object], ranges: Sequence[list[str]], folder: str
) -> str:
    """Facts, ranges, and the lines that load the first episode.

    Args:
        title: Robot and task.
        facts: Facts on the whole dataset.
        ranges: Of the joints and their targets: number, unit, smallest, mean and largest.
        folder: Where the dataset is.
    """
    known = [[name, format_value(value)] for name, value in facts.items()]
    header = ["number", "unit", "smallest", "mean", "largest"]
    tables = [
        Table(title="", header=["fact", "value"], rows=known),
        Table(title="", header=header, rows=list(ranges)),
    ]
    loading = LOADING.format(folder=folder)
    return f"{to_document(title, tables)}\nWith pyarrow alone:\n\n```python\n{loading}```\n"
