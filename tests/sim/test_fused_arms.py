"""Arms with tendons, equalities between bodies and sensors of force: their step is MJWarp's own."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
from arms import XMLS, model_of
from environments import Patch, configure, few

from mjstack.config.schema import Backend
from mjstack.sim import make_simulation
from mjstack.sim.fused.step import StepPlan, disagreement
from mjstack.sim.mjwarp import MjwarpSimulation
from mjstack.sim.sizes import BatchSizes

N = 4
SIZES = BatchSizes(nconmax=40, njmax=128)
ARMS = [
    name if name in ("tendon", "linkage") else pytest.param(name, marks=pytest.mark.full)
    for name in XMLS
]


@cache
def worlds(name: str, device: str, step: str) -> MjwarpSimulation:
    """Worlds of an arm, whose step is planned, or one by a name."""
    sim = make_simulation(
        model_of(name),
        configure("graph=require"),
        N,
        backend=Backend.mjwarp,
        device=device,
        sizes=SIZES,
    )
    assert isinstance(sim, MjwarpSimulation)
    reason = "MJWarp's smooth dynamics, because tendons are spatial" if name == "spatial" else ""
    plan = StepPlan("fused", smooth=not reason, cameras=name == "linkage", reason=reason)
    assert sim.plan == plan
    if step != "fused":
        sim.plan = replace(plan, name=step, smooth=False)
    return sim


def controls(model: mujoco.MjModel, generator: torch.Generator) -> torch.Tensor:
    """Random ones of N worlds, within their ranges."""
    low, high = torch.from_numpy(model.actuator_ctrlrange).unbind(1)
    free = low == high
    low = torch.where(free, -0.05, low)
    high = torch.where(free, 0.05, high)
    random = torch.rand((N, model.nu), generator=generator, dtype=torch.float64)
    return (low + (high - low) * random).float()


@pytest.mark.parametrize("name", few(ARMS, 2))
@pytest.mark.parametrize("step", ["arranged", "fused"])
def test_a_step_ends_where_mjwarps_own_does(step: str, name: str, device: str) -> None:
    """Arranged on the CPU device bit for bit over many steps; else each from the same state."""
    exact = step == "arranged" and device == "cpu"
    sim = worlds(name, device, step)
    stock = worlds(name, device, "stock")
    generator = torch.Generator().manual_seed(0)
    for batch in (sim, stock):
        batch.reset()
    rows = 0
    for number in range(24 if exact else 12):
        command = controls(sim.model, generator).to(device)
        thrown = 0.3 * torch.randn(sim.qvel.shape, generator=generator).to(device)
        if not exact:
            for view in ("qpos", "qvel", "act"):
                getattr(sim, view)[:] = getattr(stock, view)
            wp.copy(sim._d.qacc_warmstart, stock._d.qacc_warmstart)
        for batch in (sim, stock):
            batch.ctrl[:] = command
            batch.qvel += thrown
            batch.step(5 if exact else 1 + number % 3, kinematics=number % 2 == 0)
            batch.synchronize()
        assert torch.equal(sim.constraint_count, stock.constraint_count), number
        rows = max(rows, int(sim.constraint_count.max()))
        sizes = {"qpos": 1e-5, "qvel": 5e-3, "sensordata": 0.01, "qfrc_actuator": 1e-4}
        for view, size in sizes.items():
            values, expected = getattr(sim, view), getattr(stock, view)
            assert bool(expected.isfinite().all())
            if exact:
                assert torch.equal(values, expected), (number, view)
            elif values.numel():
                scale = float(expected.abs().max()) + 1.0
                torch.testing.assert_close(values, expected, rtol=0.0, atol=size * scale)
    assert rows >= 12


@pytest.mark.parametrize("name", ARMS)
def test_errors_against_native_are_not_above_stocks(name: str, device: str) -> None:
    """A step from each of many states of native MuJoCo, in float64. Rows of connect and weld read
    the velocities of that step.
    """
    model = model_of(name)
    native = mujoco.MjData(model)
    generator = torch.Generator().manual_seed(1)
    sims = {step: worlds(name, device, step) for step in ("fused", "stock")}
    errors: dict[str, list[float]] = {step: [] for step in sims}
    states = []
    while len(states) < 16 * N:
        native.ctrl[:] = controls(model, generator)[0]
        native.qvel += 0.3 * torch.randn(model.nv, generator=generator).numpy()
        mujoco.mj_step(model, native, 12)
        arrays = (native.qpos, native.qvel, native.act, native.ctrl)
        states.append([np.float32(values) for values in arrays])
    for begin in range(0, len(states), N):
        batch = states[begin : begin + N]
        ends = []
        for qpos, qvel, act, ctrl in batch:
            data = mujoco.MjData(model)
            data.qpos, data.qvel, data.act, data.ctrl = qpos, qvel, act, ctrl
            mujoco.mj_step(model, data)
            ends.append(data.qvel)
        end = np.array(ends)
        for step, sim in sims.items():
            sim.reset()
            for view, values in zip(
                ("qpos", "qvel", "act", "ctrl"), zip(*batch, strict=True), strict=True
            ):
                getattr(sim, view)[:] = torch.from_numpy(np.array(values))
            sim.step(1)
            sim.synchronize()
            errors[step] += np.abs(sim.qvel.cpu().numpy() - end).max(1).tolist()
    for step in sims:
        assert np.median(errors[step]) < 2e-5  # with velocities of the step before 2e-4
    for measure, most in ((np.median, 1.1), (np.linalg.norm, 1.05)):
        assert measure(errors["fused"]) <= most * measure(errors["stock"]) + 1e-8


def test_launches(monkeypatch: Patch) -> None:
    """Of a step whose sensors nothing reads. Eight of them are MJWarp's velocities and rows
    beside collision.
    """
    counts = []
    for step in ("fused", "stock"):
        sim = worlds("linkage", "cpu", step)
        for steps in (1, 2):
            made: list[str] = []
            with monkeypatch.context() as patch, wp.ScopedDevice("cpu"):
                for name in ("launch", "launch_tiled"):
                    patch.setattr(wp, name, counted(getattr(wp, name), made))
                sim._decimation(steps, kinematics=False)
            counts.append(len(made))
    assert counts[1] - counts[0] <= 16
    assert counts[3] - counts[2] >= 5 * 14


def counted(launch: Callable, made: list[str]) -> Callable:
    """The function, which notes the kernels that it launches."""

    def counting(kernel: wp.Kernel, dim: int | tuple[int, ...], *args: Any, **kwargs: Any) -> Any:
        if np.prod(dim):
            made.append(kernel.key)
        return launch(kernel, *args, dim=dim, **kwargs)

    return counting


def test_the_check_at_the_start_agrees() -> None:
    """That of a release which mjstack was not written for."""
    sim = worlds("linkage", "cpu", "fused")
    with wp.ScopedDevice("cpu"):
        assert disagreement(sim.model, sim._m, sim._d, sim.device, sim.plan) == ""
