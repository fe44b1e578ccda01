"""The throughput gate: its measurements, and what voids their figures."""

import sys
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from compositions import load_config
from environments import NewRun, Patch, at_double_speed, on_cuda

from mjstack.bench import env_step, episode, timing
from mjstack.bench.env_step import measure_env_step
from mjstack.bench.timing import (
    EnergyMeter,
    Measurement,
    steps_that_fit,
    timed,
)
from mjstack.envs import build_env
from mjstack.episodes.rollout import Episode, RolloutTiming, State
from mjstack.episodes.stage import Stage
from mjstack.gates import throughput
from mjstack.gates.throughput import run_throughput
from mjstack.report.record import GateResult, Status
from mjstack.sim import Simulation
from mjstack.sim.native import NativeSimulation

FEW = (
    "gates=[throughput]",
    "gate.throughput.repetitions=3",
    "gate.throughput.precision=0",
    "gate.throughput.steps=3",
    "gate.throughput.env_steps=2",
    "gate.throughput.cpu_max_seconds=120",
)
SHORT = (*FEW, *at_double_speed())  # of stack
NATIVE = ("sim=native", "nworld=2", *SHORT)
MJWARP = ("sim=mjwarp", "sim.device=cpu", "nworld=1", *SHORT)
ONLY = "gate.throughput.measurements="
SPEEDS = ("per_s", "ms_per", "seconds", "ratio", "over_physics", "power")


def speeds(result: GateResult, measurement: str = "") -> list[str]:
    """Metrics that say how fast something was."""
    names = [name for name in result.metrics if name.startswith(measurement)]
    return [name for name in names if any(word in name for word in SPEEDS)]


def facts(measured: Measurement) -> dict[str, float | None]:
    return {figure.key: figure.value for figure in measured.facts}


def measure(new_run: NewRun, *overrides: str) -> GateResult:
    """The first result of the gate."""
    return run_throughput(new_run(*overrides))[0]


def worlds(monkeypatch: Patch, device: str, mode: str = "auto") -> tuple[Any, Any]:
    """Four worlds that have no memory and no graph, and their configuration."""
    monkeypatch.setattr(timing, "device_memory", lambda _: None)
    sim = SimpleNamespace(device=torch.device(device), nworld=4, graph_of=lambda *_, **__: None)
    return sim, SimpleNamespace(graph=mode, timing=SimpleNamespace(decimation=10))


def test_rates_are_arithmetic(monkeypatch: Patch) -> None:
    measured = Measurement(name="m")
    some = worlds(monkeypatch, "cpu")
    measured.add_repetitions(*some, [2.0, 0.5, 1.0], 5, EnergyMeter("cpu"), captured=False)
    measured.facts.clear()
    metrics = {figure.key: figure.value for figure in measured.figures()}
    expected = {
        "ms_per_batched_step": (20.0, 10.0, 40.0),
        "world_steps_per_s": (200.0, 100.0, 400.0),
        "ms_per_env_step": (200.0, 100.0, 400.0),
        "env_steps_per_s": (20.0, 10.0, 40.0),
    }
    for name, values in expected.items():
        found = tuple(metrics[f"m.{name}.{end}"] for end in ("median", "min", "max"))
        assert found == values
    assert measured.median("world_steps") == 200.0
    measured.problem = "void"
    assert measured.figures() == []


@pytest.mark.parametrize(
    ("budget", "step", "fit"), [(10.0, 1.0, 10), (10.0, 0.1, 25), (0.5, 1.0, 1), (2.5, 1.0, 2)]
)
def test_steps_fit_into_the_time(budget: float, step: float, fit: int) -> None:
    assert steps_that_fit(25, budget, step) == fit


ONE = ("sim=native", "nworld=1", *SHORT)


