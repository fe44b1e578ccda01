"""Warp kernels for the grasp point: forward and inverse kinematics, one thread per world."""

# No `from __future__ import annotations` here: Warp reads the annotations as objects.
from functools import cache
from typing import Any

import mujoco

from mjstack.robots import posture
from mjstack.sim.warp_setup import wp

HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)

# Share of the squared error [1/rad^2] that is added to the squared damping. A far target is
# approached without running into a dead end at the limits (from home, over the reBot's whole reach,
# 97 % instead of 91 % are found); a near one converges fast.
FAR_DAMPING = wp.constant(0.1)
KNOTS = wp.constant(posture.KNOTS)
NAN = wp.constant(float("nan"))


@wp.struct
class Chain:
    """The moving links from the world to the two sites. Parts that do not move are folded
    into the links' frames.

    Links up to ``trunk`` carry both sites, from there to ``fork`` only the first one, from there to
    ``end`` only the second. Inverse kinematics keeps a joint within ``low`` and ``high``, which are
    infinite where it does not move it. Sites and the gripper's approach axis are seen from the last
    link before them, the axis from the trunk's.
    """

    frame: wp.array[wp.transform]  # the joint's frame at position 0, seen from the link before
    axis: wp.array[wp.vec3]  # of unit length, in that frame
    kind: wp.array[int]  # HINGE or SLIDE
    column: wp.array[int]  # of the joint positions
    low: wp.array[float]
    high: wp.array[float]
    trunk: int
    fork: int
    end: int
    first_site: wp.vec3
    second_site: wp.vec3
    approach: wp.vec3  # of unit length
    row: wp.array[int]  # of the tables, by link; -1 where the joint's position is its column's
    table_low: wp.array[float]  # tables of joints that follow, see `Posture`
    table_step: wp.array[float]
    table_value: wp.array2d[float]


@wp.func
def turn(pose: wp.transform, axis: wp.vec3, kind: int, value: float) -> wp.transform:
    """A joint's frame after it has moved."""
    motion = wp.transform(value * axis, wp.quat_identity())
    if kind == HINGE:
        motion = wp.transform(wp.vec3(), wp.quat_from_axis_angle(axis, value))
    return wp.transform_multiply(pose, motion)


@wp.func
def position(chain: Chain, link: int, x: float) -> wp.vec2:
    """Position of a link's joint, and its derivative by x, where its column's is x."""
    row = chain.row[link]
    if row < 0:
        return wp.vec2(x, 1.0)
    step = chain.table_step[row]
    at = wp.clamp((x - chain.table_low[row]) / step, 0.0, float(KNOTS - 1))
    knot = wp.clamp(int(at) - 1, 0, KNOTS - 4)  # the first of four: a cubic, as in `Posture`
    t = at - float(knot)
    a = chain.table_value[row, knot]
    b = chain.table_value[row, knot + 1]
    c = chain.table_value[row, knot + 2]
    first = b - a
    second = c - 2.0 * b + a
    third = (chain.table_value[row, knot + 3] - a) - 3.0 * (c - b)
    value = a + t * (first + (t - 1.0) / 2.0 * (second + (t - 2.0) / 3.0 * third))
    slope = first + (t - 0.5) * second + (t * (t / 2.0 - 1.0) + 1.0 / 3.0) * third
    return wp.vec2(value, slope / step)


@wp.func
def follow(
    chain: Chain, q: wp.array2d[float], w: int, first: int, last: int, start: wp.transform
) -> wp.transform:
    """Pose after links ``first`` to ``last`` (exclusive), from a pose."""
    pose = start
    for i in range(first, last):
        frame = wp.transform_multiply(pose, chain.frame[i])
        value = position(chain, i, q[w, chain.column[i]])[0]
        pose = turn(frame, chain.axis[i], chain.kind[i], value)
    return pose


