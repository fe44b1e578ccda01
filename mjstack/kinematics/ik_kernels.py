"""Warp kernels for the aperture centre: forward kinematics and damped least squares, one thread per world."""

# No `from __future__ import annotations` here: Warp reads the annotations as objects.
import warp as wp

wp.config.log_level = wp.LOG_ERROR  # before the first use, which starts Warp

HINGE = 0
SLIDE = 1

# Share of the squared error [1/rad^2] that is added to the squared damping. A far target is approached without running into a
# dead end at the limits (from home, over the reBot's whole reach, 97 % instead of 91 % are found); a near one converges fast.
FAR_DAMPING = wp.constant(0.1)
NAN = wp.constant(float("nan"))


@wp.struct
class Chain:
    """The moving links from the world to the two sites. What does not move is folded into the links' frames.

    Links up to ``trunk`` carry both sites, from there to ``fork`` only the first one, from there to ``end`` only the second.
    """

    frame: wp.array[wp.transform]  # the joint's frame at command 0, seen from the link before
    axis: wp.array[wp.vec3]  # of unit length, in that frame
    kind: wp.array[int]  # HINGE or SLIDE
    column: wp.array[int]  # of the command
    moved: wp.array[int]  # which of the joints that inverse kinematics moves, or -1
    trunk: int
    fork: int
    end: int
    first_site: wp.vec3  # seen from the last link before it
    second_site: wp.vec3


@wp.struct
class Moved:
    """The joints that inverse kinematics moves."""

    column: wp.array[int]  # of the command
    low: wp.array[float]
    high: wp.array[float]


@wp.struct
class Scratch:
    """Working memory. Worlds are the last dimension where they can be, so that neighbouring threads read neighbours."""

    command: wp.array2d[float]  # the iterate, (nworld, n)
    anchor: wp.array2d[wp.vec3]  # a point on each moved joint's axis, (n_moved, nworld)
    axis: wp.array2d[wp.vec3]  # in the world, (n_moved, nworld)
    jacobian: wp.array2d[wp.vec3]  # one column of three per moved joint, (n_moved, nworld)
    step: wp.array2d[float]  # (n_moved, nworld)
    held: wp.array2d[int]  # 1: the step ends at the joint's limit, (n_moved, nworld)


@wp.func
def follow(
    chain: Chain, scratch: Scratch, command: wp.array2d[float], w: int, first: int, last: int, start: wp.transform
) -> wp.transform:
    """Pose after links ``first`` to ``last`` (exclusive), from a pose; notes the axes of the moved joints."""
    pose = start
    for i in range(first, last):
        pose = wp.transform_multiply(pose, chain.frame[i])
        axis = chain.axis[i]
        k = chain.moved[i]
        if k >= 0:
            scratch.anchor[k, w] = wp.transform_get_translation(pose)
            scratch.axis[k, w] = wp.transform_vector(pose, axis)
        value = command[w, chain.column[i]]
        if chain.kind[i] == HINGE:
            pose = wp.transform_multiply(pose, wp.transform(wp.vec3(), wp.quat_from_axis_angle(axis, value)))
        else:
            pose = wp.transform_multiply(pose, wp.transform(value * axis, wp.quat_identity()))
    return pose


@wp.func
def forward(chain: Chain, scratch: Scratch, command: wp.array2d[float], w: int) -> wp.vec3:
    """Aperture centre at a command; leaves its Jacobian in the working memory."""
    trunk = follow(chain, scratch, command, w, 0, chain.trunk, wp.transform_identity())
    first = wp.transform_point(follow(chain, scratch, command, w, chain.trunk, chain.fork, trunk), chain.first_site)
    second = wp.transform_point(follow(chain, scratch, command, w, chain.fork, chain.end, trunk), chain.second_site)
    centre = wp.lerp(first, second, 0.5)
    for i in range(chain.end):
        k = chain.moved[i]
        if k >= 0:
            # Behind the trunk a joint moves one site only, and so the midpoint by half as much.
            point, share = centre, wp.float32(1.0)
            if i >= chain.fork:
                point, share = second, wp.float32(0.5)
            elif i >= chain.trunk:
                point, share = first, wp.float32(0.5)
            direction = scratch.axis[k, w]
            if chain.kind[i] == HINGE:
                direction = wp.cross(direction, point - scratch.anchor[k, w])
            scratch.jacobian[k, w] = share * direction
    return centre


