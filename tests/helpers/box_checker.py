"""The rules of the check of the box task for one recorded world, in plain NumPy.

Written from the rules' text, not from `mjstack.tasks.box`: the two have to agree because both are
right."""

import itertools
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from check_cases import BLUE, Outcome, Recording, counted

from mjstack.config.schema import Config
from mjstack.tasks.check import make_check

COLORS = ("red", "blue")
SIGNS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))


def check_box_world(rec: Recording, cfg: Config, model: mujoco.MjModel) -> Outcome:
    """Judges one world."""
    rules = make_check(cfg).t
    box = cfg.scene.objects["box"]
    floor = box.parts["floor"]
    out = Outcome(counted(rec, cfg))
    assert rec.support_force is not None
    steps = len(rec.pose)
    top = cfg.scene.table_center[2] + cfg.scene.table_half[2]

    touching = np.linalg.norm(rec.jaw_force, axis=-1) > rules.force
    supported = (np.linalg.norm(rec.support_force, axis=-1) > rules.force).any(-1)
    closed = np.array(cfg.robot.gripper_closed)
    opened = np.array(cfg.robot.gripper_open)
    opening = ((rec.gripper - closed) / (opened - closed)).min(1)
    rim = 2 * box.parts["near"].size[2]
    x_low = box.xy[0] - floor.size[0]
    x_high = box.xy[0] + floor.size[0]
    y_low = box.xy[1] - floor.size[1]
    y_high = box.xy[1] + floor.size[1]

    released_at: dict[str, int] = {}
    for cube, color in enumerate(COLORS):
        corners, speed = corners_of(
            rec.pose[:, cube], rec.velocity[:, cube], cfg.scene.objects["red"].half_height
        )
        x = corners[..., 0]
        y = corners[..., 1]
        z = corners[..., 2]
        outside = np.stack(
            [
                x_low - x,
                x - x_high,
                y_low - y,
                y - y_high,
                top + 2 * floor.size[2] - z,
                z - top - rim,
            ]
        ).max(axis=(0, 2))
        over = ((x >= x_low) & (x <= x_high) & (y >= y_low) & (y <= y_high)).all(1)
        loaded = touching[:, cube].all(1)
        detached = ~touching[:, cube].any(1)
        airborne = loaded & (z.min(1) - top >= rules.lift_height) & ~supported[:, cube]

        still = detached & (outside <= rules.inside) & (speed < rules.rest_speed)
        rest = top + 2 * floor.size[2] + cfg.scene.objects[color].half_height
        high = rec.pose[:, cube, 2] - rest > rules.drop_height
        let_go = np.append(False, loaded[:-1]) & ~loaded
        falls = high & (let_go | ~loaded & ~supported[:, cube])
        seen = Seen(loaded, airborne, over, falls, detached, still, opening, rec.pose[:, cube, :2])
        if rec.phase is None:
            found = judge_freely(seen, rules, steps)
        else:
            found = judge_by_phase(seen, rules, rec.phase, color)
        for rule, holds in found.holds.items():
            if not holds:
                out.failed.add(f"{rule}_{color.upper()}")
        if found.released_at is not None:
            released_at[color] = found.released_at
        if rest_until(still, steps - 1) < rules.window:
            out.failed.add("INSIDE")

        slot = np.array(cfg.scene.places[f"{color}_slot"].xy)
        out.values |= {
            f"slot_err_{color}_m": float(np.linalg.norm(rec.pose[-1, cube, :2] - slot)),
            f"grasp_steps_{color}": found.grasp,
            f"lift_steps_{color}": found.lift,
            f"carry_{color}_m": found.carry,
            f"unloaded_steps_{color}": found.unloaded,
            f"opening_{color}": found.widest,
            f"settled_steps_{color}": found.settled,
        }

    blue_loaded = np.flatnonzero(touching[:, BLUE].all(1))
    if len(blue_loaded) and blue_loaded[0] < released_at.get("red", steps):
        out.failed.add("ORDER")

    clearance = lowest_geometry(rec, cfg.robot.jaw_bodies, model) - (top + rim)
    out.values["jaw_clearance_m"] = clearance
    if not clearance >= rules.jaw_clearance:
        out.failed.add("JAW_CLEAR")
    return out


