"""Cases of the fuzz: datasets whose files are damaged as a value of a column, a table or a place on
the disk, for *collect* to go on with or a clone to learn from.
"""

import os
import random
import shutil
from collections.abc import Callable
from contextlib import chdir
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from dataset_checker import with_column
from environments import one_second_episode

from mjstack.cli import run

SHORT = ["nworld=2", "sim=native", *one_second_episode()]
COLLECT = [
    *("job=collect", *SHORT, "observation=state", "+observation.policy.noise=false"),
    *("job.keep_failures=true", "job.folder=set"),
]
TRAIN = [
    *("job=train", "trainer=clone", "job.dataset=set/dataset", *SHORT, "job.folder=trained"),
    *("job.batches=2", "job.batch_size=16", "job.hidden=[8]"),
]


def damaged_datasets(fixture: Path) -> Callable[[int, Path], list[str]]:
    """One damage a case, of a file drawn by the case's number."""
    with chdir(fixture):
        assert run([*COLLECT, "job.episodes=2"]) == 0
    for picture in fixture.rglob("*.png"):
        picture.unlink()

    def make(case: int, cwd: Path) -> list[str]:
        draw = random.Random(f"dataset {case}")
        shutil.copytree(fixture / "set", cwd / "set")
        dataset = cwd / "set" / "dataset"
        tables = sorted(dataset.rglob("*.parquet"))
        if draw.random() < 0.7:
            _change_table(draw, draw.choice(tables))
        else:
            _change_place(draw, draw.choice(sorted(dataset.rglob("*"))))
        return draw.choice(([*COLLECT, "job.episodes=3"], TRAIN))

    return make


def _change_table(draw: random.Random, path: Path) -> None:
    """Other values in a column, other rows, or a table that unpacks to far more than its size."""
    table = pq.read_table(path)
    name = draw.choice(table.column_names)
    values = table[name].to_pylist()
    row = draw.randrange(len(values))
    kind = draw.choice(("value", "value", "value", "all", "order", "rows", "columns", "large"))
    if kind == "value":
        values[row] = _other(draw, values[row])
    elif kind == "all":
        values = [_other(draw, values[row])] * len(values)
    elif kind == "order":
        values = values[::-1]
    if kind == "rows":
        table = table.take(draw.choice(([*range(row)], [*range(len(values)), row])))
    elif kind == "columns":
        more = draw.choice((1, 3000))
        table = draw.choice(
            (
                table.drop_columns([name]),
                table.append_column("x", table[name]),
                pa.table(
                    [*table.columns, *[table[name]] * more],
                    [*table.column_names, *map(str, range(more))],
                ),
            )
        )
    elif kind == "large":
        rows = min(draw.choice((10**4, 10**6)), 2 * 10**8 * len(values) // table.nbytes)
        table = table.take(np.full(rows, row))
    else:
        try:
            table = with_column(table, name, pa.array(values))
        except (pa.ArrowInvalid, pa.ArrowTypeError, OverflowError):
            table = with_column(table, name, pa.array([str(value) for value in values]))
    pq.write_table(table, path)


def _other(draw: random.Random, value: object) -> object:
    """Another value of a row, of its type or not."""
    if isinstance(value, list) and draw.random() < 0.8:
        at = draw.randrange(len(value))
        return draw.choice(([*value[:at], _other(draw, value[at]), *value[at + 1 :]], value[:at]))
    if isinstance(value, float) and draw.random() < 0.7:
        return draw.choice((7 * value + 1.0, float("nan"), float("inf"), -1e300))
    if isinstance(value, int) and draw.random() < 0.7:
        return draw.choice((value + 1, -1, 10**9, 2**62, -(2**63)))
    return draw.choice((None, "x", "é" * 1000, [], [[]], 3, -0.5, True, "../../x", {"a": 1}))


def _change_place(draw: random.Random, path: Path) -> None:
    """A link, a pipe, a folder, nothing or a half in place of a file or a folder."""
    kind = draw.choice(("link", "pipe", "other", "gone", "hidden", "half"))
    if kind == "hidden":
        path = path.with_name(draw.choice((f".{path.name}", f".{path.name}.part")))
        kind = draw.choice(("link", "pipe", "other", "half"))
    moved = path.parents[1] / "moved"
    is_folder = path.is_dir()
    if path.exists():
        if kind == "half" and not is_folder:
            content = path.read_bytes()
            path.write_bytes(content[: draw.randrange(len(content) + 1)])
            return
        shutil.move(path, moved)
    if kind == "link":
        path.symlink_to(draw.choice((moved, "/dev/zero", path.name, "nope")))
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "other":
        path.write_text("x") if is_folder else path.mkdir()
