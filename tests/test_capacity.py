"""Sizing the buffers: peaks that resets do not erase, sizes that are enough and not more, and who
uses them.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterator
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from compositions import load_config
from environments import at_double_speed, one_second_episode

import mjstack
from mjstack.config.schema import Backend
from mjstack.envs import Env, build_env
from mjstack.envs.buffers import (
    Peaks,
    Workload,
    join_peaks,
    measured_sizes,
    play_random_actions,
    play_workload,
    read_peaks,
    recommend_sizes,
)
from mjstack.episodes.context import RunContext
from mjstack.errors import FaultError, MjstackError, Unreachable
from mjstack.gates import capacity as capacity_module
from mjstack.gates.batch import run_batch
from mjstack.gates.capacity import run_capacity
from mjstack.report.record import GateResult, Status
from mjstack.sim import BatchSizes, Overflow, Simulation, make_simulation, resolve_sizes
from mjstack.sim.sizes import apply_configured, resolve_env_sizes, resolve_measuring_sizes

Make = Callable[..., Simulation]
NewContext = Callable[..., RunContext]
KEPT = ("most_contacts", "most_constraints", "overflow_ever")


def peaks(rows: int = 100, contacts: int = 20, nworld: int = 4, **other: object) -> Peaks:
    facts = {
        "nworld": nworld,
        "contacts": np.full(nworld, contacts),
        "rows": np.full(nworld, rows),
        "overflow": np.zeros(nworld, dtype=np.int64),
        "pool_contacts": contacts * nworld,
    }
    return Peaks(**(facts | other))


def start(sim: Simulation, context: RunContext) -> None:
    context.start(sim, context.cfg.reset)


# Counters of the simulations


@pytest.mark.full
def test_peaks_survive_masked_resets(
    backend: str, make_sim: Make, stage: Callable[[str], RunContext]
) -> None:
    sim = make_sim(backend, 3)
    start(sim, stage("so101"))
    sim.step(10)
    sim.overflow[1] |= int(Overflow.CCD)
    before = {name: getattr(sim, name).clone() for name in KEPT}
    assert (before["most_contacts"] > 8).all()
    assert (before["most_constraints"] > 100).all()
    mask = torch.tensor([False, True, False], device=sim.device)
    sim.reset(mask)
    assert (
        sim.peak_contacts.tolist()[1]
        == sim.peak_constraints.tolist()[1]
        == sim.overflow.tolist()[1]
        == 0
    )
    for name in KEPT:
        assert torch.equal(getattr(sim, name), before[name]), name
    sim.step(1)  # at qpos0, with fewer contacts: the peak stays that of the first episode
    assert int(sim.peak_contacts[1]) < int(before["most_contacts"][1])
    sim.reset(~mask)
    for name in KEPT:
        assert torch.equal(getattr(sim, name), before[name]), name
    assert sim.overflow_ever.tolist() == [0, int(Overflow.CCD), 0]
    sim.reset()
    for name in KEPT:
        assert getattr(sim, name).tolist() == [0, 0, 0], name


@pytest.mark.full
def test_a_peak_after_a_reset_counts(
    backend: str, make_sim: Make, stage: Callable[[str], RunContext]
) -> None:
    sim = make_sim(backend, 2)
    sim.step(1)
    quiet = sim.most_constraints.clone()
    sim.reset(torch.tensor([True, False], device=sim.device))
    sim.ctrl.fill_(0.3)
    start(sim, stage("so101"))  # by masked resets
    sim.step(1)
    assert (sim.most_constraints > quiet).all()
    assert torch.equal(sim.most_constraints, torch.maximum(quiet, sim.peak_constraints))


@pytest.mark.full
def test_peaks_of_an_environment_outlive_its_episodes(backend: str) -> None:
    """Every world ends in every third step; the loop keeps what it sees before each reset."""
    cfg = load_config(["termination.time_out.params.steps=3", "seed=3"])
    kind = Backend.native if backend == "native" else Backend.mjwarp
    env = build_env(
        cfg, nworld=2, backend=kind, device="cuda:0" if backend == "mjwarp-cuda" else "cpu"
    )
    env.reset(seed=3)
    seen = torch.zeros(2, dtype=torch.int32, device=env.device)
    for _ in range(8):
        play_random_actions(env, 1)
        seen = torch.maximum(seen, env.sim.constraint_count)
    found = read_peaks(env.sim)
    assert env.episode.tolist() == [2, 2]
    assert (torch.from_numpy(found.rows) >= seen.cpu()).all()
    assert found.rows.max() >= int(env.sim.peak_constraints.max())
    assert found.contacts.min() > 0


# From peaks to sizes


def test_recommended_sizes_have_the_margin_in_multiples_of_eight() -> None:
    found = recommend_sizes(peaks(rows=144, contacts=27, nworld=16), 1.25, "here")
    assert (found.njmax, found.nconmax, found.nccdmax) == (184, 40, None)  # 180 and 33.75, up
    assert found.as_overrides() == "batch.nconmax=40 batch.njmax=184"
    assert found.source == "here"
    assert (
        recommend_sizes(peaks(rows=0, contacts=0), 1.0, "").as_overrides()
        == "batch.nconmax=8 batch.njmax=8"
    )


@pytest.mark.parametrize("margin", [1.0, 1.25, 2.0])
def test_recommended_pools_hold_what_was_seen(margin: float) -> None:
    for pool in range(1, 200, 7):
        seen = peaks(nworld=3, pool_contacts=pool, pool_pairs=2 * pool, pool_ccd_pairs=pool // 2)
        found = recommend_sizes(seen, margin, "")
        assert found.contact_pool(3) >= 2 * pool * margin
        assert found.convex_pool(3) >= pool // 2
        assert found.nccdmax is not None
        assert found.nccdmax <= found.nconmax
        assert max(8, 2 * pool * margin / 3 + 8) >= found.nconmax


def test_peaks_join() -> None:
    a = peaks(rows=10, contacts=9, pool_pairs=5, pool_ccd_pairs=1)
    b = peaks(rows=20, contacts=3, pool_pairs=50, overflow=np.array([0, 1, 0, 2]))
    both = join_peaks(a, b)
    assert (
        both.rows.max(),
        both.contacts.max(),
        both.pool,
        both.pool_pairs,
        both.pool_ccd_pairs,
    ) == (20, 9, 50, 50, None)
    assert both.overflow.tolist() == [0, 1, 0, 2]


def tried(
    monkeypatch: pytest.MonkeyPatch, lost: Callable[[BatchSizes], int]
) -> tuple[list[BatchSizes], Workload]:
    """The sizes that a workload is tried in, and its last run; some of them lose physics."""
    made: list[BatchSizes] = []

    def make(sizes: BatchSizes) -> SimpleNamespace:
        made.append(sizes)
        qpos = torch.zeros(4, 1)
        return SimpleNamespace(sizes=sizes, qpos=qpos, description="", close=lambda: None)

    def read(sim: SimpleNamespace) -> Peaks:
        return peaks(rows=7, overflow=np.array([0, lost(sim.sizes), 0, 0]))

    monkeypatch.setattr("mjstack.envs.buffers.read_peaks", read)
    return made, play_workload(load_config([]), make, lambda sim: np.zeros(4))


@pytest.mark.full
def test_room_to_measure_in_grows_where_it_is_too_little(monkeypatch: pytest.MonkeyPatch) -> None:
    made, run = tried(
        monkeypatch,
        lambda s: int(Overflow.NEFC) * (s.njmax < 2000) | int(Overflow.CCD) * (s.nconmax < 200),
    )
    assert [(s.njmax, s.nconmax) for s in made] == [(768, 128), (1536, 256), (3072, 256)]
    assert not run.peaks.overflow.any()
    assert run.sizes == made[-1]
    assert measured_sizes(load_config([]), "it", run, "").njmax == 16


@pytest.mark.full
def test_room_to_measure_in_does_not_grow_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    made, run = tried(monkeypatch, lambda _: int(Overflow.NEFC))
    assert run.peaks.overflow.any()
    assert len(made) == 4
    assert run.sizes == made[-1]


@pytest.mark.parametrize(
    ("bits", "fix"),
    [
        (Overflow.NEFC, "Set batch.njmax higher still."),
        (Overflow.NEFC | Overflow.BROADPHASE, "Set batch.njmax and batch.nconmax higher still."),
        (
            Overflow.CCD,
            "Set batch.nconmax higher still.",
        ),  # with nccdmax alone the room to measure in would not grow
        (Overflow.EPA_HORIZON, "Simplify the model, or run sim=native."),
    ],
)
def test_nothing_is_sized_from_motion_that_lost_physics(bits: Overflow, fix: str) -> None:
    lost = peaks(overflow=np.array([0, int(bits), 0, int(bits)]))
    run = workload(peaks=lost, sizes=BatchSizes(nconmax=128, njmax=768))
    with pytest.raises(FaultError) as caught:
        measured_sizes(load_config([]), "the driven task", run, "")
    says = str(caught.value)
    assert says.startswith("batch=auto: what the driven task needs cannot be measured: ")
    assert "overflow in 2 of 4 worlds (1, 3) even with batch.nconmax=128 batch.njmax=768. " in says
    assert says.endswith(fix)
    assert "\n" not in says


@pytest.mark.full
def test_what_is_set_wins() -> None:
    cfg = load_config(["batch=auto", "batch.njmax=500"])
    found = apply_configured(cfg, BatchSizes(nconmax=16, njmax=100, nccdmax=8, source="measured"))
    assert found == BatchSizes(nconmax=16, njmax=500, nccdmax=8)
    assert found.source == "measured"
    assert resolve_sizes(cfg).njmax == resolve_env_sizes(cfg).njmax == 500
    assert resolve_measuring_sizes(cfg).njmax == 768
    assert resolve_measuring_sizes(load_config(["batch.njmax=900"])).njmax == 900


@pytest.mark.full
@pytest.mark.parametrize(
    ("sizes", "nworld", "room"),
    [
        (BatchSizes(nconmax=16, njmax=8, nccdmax=40), 3, 48),
        (BatchSizes(nconmax=16, njmax=8, naccdmax=100), 3, 48),
        (BatchSizes(nconmax=16, njmax=8, naconmax=31, nccdmax=16), 3, 30),
        (BatchSizes(nconmax=16, njmax=8, naconmax=2, nccdmax=16), 3, 0),
        (BatchSizes(nconmax=16, njmax=8, naccdmax=5), 3, 5),
        (BatchSizes(nconmax=16, njmax=8), 3, 48),
    ],
)
def test_convex_room_is_within_the_pool(
    sizes: BatchSizes, nworld: int, room: int, stage: Callable[[str], RunContext]
) -> None:
    """MJWarp refuses more, and one world of parity has less than thousands."""
    sim = make_simulation(
        stage("so101").model,
        load_config([]),
        nworld,
        backend=Backend.mjwarp,
        device="cpu",
        sizes=sizes,
    )
    assert sim._d.naccdmax == sizes.convex_pool(nworld) == room  # type: ignore[attr-defined]


# Exactly at the peak fits, and less does not


@pytest.fixture(scope="module")
def first_steps(stage: Callable[[str], RunContext]) -> Iterator[Callable[[BatchSizes], Peaks]]:
    """The first steps of two MJWarp worlds, in which SO-101 needs the most rows."""
    context = stage("so101")

    def run(sizes: BatchSizes) -> Peaks:
        sim = make_simulation(
            context.model, context.cfg, 2, backend=Backend.mjwarp, device="cpu", sizes=sizes
        )
        env = context.start(sim, context.cfg.reset)
        controller = context.driver(env)
        for _ in range(3):
            env.step(controller.command())
        found = read_peaks(sim)
        sim.close()
        return found

    return run


def test_sizes_at_the_peak_are_enough_and_one_less_is_not(
    first_steps: Callable[[BatchSizes], Peaks],
) -> None:
    free = first_steps(BatchSizes(nconmax=128, njmax=300))
    assert not free.overflow.any()
    assert free.pool == free.pool_contacts >= (free.pool_pairs or 0) > 0
    rows = int(free.rows.max())
    exact = BatchSizes(nconmax=64, naconmax=free.pool, njmax=rows)
    at_peak = first_steps(exact)
    assert not at_peak.overflow.any()
    assert at_peak.rows.tolist() == free.rows.tolist()
    assert (first_steps(replace(exact, njmax=rows - 1)).overflow & int(Overflow.NEFC)).any()
    assert (
        first_steps(replace(exact, naconmax=free.pool - 1)).overflow & int(Overflow.NARROWPHASE)
    ).all()
    assert not first_steps(recommend_sizes(free, 1.0, "")).overflow.any()


# The gate


@pytest.fixture(scope="module")
def too_small(new_context: NewContext) -> tuple[RunContext, GateResult, list[str]]:
    """The gate on Warp's CPU device with too few rows, and what it said."""
    said: list[str] = []
    few = ("nworld=2", "gate.capacity.random_steps=20", *at_double_speed())
    context = new_context("sim=mjwarp", "sim.device=cpu", "batch.njmax=100", *few)
    context.print_line = said.append
    (result,) = run_capacity(context)
    return context, result, said