@pytest.mark.full
def test_native_measurements(new_run: NewRun) -> None:
    result, cuda = run_throughput(new_run("sim=native", "nworld=2", *SHORT))
    assert result.status is Status.passed, result.reason
    assert cuda.status is Status.skipped or torch.cuda.is_available()
    m = result.metrics
    assert (m["worlds"], m["physics.repetitions"], m["physics.steps_per_repetition"]) == (2, 3, 3)
    assert (m["episode.succeeded"], m["episode.repetitions"]) == (2, 3)
    assert m["episode.steps_per_repetition"] == 300
    assert (m["env_step.repetitions"], m["env_step.steps_per_repetition"]) == (3, 2)
    for name in ("physics", "episode", "env_step"):
        # With three repetitions the median of the rates is the rate of the median.
        ms = m[f"{name}.ms_per_batched_step.median"]
        rate = m[f"{name}.world_steps_per_s.median"]
        assert rate == pytest.approx(2 * 1e3 / ms)
        assert m[f"{name}.ms_per_batched_step.min"] <= ms <= m[f"{name}.ms_per_batched_step.max"]
    assert m["episode.seconds.median"] == pytest.approx(
        3.0 * m["episode.ms_per_batched_step.median"]
    )
    assert m["env_step.managers_over_physics.median"] > 0.0
    assert m["env_step.managers_ms_per_step.median"] < m["env_step.ms_per_env_step.max"]
    assert result.notes["gpu_power_and_memory"] == "not measured: no GPU"
    for name in ("physics", "episode", "env_step"):
        assert m[f"{name}.captured"] is False  # native MuJoCo has nothing to capture
        assert m[f"{name}.warm_up_s"] == m[f"{name}.capture_s"] == 0.0
    alone = m["env_step.managers_alone_over_physics.median"]
    over = m["env_step.managers_over_physics.median"]
    assert f"managers {100.0 * over:+.1f} % (alone {100.0 * alone:.1f} %)" in result.reason
    assert "(eager)" not in result.reason


def episode_of(seconds: float) -> Episode:
    """An episode of four worlds that took so long."""
    spent = RolloutTiming(
        steps=5, seconds=seconds, warm_up_seconds=0.0, capture_seconds=0.0, captured=False
    )
    result: Any = SimpleNamespace(failed=torch.zeros(4), values={})
    arrays = dict.fromkeys(("start", "ik_error", "retries"), np.zeros(4))
    return Episode(result=result, **arrays, places={}, timing=spent, description="some")


@pytest.mark.parametrize(
    ("backend", "repetitions", "played"), [("mjwarp", 3, 2), ("native", 3, 2), ("native", 1, 0)]
)
def test_the_batch_gates_episode_is_the_first_repetition(
    backend: str, repetitions: int, played: int, new_run: NewRun, monkeypatch: Patch
) -> None:
    limits = {"repetitions": repetitions, "cpu_max_seconds": 100}
    choices = [f"gate.throughput.{key}={value}" for key, value in limits.items()]
    run = new_run("sim=native", "nworld=4", *choices)
    sim, _ = worlds(monkeypatch, "cpu")
    sim.backend = backend
    sim.description = "some"
    first = episode_of(1.0)
    more = [episode_of(2.0) for _ in range(played)]
    monkeypatch.setattr(Stage, "play", lambda *_: more.pop())
    measured = episode.measure_episode(run.stage, sim, first)
    assert not more
    assert measured.samples["seconds"] == [1.0] + [2.0] * played
    assert facts(measured)["of_the_batch_gate"] == 1


@pytest.mark.parametrize(
    ("times", "precision", "narrow"),
    [
        ([1.0], 0.01, False),  # one has no range
        ([1.0, 1.0], 0.0, False),  # 0: all repetitions are made
        ([1.0, 1.019], 0.01, True),
        ([1.0, 1.021], 0.01, False),
        ([1e-3, 1.019e-3], 0.01, True),
        ([1.0, 1.5, 1.01], 0.01, False),  # an outlier stays one
    ],
)
def test_repetitions_end_where_the_range_is_narrow(
    times: list[float], precision: float, narrow: bool
) -> None:
    cfg = load_config([f"gate.throughput.precision={precision}"])
    assert timing.settled(cfg, times) is narrow


@pytest.mark.full
def test_warm_up_and_capture_are_told_apart(new_run: NewRun) -> None:
    result = measure(new_run, *MJWARP, "gate.throughput.episodes=1")
    assert result.status is Status.passed, result.reason
    m = result.metrics
    assert m["episode.succeeded"] == 1
    assert m["physics.peak_constraint_rows_per_world"] > 0
    # Warp's CPU device: physics is captured, the step around it is not.
    for name in ("episode", "env_step"):
        assert (m[f"{name}.captured"], m[f"{name}.physics_captured"]) == (False, True)
    for name in ("physics", "episode", "env_step"):
        assert m[f"{name}.warm_up_s"] > 0.0
        assert m[f"{name}.capture_s"] > 0.0
    assert m["physics.captured"] is True
    # The first call of a step was neither timed nor the estimate: eager it takes some 0.15 s.
    assert 1e-3 * m["physics.ms_per_batched_step.max"] * 10 < m["physics.warm_up_s"]


