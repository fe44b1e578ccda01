"""Job *reachability*: what the arm reaches on the table, at which tilt, and how far from their
positions the objects may stand.
"""

import io
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np

from mjstack.config.schema import Config, ReachabilityJobCfg
from mjstack.episodes.context import RunContext
from mjstack.errors import ConfigError
from mjstack.jobs.runner import CheckedJob, Job, write_tables
from mjstack.kinematics.reach import PointReach
from mjstack.report.picture import figure, outline
from mjstack.report.record import GateResult, Status
from mjstack.report.write import summarize
from mjstack.scene.phases import object_targets
from mjstack.sim import resolve_backend

_MOST_POINTS = 100_000
_SHARE = 500  # points between two looks at the clock
_FINE = 0.001  # [m] to which regions are given


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


@dataclass(frozen=True, kw_only=True, slots=True)
class ObjectRegion:
    """Where one object may stand, around its nominal position.

    Attributes:
        name: The object.
        square: Largest half-width of a square that is reached with the margin [m]; 0 where none is.
        largest: Half-widths of the largest rectangle that is reached with the margin [m].
        tilt: Largest of the smallest tilts in that region at the grasp [deg]; NaN where some is not
            reached.
        reached: Whether the region of ``reset=randomized`` is, with the margin.
    """

    name: str
    square: float
    largest: tuple[float, float]
    tilt: float
    reached: bool


def check_reachability(cfg: Config) -> CheckedJob:
    """Raise for what cannot be done, before anything is written."""
    resolve_backend(cfg)
    find_levels(cfg)
    step = cast(ReachabilityJobCfg, cfg.job).step
    half = cfg.scene.table_half
    points = math.prod(2 * n + 1 for n in _counts(cfg))
    if points > _MOST_POINTS or step > min(half[:2]):
        least = math.sqrt(4.0 * half[0] * half[1] / _MOST_POINTS)
        expected = f"{least:.4f} to {min(half[:2]):g} m; this table would have {points} points"
        raise ConfigError("job.step", step, expected)
    title = f"task {cfg.task.name}, what the arm reaches"
    return CheckedJob(context=RunContext(cfg), title=title, work=run_reachability)


def run_reachability(context: RunContext, folder: Path) -> None:
    """Draw the map and leave reachability.csv, .md and .png in the folder.

    An object passes if the region of ``reset=randomized`` is reached with the margin around its
    position.
    """
    cfg = context.cfg
    levels: list[ReachLevel] = []
    results: list[GateResult] = []
    for name, (height, gripper) in find_levels(cfg).items():
        context.begin(name)
        began = time.perf_counter()
        levels.append(map_level(context, name, height, gripper))
        results.append(_level_result(levels[-1], time.perf_counter() - began))
        _write(context, levels, [], results)
        context.record(results[-1])
    regions = [find_region(cfg, levels, name) for name in cfg.scene.free]
    results += [_region_result(cfg, region) for region in regions]
    _write(context, levels, regions, results, draw=True)
    for result in results[len(levels) :]:
        context.record(result)


def find_levels(cfg: Config) -> dict[str, tuple[float, str]]:
    """Heights above the table [m] at which the task needs the grasp point, and the gripper's
    command there.

    ``approach`` is the controller's first target at an object, ``grasp`` its lowest, and ``carry``
    its highest.
    """
    targets = [target for found in object_targets(cfg).values() for target in found]
    if not targets:
        raise ConfigError(
            "controller.phases", list(cfg.controller.phases), "a phase with an object as its anchor"
        )
    low, high = (end(targets, key=lambda pair: pair[1].z) for end in (min, max))
    first = targets[0]
    top = cfg.scene.table_top
    # The jaws close where they grasp, but come there open, which reaches less far where one jaw
    # stays.
    return {
        "grasp": (low[1].z - top, "open"),
        "approach": (first[1].z - top, first[0].spec.gripper),
        "carry": (high[1].z - top, high[0].spec.gripper),
    }


def axes(cfg: Config) -> list[np.ndarray]:
    """The map's columns and rows: x and y [m] of points on the table, one in its middle."""
    step = cast(ReachabilityJobCfg, cfg.job).step
    center = cfg.scene.table_center
    return [center[k] + step * np.arange(-n, n + 1) for k, n in enumerate(_counts(cfg))]


def _counts(cfg: Config) -> list[int]:
    """Points of the map on either side of the middle one, in x and y."""
    step = cast(ReachabilityJobCfg, cfg.job).step
    return [int(half / step + 1e-9) for half in cfg.scene.table_half[:2]]