@pytest.mark.full
def test_too_small_is_found_and_the_printed_override_cures_it(
    too_small: tuple[RunContext, GateResult, list[str]], new_context: NewContext
) -> None:
    _, result, said = too_small
    assert result.status is Status.failed
    assert result.reason.startswith("njmax overflow in 2 of 2 worlds (0, 1); room for 100")
    task = next(line for line in said if line.startswith("driven task: "))
    overrides = task.removeprefix("driven task: ").split()
    assert f"batch.njmax={result.metrics['recommended.njmax']}" in overrides
    cured = new_context(
        "sim=mjwarp",
        "sim.device=cpu",
        "nworld=2",
        "batch.njmax=100",
        *overrides,
        *at_double_speed(),
    )
    # These are the sizes in which the gate played the task anew, successfully.
    assert resolve_sizes(cured.cfg).as_overrides() == result.notes["rerun.task.sizes"]
    assert result.metrics["rerun.task.overflow_worlds"] == 0
    assert result.metrics["rerun.task.succeeded"] == 2


@pytest.mark.full
def test_sizes_were_tried_with_the_same_outcome(
    too_small: tuple[RunContext, GateResult, list[str]],
) -> None:
    m = too_small[1].metrics
    assert m["rerun.task.overflow_worlds"] == m["rerun.random_actions.overflow_worlds"] == 0
    assert m["rerun.randomized.overflow_worlds"] == 0
    assert m["rerun.task.succeeded"] == 2
    assert m["rerun.task.flipped_worlds"] == m["rerun.randomized.flipped_worlds"] == 0
    assert all(
        m[f"rerun.{name}.same_final_state"] is True
        for name in ("task", "random_actions", "randomized")
    )
    notes = too_small[1].notes
    assert notes["rerun.randomized.sizes"] == notes["rerun.random_actions.sizes"]
    assert notes["rerun.task.sizes"].startswith(
        f"batch.nconmax={m['recommended.nconmax']} batch.njmax={m['recommended.njmax']}"
    )
    assert m["rerun.task.peak_constraint_rows_per_world"] == m["peak_constraint_rows_per_world"]
    assert m["recommended.naconmax"] == 2 * m["recommended.nconmax"]
    for prefix in ("", "random_actions.", "randomized."):
        assert m[f"{prefix}pool_contacts"] > 0
        assert m[f"{prefix}pool_pairs"] > 0
    needed = max(
        m[f"{prefix}peak_constraint_rows_per_world"]
        for prefix in ("random_actions.", "randomized.")
    )
    assert m["recommended_env.njmax"] >= 1.25 * needed


