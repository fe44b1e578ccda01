"""Sizing the buffers: peaks that resets do not erase, sizes that are enough and not more, and who
uses them.
"""

import math
import weakref
from collections.abc import Callable, Iterator
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
    on_cuda,
    one_second_episode,
)

import mjstack
from mjstack.config.schema import Backend
from mjstack.envs import Env, build_env
from mjstack.envs.buffers import (
    SIZED,
    Peaks,
    join_peaks,
    measure_peaks,
    measured_sizes,
    play_random_actions,
    read_peaks,
    recommend_sizes,
)
from mjstack.episodes.run import Run
from mjstack.episodes.stage import Progress, Stage
from mjstack.errors import FaultError, Unreachable
from mjstack.gates.capacity import find_shortages, run_capacity
from mjstack.managers.episode import required_fields
from mjstack.report.record import GateResult, Status
from mjstack.sim import BatchSizes, Overflow, Simulation, make_simulation, resolve_sizes
from mjstack.sim.sizes import apply_configured


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
    assert both.needs == {"njmax": 20, "nconmax": 50 / 4, "nccdmax": 1 / 4}
    assert both.overflow.tolist() == [0, 1, 0, 2]
    assert "nccdmax" not in join_peaks(peaks(), peaks()).needs


def tried(
    monkeypatch: Patch, loss: Callable[[BatchSizes], int], *overrides: str, driven: bool = False
) -> tuple[list[tuple[int, int]], Peaks]:
    """njmax and nconmax of the worlds that a workload is tried in, which loses physics, and the
    peaks of the last ones.
    """
    made: list[tuple[int, int]] = []

    def make(*_: object, sizes: BatchSizes, **__: object) -> SimpleNamespace:
        made.append((sizes.njmax, sizes.nconmax))
        return SimpleNamespace(sizes=sizes, close=lambda: None)

    def read(sim: SimpleNamespace) -> Peaks:
        return peaks(rows=7, overflow=np.array([0, loss(sim.sizes), 0, 0]), sizes=sim.sizes)

    monkeypatch.setattr("mjstack.envs.buffers.make_simulation", make)
    monkeypatch.setattr("mjstack.envs.buffers.gc.collect", lambda: 0)  # a test has much to look at
    monkeypatch.setattr("mjstack.envs.buffers.read_peaks", read)
    monkeypatch.setattr("mjstack.envs.buffers.play_random_actions", lambda *_, **__: None)
    drive = (lambda sim: None) if driven else None
    worlds = (load_config([*overrides]), None, 4, Backend.mjwarp, "cpu")
    return made, measure_peaks(*worlds, drive=drive)  # type: ignore[arg-type]


def test_room_to_measure_in_grows_where_it_is_too_little_but_not_for_ever(
    monkeypatch: Patch,
) -> None:
    made, run = tried(
        monkeypatch,
        lambda s: int(Overflow.NEFC) * (s.njmax < 2000) | int(Overflow.CCD) * (s.nconmax < 200),
    )
    assert made == [(768, 128), (1536, 256), (3072, 256)]
    assert not run.overflow.any()
    assert run.sizes is not None
    assert run.sizes.njmax == 3072
    assert measured_sizes(load_config([]), run, "").njmax == 16
    made, run = tried(monkeypatch, lambda _: SIZED)
    assert made[-2:] == [(3072, 512), (6144, 1024)]
    assert run.overflow.any()
    # A driven task needs less, its steps are faster in less, and it may grow as far
    calm = partial(tried, monkeypatch, lambda _: 0)
    assert calm(driven=True)[0] == [(300, 128)]
    assert tried(monkeypatch, lambda _: SIZED, driven=True)[0][-1] == (6144, 1024)
    # Room that is set counts where it is more
    assert [calm(f"batch.njmax={rows}")[0] for rows in (500, 900)] == [[(768, 128)], [(900, 128)]]
    assert calm("batch.njmax=500", driven=True)[0] == [(500, 128)]


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
    assert resolve_sizes(cfg).njmax == resolve_sizes(cfg, driven=False).njmax == 500


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
    share = free.needs["nconmax"]
    assert 2 * share == free.pools["contacts"] >= free.pools["pairs"] > 0
    rows = int(free.rows.max())
    exact = BatchSizes(nconmax=math.ceil(share), njmax=rows)
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


def recommended(result: GateResult, prefix: str) -> BatchSizes:
    keys = ("nconmax", "njmax", "nccdmax")
    return BatchSizes(**{key: int(result.metrics[f"{prefix}.{key}"]) for key in keys})


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
    other = stage.with_config(replace(run.cfg, reset=run.cfg.gate.success.reset))
    plays: dict[str, Callable[[Simulation], object]] = {
        "": stage.drive,
        "randomized.": other.drive,
        "random_actions.": partial(play_random_actions, run.cfg, 20),
    }
    m = result.metrics
    for prefix, play in plays.items():
        sim = make_simulation(
            stage.model,
            run.cfg,
            2,
            backend=Backend.mjwarp,
            fields=required_fields(run.cfg.reset, other.cfg.reset),
            sizes=recommended(result, "recommended_env" if prefix else "recommended"),
        )
        play(sim)
        seen = read_peaks(sim)
        assert not seen.overflow.any()
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
    wanted = recommended(result, "recommended")
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

    def unreachable(stage: Stage, sim: Simulation) -> None:
        if stage.cfg.reset is stage.cfg.gate.success.reset:
            raise Unreachable(0, "grasp_red", "red", (0.9, 0.0, 0.0), 0.3, 5e-4)
        drive(stage, sim)

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


