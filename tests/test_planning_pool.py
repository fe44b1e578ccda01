"""Planning in processes against planning alone."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import active_children
from pathlib import Path

import numpy as np
import pytest

from mjstack import interrupt
from mjstack.config.schema import Config
from mjstack.drivers import open_loop
from mjstack.drivers.open_loop import OpenLoopPlanner, Plan
from mjstack.episodes.stage import Stage
from mjstack.errors import MjstackError, Unreachable
from mjstack.scene.phases import nominal_xy

pytestmark = pytest.mark.full

GetStage = Callable[[str], Stage]
FAR = [1.5, 0.0]


@pytest.fixture
def two_processes(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Few worlds are shared out between two processes; none may be left."""
    monkeypatch.setattr(open_loop, "PARALLEL_FROM", 2)
    monkeypatch.setattr(open_loop, "WORLDS_PER_PROCESS", 1)
    monkeypatch.setattr(open_loop, "available_cores", lambda: 2)
    yield
    assert not active_children()


def layouts(stage: Stage, nworld: int) -> np.ndarray:
    shifts = np.random.default_rng(7).uniform(-0.002, 0.002, (nworld, 4))
    return nominal_xy(stage.cfg.scene) + shifts.reshape(nworld, 2, 2)


def plan_alone(cfg: Config, xy: np.ndarray) -> list[Plan]:
    planner = OpenLoopPlanner(cfg)
    return [planner.plan_world(world, at) for world, at in enumerate(xy)]


@pytest.mark.usefixtures("two_processes")
def test_plans_are_those_of_one_process(get_stage: GetStage) -> None:
    """To the last bit, twins included, and progress is told up to the end."""
    stage = get_stage("so101")
    xy = layouts(stage, 24)
    xy[[10, 23]] = xy[[2, 20]]
    told: list[int] = []
    planner = OpenLoopPlanner(stage.cfg)
    planner.plan_world = None  # type: ignore[assignment,method-assign]  # nothing is planned here
    shared = planner.plan(xy, told.append)
    for world, (knots, error) in enumerate(plan_alone(stage.cfg, xy)):
        assert shared.knots[world].numpy().tobytes() == knots.tobytes()
        assert shared.waypoint_error[world] == error
    assert len(told) == 22
    assert told == sorted(set(told))
    assert told[-1] == 24


@pytest.mark.usefixtures("two_processes")
def test_the_first_unreachable_world_is_named(get_stage: GetStage) -> None:
    """World 7 fails in another process, and often before."""
    stage = get_stage("so101")
    xy = layouts(stage, 16)
    xy[[5, 7, 12], 0] = FAR
    with pytest.raises(Unreachable) as shared:
        OpenLoopPlanner(stage.cfg).plan(xy)
    with pytest.raises(Unreachable) as alone:
        plan_alone(stage.cfg, xy)
    assert str(shared.value) == str(alone.value)
    assert (shared.value.world, shared.value.phase) == (5, "above_red")
    assert shared.value.distance == alone.value.distance


@pytest.mark.usefixtures("two_processes")
def test_kept_processes_serve_every_plan(get_stage: GetStage) -> None:
    """They start before the first plan, and an error in it leaves them at work for the next."""
    stage = get_stage("so101")
    xy = layouts(stage, 32)
    planner = OpenLoopPlanner(stage.cfg)
    with planner.processes(len(xy)):
        started = {child.pid for child in active_children()}
        far = xy.copy()
        far[0, 0] = FAR
        with pytest.raises(Unreachable):
            planner.plan(far)
        shared = planner.plan(xy)
        assert {child.pid for child in active_children()} == started
    assert len(started) == 2
    knots = [plan for plan, _ in plan_alone(stage.cfg, xy)]
    assert shared.knots.numpy().tobytes() == np.array(knots).tobytes()


