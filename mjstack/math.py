"""Batched rotations and a test for finite numbers on torch tensors, and the interval of a rate.

Quaternions are (w, x, y, z), the last dimension is the vector's own.
"""

import math
from collections.abc import Iterable, Sequence
from functools import cache

import torch
from torch import Tensor

# The third row of a rotation matrix is 2xz - 2wy, 2yz + 2wx, 1 - 2xx - 2yy: columns of w, x, y, z
# in the products of both terms; and their signs times 2, and what is added.
_Z_ROW_COLUMNS = (1, 2, 1, 2, 1, 2, 3, 3, 1, 0, 0, 2)
_Z_ROW_SIGNS = (2.0, 2.0, -2.0, -2.0, 2.0, -2.0)


def constant(values: Iterable[float], like: Tensor, dtype: torch.dtype | None = None) -> Tensor:
    """Numbers in the type of a tensor, or another, and on its device, shape ``(n,)``. Copied there
    once: a captured step may not copy from the host. Not to be written into.
    """
    return _constant(tuple(values), like.device, dtype or like.dtype)


@cache
def _constant(values: tuple[float, ...], device: torch.device, dtype: torch.dtype) -> Tensor:
    with torch.inference_mode(False):
        return torch.tensor(values, dtype=dtype, device=device)


def atan2(y: Tensor, x: Tensor) -> Tensor:
    """Angle [rad] of the direction (x, y), shape ``(...)``, alike in tensors of any size.

    On CPUs `torch.atan2` has two routines, which round differently: one for whole vectors of packed
    elements, and one for the rest. A world's angle would depend on the number of worlds. Elements
    that are not packed all take the second one.
    """
    if y.device.type == "cpu":
        y = torch.stack((y, y), dim=-1)[..., 0]
    return torch.atan2(y, x)


def norm(vectors: Tensor) -> Tensor:
    """Length of each vector, shape ``(..., n)``; shape ``(...)``."""
    return torch.linalg.vector_norm(vectors, dim=-1)


def quat_mul(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product ``a b``, shape ``(..., 4)``."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        (
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ),
        dim=-1,
    )


def quat_from_yaw(yaw: Tensor) -> Tensor:
    """Unit quaternion of a rotation about world z [rad], shape ``(...)``; shape ``(..., 4)``."""
    half = 0.5 * yaw
    zero = torch.zeros_like(yaw)
    return torch.stack((torch.cos(half), zero, zero, torch.sin(half)), dim=-1)


def quat_angle(a: Tensor, b: Tensor) -> Tensor:
    """Angle [rad] of the rotation between two unit quaternions, in [0, pi], shape ``(...)``.

    The sine comes from the vector part of ``conj(a) b``, so that small angles keep their precision
    in float32.
    """
    conj = torch.cat((a[..., :1], -a[..., 1:]), dim=-1)
    rel = quat_mul(conj, b)
    return 2.0 * atan2(norm(rel[..., 1:]), rel[..., 0].abs())


def quat_z_row(quat: Tensor) -> Tensor:
    """Third row of the rotation matrix: world z of the body's axes, shape ``(..., 3)``."""
    factors = quat.index_select(-1, constant(_Z_ROW_COLUMNS, quat, torch.int64))
    terms = factors[..., :6] * factors[..., 6:] * constant(_Z_ROW_SIGNS, quat)
    return terms[..., :3] + terms[..., 3:] + constant((0.0, 0.0, 1.0), quat)


def quat_to_matrix(quat: Tensor) -> Tensor:
    """Rotation matrix of a unit quaternion: its columns are the body's axes in the world, shape
    ``(..., 3, 3)``.
    """
    w = quat[..., :1]
    v = quat[..., 1:]
    outer = 2.0 * v[..., :, None] * v[..., None, :]
    x, y, z = (2.0 * w * v).unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), dim=-1).unflatten(-1, (3, 3))
    # 2 w^2 - 1 on the diagonal.
    return outer + cross + torch.diag_embed((2.0 * w.square() - 1.0).expand(*w.shape[:-1], 3))


def lowest_point(pos: Tensor, quat: Tensor, shape: str, size: Sequence[float]) -> Tensor:
    """World z of the lowest point [m], shape ``(...)``, of an object with shape and sizes [m] as of
    `ObjectCfg`, by its centre [m], shape ``(..., 3)``, and orientation, shape ``(..., 4)``.
    """
    vertical = quat_z_row(quat)
    if shape == "sphere":
        reach: Tensor | float = size[0]
    elif shape == "capsule":  # it lies along its x axis
        reach = size[0] + size[1] * vertical[..., 0].abs()
    elif shape == "cylinder":
        horizontal = norm(vertical[..., :2])
        reach = size[0] * horizontal + size[1] * vertical[..., 2].abs()
    elif shape == "hull":  # of points, their coordinates one after the other
        reach = -(vertical[..., None, :] * constant(size, vertical).view(-1, 3)).sum(-1).amin(-1)
    elif len(set(size)) == 1:  # a cube
        reach = size[0] * vertical.abs().sum(-1)
    else:
        x, y, z = vertical.abs().unbind(-1)
        reach = size[0] * x + size[1] * y + size[2] * z
    return pos[..., 2] - reach


def describe_tensor(value: object) -> str:
    """A tensor's type, shape and device in words; the type of anything else."""
    if not isinstance(value, Tensor):
        return f"a {type(value).__name__}"
    return f"a {value.dtype} tensor of shape {tuple(value.shape)} on {value.device}"


def not_finite(*tensors: Tensor) -> Tensor:
    """Rows in which a number is NaN or infinite, shape ``(n,)``, bool, of one or more tensors of
    shape ``(n, d)``; each may have its own d.
    """
    if all_finite(*tensors):
        return torch.zeros(len(tensors[0]), dtype=torch.bool, device=tensors[0].device)
    # 0 times what is not finite is NaN, which a sum keeps: fewer kernels than a test of each.
    numbers = torch.cat(tensors, dim=1) if len(tensors) > 1 else tensors[0]
    return (numbers * 0.0).sum(1) != 0.0


def all_finite(*tensors: Tensor) -> bool:
    """Whether a short look at tensors on the CPU shows that every number is finite: a finite sum
    has finite summands only.
    """
    return not tensors[0].is_cuda and all(math.isfinite(tensor.sum().item()) for tensor in tensors)


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Lower and upper end of the 95 % confidence interval of a success rate (Wilson, "Probable
    inference", JASA 1927), sound at 0 and at all successes too. There is at least one trial.
    """
    z = 1.959963984540054  # quantile of the normal distribution
    rate = successes / trials
    share = z * z / trials
    centre = (rate + 0.5 * share) / (1.0 + share)
    half = z * math.sqrt(rate * (1.0 - rate) / trials + 0.25 * share / trials) / (1.0 + share)
    # At the ends the exact bounds are 0 and 1; rounding must not miss them.
    return 0.0 if successes == 0 else centre - half, 1.0 if successes == trials else centre + half


def rate_interval(name: str, successes: int, trials: int) -> dict[str, float]:
    """A success rate and its 95 % interval: ``NAME``, ``NAME_low95`` and ``NAME_high95``."""
    low, high = wilson_interval(successes, trials)
    return {name: successes / trials, f"{name}_low95": low, f"{name}_high95": high}
