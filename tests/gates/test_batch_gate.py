"""The batch gate: totals over seeds, the interval of its rate, what it keeps of every world, and
what a failure leaves.
"""

import csv
import os
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from check_cases import rules_of
from compositions import load_config
from environments import NewRun, Patch, at_double_speed, judge, one_second_episode, record_of

from mjstack.drivers.open_loop import JointTrajectory
from mjstack.episodes import batches
from mjstack.episodes import tally as tally_module
from mjstack.episodes.record import EpisodeRecord
from mjstack.episodes.rollout import Episode, play_episode
from mjstack.episodes.run import Run
from mjstack.episodes.stage import Progress, Stage
from mjstack.episodes.tally import EpisodeTally
from mjstack.errors import FolderError
from mjstack.files import to_csv
from mjstack.gates.runner import run_gates
from mjstack.math import wilson_interval
from mjstack.report.record import GateResult, Status

RULES = rules_of("stack")
FAILING = "batch_failing.csv"

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
    rate = successes / trials
    ends = wilson_interval(successes, trials)
    assert ends == pytest.approx((low, high), abs=1e-5)
    for p in ends:
        expected = 1.959964**2 * p * (1.0 - p) / trials
        assert (rate - p) ** 2 == pytest.approx(expected, rel=1e-4, abs=1e-12)
    assert 0.0 <= ends[0] <= rate <= ends[1] <= 1.0


def play(run: Run, folder: Path | None) -> GateResult:
    run.folder = folder
    return judge(run)


@pytest.fixture(scope="module")
def two_seeds(
    new_run: NewRun, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, GateResult, list[str]]:
    """A native batch of seven worlds under seeds 0 and 1, some of which fail, its folder, and what
    it said.
    """
    folder = tmp_path_factory.mktemp("batch")
    run = new_run("sim=native", "nworld=7", "gate.batch.seeds=2", *TIGHT)
    lines: list[str] = []
    run.stage.progress = Progress(lines.append)
    return folder, play(run, folder), lines


def test_seeds_add_up(two_seeds: tuple[Path, GateResult, list[str]]) -> None:
    folder, result, lines = two_seeds
    failed = [np.flatnonzero(record_of(folder, seed).failed) for seed in (0, 1)]
    assert all(map(len, failed))  # else this would show less
    failing = [f"{seed}:{world}" for seed, worlds in enumerate(failed) for world in worlds]
    assert len(failing) < 14
    succeeded = 14 - len(failing)
    low, high = wilson_interval(succeeded, 14)
    metrics = result.metrics
    assert result.status is Status.failed
    assert (metrics["episodes"], metrics["succeeded"], metrics["seeds"]) == (14, succeeded, 2)
    assert metrics["seed0.succeeded"] + metrics["seed1.succeeded"] == succeeded
    assert metrics["failed.STACKED"] == len(failing)
    assert metrics["distinct_final_states"] == 14
    assert (metrics["success_rate_low95"], metrics["success_rate_high95"]) == (low, high)
    count = len(failing)
    for words in (
        f"{count} of 14 episodes ({', '.join(failing)}) failed: not stacked in {count}"
        f" (xy_err in {count})",
        f"{succeeded} of 14 episodes succeeded (",
        "95 % interval",
        f"job=replay run={folder} world={failing[0]}",
    ):
        assert words in result.reason
    assert "world_steps_per_s" not in metrics  # void where worlds failed
    assert [line.split(":")[0] for line in lines] == ["batch, seed 0", "batch, seed 1"]


def test_failing_worlds_are_a_table(two_seeds: tuple[Path, GateResult, list[str]]) -> None:
    folder, result, _ = two_seeds
    rows = list(csv.DictReader((folder / FAILING).read_text().splitlines()))
    assert len(rows) == result.metrics["failed.STACKED"]
    for row in rows:
        record = record_of(folder, int(row["seed"]))
        world = int(row["world"])
        assert record.failed[world] == RULES["STACKED"]
        assert row["rules"] == "STACKED"
        assert float(row["xy_err_m"]) > 0.00134
        for name, values in record.values.items():
            assert float(row[name]) == pytest.approx(values[world], rel=1e-5)


def test_the_table_is_written_once(new_run: NewRun, monkeypatch: Patch, tmp_path: Path) -> None:
    """Once after each seed would take quadratic time."""
    written: list[int] = []

    def counted(rows: list) -> str:
        written.append(len(rows))
        return to_csv(rows)

    monkeypatch.setattr(tally_module, "to_csv", counted)
    short = ["sim=native", "nworld=2", "gate.batch.seeds=3", *one_second_episode()]
    result = play(new_run(*short), tmp_path)
    assert written == [6]
    assert f"{FAILING} has every failing episode with what was measured" in result.details


