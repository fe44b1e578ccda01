"""Failures injected into real simulations: each is caught, in its own world and by its own rule,
and no other world is.
"""

import math
import re
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch
from check_cases import rules_of
from environments import GetStage, MakeSim, NewRun, Patch, at_double_speed, judge

from mjstack import interrupt
from mjstack.config import Config
from mjstack.config.schema import Backend
from mjstack.drivers.driver import Driver
from mjstack.envs import Env
from mjstack.episodes import batches as gate_module
from mjstack.episodes.rollout import Episode, Hook, play_episode
from mjstack.episodes.run import Run
from mjstack.episodes.stage import Stage
from mjstack.episodes.tally import EpisodeTally
from mjstack.errors import ConfigError, MjstackError
from mjstack.gates.runner import run_guarded
from mjstack.gates.throughput import run_throughput
from mjstack.jobs import gates
from mjstack.report.record import GateResult, Status
from mjstack.sim import BatchSizes, Overflow, Simulation
from mjstack.sim.usage import data_bytes
from mjstack.tasks.check import make_check


def teleport(stage: Stage, world: int) -> Callable[[int, Simulation], None]:
    """Moves red beside the stack, once, when it has been released."""
    released = stage.phase("retreat").start

    def hook(step: int, sim: Simulation) -> None:
        if step == released:
            sim.qpos[world, stage.index.object_qpos[0]] += 0.08

    return hook


def rules(bits: torch.Tensor) -> list[set[str]]:
    return [set(rules_of("stack").broken(int(b))) for b in bits]


@pytest.mark.full
def test_native(get_stage: GetStage, make_sim: MakeSim) -> None:
    stage = get_stage("so101")
    sim = make_sim("native", 6)
    push = teleport(stage, 1)
    initial = {}

    def hook(step: int, sim: Simulation) -> None:
        push(step, sim)
        if step == 0:  # world 2 stalls: its steps are counted, and it stays where it is
            initial.update(qpos=sim.qpos[2].clone(), qvel=sim.qvel[2].clone())
        sim.qpos[2] = initial["qpos"]
        sim.qvel[2] = initial["qvel"]
        if step == 300:
            sim.qvel[3, stage.index.object_qvel[1]] = math.nan
            sim.step_count[5] -= 1

    episode = stage.play(sim, stage.cfg.reset, [Hook(hook)])
    broken = rules(episode.result.failed)
    assert broken[0] == broken[4] == set()
    assert broken[1] == {"STACKED"}
    assert broken[2] == {"LIFT", "CARRY", "STACKED"}
    # A diverged world is not stepped any more
    assert {"FINITE", "STACKED", "REST_SPEED", "STEPS"} <= broken[3]
    assert broken[5] == {"STEPS"}


def crowd(stage: Stage, sim: Simulation, world: int) -> None:
    """Puts both cubes of one world into each other, the table and the gripper: far more contacts
    than elsewhere.
    """
    grasp_point = sim.site_xpos[world, stage.index.grasp_sites].mean(0)
    top = stage.cfg.scene.table_center[2] + stage.cfg.scene.table_half[2]
    red, blue = stage.index.object_qpos
    sim.qpos[world, red : red + 3] = grasp_point.to(sim.qpos.dtype)
    sim.qpos[world, blue : blue + 2] = grasp_point[:2].to(sim.qpos.dtype) + 0.01
    sim.qpos[world, blue + 2] = top + 0.015


@pytest.mark.full
def test_overflow_in_exactly_the_crowded_world(get_stage: GetStage, make_sim: MakeSim) -> None:
    stage = get_stage("so101")
    # Any world needs up to 144 rows in the first steps, the crowded one 192.
    sim = make_sim("mjwarp", 3, "batch.njmax=160")
    env = stage.start(sim, stage.cfg.reset)
    sim.forward()
    assert int(sim.overflow.abs().sum()) == 0
    crowd(stage, sim, 1)
    check = make_check(stage.cfg)
    check.start(env, stage.planner.phases[-1].stop, stage.planner.phases)
    for _ in range(3):
        sim.step(10)
        check.update(torch.zeros(3, dtype=torch.int64))
    bits = sim.overflow.tolist()
    assert bits[1] & Overflow.NEFC
    assert bits[0] == bits[2] == 0
    broken = rules(check.result().failed)
    assert ["OVERFLOW" in names for names in broken] == [False, True, False]
    sim.reset(torch.tensor([False, True, False]))
    sim.step(1)
    assert sim.overflow.tolist() == [0, 0, 0]


@pytest.mark.full
def test_batch_gate_names_world_and_rule_and_voids_throughput(
    new_run: NewRun, monkeypatch: Patch
) -> None:
    short = ("nworld=4", "gate.throughput.steps=2", "gate.throughput.repetitions=1")
    run = new_run("sim=native", "gates=[batch,throughput]", *short, *at_double_speed())

    def broken_episode(env: Env, driver: Driver, observers: list, **kwargs: Any) -> Episode:
        return play_episode(env, driver, [*observers, Hook(teleport(run.stage, 2))], **kwargs)

    monkeypatch.setattr(gate_module, "play_episode", broken_episode)
    batch = judge(run)
    assert batch.status is Status.failed
    assert "1 of 4 episodes (2) failed" in batch.reason
    assert "not stacked" in batch.reason
    assert batch.details == ["not stacked: 1 of 4 episodes (2)"]
    expected = {"succeeded": 3, "success_rate": 0.75, "failed.STACKED": 1}
    assert batch.metrics.items() >= expected.items()

    run.artifacts.results["batch"] = batch
    throughput, _ = run_throughput(run)
    assert throughput.status is Status.failed
    assert "no figure" in throughput.reason
    assert not [name for name in throughput.metrics if "per_s" in name or "ms_per" in name]

    batch.status = Status.passed  # and the episode it timed is not: that alone voids every figure
    throughput, _ = run_throughput(run)
    assert throughput.status is Status.failed
    assert "1 of 4 worlds (2) failed the check" in throughput.reason
    assert throughput.reason.count("no figure") == 3
    assert not [name for name in throughput.metrics if "per_s" in name or "ms_per" in name]

    run.artifacts.timed_episode.result.failed.zero_()
    throughput, cuda = run_throughput(run)
    assert throughput.status is Status.passed
    assert throughput.metrics["physics.world_steps_per_s.median"] > 0
    assert cuda.name == "throughput_cuda"


