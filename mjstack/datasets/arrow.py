"""pyarrow, which is an extra: loaded when a dataset is opened, and not before."""

from __future__ import annotations

from typing import Any

from mjstack.errors import MissingExtra


def require_pyarrow() -> tuple[Any, Any]:
    """`pyarrow` and `pyarrow.parquet`.

    Raises:
        MissingExtra: pyarrow is not installed.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise MissingExtra("a dataset", "pyarrow", "datasets") from error
    return pyarrow, pyarrow.parquet