def made_up(monkeypatch: Patch, play: Callable[[bool], Peaks]) -> None:
    """Have peaks made up, for the driven task or for random actions, instead of measured."""
    monkeypatch.setattr(Stage, "measure", lambda stage, *, driven=True: play(driven))


@pytest.mark.parametrize(
    ("device", "choice", "steps"),
    [("cpu", (), 600), ("cuda:0", (), 200), ("cuda:0", ("gate.capacity.random_steps=700",), 700)],
)
def test_few_worlds_act_at_random_for_an_episode(
    device: str, choice: tuple[str, ...], steps: int, monkeypatch: Patch
) -> None:
    made = []

    def make(*args: Any, **_: object) -> SimpleNamespace:
        made.append(args[2])
        return SimpleNamespace(close=lambda: None)

    played = []
    monkeypatch.setattr("mjstack.envs.buffers.make_simulation", make)
    monkeypatch.setattr("mjstack.envs.buffers.read_peaks", lambda _: workload())
    monkeypatch.setattr(
        "mjstack.envs.buffers.play_random_actions",
        lambda cfg, count, *_, **__: played.append(count),
    )
    measure_peaks(load_config([*choice]), None, 4096, Backend.mjwarp, device)  # type: ignore[arg-type]
    assert played == [steps]
    assert made == [8 if device == "cpu" else 4096]


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
    overrides = ["batch=auto", "sim=mjwarp", "gate.capacity.random_steps=4"]
    env = mjstack.make_env([*overrides], nworld=2, device="cpu")
    sizes = env.sim.sizes
    assert sizes.source == "batch=auto: random actions in 2 worlds, times 1.25"
    play_random_actions(env.cfg, 4, env.sim)
    used = read_peaks(env.sim)
    assert not used.overflow.any()
    assert used.rows.max() <= sizes.njmax < resolve_sizes(env.cfg, driven=False).njmax
    assert sizes.njmax == recommend_sizes(used, 1.25, "").njmax
    chosen = mjstack.make_env(
        [*overrides, "batch.njmax=400", "gate.capacity.random_steps=1"], nworld=1, device="cpu"
    )
    assert chosen.sim.sizes.njmax == 400
    assert chosen.sim.sizes.nconmax < 128


@pytest.mark.full
def test_a_probe_that_lost_physics_makes_no_environment(monkeypatch: Patch) -> None:
    small = BatchSizes(nconmax=128, njmax=4)  # and 32 after the last growth
    monkeypatch.setattr("mjstack.envs.buffers.robot_sizes", lambda _, driven: small)
    made: list[weakref.ref[Env]] = []

    def keep(*args: object, **kwargs: object) -> Env:
        env = Env(*args, **kwargs)  # type: ignore[arg-type]
        assert not [ref for ref in made if ref() is not None], (
            "the worlds of the run before are still there"
        )
        made.append(weakref.ref(env))
        return env

    monkeypatch.setattr("mjstack.envs.buffers.Env", keep)
    overrides = ["batch=auto", "sim=mjwarp", "gate.capacity.random_steps=1"]
    message = r"^batch=auto: sizes cannot be measured by random .*Set batch\.njmax higher still\.$"
    with pytest.raises(FaultError, match=message):
        mjstack.make_env(overrides, nworld=1, device="cpu")
    assert len(made) == 4
    assert not [ref for ref in made if ref() is not None]


@pytest.mark.full
def test_native_environment_measures_nothing(monkeypatch: Patch) -> None:
    monkeypatch.setattr("mjstack.envs.build.measure_peaks", lambda *_: pytest.fail("measured"))
    mjstack.make_env(["batch=auto", "sim=native"], nworld=1).reset(seed=0)


@pytest.mark.full
def test_batch_uses_what_capacity_measured(new_run: NewRun, monkeypatch: Patch) -> None:
    made_up(monkeypatch, lambda driven: peaks(rows=140 if driven else 300, nworld=2))
    auto = ("batch=auto", "batch.nconmax=48")
    runs = [new_run("sim=mjwarp", "sim.device=cpu", "nworld=2", *keys) for keys in (auto, ())]
    for run in runs:
        run_capacity(run)
    run, plain = runs
    sim = run.stage.batch_simulation(2)
    assert sim.sizes == BatchSizes(nconmax=48, njmax=176)  # type: ignore[attr-defined]
    other = make_simulation(run.stage.model, run.cfg, 1, backend=Backend.mjwarp)
    assert other.sizes == BatchSizes(nconmax=48, njmax=300)
    assert run.stage.measured["env"] == BatchSizes(nconmax=48, njmax=384)
    assert (plain.stage.sizes, plain.stage.measured) == (BatchSizes(nconmax=128, njmax=300), {})


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
    env = build_env(run.cfg, model=run.stage.model, sizes=run.stage.measured["env"])
    play_random_actions(run.cfg, 100, env.sim)
    assert not read_peaks(env.sim).overflow.any()
