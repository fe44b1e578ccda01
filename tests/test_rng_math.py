"""Random numbers against Random123's known answers, and rotations against MuJoCo."""

from __future__ import annotations

import itertools
import math

import mujoco
import numpy as np
import pytest
import torch

from mjstack.managers.view import rows_of
from mjstack.math import lowest_point, not_finite, quat_angle, quat_from_yaw, quat_mul, quat_z_row
from mjstack.rng import philox, uniform
from mjstack.scene.index import Columns

KNOWN = [
    (
        "00000000 00000000 00000000 00000000",
        "00000000 00000000",
        "6627e8d5 e169c58d bc57ac4c 9b00dbd8",
    ),
    (
        "ffffffff ffffffff ffffffff ffffffff",
        "ffffffff ffffffff",
        "408f276d 41c83b0e a20bc7c6 6d5451fd",
    ),
    (
        "243f6a88 85a308d3 13198a2e 03707344",
        "a4093822 299f31d0",
        "d16cfe09 94fdcceb 5001e420 24126ea1",
    ),
]


def words(text: str) -> list[int]:
    return [int(word, 16) for word in text.split()]


@pytest.mark.parametrize(("counter", "key", "expected"), KNOWN)
def test_philox_known_answers(counter: str, key: str, expected: str) -> None:
    k0, k1 = words(key)
    columns = np.array([words(counter)] * 3, dtype=np.uint64).T
    assert philox(columns, (k0, k1)).T.tolist() == [words(expected)] * 3


def draw(
    n: int, *, seed: int = 0, episode: int = 0, step: int = 0, stream: int = 1, size: int = 6
) -> torch.Tensor:
    fill = torch.full((n,), 0)
    return uniform(
        seed=seed,
        world=torch.arange(n),
        episode=fill + episode,
        step=fill + step,
        stream=stream,
        size=size,
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
    one = uniform(
        seed=0,
        world=torch.tensor([5]),
        episode=torch.tensor([0]),
        step=torch.tensor([0]),
        stream=1,
        size=6,
    )
    assert torch.equal(draw(16)[5:6], one)


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


def test_quat_mul_is_mujocos(quats: np.ndarray) -> None:
    a = quats
    b = np.roll(quats, 1, axis=0)
    expected = np.empty_like(a)
    for row, x, y in zip(expected, a, b, strict=True):
        mujoco.mju_mulQuat(row, x, y)
    np.testing.assert_allclose(
        quat_mul(torch.from_numpy(a), torch.from_numpy(b)).numpy(), expected, atol=1e-14
    )


def test_quat_from_yaw_is_mujocos() -> None:
    yaw = np.linspace(-7.0, 7.0, 29)
    expected = np.empty((29, 4))
    for row, angle in zip(expected, yaw, strict=True):
        mujoco.mju_axisAngle2Quat(row, np.array([0.0, 0.0, 1.0]), angle)
    np.testing.assert_allclose(quat_from_yaw(torch.from_numpy(yaw)).numpy(), expected, atol=1e-14)


def test_quat_angle_is_mujocos_whatever_the_signs(quats: np.ndarray) -> None:
    a = quats
    b = np.roll(quats, 1, axis=0)
    expected = np.empty(len(a))
    vel = np.empty(3)
    for k, (x, y) in enumerate(zip(a, b, strict=True)):
        mujoco.mju_subQuat(vel, x, y)
        expected[k] = np.linalg.norm(vel)
    for sign in (1.0, -1.0):
        got = quat_angle(torch.from_numpy(a), torch.from_numpy(sign * b)).numpy()
        np.testing.assert_allclose(got, np.minimum(expected, 2 * np.pi - expected), atol=1e-7)


def test_small_angles_keep_their_precision_in_float32() -> None:
    angle = torch.tensor([1e-6, 1e-4, 1e-2])
    base = quat_from_yaw(torch.full((3,), 0.7, dtype=torch.float64))
    turned = quat_from_yaw(0.7 + angle.double())
    got = quat_angle(base.float(), turned.float())
    assert (got - angle).abs().max() < 3e-7


def test_z_row_is_mujocos(quats: np.ndarray) -> None:
    expected = np.empty((len(quats), 3))
    mat = np.empty(9)
    for row, q in zip(expected, quats, strict=True):
        mujoco.mju_quat2Mat(mat, q)
        row[:] = mat[6:]
    np.testing.assert_allclose(quat_z_row(torch.from_numpy(quats)).numpy(), expected, atol=1e-14)


def test_one_number_that_is_not_finite_marks_its_row() -> None:
    first = torch.full((5, 3), 1e30)
    second = torch.zeros(5, 2, dtype=torch.float64)
    first[1, 2] = torch.nan
    first[2, 0] = torch.inf
    second[3, 1] = -torch.inf
    assert not_finite(first, second).tolist() == [False, True, True, True, False]
    assert not_finite(second).tolist() == [False, False, False, True, False]


def test_lowest_corner_against_eight_corners(quats: np.ndarray) -> None:
    pos = np.random.default_rng(1).normal(size=(len(quats), 3))
    expected = []
    for p, q in zip(pos, quats, strict=True):
        heights = []
        for signs in itertools.product((-0.022, 0.022), repeat=3):
            corner = np.empty(3)
            mujoco.mju_rotVecQuat(corner, np.array(signs), q)
            heights.append(p[2] + corner[2])
        expected.append(min(heights))
    got = lowest_point(torch.from_numpy(pos), torch.from_numpy(quats), "box", [0.022] * 3)
    np.testing.assert_allclose(got.numpy(), expected, atol=1e-14)


def test_not_finite_asks_row_by_row_where_a_sum_is_not_finite() -> None:
    """A sum of finite numbers may overflow, and two infinities may cancel to NaN."""
    huge = torch.full((4, 3), 3e38)
    assert not not_finite(huge).any()
    odd = huge.clone()
    odd[1, 0] = math.nan
    odd[2, :2] = torch.tensor([math.inf, -math.inf])
    assert not_finite(torch.zeros(4, 2), odd).tolist() == [False, True, True, False]
    assert not_finite(torch.ones(4, 0)).tolist() == [False] * 4


@pytest.mark.parametrize("indices", [(1, 2), (3, 0)])
def test_masked_writes_of_all_rows_and_of_some_agree(indices: tuple[int, ...]) -> None:
    columns = Columns(indices, torch.device("cpu"))
    mask = torch.tensor([True, False, True, False, True])
    value = torch.rand(5, 2, dtype=torch.float64)
    whole, some = torch.zeros(2, 5, 4)
    columns.write_masked(whole, mask, value)
    at = rows_of(mask)
    columns.write_masked(some, mask, value[at], at)
    assert torch.equal(whole, some)
    assert whole[mask][:, list(indices)].equal(value[mask].float())
    assert not whole[~mask].any()
