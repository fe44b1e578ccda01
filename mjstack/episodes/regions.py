"""Where an episode started against how it ended: success rates over cells of the objects' starts,
as a table and a file.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from mjstack.config.schema import Config
from mjstack.episodes.record import REGIONS
from mjstack.episodes.tally import rate_cells
from mjstack.files import to_csv, write_atomic
from mjstack.math import wilson_interval
from mjstack.report.table import Table
from mjstack.report.write import safely_write

_EDGE = 1e-9  # cells: a place this close below a cell's edge is on it


@dataclass(frozen=True, kw_only=True, slots=True)
class Region:
    """Episodes whose object started in one cell. A bound that a cell does not have is None.

    Attributes:
        object: Its name.
        x_min_m: Least x of its centre [m], and so on.
        yaw_min_deg: Least angle [deg] from the direction base to object to a face's normal, of 0 to
            90, and so on.
        episodes: How many.
        succeeded: How many of them succeeded.
        rate: Their share, and its 95 % interval.
    """

    object: str
    x_min_m: float | None = None
    x_max_m: float | None = None
    y_min_m: float | None = None
    y_max_m: float | None = None
    yaw_min_deg: float | None = None
    yaw_max_deg: float | None = None
    episodes: int
    succeeded: int
    rate: float
    rate_low95: float
    rate_high95: float

    @property
    def where(self) -> str:
        """The cell in words."""
        parts = []
        if self.x_min_m is not None:
            parts.append(f"x {self.x_min_m:.3f} to {self.x_max_m:.3f} m")
            parts.append(f"y {self.y_min_m:.3f} to {self.y_max_m:.3f} m")
        if self.yaw_min_deg is not None:
            parts.append(f"turned {self.yaw_min_deg:g} to {self.yaw_max_deg:g} deg")
        return f"{self.object}: {', '.join(parts)}"


def radial_yaw_deg(places: np.ndarray) -> np.ndarray:
    """Angle of an object relative to the direction in which the base, at the origin, sees it [deg],
    from 0 to 90.

    Args:
        places: x and y [m] and rotation about z [rad], shape ``(..., 3)``.
    """
    relative = np.degrees(places[..., 2] - np.arctan2(places[..., 1], places[..., 0]))
    return np.mod(relative, 90.0) % 90.0  # twice: just below 0 rounds to 90


def find_regions(
    places: np.ndarray,
    succeeded: np.ndarray,
    *,
    cell: float,
    yaw_cell_deg: float,
    episodes: int,
    objects: Sequence[str],
) -> list[Region]:
    """Cells of each object's position, of its direction, and of both, that have enough episodes;
    the lowest rate first.

    Args:
        places: x and y [m] and rotation about z [rad] of each object at the start, shape ``(n,
            objects, 3)``.
        succeeded: Whether each episode was, shape ``(n,)``, bool.
        cell: Width of a cell in x and y [m]; cells begin at multiples of it.
        yaw_cell_deg: Width in direction [deg]; the last one ends at 90.
        episodes: Least number of episodes.
        objects: Names of the objects.
    """
    out = []
    for number, name in enumerate(objects):
        x, y = np.floor(places[:, number, :2] / cell + _EDGE).T
        yaw = np.floor(radial_yaw_deg(places[:, number]) / yaw_cell_deg + _EDGE)
        yaw[yaw * yaw_cell_deg >= 90.0] = 0.0  # on the edge of 90, which is 0
        # Each axis: the cell of every episode, the width and the unit of a cell, and the last edge.
        axes = {
            "x": (x, cell, "m", math.inf),
            "y": (y, cell, "m", math.inf),
            "yaw": (yaw, yaw_cell_deg, "deg", 90.0),
        }
        for chosen in (("x", "y"), ("yaw",), ("x", "y", "yaw")):
            keys = np.stack([axes[axis][0] for axis in chosen], axis=1)
            cells, which = np.unique(keys, axis=0, return_inverse=True)
            for row, key in enumerate(cells.tolist()):
                outcomes = succeeded[which.ravel() == row]
                n = len(outcomes)
                if n < episodes:
                    continue
                k = int(outcomes.sum())
                bounds = {}
                for axis, at in zip(chosen, key, strict=True):
                    _, width, unit, last = axes[axis]
                    bounds[f"{axis}_min_{unit}"] = round(at * width, 9)
                    bounds[f"{axis}_max_{unit}"] = min(round((at + 1.0) * width, 9), last)
                low, high = wilson_interval(k, n)
                out.append(
                    Region(
                        object=name,
                        **bounds,
                        episodes=n,
                        succeeded=k,
                        rate=k / n,
                        rate_low95=low,
                        rate_high95=high,
                    )
                )
    return sorted(out, key=lambda region: (region.rate, region.rate_high95))


def regions_table(cfg: Config, regions: list[Region]) -> list[Table]:
    """The regions with the lowest rates; no table where none has a failure."""
    t = cfg.gate.success
    failing = [r for r in regions if r.succeeded < r.episodes]
    if not failing:
        return []
    rows = [
        [r.where, str(r.episodes), str(r.succeeded), *rate_cells(r.succeeded, r.episodes)]
        for r in failing[: t.worst_regions]
    ]
    title = (
        f"Worst regions of at least {t.cell_episodes} episodes ({len(rows)} of {len(failing)} with"
        " a failure)"
    )
    header = ["where the object started", "episodes", "succeeded", "rate", "95 % interval"]
    return [Table(title=title, header=header, rows=rows)]


def save_regions(folder: Path, regions: list[Region]) -> str:
    """Write the table of regions; return why it was not written, empty if it was."""
    rows = to_csv([asdict(region) for region in regions], [f.name for f in fields(Region)])
    return safely_write(folder / REGIONS, write_atomic, rows)
