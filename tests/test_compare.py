"""job=compare: McNemar's test, known differences of two drivers, and sides that it refuses."""

import csv
import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import torch
from compositions import load_config, refusal
from environments import Patch
from policies import report

import mjstack.jobs.compare as compare
from mjstack.cli import run
from mjstack.config.schema import Backend
from mjstack.drivers.driver import Driver
from mjstack.envs import Env
from mjstack.episodes.stage import Stage
from mjstack.jobs import check_job
from mjstack.math import mcnemar_p_value

FULL = pytest.mark.full
TINY = ("job=compare", "task=reach", "sim=native", "nworld=4", "gate.success.seeds=2")
FAULTS = {True: (0, 2), False: (2, 3)}  # by the clock: worlds in which the driver does nothing


@pytest.mark.parametrize(
    ("only_a", "only_b", "p_value"),
    [
        (0, 0, 1.0),
        (1, 0, 1.0),
        (3, 3, 1.0),
        (5, 0, 0.0625),
        (1, 9, 0.021484375),  # 2 (1 + 10) / 2^10
        (2, 10, 0.03857421875),  # 2 (1 + 12 + 66) / 2^12
        (20_000, 0, 0.0),  # smaller than any float
        (10_000, 10_000, 1.0),
    ],
)
def test_mcnemar_of_known_pairs(only_a: int, only_b: int, p_value: float) -> None:
    assert mcnemar_p_value(only_a, only_b) == mcnemar_p_value(only_b, only_a) == p_value


def test_mcnemar_is_the_exact_binomial() -> None:
    for pairs in (7, 40, 180):
        for few in range(pairs // 2):
            tail = sum(math.comb(pairs, won) for won in range(few + 1))
            exact = float(Fraction(2 * tail, 2**pairs))
            assert mcnemar_p_value(few, pairs - few) == exact


class Faulty(Driver):
    """A driver that holds some worlds where they start."""

    def __init__(self, driver: Driver, env: Env, worlds: tuple[int, ...]) -> None:
        super().__init__(env.nworld, driver.steps, env.device, driver.phases)
        self.phase, self.error, self.retries = driver.phase, driver.error, driver.retries
        self._driver = driver
        self._still = torch.isin(env.world, torch.tensor(worlds))[:, None]
        self._start = env.sim.ctrl.float().clone()

    def command(self) -> torch.Tensor:
        return torch.where(self._still, self._start, self._driver.command().float())


def test_two_drivers_that_differ_in_known_worlds(tmp_path: Path, monkeypatch: Patch) -> None:
    made = Stage.driver

    def driver(stage: Stage, env: Env) -> Driver:
        return Faulty(made(stage, env), env, FAULTS[env.cfg.controller.clock])

    shown = []
    replay = compare._replay
    monkeypatch.setattr(Stage, "driver", driver)
    monkeypatch.setattr(compare, "_replay", lambda *args: shown.extend(replay(*args)) or shown)
    sides = ["controller=closed_loop", 'job.against=["controller.clock=false"]']
    assert run([*TINY, *sides, f"hydra.run.dir={tmp_path}/out"]) == 0
    result = report(tmp_path / "out")["compare"]
    metrics = result["metrics"]
    counts = [metrics[name] for name in ("episodes", "both", "only_a", "only_b", "neither")]
    assert counts == [8, 2, 2, 2, 2]
    assert metrics["p_value"] == 1.0
    assert metrics["only_a.failed.REACHED"] == metrics["only_b.failed.REACHED"] == 2
    assert metrics["a.success_rate"] == metrics["b.success_rate"] == 0.5
    assert metrics["a.success_rate_low95"] < 0.5 < metrics["a.success_rate_high95"]
    assert "no difference is shown" in result["reason"]
    assert result["notes"]["b"] == "closed_loop, controller.clock=false"
    with (tmp_path / "out/compare.csv").open() as file:
        rows = [tuple(row.values()) for row in csv.DictReader(file)]
    assert rows == [
        *((seed, "3", "a", "REACHED") for seed in "01"),
        *((seed, "0", "b", "REACHED") for seed in "01"),
    ]
    # The page shows each of these worlds as both sides play it.
    assert [world.caption for world in shown] == [
        f"{seed}:{world}"
        for seed in "01"
        for world in ("0 a: REACHED", "0 b", "3 a", "3 b: REACHED")
    ]
    assert all(world.qpos.shape == shown[0].qpos.shape for world in shown)
    for name in ("compare.png", "episode.html", "report.html"):
        assert (tmp_path / "out" / name).stat().st_size > 0, name


@pytest.mark.full
def test_equal_sides(tmp_path: Path) -> None:
    settings = [
        'job.against=["graph=off"]',
        "web.episode=false",
        "nworld=2",
        "gate.success.seeds=1",
    ]
    assert run([*TINY, *settings, f"hydra.run.dir={tmp_path}/out"]) == 0
    metrics = report(tmp_path / "out")["compare"]["metrics"]
    assert (metrics["both"], metrics["p_value"]) == (2, 1.0)
    assert (tmp_path / "out/compare.csv").read_text() == "seed,world,succeeded,rules\n"


@pytest.mark.parametrize(
    ("overrides", "problem"),
    [
        ([], "job.against=[]: expected what the second side changes"),
        (["job.against=[policy]"], "override 'policy' cannot be read: expected key=value"),
        (['job.against=["polcy=x"]'], "'polcy' does not exist. Did you mean 'policy'?"),
        (
            ['job.against=["seed=1"]'],
            "expected the same robot, task, worlds and seeds (seed=1, expected 0)",
        ),
        *(
            pytest.param([f'job.against=["{side}"]'], f"({side}, expected {value})", marks=FULL)
            for side, value in (
                ("robot=rebot", "so101"),
                ("gate.success.seeds=3", "2"),
                ("task.check.distance=0.5", "0.02"),
            )
        ),
        (['job.against=["gate.success.region=[0.01,0.01]"]'], "expected equal starts, which"),
        (['job.against=["controller=policy","policy=nowhere/last"]'], "nowhere/last"),
        (['job.against=["graph=off"]', "view=web"], "expected false with job=compare"),
    ],
)
def test_other_sides_are_refused_in_one_line(overrides: list[str], problem: str) -> None:
    args = [*TINY, *overrides]
    refusal(lambda: check_job(load_config(args), args), problem)


def test_starts_that_turn_out_unequal_fail(tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.setattr(compare, "_start_of_first_world", lambda stage: {"start": np.zeros(1)})
    region = ['job.against=["gate.success.region=[0.01,0.01]"]']
    few = ["nworld=2", "gate.success.seeds=1", "web.episode=false"]
    assert run([*TINY, *region, *few, f"hydra.run.dir={tmp_path}/out"]) == 1
    assert "a and b did not start alike" in report(tmp_path / "out")["compare"]["reason"]


@pytest.mark.parametrize(("device", "code"), [("cpu", 1), ("cuda:0", 0)])
def test_starts_may_differ_by_rounding_on_another_device(
    device: str, code: int, tmp_path: Path, monkeypatch: Patch
) -> None:
    def backend(stage: Stage) -> tuple[Backend, str]:
        return Backend.native, device if stage.cfg.graph == "off" else "cpu"

    def play(name: str, stage: Stage) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros((2, 4), np.int32), np.full((2, 4, 13), 1e-7 * (name == "b"))

    monkeypatch.setattr(Stage, "backend", property(backend))
    monkeypatch.setattr(compare, "_play", play)
    overrides = ['job.against=["graph=off"]', "web.episode=false"]
    assert run([*TINY, *overrides, f"hydra.run.dir={tmp_path}/out"]) == code
