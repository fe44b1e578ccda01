"""The batch gate: totals over seeds, the interval of its rate, what it keeps of every world, and
what a failure leaves.
"""

from __future__ import annotations

import csv
import os
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from check_cases import rules_of
from compositions import load_config
from environments import at_double_speed, one_second_episode

from mjstack.drivers.open_loop import JointTrajectory
from mjstack.episodes import context as gate_module
from mjstack.episodes import tally as tally_module
from mjstack.episodes.context import RunContext
from mjstack.episodes.record import FAILING, EpisodeRecord
from mjstack.episodes.rollout import Episode, play_episode
from mjstack.episodes.tally import EpisodeTally
from mjstack.errors import RunError
from mjstack.files import to_csv, write_atomic
from mjstack.gates.batch import run_batch
from mjstack.gates.runner import run_gates
from mjstack.math import wilson_interval
from mjstack.report.record import GateResult, Status

RULES = rules_of("stack")

# At double speed some worlds end farther off than this.
TIGHT = ("task.check.xy_err=0.00134", *at_double_speed())


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [
        (0, 10, 0.0, 0.27753),
        (10, 10, 0.72247, 1.0),
        (8, 10, 0.49016, 0.94332),
        (50, 100, 0.40383, 0.59617),
        (1, 1, 0.20654, 1.0),
        (2047, 2048, 0.99724, 0.99991),
    ],
)
def test_wilson_interval(successes: int, trials: int, low: float, high: float) -> None:
    """The interval's ends p solve (k/n - p)^2 = z^2 p (1 - p) / n."""
    found = wilson_interval(successes, trials)
    assert found == pytest.approx((low, high), abs=1e-5)
    for p in found:
        assert (successes / trials - p) ** 2 == pytest.approx(
            1.959964**2 * p * (1.0 - p) / trials, rel=1e-4, abs=1e-12
        )
    assert 0.0 <= found[0] <= successes / trials <= found[1] <= 1.0


def play(context: RunContext, folder: Path | None) -> GateResult:
    context.folder = folder
    (result,) = run_batch(context)
    return result


@pytest.fixture(scope="module")
def two_seeds(
    new_context: Callable[..., RunContext], tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, GateResult, list[str]]:
    """A native batch of seven worlds under seeds 0 and 1, some of which fail, its folder, and what
    it said.
    """
    folder = tmp_path_factory.mktemp("batch")
    context = new_context("sim=native", "nworld=7", "gate.batch.seeds=2", *TIGHT)
    lines: list[str] = []
    context.print_line = lines.append
    return folder, play(context, folder), lines


def test_seeds_add_up(two_seeds: tuple[Path, GateResult, list[str]]) -> None:
    folder, result, lines = two_seeds
    records = [EpisodeRecord.read(folder, seed) for seed in (0, 1)]
    failing = [
        f"{seed}:{w}"
        for seed, r in enumerate(records)
        if r is not None
        for w in np.flatnonzero(r.failed)
    ]
    assert 0 < len(failing) < 14
    assert {name[0] for name in failing} == {
        "0",
        "1",
    }  # the test would show less if one seed had none
    succeeded = 14 - len(failing)
    low, high = wilson_interval(succeeded, 14)
    metrics = result.metrics
    assert result.status is Status.failed
    assert (metrics["episodes"], metrics["succeeded"], metrics["seeds"]) == (14, succeeded, 2)
    assert metrics["seed0.succeeded"] + metrics["seed1.succeeded"] == succeeded
    assert metrics["failed.STACKED"] == len(failing)
    assert metrics["distinct_final_states"] == 14
    assert (metrics["success_rate_low95"], metrics["success_rate_high95"]) == (low, high)
    assert (
        f"{len(failing)} of 14 world-episodes ({', '.join(failing)}) failed: not stacked in"
        f" {len(failing)}" in result.reason
    )
    assert f"{succeeded} of 14 world-episodes succeeded (" in result.reason
    assert "95 % interval" in result.reason
    assert f"job=replay run={folder} world={failing[0]}" in result.reason
    assert not {"episode_s", "world_steps_per_s"} & set(metrics)  # void where worlds failed
    assert [line.split(":")[0] for line in lines] == ["batch, seed 0", "batch, seed 1"]


