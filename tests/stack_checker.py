"""The rules of the check of the stack task for one recorded world, in plain NumPy and simple loops.

Written from the rules' text, not from `mjstack.tasks.stack`: the two have to agree because both are
right."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from mjstack.config.schema import Config
from mjstack.tasks.check import make_check

RED = 0
BLUE = 1


@dataclass
class Outcome:
    """Names of the broken rules, and the numbers behind them."""

    failed: set[str]
    xy_err: float
    dz: float
    rest_speed: float
    peak_speed: float
    rest_position: float
    rest_rotation: float


def rotation_matrix(quat: np.ndarray) -> np.ndarray:
    """Rotates the unit vectors one by one: v + 2 w (u x v) + 2 u x (u x v)."""
    w = quat[0]
    u = quat[1:]
    columns = [v + 2.0 * w * np.cross(u, v) + 2.0 * np.cross(u, np.cross(u, v)) for v in np.eye(3)]
    return np.array(columns).T


def lowest_corner(pose: np.ndarray, half: float) -> float:
    """Smallest world z of the eight corners."""
    turn = rotation_matrix(pose[3:])
    return min(
        float((pose[:3] + turn @ (half * np.array(s)))[2])
        for s in itertools.product((-1.0, 1.0), repeat=3)
    )


def rotation_between(a: np.ndarray, b: np.ndarray) -> float:
    """Angle between two orientations: the chord between quaternions, the nearer of the
    two signs.
    """
    chord = (
        min(np.linalg.norm(a - b), np.linalg.norm(a + b)) if np.isfinite(a + b).all() else math.nan
    )
    return 4.0 * math.asin(min(1.0, 0.5 * chord)) if math.isfinite(chord) else math.nan


def _in(step: int, span: tuple[int, int]) -> bool:
    return span[0] <= step < span[1]


def check_world(
    pose: np.ndarray,
    velocity: np.ndarray,
    cfg: Config,
    phases: list,
    *,
    jaw_force: np.ndarray,
    gripper: np.ndarray,
    step_count: int,
    overflow: bool = False,
    finite_elsewhere: bool = True,
) -> Outcome:
    """Judges one world.

    Args:
        pose: Red's and blue's pose at every step end, shape ``(steps, 2, 7)``.
        velocity: Their velocity, shape ``(steps, 2, 6)``.
        cfg: Thresholds, table and cubes.
        phases: Names with first and last (exclusive) step; empty for a driver without phases.
        jaw_force: Of each jaw on red [N], shape ``(steps, jaws, 3)``.
        gripper: Positions of its joints, shape ``(steps, n)``.
        step_count: Physics steps the world has made.
        overflow: Whether it lost contacts or constraint rows.
        finite_elsewhere: Whether the rest of its state stayed finite.
    """
    rules = make_check(cfg).t
    scene = cfg.scene
    half = scene.objects["red"].half_height
    top = scene.table_center[2] + scene.table_half[2]
    steps = len(pose)
    span = {p.name: (p.start, p.stop) for p in phases}
    failed: set[str] = set()

    if not (np.isfinite(pose).all() and np.isfinite(velocity).all() and finite_elsewhere):
        failed.add("FINITE")
    whole = phases[-1].stop if phases else cfg.task.episode_steps
    if step_count != steps * cfg.timing.decimation or steps != whole:
        failed.add("STEPS")
    if overflow:
        failed.add("OVERFLOW")

    airborne = [lowest_corner(p[RED], half) - top > rules.airborne_height for p in pose]

    pressed = np.linalg.norm(jaw_force, axis=-1) > 1e-5
    before = range(steps - rules.window)
    if phases:
        lifting = [f for f in range(steps) if any(_in(f, span[n]) for n in rules.lift_phases)]
        carrying = list(range(*span[rules.carry_phase]))
    else:
        airborne = [up and pressed[f].all() for f, up in enumerate(airborne)]
        lifting = list(before)

    run = 0
    lifted_at = None
    for step in lifting:
        run = run + 1 if airborne[step] else 0
        if run == rules.lift_steps and lifted_at is None:
            lifted_at = step
    if lifted_at is None:
        failed.add("LIFT")

    if not phases:  # the lift comes first
        carrying = [f for f in before if lifted_at is not None and f >= lifted_at]
    carried = False
    run_steps: list[int] = []
    for step in carrying:
        run_steps = [*run_steps, step] if airborne[step] else []
        if run_steps:
            start = pose[run_steps[0], RED, :2]
            far = max(float(np.linalg.norm(pose[f, RED, :2] - start)) for f in run_steps)
            carried = carried or (
                len(run_steps) >= rules.carry_steps and far >= rules.carry_distance
            )
    if not carried:
        failed.add("CARRY")

    window = range(steps - rules.window, steps)
    for step in window:
        red = pose[step, RED]
        blue = pose[step, BLUE]
        xy = float(np.linalg.norm(red[:2] - blue[:2]))
        dz = float(red[2] - blue[2])
        if not (xy <= rules.xy_err and rules.dz_min <= dz <= rules.dz_max):
            failed.add("STACKED")
        gap = abs(lowest_corner(blue, half) - top)
        inside = all(
            abs(blue[i] - scene.table_center[i]) <= scene.table_half[i] - half for i in (0, 1)
        )
        if not (gap <= rules.support_gap and inside):
            failed.add("SUPPORTED")

    closed = np.array(cfg.robot.gripper_closed)
    opening = (gripper - closed) / (np.array(cfg.robot.gripper_open) - closed)
    for step in window:
        if pressed[step].any() or not (opening[step] >= rules.open_fraction).all():
            failed.add("RELEASED")

    rms = []
    peaks = []
    distances = []
    angles = []
    for cube in (RED, BLUE):
        speeds = []
        for step in window:
            v = velocity[step, cube, :3]
            w = velocity[step, cube, 3:]
            speeds.append(float(np.linalg.norm(v) + math.sqrt(3.0) * half * np.linalg.norm(w)))
        rms.append(math.sqrt(sum(s * s for s in speeds) / len(speeds)))
        peaks.append(np.max(speeds))
        for a, b in itertools.combinations(window, 2):
            distances.append(float(np.linalg.norm(pose[a, cube, :3] - pose[b, cube, :3])))
            angles.append(rotation_between(pose[a, cube, 3:], pose[b, cube, 3:]))
    rest_speed = float(np.max(rms))
    rest_position = float(np.max(distances))
    rest_rotation = float(np.max(angles))
    if not rest_speed <= rules.rest_speed:
        failed.add("REST_SPEED")
    if not rest_position <= rules.rest_position:
        failed.add("REST_POSITION")
    if not rest_rotation <= math.radians(rules.rest_rotation_deg):
        failed.add("REST_ROTATION")

    last = pose[-1]
    return Outcome(
        failed=failed,
        xy_err=float(np.linalg.norm(last[RED, :2] - last[BLUE, :2])),
        dz=float(last[RED, 2] - last[BLUE, 2]),
        rest_speed=rest_speed,
        peak_speed=float(np.max(peaks)),
        rest_position=rest_position,
        rest_rotation=rest_rotation,
    )
