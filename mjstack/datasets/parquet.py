"""Reading parquet files, which may be a stranger's: what a file unpacks to stands in its own
footer, and is checked before anything is unpacked.
"""

import os
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mjstack.datasets import lerobot

_MOST_FOOTER = 2**25  # bytes; a file of 100 MB has 3 MB
_SMALL = 2**26  # bytes that every table may unpack to
_RATIO = 64  # a larger one may have so many times its bytes on disk; LeRobot's have 20 at most
_NUMBERS = ("BOOLEAN", "INT32", "INT64", "FLOAT", "DOUBLE")
# Of texts: the others can repeat a long one in every row, for next to no bytes
_ENCODINGS = {"PLAIN", "RLE", "BIT_PACKED", "PLAIN_DICTIONARY", "RLE_DICTIONARY"}


def open_file(path: Path, **options: Any) -> Any:
    """A `ParquetFile`, whose footer is read.

    Raises:
        Exception: It is none, or its footer is too large.
    """
    with open(path, "rb") as file:
        file.seek(max(0, file.seek(0, os.SEEK_END) - 8))
        end = file.read()
    footer = int.from_bytes(end[:4], "little")
    if end[4:] == b"PAR1" and footer > _MOST_FOOTER:
        raise ValueError(f"its footer has {footer} bytes, more than {_MOST_FOOTER}")
    return lerobot.require_pyarrow()[1].ParquetFile(path, **options)


def count_rows(path: Path) -> int:
    """Rows of a file, as its footer has them; raises as `open_file` does."""
    metadata = open_file(path).metadata
    return sum(metadata.row_group(group).num_rows for group in range(metadata.num_row_groups))


def check_names(path: Path, names: Collection[str]) -> None:
    """Raise an error if a file has other columns, or raise as `open_file` does."""
    columns = open_file(path).schema_arrow.names
    if sorted(columns) != sorted(names):
        difference = sorted({*columns} ^ {*names}) or ["a second one of a name"]
        raise ValueError(f"its columns are not those expected: {difference[0]:.60}")


def check_size(values: int, disk: int) -> None:
    """Raise a `ValueError` if numbers are far more than files of so many bytes can be meant for."""
    if 8 * values > max(_SMALL, _RATIO * disk):
        raise ValueError(f"{disk} bytes would unpack to {8 * values}")


def read_table(path: Path, widths: Mapping[str, int]) -> Any:
    """Columns as an Arrow table, whose rows have at most so many values of each as ``widths`` says.
    Texts are in dictionaries. Raises if it cannot be read, is too large, or has other values than
    numbers and texts.
    """
    file = open_file(path)
    disk = path.stat().st_size
    groups = [file.metadata.row_group(group) for group in range(file.metadata.num_row_groups)]
    rows = sum(group.num_rows for group in groups)
    check_size(rows * sum(widths.values()), disk)
    texts = {}
    for number in range(len(file.schema)):
        leaf = file.schema.column(number)
        name = leaf.path  # of a list with an ending, such as .list.element
        while name not in widths and "." in name:
            name = name.rpartition(".")[0]
        if name not in widths:
            continue
        chunks = [group.column(number) for group in groups]
        if sum(chunk.num_values for chunk in chunks) > rows * widths[name]:
            raise ValueError(f"rows of {name} without {widths[name]} numbers")
        if leaf.physical_type == "BYTE_ARRAY":
            texts[name] = leaf.path
            if not all(_ENCODINGS.issuperset(chunk.encodings) for chunk in chunks):
                raise ValueError(f"texts of {name} in another encoding than a plain one")
        elif leaf.physical_type not in _NUMBERS:
            raise ValueError(f"{name} has other values than numbers and texts")
    table = open_file(path, read_dictionary=list(texts.values())).read(columns=list(widths))
    for name in texts:
        column = table[name].combine_chunks()
        while hasattr(column, "flatten"):
            column = column.flatten()
        longest = max(map(len, filter(None, column.dictionary.to_pylist())), default=0)
        check_size(rows * longest // 8, disk)
    return table


def read_numbers(path: Path, widths: Mapping[str, int]) -> dict[str, np.ndarray]:
    """Columns of numbers, each shape ``(rows, width)``, in the file's types. Raises if it cannot be
    read, is too large, or a row has not as many numbers as ``widths`` says.
    """
    table = read_table(path, widths)
    columns = {}
    for name, width in widths.items():
        column = table[name].combine_chunks()
        even = True
        while even and hasattr(column, "flatten"):
            even = len(column.value_lengths().unique()) < 2  # a null has none
            column = column.flatten()
        if not even or len(column) != len(table) * width or column.null_count:
            raise ValueError(f"rows of {name} without {width} numbers")
        values = column.to_numpy(zero_copy_only=False)
        if values.dtype.kind not in "biuf":
            raise ValueError(f"{name} has other values than numbers")
        columns[name] = values.reshape(len(table), width)
    return columns
