"""Where an arm can work with its hand pointing down: its home, and a table in its reach."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import mujoco
import numpy as np
from numpy import ndarray

from mjstack.robots.hand import Hand, ancestors
from mjstack.robots.tips import Grip

_ITERATIONS = 30  # at most, per solve
_DAMPING = 1e-2
_MAX_STEP = 0.3  # [rad, m] per iteration
_SAMPLES = 3000  # random positions, of which those with the hand down are starts
_SEEDS = (4, 16)  # of them, the second where the first lead nowhere
_REACHED = 5e-4  # m
_UPRIGHT = 0.5  # rad: the hand points down where its approach axis is so near
_CUBE = 0.022  # m: half of its height
_TOP = 0.024  # m: height of a table's top on the floor
_ENOUGH = 1.5  # of 2: a table with such a score is taken


@dataclass(frozen=True)
class Workspace:
    """A table before an arm, seen from the file's origin, and the arm over its middle.

    Attributes:
        azimuth: Direction of the table from the arm's base [rad].
        center: Middle of the table's top [m].
        apart: Distance of two objects, beside each other, from the middle [m].
        height: Height above an object from which the hand comes [m].
        home: Positions of the arm's joints [rad, m].
        locked: Which of the arm's joints inverse kinematics need not move.
        roll: Number of the arm's joint that turns the hand about its approach axis, or None.
        upright: Whether the arm's first joint turns about the vertical.
        tilt: Largest angle of the approach axis to the vertical at the objects [rad].
        shoulder: Where the arm begins: the anchor of its first hinge [m].
        lowest: Height of its lowest point at home [m].
    """

    azimuth: float
    center: ndarray
    apart: float
    height: float
    home: ndarray
    locked: list[int]
    roll: int | None
    upright: bool
    tilt: float
    shoulder: ndarray
    lowest: float


class _Arm:
    """Inverse kinematics of a hand's pose: damped least squares within the joints' limits."""

    def __init__(self, model: mujoco.MjModel, hand: Hand, grip: Grip, limits: ndarray) -> None:
        self.model = model
        self.data = mujoco.MjData(model)
        self.hand = hand
        self.grip = grip
        self.low, self.high = limits.T
        self.qpos = model.jnt_qposadr[list(hand.arm)]
        self.dofs = model.jnt_dofadr[list(hand.arm)]

    def pose(self, q: ndarray) -> tuple[ndarray, ndarray, ndarray]:
        """Grasp point [m], approach and closing axis at positions of the arm's joints."""
        self.data.qpos[self.qpos] = q
        mujoco.mj_kinematics(self.model, self.data)
        turn = self.data.xmat[self.hand.palm].reshape(3, 3)
        point = self.data.xpos[self.hand.palm] + turn @ self.grip.point
        return point, turn @ self.grip.approach, turn @ self.grip.closing

    def jacobian(self, point: ndarray) -> tuple[ndarray, ndarray]:
        """Of the grasp point, where it is now, and of the hand's rotation, each of shape ``(3,
        joints)``.
        """
        mujoco.mj_comPos(self.model, self.data)
        jac = np.zeros((2, 3, self.model.nv))
        mujoco.mj_jac(self.model, self.data, *jac, point, self.hand.palm)
        return jac[0][:, self.dofs], jac[1][:, self.dofs]

    def solve(
        self, q: ndarray, target: ndarray, free: ndarray, across: ndarray | None, down: float = 0.2
    ) -> tuple[ndarray, float, float]:
        """Bring the grasp point to a target and the hand down, by some joints, from their positions
        ``q``; the jaws close along ``across``, if that is given. Returns the positions, the
        distance that is left [m], and the tilt [rad].
        """
        q = np.clip(q, self.low, self.high)
        vertical = np.array([0.0, 0.0, -1.0])
        for _ in range(_ITERATIONS):
            point, approach, closing = self.pose(q)
            linear, angular = self.jacobian(point)
            error = [target - point, down * np.cross(approach, vertical)]
            rows = [linear, down * angular]
            if across is not None:
                turn = np.cross(closing, np.copysign(1.0, closing @ across) * across)
                error.append([0.1 * (turn @ vertical)])
                rows.append(0.1 * vertical[None] @ angular)
            jac = np.concatenate(rows) * free
            off = np.concatenate(error)
            step = jac.T @ np.linalg.solve(jac @ jac.T + _DAMPING**2 * np.eye(len(off)), off)
            step *= min(1.0, _MAX_STEP / max(float(np.abs(step).max()), 1e-12))
            now = np.clip(q + step, self.low, self.high)
            if np.abs(now - q).max() < 1e-6:
                break
            q = now
        point, approach, _ = self.pose(q)
        tilt = float(np.arccos(np.clip(-approach[2], -1.0, 1.0)))
        return q, float(np.linalg.norm(target - point)), tilt

    def choose_locked(self, q: ndarray, upright: bool) -> tuple[list[int], int | None]:
        """Joints that inverse kinematics need not move, and the one that rolls the hand: in a plane
        with the first joint's axis an arm reaches all it can by joints across that plane.
        """
        point, approach, _ = self.pose(q)
        linear, _ = self.jacobian(point)
        axes = self.data.xaxis[list(self.hand.arm)]
        hinge = self.model.jnt_type[list(self.hand.arm)] == mujoco.mjtJoint.mjJNT_HINGE
        rolls = [k for k, axis in enumerate(axes) if hinge[k] and abs(axis @ approach) > 0.95]
        moved = np.linalg.norm(linear, axis=0)
        roll = rolls[-1] if rolls and moved[rolls[-1]] < 0.06 else None
        idle = [k for k in range(len(q)) if k and k == roll]
        if upright:
            away = point - self.data.xanchor[self.hand.arm[0]]
            side = np.cross([0.0, 0.0, 1.0], away / np.linalg.norm(away))
            lying = [k for k in range(1, len(q)) if hinge[k] and abs(axes[k] @ side) < 0.5]
            left = [k for k in range(len(q)) if k not in {*lying, *idle}]
            if len(left) >= 3 and np.linalg.svd(linear[:, left])[1][-1] > 0.03:
                idle = sorted({*lying, *idle})
        return idle, roll

    def try_table(
        self,
        seeds: list[ndarray],
        center: ndarray,
        azimuth: float,
        shoulder: ndarray,
        reach: float,
        upright: bool,
    ) -> tuple[float, Workspace] | None:
        """How well an arm works over a table, and the best home there; None if it does not."""
        side = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        # Of an arm that does not turn about the vertical no gain keeps the tilt between objects
        apart = round(min(0.14 if upright else 0.08, 0.25 * reach), 2)
        height = 0.1 if reach > 0.4 else 0.07
        everything = np.ones(len(self.low))
        best: tuple[float, Workspace] | None = None
        middle = center + np.array([0.0, 0.0, _CUBE + height])
        homes: list[ndarray] = []
        for seed in seeds:
            q, left, tilt = self.solve(seed, middle, everything, side)
            if left > _REACHED or tilt > 0.3 or any(np.abs(q - h).max() < 0.05 for h in homes):
                continue
            homes.append(q)
            lowest = self.lowest(q, center, apart)
            if lowest is None:
                continue
            locked, roll = self.choose_locked(q, upright)
            free = np.array([k not in locked for k in range(len(q))], dtype=float)
            worst = list(self.walk(q, free, center, side, apart, height))
            if max(left for left, _, _ in worst) > _REACHED:
                continue
            tilts = max(tilt for _, tilt, _ in worst)
            if tilts > _UPRIGHT:
                continue
            room = min(min(margin for _, _, margin in worst), 0.15)
            linear, _ = self.jacobian(self.pose(q)[0])
            bend = float(np.linalg.svd(linear[:, free > 0.0])[1][-1])
            score = room / 0.15 + min(bend, 0.15) / 0.15 - 1.5 * (tilt + tilts)
            score -= 0.6 * float(
                np.mean(np.abs(q - 0.5 * (self.low + self.high)) / (self.high - self.low))
            )
            if best is None or score > best[0]:
                arguments = (azimuth, center, apart, height, q, locked, roll, upright)
                best = score, Workspace(*arguments, tilts, shoulder, lowest)
            if best[0] >= _ENOUGH:
                break
        return best

    def walk(
        self,
        home: ndarray,
        free: ndarray,
        center: ndarray,
        side: ndarray,
        apart: float,
        height: float,
    ) -> Iterator[tuple[float, float, float]]:
        """Distance that is left, tilt, and share of a joint's range beside it, at objects."""
        ahead = np.cross(side, [0.0, 0.0, 1.0])
        span = np.maximum(self.high - self.low, 1e-9)
        for along, across in product((-0.03, 0.03), (-apart - 0.03, apart + 0.03)):
            q = home
            for up in (_CUBE + height + 0.07, _CUBE):
                target = center + along * ahead + across * side + [0.0, 0.0, up]
                q, _, _ = self.solve(q, target, free, None, 0.1)
                q, left, tilt = self.solve(
                    q, target, free, None, 0.0
                )  # as the point alone needs it
                margin = float((np.minimum(q - self.low, self.high - q) / span)[free > 0.0].min())
                yield left, tilt, margin

    def lowest(self, q: ndarray, center: ndarray, apart: float) -> float | None:
        """Height of the lowest point at home [m]; None if the arm is in its own way, or if a link
        but the hand's reaches into the table.
        """
        self.pose(q)
        model, data = self.model, self.data
        hand = {self.hand.palm, *self.hand.bodies}
        links = {*ancestors(model, self.hand.palm), *hand}
        lowest = np.inf
        for geom in np.flatnonzero(model.geom_contype | model.geom_conaffinity):
            body = int(model.geom_bodyid[geom])
            if model.body_weldid[body] == 0 or body not in links:
                continue
            middle, half = model.geom_aabb[geom].reshape(2, 3)
            turn = data.geom_xmat[geom].reshape(3, 3)
            at = data.geom_xpos[geom] + turn @ middle
            bottom = float(at[2] - np.abs(turn[2]) @ half)
            lowest = min(lowest, bottom)
            if bottom < center[2] and np.linalg.norm((at - center)[:2]) < apart + 0.1:
                return None
        mujoco.mj_collision(model, data)
        pairs = [model.geom_bodyid[c.geom].tolist() for c in data.contact if c.dist < -0.005]
        blocked = any({*pair} <= links and not {*pair} <= hand for pair in pairs)
        return None if blocked else lowest


