"""Where episodes fail: cells of the places where objects started, and their rates of success."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from mjstack.episodes.tally import rate_cells
from mjstack.math import rate_interval
from mjstack.report.table import Table

Region = dict[str, Any]
"""Episodes whose object started in one cell, by column of the file: the ``object``; the bounds that
the cell has, of x and y of its centre [m] and of its direction [deg], as of `radial_yaw_deg`; how
many ``episodes``, and how many ``succeeded``, their ``rate`` and its 95 % interval."""

BOUNDS = (*("x_min_m", "x_max_m", "y_min_m", "y_max_m"), "yaw_min_deg", "yaw_max_deg")
_CELL = 0.02  # m, width of a cell in x and y
_YAW_CELL = 15.0  # deg, width of a cell in an object's direction
_WORST = 12  # regions in report.md
_EDGE = 1e-9  # cells: a place this close below a cell's edge is on it


def radial_yaw_deg(places: np.ndarray) -> np.ndarray:
    """Angle of an object relative to the direction in which the arm's base sees it [deg], from 0 to
    90.

    Args:
        places: x and y from the base [m] and rotation about z [rad], shape ``(..., 3)``.
    """
    relative = np.degrees(places[..., 2] - np.arctan2(places[..., 1], places[..., 0]))
    return np.mod(relative, 90.0) % 90.0  # twice: just below 0 rounds to 90


def find_regions(
    least: int,
    places: np.ndarray,
    succeeded: np.ndarray,
    objects: Sequence[str],
    base: Sequence[float],
) -> list[Region]:
    """Cells of each object's position, of its direction, and of both, that have enough episodes;
    the lowest rate first. In x and y they begin at multiples of their width; the last one in
    direction ends at 90.

    Args:
        least: The least number of episodes.
        places: x and y [m] and rotation about z [rad] of each object at the start, NaN for a place,
            shape ``(n, objects, 3)``.
        succeeded: Whether each episode was, shape ``(n,)``, bool.
        objects: Names of the objects.
        base: x and y of the arm's base [m].
    """
    out: list[Region] = []
    widths = np.array([_CELL, _CELL, _YAW_CELL])
    ends = np.array([math.inf, math.inf, 90.0])
    for number, name in enumerate(objects):
        yaw = radial_yaw_deg(places[:, number] - [*base, 0.0])
        keys = np.floor(np.column_stack((places[:, number, :2], yaw)) / widths + _EDGE)
        keys[keys[:, 2] * _YAW_CELL >= 90.0, 2] = 0.0  # on the edge of 90, which is 0
        for axes in ([0, 1],) if np.isnan(yaw).any() else ([0, 1], [2], [0, 1, 2]):
            cells, which = np.unique(keys[:, axes], axis=0, return_inverse=True)
            for row, key in enumerate(cells):
                outcomes = succeeded[which.ravel() == row]
                n = len(outcomes)
                if n < least:
                    continue
                k = int(outcomes.sum())
                edges = (key * widths[axes], np.minimum((key + 1.0) * widths[axes], ends[axes]))
                names = [BOUNDS[2 * axis + end] for axis in axes for end in (0, 1)]
                bounds = zip(names, np.column_stack(edges).round(9).ravel().tolist(), strict=True)
                region = {"object": name, **dict(bounds), "episodes": n, "succeeded": k}
                out.append(region | rate_interval("rate", k, n))
    return sorted(out, key=lambda region: (region["rate"], region["rate_high95"]))


def describe_region(region: Region) -> str:
    """The cell in words."""
    texts = {
        "x_min_m": "x {x_min_m:.3f} to {x_max_m:.3f} m, y {y_min_m:.3f} to {y_max_m:.3f} m",
        "yaw_min_deg": "turned {yaw_min_deg:g} to {yaw_max_deg:g} deg",
    }
    parts = [text.format(**region) for name, text in texts.items() if name in region]
    return f"{region['object']}: {', '.join(parts)}"


def regions_table(least: int, regions: list[Region]) -> list[Table]:
    """The regions with the lowest rates; no table where none has a failure."""
    failing = [r for r in regions if r["succeeded"] < r["episodes"]]
    if not failing:
        return []
    rows = []
    for region in failing[:_WORST]:
        n, k = region["episodes"], region["succeeded"]
        rows.append([describe_region(region), str(n), str(k), *rate_cells(k, n)])
    title = (
        f"Worst regions of at least {least} episodes ({len(rows)} of {len(failing)} with a failure)"
    )
    header = ["where the object started", "episodes", "succeeded", "rate", "95 % interval"]
    return [Table(title=title, header=header, rows=rows)]
