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
from mjstack.episodes.context import RunContext
from mjstack.errors import MjstackError, Unreachable
from mjstack.scene.phases import nominal_xy

pytestmark = pytest.mark.full

Stage = Callable[[str], RunContext]
FAR = [1.5, 0.0]


@pytest.fixture
def two_processes(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Few worlds are shared out between two processes; none may be left."""
    monkeypatch.setattr(open_loop, "PARALLEL_FROM", 2)
    monkeypatch.setattr(open_loop, "WORLDS_PER_PROCESS", 1)
    monkeypatch.setattr(open_loop, "available_cores", lambda: 2)
    yield
    assert not active_children()


def layouts(context: RunContext, nworld: int) -> np.ndarray:
    shifts = np.random.default_rng(7).uniform(-0.002, 0.002, (nworld, 4))
    return nominal_xy(context.cfg.scene) + shifts.reshape(nworld, 2, 2)


def plan_alone(cfg: Config, xy: np.ndarray) -> list[Plan]:
    planner = OpenLoopPlanner(cfg)
    return [(world, *planner.plan_world(world, at)) for world, at in enumerate(xy)]


@pytest.mark.usefixtures("two_processes")
def test_plans_are_those_of_one_process(stage: Stage) -> None:
    """To the last bit, twins included, and progress is told up to the end."""
    context = stage("so101")
    xy = layouts(context, 24)
    xy[[10, 23]] = xy[[2, 20]]
    told: list[int] = []
    planner = OpenLoopPlanner(context.cfg)
    planner.plan_world = None  # type: ignore[assignment,method-assign]  # nothing is planned here
    shared = planner.plan(xy, told.append)
    for world, knots, error in plan_alone(context.cfg, xy):
        assert shared.knots[world].numpy().tobytes() == knots.tobytes()
        assert shared.waypoint_error[world] == error
    assert len(told) == 22
    assert told == sorted(set(told))
    assert told[-1] == 24


@pytest.mark.usefixtures("two_processes")
def test_the_first_unreachable_world_is_named(stage: Stage) -> None:
    """World 7 fails in another process, and often before."""
    context = stage("so101")
    xy = layouts(context, 16)
    xy[[5, 7, 12], 0] = FAR
    with pytest.raises(Unreachable) as shared:
        OpenLoopPlanner(context.cfg).plan(xy)
    with pytest.raises(Unreachable) as alone:
        plan_alone(context.cfg, xy)
    assert str(shared.value) == str(alone.value)
    assert (shared.value.world, shared.value.phase) == (5, "above_red")
    assert shared.value.distance == alone.value.distance


@pytest.mark.usefixtures("two_processes")
def test_kept_processes_serve_every_plan(stage: Stage) -> None:
    """They start before the first plan, and an error in it leaves them at work for the next."""
    context = stage("so101")
    xy = layouts(context, 32)
    planner = OpenLoopPlanner(context.cfg)
    with planner.processes(len(xy)):
        started = {child.pid for child in active_children()}
        far = xy.copy()
        far[0, 0] = FAR
        with pytest.raises(Unreachable):
            planner.plan(far)
        shared = planner.plan(xy)
        assert {child.pid for child in active_children()} == started
    assert len(started) == 2
    knots = [plan for _, plan, _ in plan_alone(context.cfg, xy)]
    assert shared.knots.numpy().tobytes() == np.array(knots).tobytes()


@pytest.mark.usefixtures("two_processes")
def test_a_killed_process_is_one_clear_error(stage: Stage) -> None:
    context = stage("so101")

    def kill(done: int) -> None:
        if done == 1:
            active_children()[0].kill()

    with pytest.raises(MjstackError, match="a planning process was killed") as caught:
        OpenLoopPlanner(context.cfg).plan(layouts(context, 256), kill)
    assert "\n" not in str(caught.value)
    assert "taskset" in str(caught.value)


@pytest.mark.usefixtures("two_processes")
def test_interrupt_ends_the_processes(stage: Stage) -> None:
    context = stage("so101")

    def interrupt(done: int) -> None:
        if done == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as caught:
        OpenLoopPlanner(context.cfg).plan(layouts(context, 256), interrupt)
    assert caught.tb is not None  # they are gone although every step is still alive
    assert not active_children()


@pytest.mark.usefixtures("two_processes")
def test_an_interrupted_command_does_not_wait_until_they_have_loaded(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    context = stage("so101")
    planner = OpenLoopPlanner(context.cfg)
    monkeypatch.setattr(interrupt, "_asked", True)  # as the command's handler does
    used = os.times()
    with pytest.raises(KeyboardInterrupt):
        planner.plan(layouts(context, 256))
    assert not active_children()
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
        (16, 511, 511, 1),
        (16, 4096, 511, 1),
        (16, 512, 512, 4),
        (16, 4096, 4096, 16),
        (2, 4096, 4096, 2),
        (1, 4096, 4096, 1),
    ],
)
def test_processes_by_cores_and_distinct_worlds(
    cores: int,
    nworld: int,
    distinct: int,
    processes: int,
    stage: Stage,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    context = stage("so101")
    planner = OpenLoopPlanner(context.cfg)
    made: list[int] = []
    plan = planner.plan_world(0, layouts(context, 1)[0])

    @contextmanager
    def start(_: Config, count: int) -> Iterator[object]:
        made.append(count)
        yield object()

    def parallel(_: object, worlds: list[int], __: np.ndarray, take: Callable[..., None]) -> None:
        for world in worlds:
            take(world, *plan)

    monkeypatch.setattr(planner, "plan_world", lambda *_: plan)
    monkeypatch.setattr(open_loop, "_start_processes", start)
    monkeypatch.setattr(open_loop, "plan_in_parallel", parallel)
    monkeypatch.setattr(open_loop, "available_cores", lambda: cores)
    xy = layouts(context, distinct)[np.arange(nworld) % distinct]
    tape = planner.plan(xy)
    assert made == ([] if processes == 1 else [processes])
    assert np.isfinite(tape.knots.numpy()).all()