def map_level(context: RunContext, name: str, height: float, gripper: str) -> ReachLevel:
    """Solve every point of one height."""
    cfg = context.cfg
    command = cfg.robot.grips[gripper]
    reach = PointReach(context.model, cfg.robot, command)
    tolerance = cfg.controller.ik_tolerance
    x, y = np.meshgrid(*axes(cfg))
    level = np.full(x.size, cfg.scene.table_top + height)
    points = np.stack([x.ravel(), y.ravel(), level], axis=1)
    residual = np.empty(len(points))
    tilt = np.empty(len(points))
    for first in range(0, len(points), _SHARE):
        part = slice(first, first + _SHARE)
        found = reach.solve_upright(points[part], tolerance)
        residual[part] = found.distance
        tilt[part] = np.where(found.distance <= tolerance, np.degrees(found.tilt), np.nan)
        context.advance("points", min(first + _SHARE, len(points)), len(points))
    return ReachLevel(
        name=name,
        height=height,
        gripper=gripper,
        residual=residual.reshape(x.shape),
        tilt=tilt.reshape(x.shape),
    )


def find_region(cfg: Config, levels: list[ReachLevel], name: str) -> ObjectRegion:
    """The largest regions around an object's position that are reached at every level, with the
    margin, and stay on the table.

    Between two points of the map the worse one counts.
    """
    job = cast(ReachabilityJobCfg, cfg.job)
    scene = cfg.scene
    thing = scene.objects[name]
    place = thing.xy
    x, y = axes(cfg)
    blocked = ~np.logical_and.reduce([level.reached for level in levels])
    rows, columns = np.nonzero(blocked)
    away = (
        np.stack((np.abs(x[columns] - place[0]), np.abs(y[rows] - place[1])), axis=1)
        - job.step
        - job.margin
    )
    edge = [
        min(place[k] - axis[0], axis[-1] - place[k]) - job.margin for k, axis in enumerate((x, y))
    ]

    def most_y(half_x: float) -> float:
        """How far a region of this half-width goes in y; negative where there is none."""
        beside = away[away[:, 0] <= half_x, 1]
        return min(edge[1], beside.min(initial=math.inf)) if half_x <= edge[0] else -1.0

    room = [
        scene.table_half[k] - thing.footprint - abs(place[k] - scene.table_center[k])
        for k in (0, 1)
    ]
    half_x = np.arange(0.0, max(room[0], 0.0) + 1e-9, _FINE)
    half_y = np.minimum(room[1], [most_y(one) for one in half_x])
    half_y = _FINE * np.floor(half_y / _FINE + 1e-9)
    best = (half_x * half_y).argmax()
    wide, deep = scene.random_xy
    inside = np.ix_(np.abs(y - place[1]) <= deep + 1e-9, np.abs(x - place[0]) <= wide + 1e-9)
    tilts = levels[0].tilt[inside]
    return ObjectRegion(
        name=name,
        square=half_x[half_y >= half_x - 1e-9].max(initial=0.0),
        largest=(half_x[best], max(half_y[best], 0.0)),
        tilt=tilts.max() if tilts.size else math.nan,
        reached=most_y(wide) >= deep - 1e-9,
    )


def _level_result(level: ReachLevel, seconds: float) -> GateResult:
    share = float(level.reached.mean())
    metrics: dict[str, float] = {
        "height_above_table_m": level.height,
        "points": level.reached.size,
        "reached_fraction": share,
    }
    reason = (
        f"{level.height:.3f} m above the table, {level.gripper}: {100.0 * share:.1f} % of the"
        " table reached"
    )
    if share:
        low = float(np.nanmin(level.tilt))
        high = float(np.nanmax(level.tilt))
        metrics |= {"smallest_tilt_deg": low, "largest_tilt_deg": high}
        reason += f", tilted by {low:.0f} to {high:.0f} degrees at least"
    return GateResult(
        name=level.name, status=Status.passed, reason=reason, seconds=seconds, metrics=metrics
    )


def _region_result(cfg: Config, region: ObjectRegion) -> GateResult:
    margin = cast(ReachabilityJobCfg, cfg.job).margin
    wide, deep = cfg.scene.random_xy
    x, y = region.largest
    at = "({:.3f}, {:.3f})".format(*cfg.scene.objects[region.name].xy)
    there = "reached" if region.reached else "not reached"
    reason = (
        f"at {at} m, scene.random_xy {wide:g} x {deep:g} m is {there} with {1e3 * margin:g} mm to"
        f" spare; the largest square is {region.square:.3f} m, the largest rectangle {x:.3f} x"
        f" {y:.3f} m"
    )
    return GateResult(
        name=region.name,
        status=Status.passed if region.reached else Status.failed,
        reason=reason,
        thresholds={"margin_m": margin},
        metrics={
            "random_x_m": wide,
            "random_y_m": deep,
            "largest_square_m": region.square,
            "largest_x_m": x,
            "largest_y_m": y,
            "largest_tilt_in_region_deg": region.tilt,
        },
    )


