"""The reach of the arm as a table, as text and as a picture."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from mjstack.report.table import Table, to_document

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.patches import Rectangle


@dataclass(frozen=True, kw_only=True, slots=True)
class ReachLevel:
    """One height of the map.

    Attributes:
        name: Such as ``grasp``.
        height: Of the points above the table [m].
        gripper: ``open`` or ``closed``.
        residual: Distance that is left at each point [m], shape ``(ny, nx)``.
        tilt: Smallest tilt of the gripper from vertical [rad], NaN where the point is not reached,
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
        tilt: Largest of the smallest tilts in the configured region at the grasp [rad]; NaN where
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


@dataclass(frozen=True, kw_only=True, slots=True)
class ReachMap:
    """The map.

    Attributes:
        title: What it is of.
        x: Columns [m], shape ``(nx,)``.
        y: Rows [m], shape ``(ny,)``.
        table: Centre and half size of the table in x and y [m].
        levels: Heights.
        regions: Where the objects may stand.
        colors: Red, green, blue and alpha of each object, by name.
    """

    title: str
    x: np.ndarray
    y: np.ndarray
    table: tuple[Sequence[float], Sequence[float]]
    levels: Sequence[ReachLevel]
    regions: Sequence[ObjectRegion]
    colors: Mapping[str, Sequence[float]]


def to_csv(found: ReachMap) -> str:
    """A row per point; the tilt is empty where the arm does not get to."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    parts = [
        f"{level.name}_{part}"
        for level in found.levels
        for part in ("reached", "residual_m", "tilt_deg")
    ]
    writer.writerow(["x_m", "y_m", *parts])
    for row, y in enumerate(found.y):
        for column, x in enumerate(found.x):
            cells = [f"{x:.6g}", f"{y:.6g}"]
            for level in found.levels:
                tilt = level.tilt[row, column]
                reached = np.isfinite(tilt)
                cells += [
                    str(int(reached)),
                    f"{level.residual[row, column]:.3g}",
                    f"{np.degrees(tilt):.2f}" if reached else "",
                ]
            writer.writerow(cells)
    return out.getvalue()


def to_npz(found: ReachMap) -> bytes:
    """The map as arrays, levels first."""
    out = io.BytesIO()
    np.savez_compressed(
        out,
        x_m=found.x,
        y_m=found.y,
        level=np.array([level.name for level in found.levels]),
        height_above_table_m=np.array([level.height for level in found.levels]),
        reached=np.array([level.reached for level in found.levels]),
        residual_m=np.array([level.residual for level in found.levels]),
        tilt_deg=np.degrees([level.tilt for level in found.levels]),
    )
    return out.getvalue()


def to_markdown(found: ReachMap, notes: Sequence[str], picture: str = "") -> str:
    """Both tables and the picture."""
    tables = [Table.of("", _REGION, found.regions), Table.of("", _LEVEL, found.levels)]
    return to_document(found.title, tables, notes, picture)


def _configured(region: ObjectRegion) -> str:
    x, y = region.configured
    return f"{x:.3f} x {y:.3f}, {'reached' if region.reached else 'NOT reached'}"


def _tilts(level: ReachLevel) -> str:
    if not level.reached.any():
        return ""
    low, high = (np.degrees(end(level.tilt)) for end in (np.nanmin, np.nanmax))
    return f"{low:.0f}° to {high:.0f}°"


_REGION: dict[str, Callable[[ObjectRegion], str]] = {
    "object": lambda region: region.name,
    "position": lambda region: f"({region.place[0]:.3f}, {region.place[1]:.3f})",
    "configured": _configured,
    "largest square": lambda region: f"{region.square:.3f}",
    "largest rectangle": lambda region: f"{region.largest[0]:.3f} x {region.largest[1]:.3f}",
    "tilt at most": lambda region: (
        f"{np.degrees(region.tilt):.0f}°" if np.isfinite(region.tilt) else ""
    ),
}
_LEVEL: dict[str, Callable[[ReachLevel], str]] = {
    "level": lambda level: level.name,
    "above the table": lambda level: f"{level.height:.3f} m",
    "gripper": lambda level: level.gripper,
    "reached": lambda level: f"{100.0 * level.reached.mean():.1f} %",
    "tilt": _tilts,
}


def save_map(path: Path, found: ReachMap) -> None:
    """Draw a panel per level: the tilt as colour, hatched where the arm does not get to, table,
    objects and regions.
    """
    width = found.x[-1] - found.x[0]
    panel = 3.6 * max(0.6, width / (found.y[-1] - found.y[0])) + 1.0
    figure, panels = plt.subplots(
        1, len(found.levels), figsize=(panel * len(found.levels) + 1.2, 5.6), layout="constrained"
    )
    top = max(
        (np.degrees(np.nanmax(level.tilt)) for level in found.levels if level.reached.any()),
        default=90.0,
    )
    image = None
    for axes, level in zip(np.atleast_1d(panels), found.levels, strict=True):
        axes.set_facecolor("0.92")
        axes.add_patch(
            _box(
                _middle(found.x),
                _middle(found.y),
                _span(found.x),
                _span(found.y),
                hatch="////",
                ec="0.6",
                lw=0,
            )
        )
        drawn = np.ma.masked_invalid(np.degrees(level.tilt))
        image = axes.pcolormesh(
            found.x, found.y, drawn, vmin=0.0, vmax=top, cmap="viridis", shading="nearest"
        )
        (x, y), (half_x, half_y) = found.table
        axes.add_patch(_box(x, y, half_x, half_y, fill=False, ec="k", lw=1.5))
        for region in found.regions:
            color = found.colors[region.name]
            axes.plot(*region.place, "s", color=color, markersize=7, markeredgecolor="w")
            axes.add_patch(_box(*region.place, *region.configured, fill=False, ec=color, lw=1.8))
            axes.add_patch(
                _box(*region.place, *region.largest, fill=False, ec=color, lw=1.2, ls=":")
            )
        axes.set(
            title=f"{level.name}: {level.height:.3f} m above, {level.gripper}",
            xlabel="x [m]",
            aspect="equal",
        )
    np.atleast_1d(panels)[0].set_ylabel("y [m]")
    if image is not None:
        figure.colorbar(image, ax=panels, label="smallest tilt of the gripper from vertical [deg]")
    figure.suptitle(
        f"{found.title}\nhatched: not reached; squares: objects; solid: configured region; dotted:"
        " largest with margin"
    )
    figure.savefig(path, dpi=100)
    plt.close(figure)


def _box(x: float, y: float, half_x: float, half_y: float, **style: Any) -> Rectangle:
    return Rectangle(
        (x - half_x, y - half_y), 2.0 * half_x, 2.0 * half_y, **({"fill": False} | style)
    )


def _middle(values: np.ndarray) -> float:
    return float(0.5 * (values[0] + values[-1]))


def _span(values: np.ndarray) -> float:
    return float(0.5 * (values[-1] - values[0]))
