"""Figures that are saved as pictures."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt


@contextmanager
def figure(path: Path, title: str, columns: int = 1, **options: Any) -> Iterator[tuple[Any, Any]]:
    """Make a figure with panels side by side, and save it when the block ends.

    Args:
        path: The picture.
        title: Above the panels.
        columns: Number of panels.
        options: Of ``plt.subplots``, such as ``figsize``.

    Yields:
        The figure, and its axes: an array unless there is one panel.
    """
    drawn, axes = plt.subplots(1, columns, layout="constrained", **options)
    try:
        yield drawn, axes
        drawn.suptitle(title, wrap=True)
        drawn.savefig(path, dpi=100)
    finally:
        plt.close(drawn)
