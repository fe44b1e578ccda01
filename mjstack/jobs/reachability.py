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
from mjstack.episodes.run import Run
from mjstack.episodes.stage import Stage
from mjstack.errors import ConfigError
from mjstack.files import write_atomic
from mjstack.jobs.runner import CheckedJob, Job
from mjstack.kinematics.reach import PointReach
from mjstack.report.picture import figure, outline
from mjstack.report.record import GateResult, Status
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


def check_reachability(cfg: Config) -> CheckedJob:
    """Raise for what cannot be done, before anything is written."""
    resolve_backend(cfg)
    find_levels(cfg)
    step = _job(cfg).step
    x, y, _ = cfg.scene.table_half
    points = math.prod(map(len, axes(cfg)))
    if points > _MOST_POINTS or step > min(x, y):
        least = math.sqrt(4.0 * x * y / _MOST_POINTS)
        expected = f"{least:.4f} to {min(x, y):g} m; this table would have {points} points"
        raise ConfigError("job.step", step, expected)
    title = f"task {cfg.task.name}, what the arm reaches"
    return CheckedJob(stage=Stage(cfg), title=title, work=run_reachability)


def run_reachability(run: Run, folder: Path) -> None:
    """Draw the map and leave reachability.csv and .png in the folder.

    An object passes if the region of ``reset=randomized`` is reached with the margin around its
    position.
    """
    cfg = run.cfg
    levels: list[ReachLevel] = []
    for name, (height, gripper) in find_levels(cfg).items():
        run.begin(name)
        began = time.perf_counter()
        levels.append(map_level(run, name, height, gripper))
        write_atomic(folder / "reachability.csv", _points_csv(cfg, levels))
        run.record(_level_result(cfg, levels[-1], time.perf_counter() - began))
    regions = [find_region(cfg, levels, name) for name in cfg.scene.free]
    run.draw("reachability.png", _save_map, cfg, levels, regions)
    for region in regions:
        run.record(region)


def _job(cfg: Config) -> ReachabilityJobCfg:
    return cast(ReachabilityJobCfg, cfg.job)


def find_levels(cfg: Config) -> dict[str, tuple[float, str]]:
    """Heights above the table [m] at which the task needs the grasp point, and the gripper's
    command there.

    ``approach`` is the controller's first target at an object, ``grasp`` its lowest, and ``carry``
    its highest.
    """
    targets = [target for targets in object_targets(cfg).values() for target in targets]
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
    step = _job(cfg).step
    counts = [int(half / step + 1e-9) for half in cfg.scene.table_half[:2]]
    middle = cfg.scene.table_center
    return [middle[k] + step * np.arange(-n, n + 1) for k, n in enumerate(counts)]


def map_level(run: Run, name: str, height: float, gripper: str) -> ReachLevel:
    """Solve every point of one height."""
    cfg = run.cfg
    reach = PointReach(run.stage.model, cfg.robot, cfg.robot.grips[gripper])
    tolerance = cfg.controller.ik_tolerance
    x, y = np.meshgrid(*axes(cfg))
    points = np.stack([x, y, np.full_like(x, cfg.scene.table_top + height)], axis=-1)
    points = points.reshape(-1, 3)
    residual = np.empty(x.shape)
    tilt = np.empty(x.shape)
    for first in range(0, x.size, _SHARE):
        part = slice(first, first + _SHARE)
        solution = reach.solve_upright(points[part], tolerance)
        residual.flat[part] = solution.distance
        reached = solution.distance <= tolerance
        tilt.flat[part] = np.where(reached, np.degrees(solution.tilt), np.nan)
        run.stage.progress.advance("points", min(first + _SHARE, x.size), x.size)
    return ReachLevel(name=name, height=height, gripper=gripper, residual=residual, tilt=tilt)


def find_region(cfg: Config, levels: list[ReachLevel], name: str) -> GateResult:
    """The largest regions around an object's position that are reached at every level, with the
    margin, and stay on the table. It passes if the region of ``reset=randomized`` is reached so.

    Between two points of the map the worse one counts. Lengths are half-widths: of a square, and of
    the largest rectangle; 0 where none is reached. The tilt is the largest of the smallest ones in
    the configured region at the grasp, NaN where some point is not reached.
    """
    job = _job(cfg)
    scene = cfg.scene
    thing = scene.objects[name]
    place = np.array(thing.xy)
    x, y = axes(cfg)
    rows, columns = np.nonzero(~np.logical_and.reduce([level.reached for level in levels]))
    blocked = np.stack((x[columns], y[rows]), axis=1)
    away = np.abs(blocked - place) - job.step - job.margin
    edge_x = min(place[0] - x[0], x[-1] - place[0]) - job.margin
    edge_y = min(place[1] - y[0], y[-1] - place[1]) - job.margin

    def most_y(half_x: float) -> float:
        """How far a region of this half-width goes in y; negative where there is none."""
        beside = away[away[:, 0] <= half_x, 1]
        return beside.min(initial=edge_y) if half_x <= edge_x else -1.0

    off_center = np.abs(place - scene.table_center[:2])
    room = np.array(scene.table_half[:2]) - thing.footprint - off_center
    half_x = np.arange(0.0, max(room[0], 0.0) + 1e-9, _FINE)
    half_y = np.minimum(room[1], [most_y(half) for half in half_x])
    half_y = _FINE * np.floor(half_y / _FINE + 1e-9)
    best = (half_x * half_y).argmax()
    wide, deep = scene.random_xy
    inside = np.ix_(np.abs(y - place[1]) <= deep + 1e-9, np.abs(x - place[0]) <= wide + 1e-9)
    tilts = levels[0].tilt[inside]
    square = half_x[half_y >= half_x - 1e-9].max(initial=0.0)
    largest = (half_x[best], max(half_y[best], 0.0))
    reached = most_y(wide) >= deep - 1e-9
    return GateResult(
        name=name,
        status=Status.passed if reached else Status.failed,
        reason="at ({:.3f}, {:.3f}) m, ".format(*thing.xy)
        + f"scene.random_xy {wide:g} x {deep:g} m is {'reached' if reached else 'not reached'} with"
        f" {1e3 * job.margin:g} mm to spare; the largest square is {square:.3f} m, the largest"
        f" rectangle {largest[0]:.3f} x {largest[1]:.3f} m",
        thresholds={"margin_m": job.margin},
        metrics={
            "random_x_m": wide,
            "random_y_m": deep,
            "largest_square_m": square,
            "largest_x_m": largest[0],
            "largest_y_m": largest[1],
            "largest_tilt_in_region_deg": tilts.max() if tilts.size else math.nan,
        },
    )