@wp.kernel(enable_backward=False)
def forward_kernel(
    chain: Chain,
    q: wp.array2d[float],
    point: wp.array[wp.vec3],
    closing: wp.array[wp.vec3],
    approach: wp.array[wp.vec3],
) -> None:
    """Grasp point of every world, and unit vectors of its gripper: from the first site to the
    second, and the approach axis.
    """
    w = wp.tid()
    trunk = follow(chain, q, w, 0, chain.trunk, wp.transform_identity())
    first_end = follow(chain, q, w, chain.trunk, chain.fork, trunk)
    second_end = follow(chain, q, w, chain.fork, chain.end, trunk)
    first = wp.transform_point(first_end, chain.first_site)
    second = wp.transform_point(second_end, chain.second_site)
    point[w] = wp.lerp(first, second, 0.5)
    closing[w] = wp.normalize(wp.sub(second, first))
    approach[w] = wp.transform_vector(trunk, chain.approach)


@wp.func
def within(value: float, low: float, high: float) -> float:
    """Clamp, and let NaN through, which ``wp.clamp`` would turn into a limit."""
    bounded = value
    if value < low:
        bounded = low
    if value > high:
        bounded = high
    return bounded


@cache
def solve_kernel(kinds: tuple[int, ...], mover: tuple[int, ...]) -> wp.Kernel:
    """Compile the kernel that moves every world's grasp point towards its target, for one chain: so
    its loops unroll, and its working memory is registers.

    Joints behind the last moved one, such as the wrist's roll and the fingers, are followed once
    per solve. An iteration then follows the END links up to it.

    Args:
        kinds: HINGE or SLIDE, of each link.
        mover: Link of the trunk whose joint moves each link, by inverse kinematics: itself, or the
            one that it follows; -1 where it stands.
    """
    END = max(i + 1 for i, link in enumerate(mover) if link >= 0)
    Values = wp.types.vector(length=END, dtype=float)
    Rows = wp.types.matrix(shape=(END, 3), dtype=float)  # a vector per link

    @wp.func
    def find_step(
        jacobian: Any, q: Any, guide: Any, low: Any, high: Any, error: wp.vec3, damping: float
    ) -> Any:
        """Damped least-squares step within the limits, with ``guide`` in its null space.

        A joint that would pass its limit is stopped there, and the others are solved again for the
        rest: merely cutting the step would stall beside a limit.
        """
        preset = guide  # of a stopped joint: its step
        step = guide
        at_limit = Values()
        lambda_squared = damping * damping + FAR_DAMPING * wp.dot(error, error)
        stopped = wp.int32(1)
        while stopped > 0:  # each pass stops another joint, or is the last
            rest = error
            gram = lambda_squared * wp.identity(n=3, dtype=float)
            for i in range(END):
                column = jacobian[i]
                rest -= preset[i] * column
                if at_limit[i] == 0.0:
                    gram += wp.outer(column, column)
            weights = wp.inverse(gram) * rest
            stopped = wp.int32(0)
            for i in range(END):
                if at_limit[i] == 0.0:
                    part = preset[i] + wp.dot(jacobian[i], weights)
                    bounded = wp.clamp(q[i] + part, low[i], high[i])
                    if bounded != q[i] + part:
                        part = bounded - q[i]
                        preset[i] = part
                        at_limit[i] = 1.0
                        stopped += 1
                    step[i] = part
        return step

    @wp.kernel(enable_backward=False, module="unique")
    def solve(
        chain: Chain,
        start: wp.array2d[float],
        target: wp.array[wp.vec3],
        posture: wp.array2d[float],
        desired: wp.array[wp.vec3],
        iterations: int,
        guided: int,
        damping: float,
        max_step: float,
        posture_gain: float,
        approach_gain: float,
        near: float,
        solution: wp.array2d[float],
        distance: wp.array[float],
    ) -> None:
        """``solution`` is the nearest iterate; of those nearer than ``near``, the last."""
        # Input: worlds that are not finite keep their joint positions.
        w = wp.tid()
        goal = target[w]
        finite = wp.isfinite(goal)
        if guided > 0:
            finite = finite and wp.isfinite(desired[w])
        for j in range(start.shape[1]):
            finite = finite and wp.isfinite(start[w, j])
            solution[w, j] = start[w, j]
            if guided > 0:
                finite = finite and wp.isfinite(posture[w, j])
        q = Values()
        low = Values()
        high = Values()
        home = Values()
        for i in range(END):
            j = chain.column[i]
            low[i] = chain.low[i]
            high[i] = chain.high[i]
            q[i] = within(start[w, j], low[i], high[i])
            home[i] = posture[w, j]
            if wp.static(mover[i] == i):
                solution[w, j] = q[i]
        if not finite:
            distance[w] = NAN
            return
        # Links behind the moved ones
        rest = follow(chain, start, w, END, chain.trunk, wp.transform_identity())
        first_end = follow(chain, start, w, chain.trunk, chain.fork, rest)
        second_end = follow(chain, start, w, chain.fork, chain.end, rest)
        first_site = wp.transform_point(first_end, chain.first_site)
        second_site = wp.transform_point(second_end, chain.second_site)
        approach = wp.transform_vector(rest, chain.approach)
        best = q
        nearest = wp.float32(0.0)
        # Iterations, and one more forward pass for the last one's distance
        for iteration in range(iterations + 1):
            # Forward kinematics
            anchors = Rows()
            axes = Rows()
            slopes = Values()
            for i in range(END):
                slopes[i] = 1.0
                if wp.static(mover[i] >= 0 and mover[i] != i):
                    pair = position(chain, i, q[wp.static(mover[i])])
                    q[i] = pair[0]
                    slopes[i] = pair[1]
            link = wp.transform(wp.vec3(), wp.quat_identity())
            for i in range(END):
                pose = wp.transform_multiply(link, chain.frame[i])
                anchors[i] = wp.transform_get_translation(pose)
                axes[i] = wp.transform_vector(pose, chain.axis[i])
                link = turn(pose, chain.axis[i], wp.static(kinds[i]), q[i])
            first = wp.transform_point(link, first_site)
            second = wp.transform_point(link, second_site)
            midpoint = wp.lerp(first, second, 0.5)
            error = goal - midpoint
            left = wp.length(error)
            if iteration == 0 or left < nearest or left < near:
                nearest = left
                best = q
            if iteration < iterations:
                # Jacobian of the midpoint
                jacobian = Rows()
                for i in range(END):
                    if wp.static(mover[i] >= 0):
                        direction = axes[i]
                        if wp.static(kinds[i] == HINGE):
                            direction = wp.cross(direction, midpoint - anchors[i])
                        jacobian[wp.static(mover[i])] += slopes[i] * direction
                # Null-space motion, and the step
                guide = Values()
                if iteration < guided:
                    lever = wp.cross(wp.transform_vector(link, approach), desired[w])
                    for i in range(END):
                        if wp.static(mover[i] == i):
                            guide[i] += posture_gain * (home[i] - q[i])
                        if wp.static(mover[i] >= 0 and kinds[i] == HINGE):
                            turned = slopes[i] * wp.dot(axes[i], lever)
                            guide[wp.static(mover[i])] += approach_gain * turned
                step = find_step(jacobian, q, guide, low, high, error, damping)
                largest = wp.float32(0.0)
                for i in range(END):
                    largest = wp.max(largest, wp.abs(step[i]))
                scale = wp.min(1.0, max_step / wp.max(largest, 1.0e-12))
                for i in range(END):
                    q[i] = wp.clamp(q[i] + scale * step[i], low[i], high[i])
        for i in range(END):
            if wp.static(mover[i] == i):
                solution[w, chain.column[i]] = best[i]
        distance[w] = nearest

    return solve