@pytest.mark.parametrize(
    ("device", "mode", "captured", "void"),
    [
        ("cuda", "auto", False, True),
        ("cuda", "require", False, True),
        ("cuda", "off", False, False),
        ("cuda", "auto", True, False),
        ("cpu", "auto", False, False),
    ],
)
def test_eager_work_is_void_where_it_should_be_captured(
    device: str, mode: str, captured: bool, void: bool, monkeypatch: Patch
) -> None:
    measured = Measurement(name="m")
    some = worlds(monkeypatch, device, mode)
    measured.add_repetitions(*some, [1.0], 5, EnergyMeter("cpu"), captured=captured)
    assert bool(measured.problem) is void
    assert facts(measured) == {
        "steps_per_repetition": 5,
        "repetitions": 1,
        "warm_up_s": 0.0,
        "capture_s": 0.0,
        "captured": captured,
    }


@pytest.mark.full
def test_steps_not_made_void_the_figure(new_run: NewRun, monkeypatch: Patch) -> None:
    step = NativeSimulation.step

    def lazy(self: NativeSimulation, n: int = 1, *, kinematics: bool = False) -> None:
        step(self, max(1, n - 1), kinematics=kinematics)

    monkeypatch.setattr(NativeSimulation, "step", lazy)
    result = measure(new_run, *NATIVE, f"{ONLY}[physics,env_step]")
    assert result.status is Status.failed
    for name in ("physics", "env_step"):
        problem = f"{name}: no figure: 2 worlds overflowed, diverged or were not stepped"
        assert problem in result.reason
    assert speeds(result) == []


@pytest.mark.full
def test_broken_measurement_leaves_the_others(new_run: NewRun, monkeypatch: Patch) -> None:
    def out_of_memory(*_: object, **__: object) -> None:
        raise MemoryError("Unable to allocate 9 GiB")

    monkeypatch.setattr(throughput, "measure_env_step", out_of_memory)
    result = measure(new_run, *ONE, f"{ONLY}[physics,env_step]")
    assert result.status is Status.failed
    problem = "env_step: no figure: out of memory (Unable to allocate 9 GiB). Run fewer worlds"
    assert problem in result.reason
    assert speeds(result, "env_step") == []
    assert speeds(result, "physics") != []


@pytest.mark.full
def test_broken_episode_does_not_verify_the_task(new_run: NewRun, monkeypatch: Patch) -> None:
    def broken(*_: object, **__: object) -> None:
        raise RuntimeError("bad")

    run = new_run(*ONE, f"{ONLY}[physics,episode]")
    monkeypatch.setattr(run.stage, "play", broken)
    result, _ = run_throughput(run)
    assert result.status is Status.failed
    assert "episode: no figure: RuntimeError: bad" in result.reason
    assert "the task was not verified in this run" in result.reason
    for status, verified in ((Status.passed, True), (Status.skipped, False)):
        run.artifacts.results["batch"] = GateResult(name="batch", status=status, reason="")
        result, _ = run_throughput(run)
        assert ("the task was not verified" not in result.reason) is verified


@pytest.mark.full
def test_start_states_repeat_without_the_batch_gate(new_run: NewRun) -> None:
    run = new_run("sim=native", "nworld=5", *SHORT, "gate.throughput.start_worlds=2")
    sim = run.stage.batch_simulation(5)
    state = episode.carry_start(run.stage, sim, None)
    assert state.qpos.shape[0] == 5
    assert np.array_equal(state.qpos[[0, 1, 0]], state.qpos[2:])
    assert not np.array_equal(state.qpos[0], state.qpos[1])
    red = run.stage.index.object_qpos[0]
    gripper = run.stage.index.robot_qpos[-1]
    assert np.abs(state.qpos[:, red] - run.cfg.scene.objects["red"].xy[0]).max() < 0.03
    assert state.qpos[:, gripper].max() < run.cfg.robot.gripper_open[0] - 0.1  # closed on the cube
    kept = State(state.qpos.copy(), state.qvel, state.ctrl)
    run.artifacts.carry_start = kept
    assert episode.carry_start(run.stage, sim, kept) is kept