def _write(
    context: RunContext,
    levels: list[ReachLevel],
    regions: list[ObjectRegion],
    results: list[GateResult],
    draw: bool = False,
) -> None:
    """Write table and picture as far as they are known."""
    cfg = context.cfg
    job = cast(ReachabilityJobCfg, cfg.job)
    title = f"{cfg.robot.title}, task {cfg.task.name}: what the arm reaches"
    notes = [
        (
            "Half-widths in m, around the position. A region counts as reached if it still is with"
            f" {1e3 * job.margin:g} mm more all round, at every level; points are"
            f" {1e3 * job.step:g} mm apart. Regions keep objects of any yaw on the table."
        ),
        (
            f"Reached: inverse kinematics of {', '.join(cfg.robot.ik_joints)} brings the grasp"
            f" point within {1e3 * cfg.controller.ik_tolerance:g} mm. Collisions are not looked at."
        ),
        (
            "Tilt: the smallest angle between the gripper's approach axis and straight down that a"
            " solution has. A controller that goes on from where it is need not find that solution,"
            " and may stop at a joint limit short of a point that is reached."
        ),
        "Reached does not mean grasped: how many worlds succeed, the gate success tells.",
    ]

    write_tables(
        context,
        "reachability",
        title,
        summarize(results),
        notes,
        _points_csv(cfg, levels),
        (lambda path: _save_map(path, title, cfg, levels, regions)) if draw else None,
    )


def _points_csv(cfg: Config, levels: Sequence[ReachLevel]) -> str:
    """A row per point of the map; the tilt is ``nan`` where the arm does not get to."""
    columns = dict(zip(("x_m", "y_m"), np.meshgrid(*axes(cfg)), strict=True))
    for level in levels:
        columns[f"{level.name}_reached"] = level.reached
        columns[f"{level.name}_residual_m"] = level.residual
        columns[f"{level.name}_tilt_deg"] = level.tilt
    out = io.StringIO()
    table = np.stack([column.ravel() for column in columns.values()], axis=1)
    np.savetxt(out, table, "%.6g", ",", header=",".join(columns), comments="")
    return out.getvalue()


def _save_map(
    path: Path,
    title: str,
    cfg: Config,
    levels: Sequence[ReachLevel],
    regions: Sequence[ObjectRegion],
) -> None:
    """Draw a panel per level: the tilt as colour, hatched where the arm does not get to, table,
    objects and regions.
    """
    scene = cfg.scene
    x, y = axes(cfg)
    wide = x[-1] - x[0]
    deep = y[-1] - y[0]
    title += (
        "\nhatched: not reached; squares: objects; solid: configured region; dotted: largest with"
        " margin"
    )
    count = len(levels)
    size = ((3.6 * max(0.6, wide / deep) + 1.0) * count + 1.2, 5.6)
    with figure(path, title, count, figsize=size) as (drawn, panels):
        top = np.nanmax([level.tilt for level in levels], initial=1.0)
        for panel, level in zip(np.atleast_1d(panels), levels, strict=True):
            panel.set_facecolor("0.92")
            center = (x[len(x) // 2], y[len(y) // 2])
            panel.add_patch(outline(center, (wide / 2, deep / 2), hatch="////", ec="0.6", lw=0))
            image = panel.pcolormesh(x, y, level.tilt, vmin=0.0, vmax=top, shading="nearest")
            panel.add_patch(outline(scene.table_center, scene.table_half, ec="k", lw=1.5))
            for region in regions:
                color = scene.objects[region.name].color
                place = scene.objects[region.name].xy
                panel.plot(*place, "s", color=color, markersize=7, markeredgecolor="w")
                panel.add_patch(outline(place, scene.random_xy, ec=color, lw=1.8))
                panel.add_patch(outline(place, region.largest, ec=color, lw=1.2, ls=":"))
            label = f"{level.name}: {level.height:.3f} m above, {level.gripper}"
            panel.set(title=label, xlabel="x [m]", ylabel="y [m]", aspect="equal")
        drawn.colorbar(image, ax=panels, label="smallest tilt of the gripper from vertical [deg]")


JOB = Job(check_reachability)
