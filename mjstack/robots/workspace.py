"""Where an arm can work with its hand pointing down: its home, and a table in its reach."""

from dataclasses import dataclass
from itertools import product

import mujoco
import numpy as np
from numpy import ndarray

from mjstack.robots.bodies import ancestors, solid_geoms, world_boxes
from mjstack.robots.hand import Hand
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
_DOWN = np.array([0.0, 0.0, -1.0])


@dataclass(frozen=True)
class Workspace:
    """A table before an arm, seen from the file's origin, and the arm over its middle.

    Attributes:
        arm: The arm.
        azimuth: Direction of the table from the arm's base [rad].
        center: Middle of the table's top [m].
        home: Positions of the arm's joints [rad, m].
        locked: Which of the arm's joints inverse kinematics need not move.
        roll: Number of the arm's joint that turns the hand about its approach axis, or None.
        tilt: Largest angle of the approach axis to the vertical at the objects [rad].
        lowest: Height of its lowest point at home [m].
    """

    arm: "ArmReach"
    azimuth: float
    center: ndarray
    home: ndarray
    locked: list[int]
    roll: int | None
    tilt: float
    lowest: float


class ArmReach:
    """Inverse kinematics of a hand's pose: damped least squares within the joints' limits.

    Attributes:
        shoulder: Where the arm begins: the anchor of its first hinge [m].
        upright: Whether the arm's first joint turns about the vertical.
        reach: Horizontal distance from there that nearly all positions are within [m].
        apart: Distance of two objects, beside each other, from a table's middle [m].
        height: Height above an object from which the hand comes [m].
    """

    def __init__(self, model: mujoco.MjModel, hand: Hand, grip: Grip, limits: ndarray) -> None:
        """Sample positions of an arm's joints within limits [rad, m], shape ``(n, 2)``."""
        self.model = model
        self.data = data = mujoco.MjData(model)
        self.hand = hand
        self.grip = grip
        self.low, self.high = limits.T
        joints = list(hand.arm)
        self.qpos = model.jnt_qposadr[joints]
        self.dofs = model.jnt_dofadr[joints]
        self.hinge = model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_HINGE
        low, high = np.clip(limits.T, -np.pi, np.pi)
        self._plain = [np.clip(0.0, self.low, self.high), 0.5 * (low + high)]
        self._starts = np.random.default_rng(0).uniform(low, high, (_SAMPLES, len(low)))
        points, approaches, _ = zip(*map(self.pose, self._starts), strict=True)
        self._cloud = np.array(points)
        self._lifted = 9.0 * (np.array(approaches)[:, 2] >= -0.7)  # m: far, as the hand is not down
        self.pose(np.clip(model.qpos0[self.qpos], self.low, self.high))
        anchors = data.xanchor[joints][self.hinge]
        self.shoulder = anchors[0] if len(anchors) else self._cloud.mean(axis=0)
        self.upright = bool(self.hinge[0] and abs(data.xaxis[joints[0], 2]) > 0.999)
        away = np.linalg.norm((self._cloud - self.shoulder)[:, :2], axis=1)
        self.reach = float(np.quantile(away, 0.95))
        # Of an arm that does not turn about the vertical no gain keeps the tilt between objects
        self.apart = round(min(0.14 if self.upright else 0.08, 0.25 * self.reach), 2)
        self.height = 0.1 if self.reach > 0.4 else 0.07

    def pose(self, q: ndarray) -> tuple[ndarray, ndarray, ndarray]:
        """Grasp point [m], approach and closing axis at positions of the arm's joints."""
        self.data.qpos[self.qpos] = q
        mujoco.mj_kinematics(self.model, self.data)
        turn = self.data.xmat[self.hand.palm].reshape(3, 3)
        point = self.data.xpos[self.hand.palm] + turn @ self.grip.point
        return point, turn @ self.grip.approach, turn @ self.grip.closing

    def jacobian(self, point: ndarray) -> ndarray:
        """Of the grasp point, where it is now, and of the hand's rotation, shape ``(2, 3,
        joints)``.
        """
        mujoco.mj_comPos(self.model, self.data)
        jac = np.zeros((2, 3, self.model.nv))
        mujoco.mj_jac(self.model, self.data, *jac, point, self.hand.palm)
        return jac[..., self.dofs]

    def solve(
        self, q: ndarray, target: ndarray, free: ndarray, down: float, across: ndarray | None = None
    ) -> tuple[ndarray, float, float]:
        """Bring the grasp point to a target and the hand down, by some joints, from their positions
        ``q``; the jaws close along ``across``, if that is given. Returns the positions, the
        distance that is left [m], and the tilt [rad].
        """
        q = np.clip(q, self.low, self.high)
        for _ in range(_ITERATIONS):
            point, approach, closing = self.pose(q)
            linear, angular = self.jacobian(point)
            error = [target - point, down * np.cross(approach, _DOWN)]
            rows = [linear, down * angular]
            if across is not None:
                turn = np.cross(closing, np.copysign(1.0, closing @ across) * across)
                error.append([0.1 * (turn @ _DOWN)])
                rows.append(0.1 * _DOWN[None] @ angular)
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

    def choose_locked(self, q: ndarray) -> tuple[list[int], int | None]:
        """Joints that inverse kinematics need not move, and the one that rolls the hand: in a plane
        with the first joint's axis an arm reaches all it can by joints across that plane.
        """
        point, approach, _ = self.pose(q)
        linear, _ = self.jacobian(point)
        axes = self.data.xaxis[list(self.hand.arm)]
        rolls = np.flatnonzero(self.hinge & (np.abs(axes @ approach) > 0.95))
        moved = np.linalg.norm(linear, axis=0)
        roll = int(rolls[-1]) if rolls.size and moved[rolls[-1]] < 0.06 else None
        idle: set[int] = {roll} if roll else set()
        if self.upright:
            away = point - self.data.xanchor[self.hand.arm[0]]
            side = np.cross([0.0, 0.0, 1.0], away / np.linalg.norm(away))
            lying = {*np.flatnonzero(self.hinge & (np.abs(axes @ side) < 0.5)).tolist()} - {0}
            left = [k for k in range(len(q)) if k not in lying | idle]
            if len(left) >= 3 and np.linalg.svd(linear[:, left])[1][-1] > 0.03:
                idle |= lying
        return sorted(idle), roll

    def try_table(
        self, center: ndarray, azimuth: float, count: int
    ) -> tuple[float, Workspace] | None:
        """How well an arm works over a table, and the best home there, found from a number of
        positions; None if it does not.
        """
        away = np.linalg.norm(self._cloud - center - [0.0, 0.0, _CUBE + 0.1], axis=1) + self._lifted
        near = np.argsort(away)[:count]
        if away[near[0]] > 0.5 * self.reach + 0.1:
            return None
        side = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        best: tuple[float, Workspace] | None = None
        middle = center - (_CUBE + self.height) * _DOWN
        homes: list[ndarray] = []
        for seed in [*self._plain, *self._starts[near]]:
            q, left, tilt = self.solve(seed, middle, np.ones(len(seed)), 0.2, side)
            if left > _REACHED or tilt > 0.3 or any(np.abs(q - h).max() < 0.05 for h in homes):
                continue
            homes.append(q)
            lowest = self.lowest(q, center)
            if lowest is None:
                continue
            locked, roll = self.choose_locked(q)
            free = ~np.isin(np.arange(len(q)), locked)
            left, tilts, room = self.walk(q, free, center, side)
            if left > _REACHED or tilts > _UPRIGHT:
                continue
            linear, _ = self.jacobian(self.pose(q)[0])
            bend = float(np.linalg.svd(linear[:, free])[1][-1])
            score = (min(room, 0.15) + min(bend, 0.15)) / 0.15 - 1.5 * (tilt + tilts)
            off_middle = np.abs(q - 0.5 * (self.low + self.high)) / (self.high - self.low)
            score -= 0.6 * float(off_middle.mean())
            if best is None or score > best[0]:
                best = score, Workspace(self, azimuth, center, q, locked, roll, tilts, lowest)
            if best[0] >= _ENOUGH:
                break
        return best

    def walk(
        self, home: ndarray, free: ndarray, center: ndarray, side: ndarray
    ) -> tuple[float, float, float]:
        """Largest distance that is left and tilt, and smallest share of a joint's range beside it,
        on the way from home to objects at a table's ends.
        """
        ahead = np.cross(side, [0.0, 0.0, 1.0])
        span = np.maximum(self.high - self.low, 1e-9)
        ends = []
        for along, across in product((-0.03, 0.03), (-self.apart - 0.03, self.apart + 0.03)):
            q = home
            for up in (_CUBE + self.height + 0.07, _CUBE):
                target = center + along * ahead + across * side + [0.0, 0.0, up]
                q, _, _ = self.solve(q, target, free, 0.1)
                q, left, tilt = self.solve(q, target, free, 0.0)  # as the point alone needs it
                margin = np.minimum(q - self.low, self.high - q) / span
                ends.append((left, tilt, -float(margin[free].min())))
        left, tilt, margin = np.max(ends, axis=0)
        return left, tilt, -margin

    def lowest(self, q: ndarray, center: ndarray) -> float | None:
        """Height of the lowest point at home [m]; None if the arm is in its own way, or if a link
        but the hand's reaches into the table.
        """
        self.pose(q)
        model, data = self.model, self.data
        hand = {self.hand.palm, *self.hand.bodies}
        links = {*ancestors(model, self.hand.palm), *hand}
        solid = solid_geoms(model, [body for body in links if model.body_weldid[body]])
        middle, half = world_boxes(data, solid)
        bottom = middle[:, 2] - half[:, 2]
        beside = np.linalg.norm((middle - center)[:, :2], axis=1) >= self.apart + 0.1
        mujoco.mj_collision(model, data)
        pairs = [model.geom_bodyid[c.geom].tolist() for c in data.contact if c.dist < -0.005]
        blocked = any({*pair} <= links and not {*pair} <= hand for pair in pairs)
        clear = (beside | (bottom >= center[2])).all() and not blocked
        return float(bottom.min(initial=np.inf)) if clear else None


