"""The rules of the check of the stack task for one recorded world, in plain NumPy.

Written from the rules' text, not from `mjstack.tasks.stack`: the two have to agree because both are
right."""

import math

import numpy as np
from box_checker import corners_of
from check_cases import BLUE, RED, Outcome, Recording, counted

from mjstack.config.schema import Config
from mjstack.tasks.check import make_check


def rotation_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles between two orientations: from the chord between quaternions, the nearer of the two
    signs.
    """
    chord = np.minimum(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1))
    return 4.0 * np.arcsin(np.minimum(1.0, 0.5 * chord))


def check_world(rec: Recording, cfg: Config) -> Outcome:
    """Judges one world."""
    rules = make_check(cfg).t
    scene = cfg.scene
    half = scene.objects["red"].half_height
    top = scene.table_center[2] + scene.table_half[2]
    pose = rec.pose
    velocity = rec.velocity
    phase = rec.phase
    steps = len(pose)
    failed = counted(rec, cfg)

    corners = [corners_of(pose[:, cube], velocity[:, cube], half)[0] for cube in (RED, BLUE)]
    airborne = list(corners[RED][..., 2].min(1) - top > rules.airborne_height)

    pressed = np.linalg.norm(rec.jaw_force[:, RED], axis=-1) > 1e-5
    before = range(steps - rules.window)
    if phase is not None:
        lifting = [f for f in range(steps) if phase[f] in rules.lift_phases]
        carrying = [f for f in range(steps) if phase[f] == rules.carry_phase]
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

    if phase is None:  # the lift comes first
        carrying = [f for f in before if lifted_at is not None and f >= lifted_at]
    carried = False
    run_steps: list[int] = []
    for step in carrying:
        run_steps = [*run_steps, step] if airborne[step] else []
        if run_steps:
            way = pose[run_steps, RED, :2] - pose[run_steps[0], RED, :2]
            far = np.linalg.norm(way, axis=1).max()
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
        gap = abs(corners[BLUE][step, :, 2].min() - top)
        inside = all(
            abs(blue[i] - scene.table_center[i]) <= scene.table_half[i] - half for i in (0, 1)
        )
        if not (gap <= rules.support_gap and inside):
            failed.add("SUPPORTED")

    closed = np.array(cfg.robot.gripper_closed)
    opening = (rec.gripper - closed) / (np.array(cfg.robot.gripper_open) - closed)
    for step in window:
        if pressed[step].any() or not (opening[step] >= rules.open_fraction).all():
            failed.add("RELEASED")

    rms = []
    peaks = []
    distances = []
    angles = []
    pairs = tuple(np.triu_indices(rules.window, 1))
    for cube in (RED, BLUE):
        at = pose[window, cube]
        v = np.linalg.norm(velocity[window, cube, :3], axis=1)
        w = np.linalg.norm(velocity[window, cube, 3:], axis=1)
        speeds = v + math.sqrt(3.0) * half * w
        rms.append(math.sqrt(np.square(speeds).mean()))
        peaks.append(speeds.max())
        first, second = (at[index] for index in pairs)
        distances.append(np.linalg.norm(first[:, :3] - second[:, :3], axis=1).max())
        angles.append(rotation_between(first[:, 3:], second[:, 3:]).max())
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
    values = {
        "xy_err_m": float(np.linalg.norm(last[RED, :2] - last[BLUE, :2])),
        "dz_m": float(last[RED, 2] - last[BLUE, 2]),
        "rest_speed_m_per_s": rest_speed,
        "peak_speed_m_per_s": float(np.max(peaks)),
        "rest_position_m": rest_position,
        "rest_rotation_deg": math.degrees(rest_rotation),
    }
    return Outcome(failed, values)