def test_failing_worlds_are_a_table(two_seeds: tuple[Path, GateResult, list[str]]) -> None:
    folder, result, _ = two_seeds
    rows = list(csv.DictReader((folder / FAILING).read_text().splitlines()))
    assert len(rows) == result.metrics["failed.STACKED"]
    for row in rows:
        record = EpisodeRecord.read(folder, int(row["seed"]))
        assert record is not None
        assert record.failed[int(row["world"])] == RULES["STACKED"]
        assert row["rules"] == "STACKED"
        assert float(row["xy_err_m"]) > 0.00134
        for name, values in record.values.items():
            assert float(row[name]) == pytest.approx(values[int(row["world"])], rel=1e-5)


def test_the_table_is_written_once(
    new_context: Callable[..., RunContext], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Once after each seed would take quadratic time."""
    written: list[int] = []

    def counted(rows: list) -> str:
        written.append(len(rows))
        return to_csv(rows)

    monkeypatch.setattr(tally_module, "to_csv", counted)
    own = ["sim=native", "nworld=2", "gate.batch.seeds=3", *one_second_episode()]
    result = play(new_context(*own), tmp_path)
    assert written == [6]
    assert f"{FAILING} has every failing episode with what was measured" in result.details


@pytest.mark.full
def test_second_seed_is_what_it_is_alone(
    two_seeds: tuple[Path, GateResult, list[str]],
    new_context: Callable[..., RunContext],
    tmp_path: Path,
) -> None:
    """Worlds are started anew: nothing of seed 0 is left in them. Fewer of them, too, because
    nworld does not matter.
    """
    result = play(new_context("sim=native", "nworld=3", "seed=1", *TIGHT), tmp_path)
    alone = EpisodeRecord.read(tmp_path, 1)
    after = EpisodeRecord.read(two_seeds[0], 1)
    assert alone is not None
    assert after is not None
    assert np.array_equal(alone.qpos, after.qpos[:3])
    assert np.array_equal(alone.failed, after.failed[:3])
    first = EpisodeRecord.read(two_seeds[0], 0)
    assert first is not None
    assert not np.array_equal(first.qpos, after.qpos)
    bad = np.flatnonzero(alone.failed).tolist()
    assert (
        f"({', '.join(map(str, bad))}) failed" in result.reason
    )  # one seed: worlds have no seed in their names
    assert result.metrics["worlds"] == 3


@pytest.mark.parametrize("nu", [6, 8])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_commands_do_not_depend_on_nworld(nu: int, dtype: torch.dtype) -> None:
    """Not even in their last bits, or a world would not do alone what it did among many."""
    rng = np.random.default_rng(0)
    knots = torch.from_numpy(rng.normal(size=(200, 12, nu)))
    weights = torch.from_numpy(rng.normal(size=(5, 6)))
    numbers = torch.tensor([0, 0, 6, 6, 6])[:, None] + torch.arange(6)
    error = np.zeros(200)
    many = JointTrajectory(knots, weights, numbers, error).to(torch.device("cpu"), dtype)
    for world in range(0, 200, 7):
        alone = JointTrajectory(knots[world : world + 1], weights, numbers, error[:1]).to(
            torch.device("cpu"), dtype
        )
        for step in range(5):
            assert torch.equal(alone.command(step)[0], many.command(step)[world])


class Stop(Exception):
    """Something that nobody foresaw."""


@pytest.mark.full
@pytest.mark.parametrize("error", [Stop("the second seed"), KeyboardInterrupt()])
def test_what_stops_the_second_seed_keeps_the_first(
    error: BaseException,
    new_context: Callable[..., RunContext],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    def stops(*args: Any, **kwargs: Any) -> Episode:
        if (tmp_path / "worlds_seed0.npz").exists():
            raise error
        return play_episode(*args, **kwargs)

    monkeypatch.setattr(gate_module, "play_episode", stops)
    context = new_context(
        "sim=native",
        "nworld=2",
        "gate.batch.seeds=3",
        "task.check.xy_err=1e-6",
        *at_double_speed(),
    )
    if isinstance(error, KeyboardInterrupt):
        with pytest.raises(KeyboardInterrupt):
            play(context, tmp_path)
    else:
        result = play(context, tmp_path)
        assert result.status is Status.failed
        assert "2 of 2 world-episodes (0:0, 0:1) failed" in result.reason
        assert "seeds 1 to 2 not played: the second seed" in result.reason
        assert result.metrics["seeds"] == 1
    assert len((tmp_path / FAILING).read_text().splitlines()) == 3
    record = EpisodeRecord.read(tmp_path, 0)
    assert record is not None
    assert (record.failed == RULES["STACKED"]).all()


@pytest.mark.full
def test_full_disk_takes_no_verdict_back(
    new_context: Callable[..., RunContext], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    result = play(new_context("sim=native", "nworld=2", *at_double_speed()), tmp_path)
    assert result.status is Status.passed
    assert (
        "2 of 2 worlds succeeded (100 %, 95 % interval 34.24 to 100 %), 2 distinct" in result.reason
    )
    assert result.metrics["world_steps_per_s"] == pytest.approx(
        2 * 3000 / result.metrics["episode_s"]
    )
    assert any("No space left on device" in line for line in result.details)
    assert list(tmp_path.iterdir()) == []


def test_table_is_replaced_in_one_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_atomic(tmp_path / FAILING, "seed,world\n0,1\n")

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", killed)
    with pytest.raises(KeyboardInterrupt):
        write_atomic(tmp_path / FAILING, "seed,world\n0,1\n1,2\n")
    assert (tmp_path / FAILING).read_text() == "seed,world\n0,1\n"
    assert [path.name for path in tmp_path.iterdir()] == [FAILING]


def test_damaged_record_is_one_line(tmp_path: Path) -> None:
    assert EpisodeRecord.read(tmp_path, 0) is None
    (tmp_path / "worlds_seed0.npz").write_bytes(b"PK not a zip")
    with pytest.raises(RunError, match=r"worlds_seed0\.npz: cannot be read") as caught:
        EpisodeRecord.read(tmp_path, 0)
    assert "\n" not in str(caught.value)


@pytest.mark.full
def test_a_few_failures_may_be_allowed(new_context: Callable[..., RunContext]) -> None:
    """nworld=2 of seed 0 has world 1 off; allowed, it is still named."""
    result = play(new_context("sim=native", "nworld=2", "gate.batch.failed_worlds=1", *TIGHT), None)
    assert result.status is Status.passed
    assert "1 of 2 worlds succeeded (50 %," in result.reason
    assert "1 of 2 worlds (1) failed: not stacked in 1" in result.reason
    assert not {"episode_s", "world_steps_per_s"} & set(
        result.metrics
    )  # allowed, and void nonetheless


@pytest.mark.full
def test_no_trajectory_is_kept(new_context: Callable[..., RunContext], tmp_path: Path) -> None:
    """A trajectory of qpos alone would take 48 kB a world on the host. The 3-D page has its own
    bound, of 64 worlds.
    """

    def peak(nworld: int) -> int:
        own = ["sim=native", f"nworld={nworld}", "web.episode=false"]
        context = new_context(*own, *at_double_speed())
        assert context.model.nq * 8 * 300 == 48_000
        tracemalloc.start()
        play(context, tmp_path)
        try:
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    peak(2)  # whatever is made once
    assert (peak(12) - peak(2)) / 10 < 15_000


def test_a_further_seed_takes_9_bytes_a_world(new_context: Callable[..., RunContext]) -> None:
    """Of worlds that do not fail, after those that the page shows: a flag and a hash."""
    check = new_context("sim=native").check
    tally = EpisodeTally(
        gate="batch", noun="worlds", several=True, check=check, path=None, replayed=False
    )
    worlds = 20_000
    rng = np.random.default_rng(0)

    def add(seed: int) -> None:
        record = EpisodeRecord(
            seed=seed,
            backend="native",
            device="cpu",
            failed=np.zeros(worlds, np.int32),
            values={name: rng.random(worlds) for name in ("xy_err", "height_err")},
            qpos=rng.random((worlds, 20)),
            start=rng.random((worlds, 20)),
            measured={"peak_contacts": rng.random(worlds)},
        )
        tally.add(record)

    add(0)
    tracemalloc.start()
    try:
        add(1)
        before = tracemalloc.get_traced_memory()[0]
        for seed in range(2, 8):
            add(seed)
        grown = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert tally.distinct_ends == tally.good == 8 * worlds
    assert 8.9 < grown / (6 * worlds) < 9.2


@pytest.mark.full
@pytest.mark.parametrize("lacks", ["check", "phases"])
def test_gates_of_a_task_without_an_episode_are_skipped(lacks: str) -> None:
    cfg = load_config(["sim=native", "gates=[baseline,parity,capacity,batch,success]"])
    if lacks == "check":
        cfg.task.check = None
    else:
        cfg.controller.phases = {}
    results: list[GateResult] = []
    run_gates(RunContext(cfg, record=results.append))
    assert [result.name for result in results] == cfg.gates
    assert all(result.status is Status.skipped for result in results)
    assert all(f"task stack has no {lacks}" in result.reason for result in results)
