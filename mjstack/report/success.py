"""Where episodes started, and which failed, as a picture of the table from above."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.collections import PathCollection
from matplotlib.patches import Rectangle

from mjstack.report.figure import figure


def save_places(
    path: Path,
    places: np.ndarray,
    succeeded: np.ndarray,
    table: tuple[Sequence[float], Sequence[float]],
    title: str,
    colors: Mapping[str, Sequence[float]],
) -> None:
    """Draw every start as a dot per object; a failed one as crosses on its objects, joined by a
    line.

    Args:
        path: The picture.
        places: x and y [m] of each object first, shape ``(n, objects, 2 or more)``.
        succeeded: Whether each episode was, shape ``(n,)``, bool.
        table: Centre and half size of the table in x and y [m].
        title: What is shown.
        colors: Red, green, blue and alpha of each object, by name.
    """
    (x, y), (half_x, half_y) = table
    size, alpha = (12.0, 0.5) if len(places) <= 2000 else (3.0, 0.25)
    failed = places[~succeeded]
    with figure(path, title, figsize=(7.5, 6.5)) as (_, axes):
        # As seen by someone who stands behind the arm: y to the left, x away from the base.
        corner = (y - half_y, x - half_x)
        axes.add_patch(Rectangle(corner, 2.0 * half_y, 2.0 * half_x, fill=False, ec="k", lw=1.5))
        axes.plot(0.0, 0.0, "k^", markersize=9, label="base")
        for pair in failed:
            axes.plot(pair[:, 1], pair[:, 0], color="0.3", lw=0.5, alpha=0.6)
        for number, (name, color) in enumerate(colors.items()):
            good, bad = (some[:, number] for some in (places[succeeded], failed))
            label = f"{name}, succeeded: {len(good):,}"
            axes.scatter(good[:, 1], good[:, 0], size, color, alpha=alpha, lw=0, label=label)
            label = f"{name}, failed: {len(bad):,}"
            axes.scatter(bad[:, 1], bad[:, 0], 45.0, "k", "x", lw=2.6)
            axes.scatter(bad[:, 1], bad[:, 0], 40.0, color=color, marker="x", lw=1.2, label=label)
        axes.set(xlabel="y [m]", ylabel="x [m]", aspect="equal")
        axes.invert_xaxis()
        axes.grid(alpha=0.3)
        legend = axes.legend(
            frameon=False, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=5
        )
        for handle in legend.legend_handles:
            # The dots of ten thousand worlds are too small and faint to tell apart here.
            if isinstance(handle, PathCollection):
                handle.set(sizes=[40.0], alpha=1.0)