@pytest.mark.full
def test_environments_with_too_few_rows_by_choice_are_a_remark(
    too_small: tuple[RunContext, GateResult, list[str]],
) -> None:
    _, result, _ = too_small
    assert "environments" not in result.reason
    assert any(
        line.startswith("environments: njmax overflow") and "batch.njmax=" in line
        for line in result.details
    )


@pytest.mark.full
def test_memory_is_that_of_the_arrays(
    too_small: tuple[RunContext, GateResult, list[str]], stage: Callable[[str], RunContext]
) -> None:
    from mjstack.sim.usage import array_bytes, data_bytes

    context, result, _ = too_small
    m = result.metrics
    model = stage("so101").model
    wanted = BatchSizes(**{key: m[f"recommended.{key}"] for key in ("nconmax", "njmax", "nccdmax")})
    for which, sizes in (("current", resolve_sizes(context.cfg)), ("recommended", wanted)):
        assert m[f"memory.task.{which}_mb"] == pytest.approx(data_bytes(model, 2, sizes) / 1e6)
    for sizes in (
        BatchSizes(nconmax=40, njmax=184),
        BatchSizes(nconmax=24, njmax=77, naconmax=101, nccdmax=8),
    ):
        for nworld in (1, 5):
            sim = make_simulation(
                model, context.cfg, nworld, backend=Backend.mjwarp, device="cpu", sizes=sizes
            )
            assert data_bytes(model, nworld, sizes) == array_bytes(sim._d)  # type: ignore[attr-defined]


