"""Sizing the buffers: peaks that resets do not erase, sizes that are enough and not more, and who
uses them.
"""

import math
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from compositions import load_config
from environments import (
    GetStage,
    MakeSim,
    NewRun,
    Patch,
    at_double_speed,
    judge,
    on_backend,
    on_cuda,
    one_second_episode,
)

import mjstack
from mjstack.config.schema import Backend
from mjstack.envs import Env, build_env
from mjstack.envs.buffers import (
    SIZED,
    MeasuringWorlds,
    Peaks,
    join_peaks,
    measured_sizes,
    play_random_actions,
    read_peaks,
    recommend_sizes,
)
from mjstack.episodes.run import Run
from mjstack.episodes.stage import Progress, Stage
from mjstack.errors import FaultError, Unreachable
from mjstack.gates import capacity as capacity_module
from mjstack.gates.capacity import find_shortages, run_capacity
from mjstack.managers.episode import required_fields
from mjstack.report.record import GateResult, Status
from mjstack.sim import BatchSizes, Overflow, Simulation, make_simulation, resolve_sizes
from mjstack.sim.sizes import apply_configured, resolve_env_sizes, resolve_measuring_sizes


def peaks(
    rows: int = 100,
    contacts: int = 20,
    nworld: int = 4,
    overflow: np.ndarray | None = None,
    sizes: BatchSizes | None = None,
    **pools: int,
) -> Peaks:
    return Peaks(
        contacts=np.full(nworld, contacts),
        rows=np.full(nworld, rows),
        overflow=np.zeros(nworld, dtype=np.int64) if overflow is None else overflow,
        pools={"contacts": contacts * nworld} | pools,
        sizes=sizes,
        description="",
    )


def start(sim: Simulation, stage: Stage) -> None:
    stage.start(sim, stage.cfg.reset)


# Counters of the simulations


@pytest.mark.full
def test_peaks_survive_masked_resets(backend: str, make_sim: MakeSim, get_stage: GetStage) -> None:
    sim = make_sim(backend, 3)
    start(sim, get_stage("so101"))
    sim.step(10)
    sim.overflow[1] |= int(Overflow.CCD)
    before = torch.stack(sim.lasting_peaks())
    assert (before[0] > 8).all()
    assert (before[1] > 100).all()
    mask = torch.tensor([False, True, False], device=sim.device)
    sim.reset(mask)
    for counter in (sim.peak_contacts, sim.peak_constraints, sim.overflow):
        assert counter[1] == 0
    sim.step(1)  # at qpos0, with fewer contacts: the peak stays that of the first episode
    assert int(sim.peak_contacts[1]) < int(before[0, 1])
    for _ in range(2):
        assert torch.equal(torch.stack(sim.lasting_peaks()), before)
        sim.reset(~mask)
    assert before[2].tolist() == [0, int(Overflow.CCD), 0]
    sim.reset()
    assert not torch.stack(sim.lasting_peaks()).any()


@pytest.mark.full
def test_a_peak_after_a_reset_counts(backend: str, make_sim: MakeSim, get_stage: GetStage) -> None:
    sim = make_sim(backend, 2)
    sim.step(1)
    quiet = sim.lasting_peaks()[1]
    sim.reset(torch.tensor([True, False], device=sim.device))
    sim.ctrl.fill_(0.3)
    start(sim, get_stage("so101"))  # by masked resets
    sim.step(1)
    rows = sim.lasting_peaks()[1]
    assert (rows > quiet).all()
    assert torch.equal(rows, torch.maximum(quiet, sim.peak_constraints))


# From peaks to sizes