def find_workspace(
    model: mujoco.MjModel, hand: Hand, grip: Grip, limits: ndarray
) -> Workspace | None:
    """Search tables around an arm for the one that it reaches best with its hand down, by inverse
    kinematics; None if it reaches none. ``limits`` are those of the arm's joints [rad, m], shape
    ``(n, 2)``.
    """
    arm = _Arm(model, hand, grip, limits)
    rng = np.random.default_rng(0)
    low, high = np.clip(limits.T, -np.pi, np.pi)
    starts = rng.uniform(low, high, (_SAMPLES, len(low)))
    plain = [np.clip(0.0, *limits.T), 0.5 * (low + high)]
    poses = [arm.pose(q) for q in starts]
    cloud = np.array([point for point, _, _ in poses])
    down = np.array([approach[2] for _, approach, _ in poses]) < -0.7
    arm.pose(np.clip(model.qpos0[arm.qpos], *limits.T))
    hinges = [j for j in hand.arm if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE]
    shoulder = arm.data.xanchor[hinges[0]].copy() if hinges else cloud.mean(axis=0)
    axis = arm.data.xaxis[hand.arm[0]]
    upright = bool(hand.arm[0] in hinges and abs(axis[2]) > 0.999)
    reach = float(np.quantile(np.linalg.norm((cloud - shoulder)[:, :2], axis=1), 0.95))
    shares = (0.55, 0.7, 0.4) if hinges else (0.0,)
    tops = {_TOP: 0.0} | {z: 0.3 + abs(z - _TOP) for z in shoulder[2] + np.arange(-0.6, 0.31, 0.15)}
    tables = [
        (cost + abs(s - shares[0]), top, s) for (top, cost), s in product(tops.items(), shares)
    ]
    best: tuple[float, Workspace | None] = (-np.inf, None)
    for count, azimuth in product(_SEEDS, (0.0, -0.5 * np.pi, 0.5 * np.pi, np.pi)):
        ahead = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        for cost, top, share in sorted(tables):
            if best[0] >= _ENOUGH - cost:
                break
            center = np.array([*shoulder[:2], top]) + share * reach * ahead
            away = np.linalg.norm(cloud - center - [0.0, 0.0, _CUBE + 0.1], axis=1)
            near = np.argsort(away + 9.0 * ~down)[:count]
            if away[near[0]] + 9.0 * ~down[near[0]] > 0.5 * reach + 0.1:
                continue
            seeds = [*plain, *starts[near]]
            tried = arm.try_table(seeds, center, azimuth, shoulder, reach, upright)
            if tried is not None:
                best = max(best, (tried[0] - cost, tried[1]), key=lambda pair: pair[0])
        if best[1] is not None:
            break  # the nearer to the file's own direction, the better
    return best[1]