@pytest.mark.full
def test_worlds_with_an_empty_grasp_are_counted(new_run: NewRun) -> None:
    """Red beside the jaws in two of five worlds, then in three of them."""
    run = new_run("sim=native", "nworld=5", *SHORT, f"{ONLY}[physics]")
    sim = run.stage.batch_simulation(5)
    state = episode.carry_start(run.stage, sim, None)
    red = run.stage.index.object_qpos[0]
    state.qpos[[1, 4], red + 1] -= 0.1
    run.artifacts.carry_start = state
    result, _ = run_throughput(run)
    assert result.metrics["physics.worlds_with_object_in_hand"] == 3
    assert speeds(result, "physics")
    assert "(2 of them with an empty grasp)" in result.reason
    state.qpos[0, red + 1] -= 0.1
    result, _ = run_throughput(run)
    assert result.status is Status.failed
    few = "physics: no figure: only 2 of 5 worlds have the object in hand as lift_red begins"
    assert few in result.reason
    assert speeds(result, "physics") == []


@pytest.mark.full
def test_the_parts_play_one_trajectory(monkeypatch: Patch) -> None:
    """Physics alone ends where the whole step ended, except in worlds that were reset meanwhile, of
    which there are some.
    """
    limits = {"env_steps": 4, "repetitions": 3, "precision": 0, "cpu_max_seconds": 1000}
    choices = [f"gate.throughput.{key}={value}" for key, value in limits.items()]
    cfg = load_config(["task=stack", "sim=native", "task.episode_steps=9", *choices])
    env = build_env(cfg, nworld=12)
    wholes = []
    take = env_step.snapshot

    def keep(sim: Simulation) -> State:
        wholes.append((take(sim), env.episode.clone()))
        return wholes[-1][0]

    monkeypatch.setattr(env_step, "snapshot", keep)
    ends = []  # of physics alone
    lost = timing.lost_worlds

    def look(sim: Simulation, steps: int) -> torch.Tensor:
        ends.append((steps, sim.qpos.clone()))
        return lost(sim, steps)

    monkeypatch.setattr(timing, "lost_worlds", look)
    times = measure_env_step(env, "env_step", lambda what, done, total: None)
    figures = times.samples
    names = ("ms_per_env_step", "physics_ms_per_step", "managers_ms_per_step")
    repetitions = list(zip(*(figures[name] for name in names), strict=True))
    assert len(repetitions) == 3
    for number, (whole_ms, physics_ms, managers_ms) in enumerate(repetitions):
        over, alone = whole_ms / physics_ms - 1.0, managers_ms / physics_ms
        assert figures["managers_over_physics"][number] == pytest.approx(over)
        assert figures["managers_alone_over_physics"][number] == pytest.approx(alone)
        residual = figures["residual_ms_per_step"][number]
        assert residual + physics_ms + managers_ms == pytest.approx(whole_ms)
    assert times.problem == ""
    ended = 0
    repeated = zip(wholes[:-1], wholes[1:], ends, strict=True)
    for (_, before), (whole, after), (steps, alone) in repeated:
        same = (before == after).numpy()
        ended += int((after - before).sum())
        assert steps == 4 * cfg.timing.decimation
        assert same.any()
        assert np.array_equal(whole.qpos[same], alone.numpy()[same])
        assert not np.array_equal(whole.qpos[~same], alone.numpy()[~same])
    assert ended > 12  # 16 steps of episodes of 9: every world once at least
    assert 0 < facts(times)["episodes_ended"] < ended  # the first repetition warms up


@pytest.mark.parametrize(
    ("precision", "physics", "made"), [(0.01, 1.0, 2), (0.01, 0.9, 5), (0.0, 1.0, 5)]
)
def test_env_step_repeats_until_its_ratio_to_physics_is_narrow(
    precision: float, physics: float, made: int, monkeypatch: Patch
) -> None:
    """The times themselves may grow; ``physics`` is the first repetition's share of them."""
    cfg = load_config(["sim=native", f"gate.throughput.precision={precision}"])
    times = iter([0.0, 1.0, 2.0, 2.0, 4.0, 5.0])  # the first one warms up

    def play(parts: Any, steps: int, meter: Any) -> tuple[list[float], float]:
        whole = next(times)
        return [1.07 * whole, whole * (physics if whole == 1.0 else 1.0), 0.05 * whole, 0.0], 0.0

    monkeypatch.setattr(env_step._Parts, "play", play)
    env = build_env(cfg, nworld=1)
    measured = measure_env_step(env, "env_step", lambda what, done, total: None)
    env.close()
    assert facts(measured)["repetitions"] == made