@pytest.mark.full
def test_defaults_too_small_for_environments_fail(new_context: NewContext) -> None:
    context = new_context(
        "sim=native",
        "nworld=2",
        "gate.capacity.random_steps=40",
        "robot.placements.stack.env_njmax=60",
        *one_second_episode(),
    )
    (result,) = run_capacity(context)
    assert result.status is Status.failed
    assert "environments: njmax overflow in 2 of 2 worlds" in result.reason


@pytest.mark.full
def test_native_says_what_it_cannot_know(new_context: NewContext) -> None:
    said: list[str] = []
    context = new_context(
        "sim=native", "nworld=2", "gate.capacity.random_steps=5", *one_second_episode()
    )
    context.print_line = said.append
    (result,) = run_capacity(context)
    assert result.status is Status.passed
    assert "native MuJoCo has no fixed buffers" in result.notes["rerun"]
    assert not {"pool_pairs", "pool_ccd_pairs"} & result.metrics.keys()
    assert not [name for name in result.metrics if name.startswith(("rerun.", "memory."))]
    assert any("does not count the collision pairs" in line for line in said)


@pytest.mark.full
def test_a_layout_out_of_reach_leaves_the_other_workloads(
    new_context: NewContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    context = new_context(
        "sim=native", "nworld=1", "gate.capacity.random_steps=5", *one_second_episode()
    )
    play = RunContext.play_task

    def unreachable(context: RunContext, reset: dict) -> Workload:
        if reset is context.cfg.gate.capacity.reset:
            raise Unreachable(0, "grasp_red", "red", (0.9, 0.0, 0.0), 0.3, 5e-4)
        return play(context, reset)

    monkeypatch.setattr(RunContext, "play_task", unreachable)
    (result,) = run_capacity(context)
    assert result.status is Status.passed
    assert any(
        line.startswith("randomised starts: not measured: world 0") for line in result.details
    )
    assert "randomized.pool_contacts" not in result.metrics


def workload(**changes: object) -> Workload:
    facts = {
        "peaks": peaks(nworld=2),
        "sizes": BatchSizes(nconmax=128, njmax=300),
        "final": np.zeros((2, 3)),
        "failed": np.zeros(2, dtype=np.int64),
        "description": "",
    }
    return Workload(**(facts | changes))


@pytest.mark.parametrize(
    ("again", "on_cpu", "on_cuda"),
    [
        ({}, "", ""),
        (
            {"final": np.array([[0.0, 0.0, 0.0], [0.0, 1e-6, 0.0]])},
            "another final state in 1 of 2 worlds (1)",
            "",
        ),
        ({"failed": np.array([4, 0])}, "another result in 1 of 2 worlds (0)", ""),
        (
            {"peaks": peaks(nworld=2, overflow=np.array([0, 1]))},
            *["overflow in 1 of 2 worlds (1)"] * 2,
        ),
    ],
)
def test_a_second_run_that_differs(again: dict, on_cpu: str, on_cuda: str) -> None:
    for exact, says in ((True, on_cpu), (False, on_cuda)):
        result = GateResult(name="capacity", status=Status.passed)
        problem = capacity_module._compare(
            "task", workload(), workload(**again), result, exact=exact
        )
        assert bool(problem) is bool(says)
        assert says in problem
        flipped = int("failed" in again)
        assert result.metrics["rerun.task.flipped_worlds"] == flipped
        assert bool(result.details) is bool(flipped and not exact)
        told = problem + "".join(result.details)
        assert flipped == 0 or "another result in 1 of 2 worlds (0)" in told


@pytest.mark.full
@pytest.mark.parametrize("device", ["cpu", "cuda:0"])
def test_each_workload_is_played_again_and_a_flip_fails_where_runs_repeat(
    device: str, new_context: NewContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    context = new_context("sim=mjwarp", "sim.device=cpu", "nworld=2")
    context.backend = (Backend.mjwarp, device)  # the runs are made up: no device is used
    played: list[tuple[str, BatchSizes]] = []
    other = context.cfg.gate.capacity.reset

    starts = {"randomized": peaks(rows=200, nworld=2), "task": peaks(rows=100, nworld=2)}

    def play_task(context: RunContext, reset: dict, sizes: BatchSizes | None = None) -> Workload:
        name = "randomized" if reset is other else "task"
        if sizes is None:
            return workload(peaks=starts[name])
        played.append((name, sizes))
        return workload(sizes=sizes, failed=np.array([0, 4 if reset is other else 0]))

    def play_random(context: RunContext, sizes: BatchSizes | None = None) -> Workload:
        if sizes is None:
            return workload()
        played.append(("random_actions", sizes))
        return workload(sizes=sizes)

    monkeypatch.setattr(RunContext, "play_task", play_task)
    monkeypatch.setattr(capacity_module, "play_random", play_random)
    (result,) = run_capacity(context)
    assert {name: sizes.njmax for name, sizes in played} == {
        "randomized": 256,
        "random_actions": 256,
        "task": 128,
    }
    assert {sizes for name, sizes in played if name != "task"} == {context.artifacts.env_sizes}
    flip = "randomized at batch.nconmax=32 batch.njmax=256: another result in 1 of 2 worlds (1)"
    assert result.metrics["rerun.randomized.flipped_worlds"] == 1
    if device == "cpu":
        assert (result.status, result.reason) == (Status.failed, flip)
    else:
        assert result.status is Status.passed
        assert f"{flip}: on CUDA sums have no fixed order" in result.details


@pytest.mark.full
def test_the_gate_recommends_nothing_from_motion_that_lost_physics(
    new_context: NewContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    context = new_context("sim=mjwarp", "sim.device=cpu", "nworld=2", "batch=auto")
    context.print_line = said.append
    lost = workload(peaks=peaks(nworld=2, overflow=np.array([0, int(Overflow.NEFC)])))
    monkeypatch.setattr(RunContext, "play_task", lambda *_: workload())

    def play_random(context: RunContext, *sizes: BatchSizes) -> Workload:
        assert not sizes, "tried sizes that are not known"
        return lost

    monkeypatch.setattr(capacity_module, "play_random", play_random)
    (result,) = run_capacity(context)
    assert result.status is Status.failed
    assert result.reason.startswith(
        "environments: NEFC overflow in 1 of 2 worlds (1) even with batch.nconmax=128"
    )
    assert context.artifacts.sizes is not None
    assert context.artifacts.env_sizes is None
    assert said[1].endswith("not known, physics was lost")
    assert "recommended.njmax" in result.metrics
    assert "recommended_env.njmax" not in result.metrics
    assert "rerun.randomized.sizes" not in result.notes


@pytest.mark.full
def test_convex_pairs_and_whole_pools_are_held_against_their_keys() -> None:
    cfg = load_config(["nworld=4", "batch.naconmax=60", "batch.naccdmax=12"])
    seen = peaks(nworld=4, contacts=20, pool_ccd_pairs=40)
    wanted = recommend_sizes(seen, 1.25, "")
    group = capacity_module._Group(
        name="task",
        title="",
        runs={},
        peaks=seen,
        sizes=resolve_sizes(cfg),
        wanted=wanted,
        lost="",
    )
    found = [text for _, text in capacity_module._shortages(cfg, group)]
    assert any("contact pool overflow" in text and "batch.naconmax=128" in text for text in found)
    assert any("convex pairs overflow" in text and "batch.naccdmax=64" in text for text in found)
    pasted = capacity_module._overrides(cfg, wanted)
    group.sizes = resolve_sizes(load_config(["nworld=4", *pasted.split()]))
    assert capacity_module._shortages(cfg, group) == []


# batch=auto


@pytest.mark.full
def test_environment_is_sized_by_a_probe() -> None:
    overrides = ["batch=auto", "sim=mjwarp", "gate.capacity.probe_steps=4"]
    env = mjstack.make_env([*overrides], nworld=2, device="cpu")
    sizes = env.sim.sizes
    assert sizes.source == "batch=auto: 4 steps of random actions in 2 worlds, times 1.25"
    env.reset(seed=0)
    play_random_actions(env, 4)
    used = read_peaks(env.sim)
    assert not used.overflow.any()
    assert used.rows.max() <= sizes.njmax < resolve_env_sizes(env.cfg).njmax
    assert sizes.njmax == recommend_sizes(used, 1.25, "").njmax
    chosen = mjstack.make_env(
        [*overrides, "batch.njmax=400", "gate.capacity.probe_steps=1"], nworld=1, device="cpu"
    )
    assert chosen.sim.sizes.njmax == 400
    assert chosen.sim.sizes.nconmax < 128


@pytest.mark.full
def test_a_probe_that_lost_physics_makes_no_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    small = BatchSizes(nconmax=128, njmax=4)  # and 32 after the last growth
    monkeypatch.setattr("mjstack.envs.buffers.resolve_measuring_sizes", lambda _: small)
    made: list[weakref.ref[Env]] = []

    def keep(*args: object, **kwargs: object) -> Env:
        env = Env(*args, **kwargs)  # type: ignore[arg-type]
        assert not [ref for ref in made if ref() is not None], (
            "the worlds of the run before are still there"
        )
        made.append(weakref.ref(env))
        return env

    monkeypatch.setattr("mjstack.envs.buffers.Env", keep)
    overrides = ["batch=auto", "sim=mjwarp", "gate.capacity.probe_steps=1"]
    with pytest.raises(
        FaultError,
        match=(
            r"^batch=auto: what an environment of 1 worlds needs .*Set batch\.njmax higher still\.$"
        ),
    ):
        mjstack.make_env(overrides, nworld=1, device="cpu")
    assert len(made) == 4
    assert not [ref for ref in made if ref() is not None]


@pytest.mark.full
def test_gates_get_no_sizes_from_a_task_that_lost_physics(
    new_context: NewContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    lost = workload(peaks=peaks(nworld=2, overflow=np.array([int(Overflow.NEFC), 0])))
    monkeypatch.setattr(RunContext, "play_task", lambda *_: lost)
    context = new_context("sim=mjwarp", "sim.device=cpu", "nworld=2", "batch=auto")
    with pytest.raises(
        FaultError,
        match="what the driven task needs cannot be measured: NEFC overflow in 1 of 2 worlds",
    ):
        context.sizes  # noqa: B018
    assert context.artifacts.sizes is None


@pytest.mark.full
def test_native_environment_measures_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mjstack.envs.buffers.play_workload", lambda *_: pytest.fail("measured"))
    mjstack.make_env(["batch=auto", "sim=native"], nworld=1).reset(seed=0)


@pytest.mark.full
def test_batch_uses_what_capacity_measured(new_context: NewContext) -> None:
    context = new_context(
        "sim=mjwarp", "sim.device=cpu", "nworld=2", "batch=auto", "batch.nconmax=48"
    )
    context.artifacts.sizes = BatchSizes(nconmax=40, njmax=184, source="batch=auto: somewhere")
    sim = context.batch_simulation(2)
    assert sim.sizes == BatchSizes(nconmax=48, njmax=184)  # type: ignore[attr-defined]
    assert make_simulation(
        context.model, context.cfg, 1, backend=Backend.mjwarp
    ).sizes == BatchSizes(nconmax=48, njmax=300)  # type: ignore[attr-defined]
    assert context.env_sizes is None
    context.artifacts.env_sizes = BatchSizes(nconmax=64, njmax=400)
    assert context.env_sizes == BatchSizes(nconmax=48, njmax=400)
    plain = new_context("sim=mjwarp", "sim.device=cpu", "nworld=2")
    plain.artifacts.sizes = plain.artifacts.env_sizes = BatchSizes(nconmax=8, njmax=8)
    assert (plain.sizes, plain.env_sizes) == (BatchSizes(nconmax=128, njmax=300), None)


@pytest.mark.full
def test_batch_measures_where_capacity_does_not_run(new_context: NewContext) -> None:
    said: list[str] = []
    context = new_context(
        "sim=mjwarp",
        "sim.device=cpu",
        "nworld=1",
        "batch=auto",
        "gates=[batch]",
        *at_double_speed(),
    )
    context.print_line = said.append
    (result,) = run_batch(context)
    assert result.status is Status.passed, result.reason
    assert (
        result.notes["sizes"]
        == "batch.nconmax=40 batch.njmax=184 batch.nccdmax=8 (batch=auto: the driven task in 1"
        " worlds, times 1.25)"
    )
    assert said == [result.notes["sizes"]]
    assert int(result.metrics["peak_constraint_rows_per_world"]) <= 184


BAD = [
    ("gate.capacity.margin=0.9", "gate.capacity.margin=0.9"),
    ("gate.capacity.margin=nan", "gate.capacity.margin=nan"),
    ("gate.capacity.margin=inf", "gate.capacity.margin=inf"),
    ("gate.capacity.random_steps=0", "gate.capacity.random_steps=0"),
    ("gate.capacity.probe_steps=0", "gate.capacity.probe_steps=0"),
    ("gate.capacity.probe_nworld=-1", "gate.capacity.probe_nworld=-1"),
    ("gate.capacity.cpu_nworld=0", "gate.capacity.cpu_nworld=0"),
    ("gate.capacity.reset.cubes.parms.yaw=1", "parms"),
    ("batch.auto=perhaps", "batch.auto"),
    ("batch=automatic", "Did you mean 'auto'?"),
]


@pytest.mark.full
@pytest.mark.parametrize(("override", "says"), BAD, ids=[override for override, _ in BAD])
def test_bad_values_give_one_line(override: str, says: str) -> None:
    with pytest.raises(MjstackError) as caught:
        load_config([override])
    assert caught.value.exit_code == 2
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")
def test_gate_on_cuda(new_context: NewContext) -> None:
    context = new_context("sim=mjwarp", "nworld=64", "batch=auto", "gate.capacity.random_steps=100")
    (result,) = run_capacity(context)
    assert result.status is Status.passed, result.reason
    m = result.metrics
    assert m["worlds"] == 64
    assert m["rerun.task.overflow_worlds"] == m["rerun.random_actions.overflow_worlds"] == 0
    assert m["rerun.randomized.overflow_worlds"] == 0
    assert "rerun.task.same_final_state" not in m
    assert context.batch_simulation(64).sizes.source.startswith(
        "batch=auto: gate capacity, 64 worlds"
    )  # type: ignore[attr-defined]