@dataclass
class Seen:
    """A cube at every step end."""

    loaded: np.ndarray
    airborne: np.ndarray
    over: np.ndarray
    falls: np.ndarray
    detached: np.ndarray
    still: np.ndarray
    opening: np.ndarray
    xy: np.ndarray


@dataclass
class Found:
    """A cube's rules, and the numbers behind them."""

    grasp: int
    lift: int
    carry: float
    over_box: bool
    unloaded: int
    widest: float
    released_at: int | None
    settled: int
    rules: Any

    @property
    def holds(self) -> dict[str, bool]:
        return {
            "GRASP": self.grasp >= self.rules.grasp_steps,
            "LIFT": self.lift >= self.rules.lift_steps,
            "CARRY": self.carry >= self.rules.carry_distance and self.over_box,
            "DROP": self.unloaded == 0,
            "RELEASE": self.released_at is not None,
            "SETTLED": self.settled >= self.rules.window,
        }


def farthest(xy: np.ndarray, run: list[int]) -> float:
    """Largest distance from where a run began."""
    return float(np.linalg.norm(xy[run] - xy[run[0]], axis=1).max())


def judge_by_phase(seen: Seen, rules: Any, phase: np.ndarray, color: str) -> Found:
    """The rules in the phases that they name."""
    # A world that goes back to its approach is judged from there.
    approaches = np.flatnonzero(phase == f"approach_{color}")
    first = approaches[-1] + 1 if len(approaches) else 0

    def steps_in(*roles: str) -> list[int]:
        names = {f"{role}_{color}" for role in roles}
        return [f for f in range(first, len(phase)) if phase[f] in names]

    carries = [r for r in runs(seen.airborne, steps_in("carry")) if len(r) >= rules.carry_steps]
    holds = steps_in("hold")
    grasps = [r for r in runs(seen.loaded, steps_in("close")) if len(r) >= rules.grasp_steps]
    unloaded = 0
    if grasps:  # the last one made while closing
        grasped_at = grasps[-1][rules.grasp_steps - 1]
        held = [f for f in steps_in("close", "lift", "carry", "hold") if f >= grasped_at]
        unloaded = sum(not seen.loaded[f] for f in held)
    free = [f for f in steps_in("open", "retreat", "settle") if seen.detached[f]]
    settles = steps_in("settle")
    return Found(
        grasp=longest(seen.loaded, steps_in("close")),
        lift=longest(seen.airborne, steps_in("lift", "carry")),
        carry=max((farthest(seen.xy, run) for run in carries), default=0.0),
        over_box=bool(len(holds) and seen.over[holds[-1]]),
        unloaded=unloaded,
        widest=max((float(seen.opening[f]) for f in free), default=0.0),
        released_at=next((f for f in free if seen.opening[f] >= rules.open_fraction), None),
        settled=rest_until(seen.still, settles[-1]) if settles else 0,
        rules=rules,
    )