def find_workspace(
    model: mujoco.MjModel, hand: Hand, grip: Grip, limits: ndarray
) -> Workspace | None:
    """Search tables around an arm for the one that it reaches best with its hand down, by inverse
    kinematics; None if it reaches none. ``limits`` are those of the arm's joints [rad, m], shape
    ``(n, 2)``.
    """
    arm = ArmReach(model, hand, grip, limits)
    shares = (0.55, 0.7, 0.4) if arm.hinge.any() else (0.0,)
    tops = {z: 0.3 + abs(z - _TOP) for z in arm.shoulder[2] + np.arange(-0.6, 0.31, 0.15)}
    tables = [
        (cost + abs(share - shares[0]), top, share)
        for (top, cost), share in product((tops | {_TOP: 0.0}).items(), shares)
    ]
    best: tuple[float, Workspace | None] = (-np.inf, None)
    for count, azimuth in product(_SEEDS, (0.0, -0.5 * np.pi, 0.5 * np.pi, np.pi)):
        ahead = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        for cost, top, share in sorted(tables):
            if best[0] >= _ENOUGH - cost:
                break
            center = np.array([*arm.shoulder[:2], top]) + share * arm.reach * ahead
            tried = arm.try_table(center, azimuth, count)
            if tried is not None and tried[0] - cost > best[0]:
                best = (tried[0] - cost, tried[1])
        if best[1] is not None:
            break  # the nearer to the file's own direction, the better
    return best[1]