def _level_result(cfg: Config, level: ReachLevel, seconds: float) -> GateResult:
    share = float(level.reached.mean())
    joints = ", ".join(cfg.robot.ik_joints)
    metrics: dict[str, float] = {
        "height_above_table_m": level.height,
        "points": level.reached.size,
        "reached_fraction": share,
    }
    where = f"{level.height:.3f} m above the table, {level.gripper}"
    reason = f"{where}: {100.0 * share:.1f} % of the table reached"
    if share:
        low = float(np.nanmin(level.tilt))
        high = float(np.nanmax(level.tilt))
        metrics |= {"smallest_tilt_deg": low, "largest_tilt_deg": high}
        reason += f", tilted by {low:.0f} to {high:.0f} degrees at least"
    return GateResult(
        name=level.name,
        status=Status.passed,
        reason=reason,
        seconds=seconds,
        metrics=metrics,
        notes={"reached": f"to {1e3 * cfg.controller.ik_tolerance:g} mm, by {joints}"},
    )


def _points_csv(cfg: Config, levels: Sequence[ReachLevel]) -> str:
    """A row per point of the map; the tilt is ``nan`` where the arm does not get to."""
    x, y = np.meshgrid(*axes(cfg))
    columns = {"x_m": x, "y_m": y}
    for level in levels:
        columns[f"{level.name}_reached"] = level.reached
        columns[f"{level.name}_residual_m"] = level.residual
        columns[f"{level.name}_tilt_deg"] = level.tilt
    out = io.StringIO()
    table = np.stack([column.ravel() for column in columns.values()], axis=1)
    np.savetxt(out, table, "%.6g", ",", header=",".join(columns), comments="")
    return out.getvalue()


def _save_map(
    path: Path, cfg: Config, levels: Sequence[ReachLevel], regions: Sequence[GateResult]
) -> None:
    """Draw a panel per level: the tilt as colour, hatched where the arm does not get to, table,
    objects and regions.
    """
    scene = cfg.scene
    x, y = axes(cfg)
    wide = x[-1] - x[0]
    deep = y[-1] - y[0]
    title = (
        f"{cfg.robot.title}, task {cfg.task.name}: what the arm reaches\nhatched: not reached;"
        " squares: objects; solid: configured region; dotted: largest with margin"
    )
    size = ((3.6 * max(0.6, wide / deep) + 1.0) * len(levels) + 1.2, 5.6)
    with figure(path, title, len(levels), figsize=size) as (drawing, panels):
        top = np.nanmax([level.tilt for level in levels], initial=1.0)
        for panel, level in zip(np.atleast_1d(panels), levels, strict=True):
            panel.set_facecolor("0.92")
            middle = (x[len(x) // 2], y[len(y) // 2])
            panel.add_patch(outline(middle, (wide / 2, deep / 2), hatch="////", ec="0.6", lw=0))
            image = panel.pcolormesh(x, y, level.tilt, vmin=0.0, vmax=top, shading="nearest")
            panel.add_patch(outline(scene.table_center, scene.table_half, ec="k", lw=1.5))
            for region in regions:
                color = scene.objects[region.name].color
                place = scene.objects[region.name].xy
                panel.plot(*place, "s", color=color, markersize=7, markeredgecolor="w")
                panel.add_patch(outline(place, scene.random_xy, ec=color, lw=1.8))
                largest = [region.metrics[f"largest_{axis}_m"] for axis in "xy"]
                panel.add_patch(outline(place, largest, ec=color, lw=1.2, ls=":"))
            label = f"{level.name}: {level.height:.3f} m above, {level.gripper}"
            panel.set(title=label, xlabel="x [m]", ylabel="y [m]", aspect="equal")
        drawing.colorbar(image, ax=panels, label="smallest tilt of the gripper from vertical [deg]")


JOB = Job(check_reachability)