def test_recommended_sizes_have_the_margin_in_multiples_of_eight() -> None:
    found = recommend_sizes(peaks(rows=144, contacts=27, nworld=16), 1.25, "here")
    assert (found.njmax, found.nconmax, found.nccdmax) == (184, 40, None)  # 180 and 33.75, up
    assert found.as_overrides() == "batch.nconmax=40 batch.njmax=184"
    assert found.source == "here"
    least = recommend_sizes(peaks(rows=0, contacts=0), 1.0, "")
    assert least.as_overrides() == "batch.nconmax=8 batch.njmax=8"


@pytest.mark.parametrize("margin", [1.0, 1.25, 2.0])
def test_recommended_pools_hold_what_was_seen(margin: float) -> None:
    for pool in range(1, 200, 7):
        seen = peaks(contacts=pool, pairs=6 * pool, ccd_pairs=pool // 2, nworld=3)
        found = recommend_sizes(seen, margin, "")
        assert found.nconmax >= 2 * pool * margin
        assert 3 * found.as_kwargs()["nccdmax"] >= pool // 2
        assert found.nccdmax is not None
        assert found.nccdmax <= found.nconmax
        step = 8 if found.nconmax <= 256 else 64
        assert max(8, 2 * pool * margin + step) >= found.nconmax
        assert found.nconmax % step == 0


def test_peaks_join() -> None:
    a = peaks(rows=10, contacts=9, pairs=5, ccd_pairs=1)
    b = peaks(rows=20, contacts=3, pairs=50, ccd_pairs=0, overflow=np.array([0, 1, 0, 2]))
    both = join_peaks(a, b)
    assert (both.rows.max(), both.contacts.max()) == (20, 9)
    assert (both.share, both.convex_share) == (50 / 4, 1 / 4)
    assert both.overflow.tolist() == [0, 1, 0, 2]
    assert join_peaks(peaks(), peaks()).convex_share is None


def tried(
    monkeypatch: Patch, *losses: Callable[[BatchSizes], int], driven: Sequence[bool] = ()
) -> tuple[list[BatchSizes], list[Peaks]]:
    """The sizes of the worlds that some workloads are tried in, and the last run of each; they lose
    physics. By default none is driven.
    """
    made: list[BatchSizes] = []

    def make(*_: object, sizes: BatchSizes, **__: object) -> SimpleNamespace:
        made.append(sizes)
        facts = {"sizes": sizes, "fields": {}, "qpos": torch.zeros(4, 1), "description": ""}
        return SimpleNamespace(**facts, reset=lambda: None, close=lambda: None)

    lost = [0]

    def read(sim: SimpleNamespace) -> Peaks:
        return peaks(rows=7, overflow=np.array([0, lost[0], 0, 0]), sizes=sim.sizes)

    def workload(loss: Callable[[BatchSizes], int], sim: SimpleNamespace) -> None:
        lost[0] = loss(sim.sizes)

    monkeypatch.setattr("mjstack.envs.buffers.make_simulation", make)
    monkeypatch.setattr("mjstack.envs.buffers.gc.collect", lambda: 0)  # nothing is held, and a test
    # process has much to look through
    monkeypatch.setattr("mjstack.envs.buffers.read_peaks", read)
    worlds = MeasuringWorlds(load_config([]), None, 4, Backend.mjwarp, "cpu")  # type: ignore[arg-type]
    pairs = zip(losses, driven or [False] * len(losses), strict=True)
    runs = [worlds.play(partial(workload, loss), driven=task) for loss, task in pairs]  # type: ignore[arg-type]
    worlds.close()
    return made, runs


@pytest.mark.full
def test_room_to_measure_in_grows_where_it_is_too_little_but_not_for_ever(
    monkeypatch: Patch,
) -> None:
    made, (run,) = tried(
        monkeypatch,
        lambda s: int(Overflow.NEFC) * (s.njmax < 2000) | int(Overflow.CCD) * (s.nconmax < 200),
    )
    assert [(s.njmax, s.nconmax) for s in made] == [(768, 128), (1536, 256), (3072, 256)]
    assert not run.overflow.any()
    assert run.sizes == made[-1]
    assert measured_sizes(load_config([]), run, "").njmax == 16
    made, (run,) = tried(monkeypatch, lambda _: int(Overflow.NEFC))
    assert run.overflow.any()
    assert len(made) == 4
    assert run.sizes == made[-1]


def test_workloads_share_worlds_and_the_room_that_one_of_them_needs(monkeypatch: Patch) -> None:
    def calm(_: BatchSizes) -> int:
        return 0

    def rows(sizes: BatchSizes) -> int:
        return int(Overflow.NEFC) * (sizes.njmax < 2000)

    def contacts(sizes: BatchSizes) -> int:
        return int(Overflow.NARROWPHASE) * (sizes.nconmax < 1000)

    made, runs = tried(monkeypatch, calm, calm, calm)
    assert len(made) == 1
    # As much of each as a workload gets alone, although that is five growths.
    made, runs = tried(monkeypatch, calm, rows, contacts, rows)
    sizes = [(768, 128), (1536, 128), (3072, 128), (3072, 256), (3072, 512), (3072, 1024)]
    assert [(s.njmax, s.nconmax) for s in made] == sizes
    assert [run.sizes for run in runs] == [made[0], made[2], made[5], made[5]]
    assert not any(run.overflow.any() for run in runs)
    # Two that lose physics in any room do not grow it further than one does.
    made, runs = tried(monkeypatch, *[lambda _: int(Overflow.NEFC)] * 2)
    assert [s.njmax for s in made] == [768, 1536, 3072, 6144]
    assert all(run.overflow.any() for run in runs)


def test_a_driven_workload_begins_with_less_room_and_gets_as_much(monkeypatch: Patch) -> None:
    def calm(_: BatchSizes) -> int:
        return 0

    def rows(sizes: BatchSizes) -> int:
        return int(Overflow.NEFC) * (sizes.njmax < 5000)

    def always(_: BatchSizes) -> int:
        return SIZED

    task, random = resolve_sizes(load_config([])), resolve_measuring_sizes(load_config([]))
    assert (task.njmax, task.nconmax, random.njmax, random.nconmax) == (300, 128, 768, 128)
    made, runs = tried(monkeypatch, calm, calm, calm, driven=(False, True, True))
    assert [(s.njmax, s.nconmax) for s in made] == [(768, 128), (300, 128)]
    assert [run.sizes for run in runs] == [made[0], made[1], made[1]]
    # Where it is too little, that of random actions is next
    made, runs = tried(monkeypatch, calm, rows, calm, driven=(False, True, True))
    assert [s.njmax for s in made] == [768, 300, 768, 1536, 3072, 6144]
    assert [run.sizes for run in runs] == [made[0], made[5], made[5]]
    for driven in (False, True):
        made, (run,) = tried(monkeypatch, always, driven=[driven])
        assert (made[-1].njmax, made[-1].nconmax) == (6144, 1024)
        assert run.overflow.any()


def test_a_workload_in_used_worlds_ends_as_in_new_ones(backend: str, new_run: NewRun) -> None:
    """Nothing of the workload before acts on: fields, state, counters. Fields that it does not need
    change nothing either.
    """
    where = on_backend(backend)
    run = new_run(f"sim={where['backend']}", f"sim.device={where['device']}", "nworld=2")
    stage = run.stage
    randomized = run.cfg.gate.capacity.reset

    def steps(sim: Simulation, reset: dict) -> None:
        env = stage.start(sim, reset)
        driver = stage.driver(env)
        for _ in range(20):
            env.step(driver.command())

    def wild(sim: Simulation) -> None:
        steps(sim, randomized)
        for name in ("body_mass", "geom_friction", "actuator_gainprm"):
            values = torch.from_numpy(getattr(sim.model, name)).to(sim.fields[name])
            assert not torch.equal(sim.fields[name][0], values)
        sim.overflow.fill_(int(Overflow.CCD))
        sim.qpos[1] = math.nan
        sim.step(2)

    def task(sim: Simulation) -> None:
        assert not torch.stack(sim.lasting_peaks()).any()
        for name, field in sim.fields.items():
            values = torch.from_numpy(getattr(sim.model, name)).to(field)
            assert torch.equal(field, values.expand_as(field)), name
        steps(sim, run.cfg.reset)
        ends.append(sim.qpos.cpu().numpy().tobytes())

    ends: list[bytes] = []

    def last(*workloads: Callable[[Simulation], None], resets: tuple = (), driven: int) -> Peaks:
        """Of the last one; so many of them are driven."""
        with closing(stage.measuring_worlds(*resets)) as worlds:
            first = len(workloads) - driven
            plays = [worlds.play(w, driven=n >= first) for n, w in enumerate(workloads)]
            return plays[-1]

    expected = last(task, driven=0)
    resets = (randomized,)
    many = [last(task, resets=resets, driven=1)]
    many += [last(wild, task, resets=resets, driven=driven) for driven in (1, 2)]
    for seen in many:
        assert not seen.overflow.any()
        if where["device"] != "cpu":  # sums have no fixed order
            continue
        for name in ("contacts", "rows"):
            assert getattr(seen, name).tolist() == getattr(expected, name).tolist()
        assert seen.pools == expected.pools
    assert len(ends) == 4
    assert where["device"] != "cpu" or len({*ends}) == 1


@pytest.mark.parametrize(
    ("bits", "fix"),
    [
        (Overflow.NEFC, "Set batch.njmax higher still."),
        (Overflow.NEFC | Overflow.BROADPHASE, "Set batch.njmax and batch.nconmax higher still."),
        # With nccdmax alone the room to measure in would not grow.
        (Overflow.CCD, "Set batch.nconmax higher still."),
        (Overflow.EPA_HORIZON, "Simplify the model, or run sim=native."),
    ],
)
def test_nothing_is_sized_from_motion_that_lost_physics(bits: Overflow, fix: str) -> None:
    lost = np.array([0, int(bits), 0, int(bits)])
    run = peaks(overflow=lost, sizes=BatchSizes(nconmax=128, njmax=768))
    with pytest.raises(FaultError) as caught:
        measured_sizes(load_config([]), run, "the driven task")
    says = str(caught.value)
    assert says.startswith("batch=auto: sizes cannot be measured by the driven task: ")
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
    # A driven task needs less, and its steps are faster in less
    robot = load_config([])
    assert resolve_measuring_sizes(robot, driven=True) == resolve_sizes(robot)
    for njmax, room in ((100, 300), (500, 500)):
        cfg = load_config([f"batch.njmax={njmax}"])
        assert resolve_measuring_sizes(cfg, driven=True).njmax == room


@pytest.mark.full
@pytest.mark.parametrize(("nccdmax", "room"), [(40, 16), (5, 5), (None, 16)])
def test_convex_room_is_within_the_pool(
    nccdmax: int | None, room: int, get_stage: GetStage
) -> None:
    """MJWarp refuses more, and one world of parity has less than thousands."""
    sizes = BatchSizes(nconmax=16, njmax=8, nccdmax=nccdmax)
    cfg = load_config([])
    model = get_stage("so101").model
    sim = make_simulation(model, cfg, 3, backend=Backend.mjwarp, device="cpu", sizes=sizes)
    assert sizes.as_kwargs()["nccdmax"] == room
    assert sim._d.naccdmax == 3 * room  # type: ignore[attr-defined]


# Exactly at the peak fits, and less does not


@pytest.fixture(scope="module")
def first_steps(get_stage: GetStage) -> Iterator[Callable[[BatchSizes], Peaks]]:
    """The first steps of two MJWarp worlds, in which SO-101 needs the most rows."""
    stage = get_stage("so101")

    def run(sizes: BatchSizes) -> Peaks:
        sim = make_simulation(
            stage.model, stage.cfg, 2, backend=Backend.mjwarp, device="cpu", sizes=sizes
        )
        env = stage.start(sim, stage.cfg.reset)
        controller = stage.driver(env)
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
    assert 2 * free.share == free.pools["contacts"] >= free.pools["pairs"] > 0
    rows = int(free.rows.max())
    exact = BatchSizes(nconmax=math.ceil(free.share), njmax=rows)
    at_peak = first_steps(exact)
    assert not at_peak.overflow.any()
    assert at_peak.rows.tolist() == free.rows.tolist()
    assert (first_steps(replace(exact, njmax=rows - 1)).overflow & int(Overflow.NEFC)).any()
    crowded = first_steps(replace(exact, nconmax=exact.nconmax - 1))
    assert (crowded.overflow & int(Overflow.NARROWPHASE)).all()
    assert not first_steps(recommend_sizes(free, 1.0, "")).overflow.any()


# The gate


def measure(new_run: NewRun, *overrides: str) -> tuple[Run, GateResult, list[str]]:
    """The gate's run, its result and the lines that it printed."""
    lines: list[str] = []
    run = new_run(*overrides)
    run.stage.progress = Progress(lines.append)
    (result,) = run_capacity(run)
    return run, result, lines


TOO_SMALL = ("sim=mjwarp", "sim.device=cpu", "nworld=2", "batch.njmax=100", *at_double_speed())
NATIVE = ("sim=native", *one_second_episode())


@pytest.fixture(scope="module")
def too_small(new_run: NewRun) -> tuple[Run, GateResult, list[str]]:
    """The gate on Warp's CPU device with too few rows."""
    return measure(new_run, *TOO_SMALL, "gate.capacity.random_steps=20")


@pytest.mark.full
def test_too_small_is_found_and_the_printed_override_cures_it(
    too_small: tuple[Run, GateResult, list[str]], new_run: NewRun
) -> None:
    _, result, lines = too_small
    assert result.status is Status.failed
    assert result.reason.startswith("njmax overflow in 2 of 2 worlds (0, 1); room for 100")
    task = next(line for line in lines if line.startswith("driven task: "))
    overrides = task.removeprefix("driven task: ").split()
    assert f"batch.njmax={result.metrics['recommended.njmax']}" in overrides
    batch = judge(new_run(*TOO_SMALL, *overrides))
    assert batch.status is Status.passed, batch.reason
    # Too few rows for environments are a remark, as they were set.
    assert "environments" not in result.reason
    remark = next(d for d in result.details if d.startswith("environments: njmax overflow"))
    assert "batch.njmax=" in remark


@pytest.mark.full
def test_worlds_of_the_recommended_sizes_have_the_same_peaks(
    too_small: tuple[Run, GateResult, list[str]],
) -> None:
    """Every workload once more, in exactly these sizes."""
    run, result, _ = too_small
    stage = run.stage
    other = run.cfg.gate.capacity.reset
    plays: dict[str, Callable[[Simulation], object]] = {
        "": lambda sim: stage.drive(sim, run.cfg.reset),
        "randomized.": lambda sim: stage.drive(sim, other),
        "random_actions.": partial(play_random_actions, run.cfg, 20),
    }
    for prefix, play in plays.items():
        sim = make_simulation(
            stage.model,
            run.cfg,
            2,
            backend=Backend.mjwarp,
            fields=required_fields(run.cfg.reset, other),
            sizes=run.stage.measured["env" if prefix else "task"],
        )
        play(sim)
        seen = read_peaks(sim)
        assert not seen.overflow.any()
        m = result.metrics
        assert m[f"{prefix}peak_constraint_rows_per_world"] == seen.rows.max()
        assert m[f"{prefix}peak_contacts_per_world"] == seen.contacts.max()
        for key, peak in seen.pools.items():
            assert m[f"{prefix}pool_{key}"] == peak
        assert min(seen.pools["contacts"], seen.pools["pairs"]) > 0


@pytest.mark.full
def test_memory_is_that_of_the_arrays(
    too_small: tuple[Run, GateResult, list[str]], get_stage: GetStage
) -> None:
    from mjstack.sim.usage import array_bytes, data_bytes

    run, result, _ = too_small
    m = result.metrics
    model = get_stage("so101").model
    wanted = BatchSizes(**{key: m[f"recommended.{key}"] for key in ("nconmax", "njmax", "nccdmax")})
    for which, sizes in (("current", resolve_sizes(run.cfg)), ("recommended", wanted)):
        assert m[f"memory.task.{which}_mb"] == pytest.approx(data_bytes(model, 2, sizes) / 1e6)
    for sizes in (BatchSizes(nconmax=40, njmax=184), BatchSizes(nconmax=24, njmax=77, nccdmax=8)):
        for nworld in (1, 5):
            worlds = {"backend": Backend.mjwarp, "device": "cpu", "sizes": sizes}
            sim = make_simulation(model, run.cfg, nworld, **worlds)
            assert data_bytes(model, nworld, sizes) == array_bytes(sim._d)


@pytest.mark.full
def test_defaults_too_small_for_environments_fail(new_run: NewRun) -> None:
    few = ("gate.capacity.random_steps=40", "robot.placements.stack.env_njmax=60")
    _, result, _ = measure(new_run, *NATIVE, "nworld=2", *few)
    assert result.status is Status.failed
    assert "environments: njmax overflow in 2 of 2 worlds" in result.reason


@pytest.mark.full
def test_native_tells_what_it_cannot_know_and_a_layout_out_of_reach_leaves_the_rest(
    new_run: NewRun, monkeypatch: Patch
) -> None:
    drive = Stage.drive

    def unreachable(stage: Stage, sim: Simulation, reset: dict) -> None:
        if reset is stage.cfg.gate.capacity.reset:
            raise Unreachable(0, "grasp_red", "red", (0.9, 0.0, 0.0), 0.3, 5e-4)
        drive(stage, sim, reset)

    monkeypatch.setattr(Stage, "drive", unreachable)
    _, result, lines = measure(new_run, *NATIVE, "nworld=1", "gate.capacity.random_steps=5")
    assert result.status is Status.passed
    assert any("randomised starts: not measured: world 0" in text for text in result.details)
    assert "randomized.pool_contacts" not in result.metrics
    assert not {"pool_pairs", "pool_ccd_pairs"} & result.metrics.keys()
    assert not [name for name in result.metrics if name.startswith("memory.")]
    assert any("does not count the pairs" in line for line in lines)


def workload(overflow: np.ndarray | None = None) -> Peaks:
    return peaks(nworld=2, overflow=overflow, sizes=BatchSizes(nconmax=128, njmax=300))


def made_up(monkeypatch: Patch, randomized: dict, play: Callable[[str], Peaks]) -> None:
    """Have workloads made up from their names, in the place of playing them."""

    class Worlds(MeasuringWorlds):
        def __init__(self, *_: object) -> None:
            pass

        def play(self, play_name: Callable, *, driven: bool = False) -> Peaks:
            name = play_name(None)
            assert driven == (name != "random_actions")
            return play(name)

        def close(self) -> None:
            pass

    def episode(stage: Stage, sim: None, reset: dict) -> str:
        return "randomized" if reset is randomized else "task"

    monkeypatch.setattr("mjstack.episodes.stage.MeasuringWorlds", Worlds)
    monkeypatch.setattr(Stage, "drive", episode)
    monkeypatch.setattr(capacity_module, "play_random_actions", lambda *_, **__: "random_actions")


@pytest.mark.parametrize(
    ("device", "choice", "steps"),
    [("cpu", (), 600), ("cuda:0", (), 200), ("cuda:0", ("gate.capacity.random_steps=700",), 700)],
)
def test_few_worlds_act_at_random_for_an_episode(
    device: str, choice: tuple[str, ...], steps: int, new_run: NewRun, monkeypatch: Patch
) -> None:
    run = new_run("sim=mjwarp", "sim.device=cpu", "nworld=2", *choice)
    run.stage.backend = (Backend.mjwarp, device)  # the runs are made up: no device is used
    made_up(monkeypatch, run.cfg.gate.capacity.reset, lambda *_: workload())
    played = []

    def act(cfg: Any, count: int, sim: None, **_: object) -> str:
        played.append(count)
        return "random_actions"

    monkeypatch.setattr(capacity_module, "play_random_actions", act)
    run_capacity(run)
    assert set(played) == {steps}


@pytest.mark.full
def test_the_gate_recommends_nothing_from_motion_that_lost_physics(
    new_run: NewRun, monkeypatch: Patch
) -> None:
    said: list[str] = []
    run = new_run("sim=mjwarp", "sim.device=cpu", "nworld=2", "batch=auto")
    run.stage.progress = Progress(said.append)
    lost = workload(overflow=np.array([0, int(Overflow.NEFC)]))

    def play(name: str) -> Peaks:
        return lost if name == "random_actions" else workload()

    made_up(monkeypatch, run.cfg.gate.capacity.reset, play)
    (result,) = run_capacity(run)
    assert result.status is Status.failed
    assert result.reason.startswith(
        "environments: NEFC overflow in 1 of 2 worlds (1) even with batch.nconmax=128"
    )
    assert "task" in run.stage.measured
    assert "env" not in run.stage.measured
    assert said[1].endswith("not known, physics was lost")
    assert "recommended.njmax" in result.metrics
    assert "recommended_env.njmax" not in result.metrics


@pytest.mark.full
def test_contacts_and_convex_pairs_are_held_against_their_keys() -> None:
    cfg = load_config(["nworld=4", "batch.nconmax=15", "batch.nccdmax=3"])
    seen = peaks(nworld=4, contacts=20, ccd_pairs=40)
    wanted = recommend_sizes(seen, 1.25, "")
    texts = find_shortages(seen, resolve_sizes(cfg), wanted)
    assert "contact pool overflow" in texts["nconmax"]
    assert "batch.nconmax=32" in texts["nconmax"]
    assert "convex pairs overflow" in texts["nccdmax"]
    assert "batch.nccdmax=16" in texts["nccdmax"]
    pasted = load_config(["nworld=4", *wanted.as_overrides().split()])
    assert find_shortages(seen, resolve_sizes(pasted), wanted) == {}


# batch=auto


@pytest.mark.full
def test_environment_is_sized_by_a_probe() -> None:
    overrides = ["batch=auto", "sim=mjwarp", "gate.capacity.probe_steps=4"]
    env = mjstack.make_env([*overrides], nworld=2, device="cpu")
    sizes = env.sim.sizes
    assert sizes.source == "batch=auto: 4 steps of random actions in 2 worlds, times 1.25"
    play_random_actions(env.cfg, 4, env.sim)
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
def test_a_probe_that_lost_physics_makes_no_environment(monkeypatch: Patch) -> None:
    small = BatchSizes(nconmax=128, njmax=4)  # and 32 after the last growth
    monkeypatch.setattr(
        "mjstack.envs.buffers.resolve_measuring_sizes", lambda _, driven=False: small
    )
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
    message = r"^batch=auto: sizes cannot be measured by 1 steps .*Set batch\.njmax higher still\.$"
    with pytest.raises(FaultError, match=message):
        mjstack.make_env(overrides, nworld=1, device="cpu")
    assert len(made) == 4
    assert not [ref for ref in made if ref() is not None]


@pytest.mark.full
def test_gates_get_no_sizes_from_a_task_that_lost_physics(
    new_run: NewRun, monkeypatch: Patch
) -> None:
    lost = workload(overflow=np.array([int(Overflow.NEFC), 0]))
    made_up(monkeypatch, {}, lambda *_: lost)
    run = new_run("sim=mjwarp", "sim.device=cpu", "nworld=2", "batch=auto")
    message = "measured by the driven task in 2 worlds: NEFC overflow in 1 of 2 worlds"
    with pytest.raises(FaultError, match=message):
        run.stage.sizes  # noqa: B018
    assert "task" not in run.stage.measured


@pytest.mark.full
def test_native_environment_measures_nothing(monkeypatch: Patch) -> None:
    monkeypatch.setattr(MeasuringWorlds, "play", lambda *_: pytest.fail("measured"))
    mjstack.make_env(["batch=auto", "sim=native"], nworld=1).reset(seed=0)


@pytest.mark.full
def test_batch_uses_what_capacity_measured(new_run: NewRun) -> None:
    run = new_run("sim=mjwarp", "sim.device=cpu", "nworld=2", "batch=auto", "batch.nconmax=48")
    run.stage.measured["task"] = BatchSizes(nconmax=40, njmax=184, source="batch=auto: somewhere")
    sim = run.stage.batch_simulation(2)
    assert sim.sizes == BatchSizes(nconmax=48, njmax=184)  # type: ignore[attr-defined]
    other = make_simulation(run.stage.model, run.cfg, 1, backend=Backend.mjwarp)
    assert other.sizes == BatchSizes(nconmax=48, njmax=300)
    assert run.stage.env_sizes is None
    run.stage.measured["env"] = BatchSizes(nconmax=64, njmax=400)
    assert run.stage.env_sizes == BatchSizes(nconmax=48, njmax=400)
    plain = new_run("sim=mjwarp", "sim.device=cpu", "nworld=2")
    plain.stage.measured |= dict.fromkeys(("task", "env"), BatchSizes(nconmax=8, njmax=8))
    assert (plain.stage.sizes, plain.stage.env_sizes) == (BatchSizes(nconmax=128, njmax=300), None)


@pytest.mark.full
def test_batch_measures_where_capacity_does_not_run(new_run: NewRun) -> None:
    said: list[str] = []
    auto = ("sim=mjwarp", "sim.device=cpu", "nworld=1", "batch=auto", "gates=[batch]")
    run = new_run(*auto, *at_double_speed())
    run.stage.progress = Progress(said.append)
    result = judge(run)
    assert result.status is Status.passed, result.reason
    sizes = "batch.nconmax=40 batch.njmax=184 batch.nccdmax=8"
    text = f"{sizes} (batch=auto: the driven task in 1 worlds, times 1.25)"
    assert said == [result.notes["sizes"]] == [text]
    assert result.reason.startswith(
        "1 of 1 episodes succeeded (100 %, 95 % interval 20.65 to 100 %)"
    )
    metrics = result.metrics
    assert metrics["world_steps_per_s"] == pytest.approx(3000 / metrics["episode_s"])
    assert int(metrics["peak_constraint_rows_per_world"]) <= 184


@on_cuda
def test_gate_on_cuda(new_run: NewRun) -> None:
    run = new_run("sim=mjwarp", "nworld=64", "batch=auto", "gate.capacity.random_steps=100")
    (result,) = run_capacity(run)
    assert result.status is Status.passed, result.reason
    m = result.metrics
    assert m["worlds"] == 64
    sizes = run.stage.sizes
    assert sizes.source.startswith("batch=auto: gate capacity, 64 worlds")
    batch = judge(run)
    assert batch.status is Status.passed, batch.reason
    env = build_env(run.cfg, model=run.stage.model, sizes=run.stage.env_sizes)
    play_random_actions(run.cfg, 100, env.sim)
    assert not read_peaks(env.sim).overflow.any()