@wp.func
def within(value: float, low: float, high: float) -> float:
    """Clamps, and lets NaN through, which ``wp.clamp`` would turn into a limit."""
    bounded = value
    if value < low:
        bounded = low
    if value > high:
        bounded = high
    return bounded


@wp.func
def find_step(moved: Moved, scratch: Scratch, w: int, error: wp.vec3, damping: float) -> float:
    """Damped least-squares step within the limits; returns its largest part.

    A joint that would pass its limit is stopped there, and the others are solved again for what it leaves to do: merely
    cutting the step would stall beside a limit.
    """
    n = moved.column.shape[0]
    for k in range(n):
        scratch.held[k, w] = 0
    lambda_squared = damping * damping + FAR_DAMPING * wp.dot(error, error)
    for _ in range(n):
        rest = error
        gram = lambda_squared * wp.identity(n=3, dtype=float)
        for k in range(n):
            column = scratch.jacobian[k, w]
            if scratch.held[k, w] == 1:
                rest -= scratch.step[k, w] * column
            else:
                gram += wp.outer(column, column)
        weights = wp.inverse(gram) * rest
        stopped = wp.int32(0)
        for k in range(n):
            if scratch.held[k, w] == 0:
                at = scratch.command[w, moved.column[k]]
                step = wp.dot(scratch.jacobian[k, w], weights)
                bounded = wp.clamp(at + step, moved.low[k], moved.high[k])
                if bounded != at + step:
                    step = bounded - at
                    scratch.held[k, w] = 1
                    stopped += 1
                scratch.step[k, w] = step
        if stopped == 0:
            break
    largest = wp.float32(0.0)
    for k in range(n):
        largest = wp.max(largest, wp.abs(scratch.step[k, w]))
    return largest


@wp.kernel(enable_backward=False)
def aperture_kernel(chain: Chain, scratch: Scratch, command: wp.array2d[float], centre: wp.array[wp.vec3]) -> None:
    """Aperture centre of every world."""
    w = wp.tid()
    centre[w] = forward(chain, scratch, command, w)


@wp.kernel(enable_backward=False)
def solve_kernel(
    chain: Chain,
    moved: Moved,
    scratch: Scratch,
    given: wp.array2d[float],
    target: wp.array[wp.vec3],
    iterations: int,
    damping: float,
    max_step: float,
    command: wp.array2d[float],
    distance: wp.array[float],
) -> None:
    """Moves every world's aperture centre towards its target; ``command`` holds the nearest iterate."""
    w = wp.tid()
    goal = target[w]
    finite = wp.isfinite(goal)
    for j in range(given.shape[1]):
        command[w, j] = given[w, j]
        finite = finite and wp.isfinite(given[w, j])
    for k in range(moved.column.shape[0]):
        j = moved.column[k]
        command[w, j] = within(given[w, j], moved.low[k], moved.high[k])
    if not finite:
        distance[w] = NAN
        return
    for j in range(given.shape[1]):
        scratch.command[w, j] = command[w, j]
    error = goal - forward(chain, scratch, scratch.command, w)
    nearest = wp.length(error)
    for _ in range(iterations):
        largest = find_step(moved, scratch, w, error, damping)
        scale = wp.min(1.0, max_step / wp.max(largest, 1.0e-12))
        for k in range(moved.column.shape[0]):
            j = moved.column[k]
            at = scratch.command[w, j] + scale * scratch.step[k, w]
            scratch.command[w, j] = wp.clamp(at, moved.low[k], moved.high[k])
        error = goal - forward(chain, scratch, scratch.command, w)
        left = wp.length(error)
        if left < nearest:
            nearest = left
            for k in range(moved.column.shape[0]):
                command[w, moved.column[k]] = scratch.command[w, moved.column[k]]
    distance[w] = nearest