class FakeNvml:
    """NVML whose counter goes by 100 J from one reading to the next."""

    class NVMLError(Exception):
        pass

    def __init__(self, refuses: str = "") -> None:
        self.refuses = refuses
        self.millijoules = 0.0

    def nvmlInit(self) -> None:
        pass

    def nvmlDeviceGetHandleByUUID(self, uuid: str) -> str:
        if self.refuses:
            raise self.NVMLError(self.refuses)
        assert uuid == "GPU-1"
        return uuid

    def nvmlDeviceGetTotalEnergyConsumption(self, _: str) -> float:
        self.millijoules += 1e5
        return self.millijoules


def meter(monkeypatch: Patch, nvml: FakeNvml | None) -> EnergyMeter:
    monkeypatch.setitem(sys.modules, "pynvml", nvml)  # None: an import error
    monkeypatch.setattr(timing, "cuda_uuid", lambda _: "GPU-1")
    return EnergyMeter("cuda:0")


def test_energy_is_that_of_the_stretches_alone(monkeypatch: Patch) -> None:
    """What passes between them, 500 J and a minute, does not count."""
    clock = iter([10.0, 14.0, 74.0, 80.0])
    monkeypatch.setattr(timing.time, "perf_counter", lambda: next(clock))
    nvml = FakeNvml()
    energy = meter(monkeypatch, nvml)
    for _ in range(2):
        energy.start()
        energy.stop()
        nvml.millijoules += 5e5
    assert {figure.key: figure.value for figure in energy.figures()} == {
        "gpu_power_mean_w": pytest.approx(20.0),
        "gpu_energy_j": pytest.approx(200.0),
    }
    energy = meter(monkeypatch, nvml)
    assert energy.figures() == []
    assert "too short" in energy.missing


def test_the_meter_runs_while_the_work_does() -> None:
    """And the device is idle at both ends."""
    seen: list[str] = []
    sim: Any = SimpleNamespace(synchronize=lambda: seen.append("wait"))
    energy: Any = SimpleNamespace(
        start=lambda: seen.append("start"), stop=lambda: seen.append("stop")
    )
    assert timed(sim, lambda: (seen.append("work"), time.sleep(0.01)), energy) >= 0.01
    assert seen == ["wait", "start", "work", "wait", "stop"]


@pytest.mark.full
def test_the_meter_sees_an_episodes_replayed_steps(new_run: NewRun) -> None:
    run = new_run("sim=native", "nworld=1")
    seen = []
    sim = run.stage.batch_simulation(1)
    energy: Any = SimpleNamespace(
        start=lambda: seen.append(int(sim.step_count[0])),
        stop=lambda: seen.append(int(sim.step_count[0])),
    )
    run.stage.play(sim, run.cfg.reset, [timing.EnergyObserver(energy)])
    assert seen == [20, 6000]  # not the two steps that warm up and are captured


@pytest.mark.parametrize(
    ("nvml", "why"),
    [
        (None, "nvidia-ml-py is not installed"),
        (FakeNvml("Not Supported"), "Not Supported"),
        (FakeNvml(), "too short"),
    ],
)
def test_missing_power_says_why(monkeypatch: Patch, nvml: FakeNvml | None, why: str) -> None:
    energy = meter(monkeypatch, nvml)
    energy.start()
    energy.stop()
    assert energy.figures() == []
    assert why in energy.missing


@pytest.mark.full
@on_cuda
def test_figures_of_2048_worlds_on_cuda(new_run: NewRun) -> None:
    run = new_run(
        "sim=mjwarp",
        "nworld=2048",
        "gates=[throughput]",
        "gate.throughput.repetitions=3",
        "gate.throughput.native_baseline=false",
    )
    baseline, result = run_throughput(run)
    assert baseline.status is Status.skipped
    assert result.status is Status.passed, result.reason
    m = result.metrics
    assert m["episode.succeeded"] == 2048
    for name in ("physics", "episode", "env_step"):
        assert 0.0 < m[f"{name}.gpu_memory_arrays_mib"] <= m[f"{name}.gpu_memory_whole_gpu_mib"]
        watts = m.get(f"{name}.gpu_power_mean_w")
        assert 50.0 < watts < 2000.0 if watts else f"{name}.gpu_power_mean_w" in result.notes
        assert m[f"{name}.captured"] is True
        assert m[f"{name}.warm_up_s"] > 0.0
        assert m[f"{name}.capture_s"] > 0.0
    assert m["env_step.managers_over_physics.median"] < 1.0