def judge_freely(seen: Seen, rules: Any, steps: int) -> Found:
    """Grasp, lift and carry in this order at any time before the settled window; released after the
    carry, and at rest for the window at some time after that.
    """
    before = range(steps - rules.window)

    def reaches(holds: np.ndarray, start: int | None, length: int) -> int | None:
        """The step that makes a run from ``start`` on long enough."""
        found = [] if start is None else runs(holds, [f for f in before if f >= start])
        return next((run[length - 1] for run in found if len(run) >= length), None)

    grasped_at = reaches(seen.loaded, 0, rules.grasp_steps)
    lifted_at = reaches(seen.airborne, grasped_at, rules.lift_steps)
    lifting = [] if grasped_at is None else [f for f in before if f >= grasped_at]
    carrying = [] if lifted_at is None else [f for f in before if f >= lifted_at]

    carry = 0.0
    carried_at = None
    for run in runs(seen.airborne, carrying):
        for length in range(rules.carry_steps, len(run) + 1):
            carry = max(carry, farthest(seen.xy, run[:length]))
            if carry >= rules.carry_distance and carried_at is None:
                carried_at = run[length - 1]

    unloaded = 0
    over_box = False
    for f in range(steps):
        if seen.loaded[f]:
            over_box = bool(seen.over[f])
        elif lifted_at is not None and f >= lifted_at and (seen.falls[f] or not over_box):
            unloaded += 1

    free = [f for f in range(steps) if carried_at is not None and f >= carried_at]
    free = [f for f in free if seen.detached[f]]
    released_at = next((f for f in free if seen.opening[f] >= rules.open_fraction), None)
    after = [] if released_at is None else range(released_at, steps)
    return Found(
        grasp=longest(seen.loaded, list(before)),
        lift=longest(seen.airborne, lifting),
        carry=carry,
        over_box=over_box,
        unloaded=unloaded,
        widest=max((float(seen.opening[f]) for f in free), default=0.0),
        released_at=released_at,
        settled=max((rest_until(seen.still, f) for f in after), default=0),
        rules=rules,
    )


def corners_of(
    pose: np.ndarray, velocity: np.ndarray, half: float
) -> tuple[np.ndarray, np.ndarray]:
    """World places of the eight corners, ``(steps, 8, 3)``, and the speed of the fastest,
    ``(steps,)``.
    """
    turn = rotations(pose[:, 3:])
    arms = np.einsum("fij,kj->fki", turn, half * SIGNS)
    spin = np.einsum(
        "fij,fj->fi", turn, velocity[:, 3:]
    )  # a free joint's angular velocity is in the body's frame
    moving = velocity[:, None, :3] + np.cross(spin[:, None], arms)
    return pose[:, None, :3] + arms, np.linalg.norm(moving, axis=2).max(1)


def rotations(quat: np.ndarray) -> np.ndarray:
    """Matrices, by rotating the unit vectors: v + 2 w (u x v) + 2 u x (u x v)."""
    w = quat[:, :1]
    u = quat[:, 1:]
    columns = []
    for axis in np.eye(3):
        first = np.cross(u, axis)
        columns.append(axis + 2.0 * w * first + 2.0 * np.cross(u, first))
    return np.stack(columns, axis=2)


def runs(holds: np.ndarray, judged: list[int]) -> list[list[int]]:
    """Uninterrupted runs in which something holds, among the judged steps."""
    out: list[list[int]] = []
    going = False
    for f in judged:
        if holds[f]:
            if not going:
                out.append([])
            out[-1].append(f)
        going = bool(holds[f])
    return out


def longest(holds: np.ndarray, judged: list[int]) -> int:
    """Length of the longest run."""
    return max((len(run) for run in runs(holds, judged)), default=0)


def rest_until(still: np.ndarray, last: int) -> int:
    """Steps in a row up to the last one."""
    moving = np.flatnonzero(~still[: last + 1])
    return last - (moving[-1] if len(moving) else -1)


def lowest_geometry(rec: Recording, bodies: list[str], model: mujoco.MjModel) -> float:
    """Smallest z of the colliding geoms of some bodies, by MuJoCo's distance from the floor."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    floor = model.geom("floor").id
    lowest = 2.0
    for geom in range(model.ngeom):
        body = model.geom_bodyid[geom]
        collides = model.geom_contype[geom] or model.geom_conaffinity[geom]
        if model.body(body).name in bodies and collides:
            turn = rotations(rec.xquat[None, body])[0]
            data.geom_xpos[geom] = rec.xpos[body] + turn @ model.geom_pos[geom]
            data.geom_xmat[geom] = (turn @ rotations(model.geom_quat[None, geom])[0]).ravel()
            lowest = min(lowest, mujoco.mj_geomDistance(model, data, floor, geom, 2.0, None))
    return lowest