@pytest.mark.parametrize("nu", [6, 8])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_commands_do_not_depend_on_nworld(nu: int, dtype: torch.dtype) -> None:
    """Not even in their last bits, or a world would not do alone what it did among many."""
    rng = np.random.default_rng(0)
    knots = torch.from_numpy(rng.normal(size=(200, 12, nu)))
    weights = torch.from_numpy(rng.normal(size=(5, 6)))
    numbers = torch.tensor([0, 0, 6, 6, 6])[:, None] + torch.arange(6)

    def trajectory(worlds: slice) -> JointTrajectory:
        made = JointTrajectory(knots[worlds], weights, numbers, np.zeros(200)[worlds])
        return made.to(torch.device("cpu"), dtype)

    together = trajectory(slice(None))
    for world in range(0, 200, 7):
        alone = trajectory(slice(world, world + 1))
        for step in range(5):
            assert torch.equal(alone.command(step)[0], together.command(step)[world])


class Stop(Exception):
    """Something that nobody foresaw."""


FAIL_EARLY = ("sim=native", "nworld=2", *one_second_episode())
PASS_ANYHOW = ("gate.batch.rate=0", "gate.success.rate=0")


@pytest.mark.full
@pytest.mark.parametrize(
    ("gate", "error"),
    [
        ("batch", Stop("the second seed")),
        ("batch", KeyboardInterrupt()),
        ("success", Stop("the second seed")),
    ],
)
def test_what_stops_the_second_seed_keeps_the_first(
    gate: str, error: BaseException, new_run: NewRun, monkeypatch: Patch, tmp_path: Path
) -> None:
    file = tmp_path / f"{gate}_seed0.npz"

    def stops(*args: Any, **kwargs: Any) -> Episode:
        if file.exists():
            raise error
        return play_episode(*args, **kwargs)

    monkeypatch.setattr(batches, "play_episode", stops)
    run = new_run(*FAIL_EARLY, *PASS_ANYHOW, f"gates=[{gate}]", f"gate.{gate}.seeds=3")
    run.folder = tmp_path
    if isinstance(error, KeyboardInterrupt):
        with pytest.raises(KeyboardInterrupt):
            judge(run, gate)
    else:
        result = judge(run, gate)
        assert result.status is Status.failed
        assert "episodes (0:0, 0:1) failed" in result.reason
        assert "seeds 1 to 2 not played: the second seed" in result.reason
        assert result.metrics["seeds"] == 1
    assert len((tmp_path / f"{gate}_failing.csv").read_text().splitlines()) == 3
    assert file.exists()


@pytest.mark.full
@pytest.mark.parametrize("gate", ["batch", "success"])
def test_full_disk_takes_no_verdict_back(
    gate: str, new_run: NewRun, monkeypatch: Patch, tmp_path: Path
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    run = new_run(*FAIL_EARLY, *PASS_ANYHOW, f"gates=[{gate}]")
    run.folder = tmp_path
    result = judge(run, gate)
    assert result.status is Status.passed
    assert "2 of 2 " in result.reason  # what is allowed is named, and voids figures of the batch
    assert "world_steps_per_s" not in result.metrics
    problems = [line for line in result.details if "No space left on device" in line]
    files = ("starts_seed0.npz",) if gate == "success" else ()
    for name in ("seed0.npz", "failing.csv", *files):
        assert any(f"{gate}_{name}" in line for line in problems)
    assert list(tmp_path.iterdir()) == []


def test_damaged_record_is_one_line(tmp_path: Path) -> None:
    assert EpisodeRecord.read(tmp_path, 0) is None
    (tmp_path / "batch_seed0.npz").write_bytes(b"PK not a zip")
    with pytest.raises(FolderError, match=r"batch_seed0\.npz: cannot be read") as caught:
        EpisodeRecord.read(tmp_path, 0)
    assert "\n" not in str(caught.value)


def test_a_further_seed_keeps_its_record_without_final_positions(new_run: NewRun) -> None:
    """The record's other arrays, and 8 bytes a world for the hash of its final positions."""
    check = new_run("sim=native").stage.check
    tally = EpisodeTally(gate="batch", check=check, folder=None)
    worlds = 20_000
    rng = np.random.default_rng(0)

    def add(seed: int) -> None:
        names = ("value.xy_err", "value.height_err", "measured.peak_contacts")
        arrays = {name: rng.random(worlds) for name in names}
        arrays |= {name: rng.random((worlds, 20)) for name in ("start_qpos", "qpos")}
        arrays["failed"] = np.zeros(worlds, np.int32)
        tally.add(EpisodeRecord(seed=seed, backend="native", device="cpu", worlds=arrays))

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
    assert len(np.unique(tally.array("end"))) == tally.successes == 8 * worlds
    kept = 3 * 8 + 20 * 8 + 4 + 8
    assert kept <= grown / (6 * worlds) < kept + 0.2


@pytest.mark.full
@pytest.mark.parametrize("lacks", ["check", "phases"])
def test_gates_of_a_task_without_an_episode_are_skipped(lacks: str, tmp_path: Path) -> None:
    cfg = load_config(["sim=native", "gates=[baseline,parity,capacity,batch,success]"])
    if lacks == "check":
        cfg.task.check = None
    else:
        cfg.controller.phases = {}
    results: list[GateResult] = []
    run_gates(Run(Stage(cfg), record=results.append), tmp_path)
    assert [result.name for result in results] == cfg.gates
    assert all(result.status is Status.skipped for result in results)
    assert all(f"task stack has no {lacks}" in result.reason for result in results)