@pytest.mark.usefixtures("two_processes")
@pytest.mark.parametrize("way", ["kill", "raise", "ask"])
def test_processes_end_with_what_ends_the_planning(
    way: str, get_stage: GetStage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A process that is killed is one clear error. After Ctrl-C in a step they are gone although
    every step is still alive, and the command's handler does not wait until they have loaded.
    """
    stage = get_stage("so101")
    planner = OpenLoopPlanner(stage.cfg)

    def stop(done: int) -> None:
        if way == "kill" and done == 1:
            active_children()[0].kill()
        if way == "raise" and done == 5:
            raise KeyboardInterrupt

    if way == "ask":
        monkeypatch.setattr(interrupt, "_asked", True)
    used = os.times()
    with pytest.raises(MjstackError if way == "kill" else KeyboardInterrupt) as caught:
        planner.plan(layouts(stage, 256), stop)
    assert caught.tb is not None
    assert not active_children()
    if way == "kill":
        assert "a planning process was killed" in str(caught.value)
        assert "taskset" in str(caught.value)
        assert "\n" not in str(caught.value)
    if way == "ask":
        assert os.times().children_user - used.children_user < 2.0


SCRIPT = """
import os, signal, sys
import numpy as np
from mjstack.config import load_config
from mjstack.drivers import open_loop
from mjstack.scene.phases import nominal_xy
print("imported", flush=True)
open_loop.PARALLEL_FROM, open_loop.WORLDS_PER_PROCESS = 2, 1
open_loop.available_cores = lambda: 2
cfg = load_config([])
xy = nominal_xy(cfg.scene) + np.linspace(0.0, 0.002, 12)[:, None, None]

def show(done):
    from multiprocessing import active_children
    if done == 1:
        print(*(child.pid for child in active_children()), flush=True)
        if "die" in sys.argv:
            os.kill(os.getpid(), signal.SIGKILL)

open_loop.OpenLoopPlanner(cfg).plan(xy, show)
print("planned", signal.pthread_sigmask(signal.SIG_BLOCK, ()), flush=True)
"""


@pytest.mark.parametrize("dies", [False, True])
def test_a_script_without_a_main_guard(dies: bool, tmp_path: Path) -> None:
    """It runs once, its state is as before, and its processes end with it, also by a kill."""
    script = tmp_path / "mine.py"
    script.write_text(SCRIPT)
    run = subprocess.run(
        [sys.executable, str(script), *["die"] * dies],
        stdout=subprocess.PIPE,
        text=True,
        check=False,
    )
    assert run.returncode == (-signal.SIGKILL if dies else 0)
    first, pids, *rest = run.stdout.splitlines()
    assert first == "imported"
    assert rest == ([] if dies else ["planned set()"])
    assert len(pids.split()) == 2
    until = time.monotonic() + 30.0
    while any(is_running(pid) for pid in pids.split()):
        assert time.monotonic() < until
        time.sleep(0.1)


def is_running(pid: str) -> bool:
    try:
        return "zombie" not in Path(f"/proc/{pid}/status").read_text()
    except FileNotFoundError:
        return False


@pytest.mark.parametrize(
    ("cores", "nworld", "distinct", "processes"),
    [
        (16, 511, 511, []),
        (16, 4096, 511, []),
        (16, 512, 512, [4]),
        (16, 4096, 4096, [16]),
        (2, 4096, 4096, [2]),
        (1, 4096, 4096, []),
    ],
)
def test_processes_by_cores_and_distinct_worlds(
    cores: int,
    nworld: int,
    distinct: int,
    processes: list[int],
    get_stage: GetStage,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stage = get_stage("so101")
    planner = OpenLoopPlanner(stage.cfg)
    made: list[int] = []
    plan = planner.plan_world(0, layouts(stage, 1)[0])

    @contextmanager
    def start(_: Config, count: int) -> Iterator[None]:
        made.append(count)
        yield

    monkeypatch.setattr(planner, "_plans", lambda worlds, _: [plan] * len(worlds))
    monkeypatch.setattr(open_loop, "_start_processes", start)
    monkeypatch.setattr(open_loop, "available_cores", lambda: cores)
    trajectory = planner.plan(layouts(stage, distinct)[np.arange(nworld) % distinct])
    assert made == processes
    assert np.isfinite(trajectory.knots.numpy()).all()
