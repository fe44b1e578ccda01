"""The reach of the arm as a table, as text and as a picture."""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mjstack.report.picture import figure, outline


@dataclass(frozen=True, kw_only=True, slots=True)
class ReachLevel:
    """One height of the map.

    Attributes:
        name: Such as ``grasp``.
        height: Of the points above the table [m].
        gripper: ``open`` or ``closed``.
        residual: Distance that is left at each point [m], shape ``(ny, nx)``.
        tilt: Smallest tilt of the gripper from vertical [deg], NaN where the point is not reached,
            shape ``(ny, nx)``.
    """

    name: str
    height: float
    gripper: str
    residual: np.ndarray
    tilt: np.ndarray

    @property
    def reached(self) -> np.ndarray:
        """Shape ``(ny, nx)``, bool."""
        return np.isfinite(self.tilt)

    @property
    def tilts(self) -> tuple[float, float]:
        """Smallest and largest tilt [deg]; NaN where no point is reached."""
        some = self.tilt[self.reached]
        return (float(some.min()), float(some.max())) if len(some) else (np.nan, np.nan)


@dataclass(frozen=True, kw_only=True, slots=True)
class ObjectRegion:
    """Where one object may stand.

    Attributes:
        name: The object.
        place: Its nominal x and y [m].
        configured: Half-widths of ``reset=randomized`` [m].
        square: Largest half-width of a square around the place that is reached with the margin [m];
            0 where none is.
        largest: Half-widths of the largest rectangle that is reached with the margin [m].
        tilt: Largest of the smallest tilts in the configured region at the grasp [deg]; NaN where
            some is not reached.
        reached: Whether the configured region is, with the margin.
    """

    name: str
    place: tuple[float, float]
    configured: tuple[float, float]
    square: float
    largest: tuple[float, float]
    tilt: float
    reached: bool


def points_csv(x: np.ndarray, y: np.ndarray, levels: Sequence[ReachLevel]) -> str:
    """A row per point of the map; the tilt is ``nan`` where the arm does not get to.

    Args:
        x: Columns of the map [m], shape ``(nx,)``.
        y: Rows [m], shape ``(ny,)``.
        levels: Heights.
    """
    columns = dict(zip(("x_m", "y_m"), np.meshgrid(x, y), strict=True))
    for level in levels:
        columns[f"{level.name}_reached"] = level.reached
        columns[f"{level.name}_residual_m"] = level.residual
        columns[f"{level.name}_tilt_deg"] = level.tilt
    out = io.StringIO()
    table = np.stack([column.ravel() for column in columns.values()], axis=1)
    np.savetxt(out, table, "%.6g", ",", header=",".join(columns), comments="")
    return out.getvalue()


def save_map(
    path: Path,
    title: str,
    x: np.ndarray,
    y: np.ndarray,
    levels: Sequence[ReachLevel],
    regions: Sequence[ObjectRegion],
    table: tuple[Sequence[float], Sequence[float]],
    colors: Mapping[str, Sequence[float]],
) -> None:
    """Draw a panel per level: the tilt as colour, hatched where the arm does not get to, table,
    objects and regions.

    Args:
        path: The picture.
        title: What is shown.
        x: Columns of the map [m], shape ``(nx,)``.
        y: Rows [m], shape ``(ny,)``.
        levels: Heights.
        regions: Where the objects may stand.
        table: Centre and half size of the table in x and y [m].
        colors: Red, green, blue and alpha of each object, by name.
    """
    wide = x[-1] - x[0]
    deep = y[-1] - y[0]
    title += (
        "\nhatched: not reached; squares: objects; solid: configured region; dotted: largest with"
        " margin"
    )
    count = len(levels)
    size = ((3.6 * max(0.6, wide / deep) + 1.0) * count + 1.2, 5.6)
    with figure(path, title, count, figsize=size) as (drawn, panels):
        top = np.nanmax([level.tilts[1] for level in levels] + [1.0])
        for axes, level in zip(np.atleast_1d(panels), levels, strict=True):
            axes.set_facecolor("0.92")
            box = ((x[0] + x[-1]) / 2, (y[0] + y[-1]) / 2), (wide / 2, deep / 2)
            axes.add_patch(outline(*box, hatch="////", ec="0.6", lw=0))
            image = axes.pcolormesh(x, y, level.tilt, vmin=0.0, vmax=top, shading="nearest")
            axes.add_patch(outline(*table, ec="k", lw=1.5))
            for region in regions:
                color = colors[region.name]
                axes.plot(*region.place, "s", color=color, markersize=7, markeredgecolor="w")
                axes.add_patch(outline(region.place, region.configured, ec=color, lw=1.8))
                axes.add_patch(outline(region.place, region.largest, ec=color, lw=1.2, ls=":"))
            label = f"{level.name}: {level.height:.3f} m above, {level.gripper}"
            axes.set(title=label, xlabel="x [m]", ylabel="y [m]", aspect="equal")
        drawn.colorbar(image, ax=panels, label="smallest tilt of the gripper from vertical [deg]")