def test_batch_gate_refuses_identical_worlds(new_run: NewRun) -> None:
    batch = judge(new_run("sim=native", "nworld=2", "reset=nominal", *at_double_speed()))
    assert batch.status is Status.failed
    assert batch.metrics["distinct_final_states"] == 1
    assert "reset=jitter" in batch.reason


def test_batch_gate_takes_worlds_that_start_apart_and_end_alike(
    new_run: NewRun, monkeypatch: Patch
) -> None:
    array = EpisodeTally.array
    monkeypatch.setattr(
        EpisodeTally, "array", lambda tally, name: array(tally, name) * (name != "end")
    )
    batch = judge(new_run("sim=native", "nworld=2", *at_double_speed()))
    assert batch.metrics["distinct_final_states"] == 1
    assert batch.status is Status.passed


@pytest.mark.parametrize(
    "error",
    [
        MemoryError("Unable to allocate 9 GiB"),
        torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 9 GiB"),
        RuntimeError("Failed to allocate 99 bytes on device 'cuda:0'"),
        RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to"),
    ],
)
def test_memory_that_runs_out_is_said(error: Exception, so101_cfg: Config) -> None:
    def gate(run: Run) -> list[GateResult]:
        raise error

    results: list[GateResult] = []
    run_guarded(Run(Stage(so101_cfg), record=results.append), "batch", gate)
    (result,) = results
    assert result.status is Status.failed
    assert result.reason.startswith(f"out of memory ({error}). Run fewer worlds")


def test_worlds_that_do_not_fit_are_refused(new_run: NewRun, monkeypatch: Patch) -> None:
    assert 0 < gates.available_memory() < 2**44
    monkeypatch.setattr(gates, "available_memory", lambda: 10**9)
    with pytest.raises(ConfigError, match=r"not enough memory .* GiB needed") as caught:
        gates._check_memory(new_run("sim=native", "nworld=10000000").stage)
    most = re.search(r"at most (\d+),", str(caught.value))[1]
    gates._check_memory(new_run("sim=native", f"nworld={most}").stage)
    with pytest.raises(ConfigError, match=f"at most {most}, because"):
        gates._check_memory(new_run("sim=native", f"nworld={int(most) + 1}").stage)


def test_a_part_that_cannot_be_loaded_fails_its_gate(so101_cfg: Config) -> None:
    def begin(name: str) -> None:
        raise ImportError("no warp here")

    results: list[GateResult] = []
    run_guarded(Run(Stage(so101_cfg), begin=begin, record=results.append), "batch", lambda _: [])
    (result,) = results
    assert (result.name, result.status) == ("batch", Status.failed)
    assert "no warp here" in result.reason


def test_worlds_that_a_gpu_cannot_hold_are_refused_with_how_many_it_can(
    get_stage: GetStage, monkeypatch: Patch
) -> None:
    """The GPU is made up."""
    from mjstack.sim import build, mjwarp

    def raises(error: Exception) -> Callable[..., None]:
        def make(*_: Any) -> None:
            raise error

        return make

    stage = get_stage("so101")
    monkeypatch.setattr(build, "resolve_backend", lambda *_: (Backend.mjwarp, "cuda:0"))
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda _: (2**30, 2**33))
    sizes = BatchSizes(nconmax=40, njmax=184)
    make = partial(build.make_simulation, stage.model, stage.cfg, sizes=sizes)
    lost = RuntimeError("Failed to allocate 99 bytes on device 'cuda:0'")
    monkeypatch.setattr(mjwarp, "MjwarpSimulation", raises(lost))
    with pytest.raises(MjstackError, match=r"1\.0 are free, expected at most [\d,]+\.") as caught:
        make(200_000)
    says = str(caught.value)
    assert says.startswith("out of memory: 200,000 worlds with batch.nconmax=40 batch.njmax=184")
    most = int(re.search(r"at most ([\d,]+)", says)[1].replace(",", ""))  # type: ignore[index]
    assert 0.5 * 2**30 < data_bytes(stage.model, most, sizes) < 2**30
    with pytest.raises(RuntimeError, match="Failed to allocate 99 bytes"):
        make(2)  # these would fit: something else has the memory
    monkeypatch.setattr(mjwarp, "MjwarpSimulation", raises(ValueError("another reason")))
    with pytest.raises(ValueError, match="another reason"):
        make(200_000)


def test_an_interrupt_fails_no_gate(so101_cfg: Config, monkeypatch: Patch) -> None:
    """Also where it breaks something that would have gone on otherwise."""

    def gate(run: Run) -> list[GateResult]:
        monkeypatch.setattr(interrupt, "_asked", True)  # as the command's handler does
        raise RuntimeError("a helper was interrupted too")

    results: list[GateResult] = []
    with pytest.raises(KeyboardInterrupt):
        run_guarded(Run(Stage(so101_cfg), record=results.append), "batch", gate)
    assert not results
