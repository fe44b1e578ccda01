"""Random numbers against Random123's known answers, and rotations against MuJoCo."""

import math
from collections.abc import Callable

import mujoco
import numpy as np
import pytest
import torch

from mjstack.math import atan2, not_finite, quat_angle, quat_from_yaw, quat_mul, quat_z_row
from mjstack.rng import philox, uniform
from mjstack.sim.simulation import Columns

# Four words of the counter, two of the key, and the four that come out
KNOWN = """
00000000 00000000 00000000 00000000 00000000 00000000 6627e8d5 e169c58d bc57ac4c 9b00dbd8
ffffffff ffffffff ffffffff ffffffff ffffffff ffffffff 408f276d 41c83b0e a20bc7c6 6d5451fd
243f6a88 85a308d3 13198a2e 03707344 a4093822 299f31d0 d16cfe09 94fdcceb 5001e420 24126ea1
"""


@pytest.mark.parametrize("line", KNOWN.split("\n")[1:-1])
def test_philox_known_answers(line: str) -> None:
    words = [int(word, 16) for word in line.split()]
    columns = np.array([words[:4]] * 3, dtype=np.uint32).T
    assert philox(columns, (words[4], words[5])).T.tolist() == [words[6:]] * 3


def draw(
    n: int, *, seed: int = 0, episode: int = 0, step: int = 0, stream: int = 1, size: int = 6
) -> torch.Tensor:
    return uniform(
        seed, stream, torch.arange(n), torch.full((n,), episode), torch.full((n,), step), size
    )


def test_uniform_range_mean_and_spread() -> None:
    u = draw(20_000)
    assert u.shape == (20_000, 6)
    assert u.dtype == torch.float32
    assert float(u.min()) >= -1.0
    assert float(u.max()) < 1.0
    assert float(u.min()) < -0.999
    assert float(u.max()) > 0.999
    assert u.mean(0).abs().max() < 0.02
    assert (u.var(0) - 1.0 / 3.0).abs().max() < 0.01
    assert torch.corrcoef(u.T).fill_diagonal_(0.0).abs().max() < 0.03


def test_world_draws_the_same_whatever_nworld() -> None:
    assert torch.equal(draw(2048)[:16], draw(16))
    assert torch.equal(draw(16)[5:6], uniform(0, 1, torch.tensor([5]), torch.tensor([0]), None, 6))


@pytest.mark.parametrize("change", [{"seed": 1}, {"episode": 1}, {"step": 1}, {"stream": 2}])
def test_each_key_changes_every_draw(change: dict[str, int]) -> None:
    assert not (draw(64) == draw(64, **change)).all(1).any()


def test_worlds_differ_and_size_only_appends() -> None:
    assert len(torch.unique(draw(4096), dim=0)) == 4096
    assert torch.equal(draw(8, size=9)[:, :6], draw(8, size=6))


@pytest.fixture(scope="module")
def quats() -> np.ndarray:
    q = np.random.default_rng(0).normal(size=(64, 4))
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def by_mujoco(func: Callable[..., None], width: int, *columns: np.ndarray) -> np.ndarray:
    """What a function of MuJoCo writes for each row."""
    out = np.empty((len(columns[0]), width))
    for row, *values in zip(out, *columns, strict=True):
        func(row, *values)
    return out


def test_quat_mul_is_mujocos(quats: np.ndarray) -> None:
    pair = (quats, np.roll(quats, 1, axis=0))
    got = quat_mul(*map(torch.from_numpy, pair)).numpy()
    np.testing.assert_allclose(got, by_mujoco(mujoco.mju_mulQuat, 4, *pair), atol=1e-14)


def test_quat_from_yaw_is_mujocos() -> None:
    yaw = np.linspace(-7.0, 7.0, 29)
    axes = np.tile([0.0, 0.0, 1.0], (29, 1))
    expected = by_mujoco(mujoco.mju_axisAngle2Quat, 4, axes, yaw)
    np.testing.assert_allclose(quat_from_yaw(torch.from_numpy(yaw)).numpy(), expected, atol=1e-14)


def test_quat_angle_is_mujocos_whatever_the_signs(quats: np.ndarray) -> None:
    other = np.roll(quats, 1, axis=0)
    turns = np.linalg.norm(by_mujoco(mujoco.mju_subQuat, 3, quats, other), axis=1)
    for sign in (1.0, -1.0):
        got = quat_angle(torch.from_numpy(quats), torch.from_numpy(sign * other)).numpy()
        np.testing.assert_allclose(got, np.minimum(turns, 2 * np.pi - turns), atol=1e-7)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_an_angle_does_not_depend_on_the_number_of_worlds(dtype: torch.dtype) -> None:
    y, x = torch.randn((2, 1000), dtype=dtype, generator=torch.Generator().manual_seed(0))
    angles = atan2(y, x)
    alone = [atan2(y[n : n + 1], x[n : n + 1]) for n in range(1000)]
    assert torch.equal(angles, torch.cat(alone))
    np.testing.assert_allclose(angles.numpy(), np.arctan2(y.numpy(), x.numpy()), rtol=1e-6)


def test_small_angles_keep_their_precision_in_float32() -> None:
    angle = torch.tensor([1e-6, 1e-4, 1e-2])
    base = quat_from_yaw(torch.full((3,), 0.7, dtype=torch.float64))
    turned = quat_from_yaw(0.7 + angle.double())
    got = quat_angle(base.float(), turned.float())
    assert (got - angle).abs().max() < 3e-7


def test_z_row_is_mujocos(quats: np.ndarray) -> None:
    got = quat_z_row(torch.from_numpy(quats)).numpy()
    expected = by_mujoco(mujoco.mju_quat2Mat, 9, quats)[:, 6:]
    np.testing.assert_allclose(got, expected, atol=1e-14)


def test_numbers_that_are_not_finite_mark_their_rows() -> None:
    """A sum of finite numbers may overflow, and two infinities may cancel to NaN."""
    first = torch.full((5, 3), 3e38)
    second = torch.zeros(5, 2, dtype=torch.float64)
    assert not not_finite(first, second).any()
    first[1, 2] = math.nan
    first[2, :2] = torch.tensor([math.inf, -math.inf])
    second[3, 1] = -math.inf
    assert not_finite(first, second).tolist() == [False, True, True, True, False]
    assert not_finite(second).tolist() == [False, False, False, True, False]
    assert not_finite(torch.ones(4, 0)).tolist() == [False] * 4


@pytest.mark.parametrize("indices", [(1, 2), (3, 0)])
def test_masked_writes_leave_other_rows_and_columns(indices: tuple[int, ...]) -> None:
    columns = Columns(indices, torch.device("cpu"))
    mask = torch.tensor([True, False, True, False, True])
    value = torch.rand(5, 2, dtype=torch.float64)
    whole = torch.zeros(5, 4)
    columns.write_masked(whole, mask, value)
    assert whole[mask][:, list(indices)].equal(value[mask].float())
    whole[:, list(indices)] = torch.where(mask[:, None], 0.0, whole[:, list(indices)])
    assert not whole.any()
