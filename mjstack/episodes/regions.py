"""Where an episode started against how it ended: success rates over cells of the objects'
starts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mjstack.math import wilson_interval

_EDGE = 1e-9  # cells: a place this close below a cell's edge is on it


@dataclass(frozen=True, kw_only=True, slots=True)
class Region:
    """Episodes whose object started in one cell. What a cell does not restrict is None.

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
    x_min_m: float | None
    x_max_m: float | None
    y_min_m: float | None
    y_max_m: float | None
    yaw_min_deg: float | None
    yaw_max_deg: float | None
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
            parts.append(
                f"x {self.x_min_m:.3f} to {self.x_max_m:.3f} m, y {self.y_min_m:.3f} to"
                f" {self.y_max_m:.3f} m"
            )
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

    def edge(number: int) -> float:
        return round(number * cell, 9)

    out = []
    for number, name in enumerate(objects):
        mine = places[:, number]
        at = np.floor(mine[:, :2] / cell + _EDGE).astype(np.int64)
        turn = np.floor(radial_yaw_deg(mine) / yaw_cell_deg + _EDGE).astype(np.int64)[:, None]
        turn[turn * yaw_cell_deg >= 90.0] = 0  # on the edge of 90, which is 0
        unbound = np.full_like(turn, -1)
        for keys, placed in (
            (np.hstack((at, unbound)), True),
            (np.hstack((np.zeros_like(at), turn)), False),
            (np.hstack((at, turn)), True),
        ):
            cells, which = np.unique(keys, axis=0, return_inverse=True)
            counts = np.bincount(which.ravel(), minlength=len(cells))
            good = np.bincount(which.ravel(), weights=succeeded, minlength=len(cells)).astype(
                np.int64
            )
            for (i, j, k), n, k_good in zip(
                cells.tolist(), counts.tolist(), good.tolist(), strict=True
            ):
                if n < episodes:
                    continue
                low, high = wilson_interval(k_good, n)
                yaw = (
                    (None, None) if k < 0 else (k * yaw_cell_deg, min((k + 1) * yaw_cell_deg, 90.0))
                )
                out.append(
                    Region(
                        object=name,
                        x_min_m=edge(i) if placed else None,
                        x_max_m=edge(i + 1) if placed else None,
                        y_min_m=edge(j) if placed else None,
                        y_max_m=edge(j + 1) if placed else None,
                        yaw_min_deg=yaw[0],
                        yaw_max_deg=yaw[1],
                        episodes=n,
                        succeeded=k_good,
                        rate=k_good / n,
                        rate_low95=low,
                        rate_high95=high,
                    )
                )
    return sorted(out, key=lambda region: (region.rate, region.rate_high95))
