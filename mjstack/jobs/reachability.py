"""Job *reachability*: what the arm reaches on the table, at which tilt, and how far from their
positions the objects may stand.
"""

import math
import time
from pathlib import Path
from typing import cast

import numpy as np
from rich.markup import escape

from mjstack.config.schema import Config, ReachabilityJobCfg
from mjstack.episodes.context import RunContext
from mjstack.errors import ConfigError
from mjstack.jobs.job import Job, JobResult
from mjstack.jobs.progress import ProgressBar
from mjstack.jobs.runner import Record, run_reported
from mjstack.kinematics.reach import PointReach
from mjstack.report.reachability import (
    ObjectRegion,
    ReachLevel,
    points_csv,
    save_map,
)
from mjstack.report.record import GateResult, Status
from mjstack.report.write import summarize, write_tables
from mjstack.scene import table_top
from mjstack.scene.phases import object_targets
from mjstack.sim import resolve_backend

_MOST_POINTS = 100_000
_SHARE = 500  # points between two looks at the clock
_FINE = 0.001  # [m] to which regions are given


def check_reachability(cfg: Config) -> RunContext:
    """Raise for what cannot be done, before anything is written."""
    resolve_backend(cfg)
    find_levels(cfg)
    step = cast(ReachabilityJobCfg, cfg.job).step
    half = cfg.scene.table_half
    points = math.prod(2 * int(half[k] / step) + 1 for k in (0, 1))
    if points > _MOST_POINTS or step > min(half[:2]):
        least = math.sqrt(4.0 * half[0] * half[1] / _MOST_POINTS)
        expected = f"{least:.4f} to {min(half[:2]):g} m; this table would have {points} points"
        raise ConfigError("job.step", step, expected)
    return RunContext(cfg)


def run_reachability_job(context: RunContext, folder: Path, overrides: list[str]) -> JobResult:
    """Draw the map and leave reachability.csv, .md, .png and the report.

    Args:
        context: The configuration.
        folder: Where they go.
        overrides: The command line.

    Returns:
        How it ended: a pass if the region of ``reset=randomized`` is reached with the margin,
        around every object's position.
    """
    cfg = context.cfg

    def work(context: RunContext, bar: ProgressBar, record: Record) -> None:
        levels: list[ReachLevel] = []
        results: list[GateResult] = []
        for name, (height, gripper) in find_levels(cfg).items():
            bar.start(name)
            began = time.perf_counter()
            levels.append(map_level(context, name, height, gripper))
            results.append(_level_result(levels[-1], time.perf_counter() - began))
            _write(cfg, folder, levels, [], results)
            record(results[-1])
        regions = [find_region(cfg, levels, name) for name in cfg.scene.free]
        results += [_region_result(cfg, region) for region in regions]
        if problem := _write(cfg, folder, levels, regions, results, draw=True):
            bar.say(escape(problem))
        for result in results[len(levels) :]:
            record(result)

    title = f"task {cfg.task.name}, what the arm reaches"
    return run_reported(context, folder, overrides, title, work)


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
    top = table_top(cfg.scene)
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
    center, half = cfg.scene.table_center, cfg.scene.table_half
    counts = [int(half[k] / step + 1e-9) for k in (0, 1)]
    return [center[k] + step * np.arange(-n, n + 1) for k, n in enumerate(counts)]


def map_level(context: RunContext, name: str, height: float, gripper: str) -> ReachLevel:
    """Solve every point of one height."""
    cfg = context.cfg
    command = cfg.robot.grips[gripper]
    reach = PointReach(context.model, cfg.robot, command)
    tolerance = cfg.controller.ik_tolerance
    x, y = np.meshgrid(*axes(cfg))
    level = np.full(x.size, table_top(cfg.scene) + height)
    points = np.stack([x.ravel(), y.ravel(), level], axis=1)
    residual = np.empty(len(points))
    tilt = np.empty(len(points))
    for first in range(0, len(points), _SHARE):
        part = slice(first, first + _SHARE)
        found = reach.solve_upright(points[part], tolerance)
        residual[part] = found.distance
        tilt[part] = np.where(found.distance <= tolerance, np.degrees(found.tilt), np.nan)
        context.tell("points", min(first + _SHARE, len(points)), len(points))
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
    ends = [min(place[k] - axis[0], axis[-1] - place[k]) for k, axis in enumerate((x, y))]
    edge = [end - job.margin for end in ends]

    def most_y(half_x: float) -> float:
        """How far a region of this half-width goes in y; negative where there is none."""
        beside = away[away[:, 0] <= half_x, 1]
        return min(edge[1], beside.min(initial=math.inf)) if half_x <= edge[0] else -1.0

    room = [
        scene.table_half[k] - thing.footprint - abs(place[k] - scene.table_center[k])
        for k in (0, 1)
    ]
    square = 0.0
    largest = (0.0, 0.0)
    for half_x in np.arange(0.0, max(room[0], 0.0) + 1e-9, _FINE):
        half_y = min(room[1], most_y(half_x))
        if half_y < 0.0:
            continue
        half_y = _FINE * math.floor(half_y / _FINE + 1e-9)
        if half_y >= half_x - 1e-9:
            square = half_x
        if half_x * half_y > largest[0] * largest[1]:
            largest = float(half_x), half_y
    wide, deep = scene.random_xy
    inside = np.ix_(np.abs(y - place[1]) <= deep + 1e-9, np.abs(x - place[0]) <= wide + 1e-9)
    return ObjectRegion(
        name=name,
        place=(place[0], place[1]),
        configured=(wide, deep),
        square=float(square),
        largest=largest,
        tilt=float(levels[0].tilt[inside].max(initial=-math.inf)),
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
        low, high = level.tilts
        metrics |= {"smallest_tilt_deg": low, "largest_tilt_deg": high}
        reason += f", tilted by {low:.0f} to {high:.0f} degrees at least"
    return GateResult(
        name=level.name, status=Status.passed, reason=reason, seconds=seconds, metrics=metrics
    )


def _region_result(cfg: Config, region: ObjectRegion) -> GateResult:
    margin = cast(ReachabilityJobCfg, cfg.job).margin
    wide, deep = region.configured
    x, y = region.largest
    at = "({:.3f}, {:.3f})".format(*region.place)
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
    cfg: Config,
    folder: Path,
    levels: list[ReachLevel],
    regions: list[ObjectRegion],
    results: list[GateResult],
    draw: bool = False,
) -> str:
    """Write table and picture as far as they are known; return why there is no picture."""
    job = cast(ReachabilityJobCfg, cfg.job)
    scene = cfg.scene
    x, y = axes(cfg)
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

    def picture(path: Path) -> None:
        table = (scene.table_center[:2], scene.table_half[:2])
        colors = {name: thing.color for name, thing in scene.free.items()}
        save_map(path, title, x, y, levels, regions, table, colors)

    return write_tables(
        folder,
        "reachability",
        title,
        [summarize(results)],
        notes,
        points_csv(x, y, levels),
        picture if draw else None,
    )


JOB = Job(check_reachability, run_reachability_job)
