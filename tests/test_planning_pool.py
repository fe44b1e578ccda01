"""Planning with worker processes against planning alone. Here every world of the parent waits until
a worker has answered.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from multiprocessing.connection import wait

import numpy as np
import pytest

from mjstack.config.schema import Config
from mjstack.drivers import open_loop as planner_module
from mjstack.drivers import planning_pool
from mjstack.drivers.open_loop import OpenLoopPlanner
from mjstack.drivers.planning_pool import Plan
from mjstack.episodes.context import RunContext
from mjstack.errors import Unreachable, WorkerLost
from mjstack.scene.phases import nominal_xy

pytestmark = pytest.mark.full

Stage = Callable[[str], RunContext]
Workers = list[planning_pool._Worker]
FAR = [1.5, 0.0]


@pytest.fixture
def workers(monkeypatch: pytest.MonkeyPatch) -> Iterator[Workers]:
    """Every worker that the test starts; none may be left, not even as a zombie."""
    made: Workers = []

    class Recorded(planning_pool._Worker):
        def __init__(self, label: str, cfg: Config) -> None:
            super().__init__(label, cfg)
            made.append(self)

    monkeypatch.setattr(planning_pool, "_Worker", Recorded)
    yield made
    for worker in made:
        assert worker._process.returncode is not None
        assert not os.path.exists(f"/proc/{worker._process.pid}")
        assert worker.socket.closed


class PatientPlanner(OpenLoopPlanner):
    """Plans a world of its own only when some worker has answered, and keeps the world's number."""

    def __init__(self, cfg: Config, workers: Workers, processes: int) -> None:
        self.own: list[int] = []
        self.workers = workers
        self.at: dict[int, Callable[[], None]] = {}
        super().__init__(cfg, parallel_from=2, processes=processes)
        self.own.clear()

    def plan_world(self, world: int, xy: np.ndarray) -> tuple[np.ndarray, float]:
        if self.workers:
            assert wait([worker.socket for worker in self.workers], timeout=60.0), (
                "no worker answers"
            )
        self.own.append(world)
        self.at.pop(world, lambda: None)()
        return super().plan_world(world, xy)


def layouts(context: RunContext, nworld: int) -> np.ndarray:
    shifts = np.random.default_rng(7).uniform(-0.002, 0.002, (nworld, 4))
    return nominal_xy(context.cfg.scene) + shifts.reshape(nworld, 2, 2)


def test_plans_are_those_of_one_process(robot: str, stage: Stage, workers: Workers) -> None:
    """To the last bit, twins included, and progress is told up to the end."""
    context = stage(robot)
    xy = layouts(context, 64)
    xy[[30, 63]] = xy[[2, 40]]
    planner = PatientPlanner(context.cfg, workers, processes=3)
    told: list[int] = []
    shared = planner.plan(xy, told.append)
    alone = OpenLoopPlanner(context.cfg).plan(xy)
    assert len(workers) == 2
    assert 0 < len(planner.own) < 32
    assert shared._knots.numpy().tobytes() == alone._knots.numpy().tobytes()
    assert shared.waypoint_error.tobytes() == alone.waypoint_error.tobytes()
    assert len(told) == 62
    assert told == sorted(set(told))
    assert told[-1] == 64


def test_the_first_unreachable_world_is_named(stage: Stage, workers: Workers) -> None:
    """World 12 fails in a worker after 17 has failed here."""
    context = stage("so101")
    xy = layouts(context, 40)
    xy[[12, 15, 17, 30], 0] = FAR
    planner = PatientPlanner(context.cfg, workers, processes=2)
    with pytest.raises(Unreachable) as shared:
        planner.plan(xy)
    assert planner.own == [0, 17]
    with pytest.raises(Unreachable) as alone:
        OpenLoopPlanner(context.cfg).plan(xy)
    assert str(shared.value) == str(alone.value)
    assert (shared.value.world, shared.value.phase) == (12, "above_red")
    assert shared.value.distance == alone.value.distance


def test_a_killed_worker_is_one_clear_error(stage: Stage, workers: Workers) -> None:
    context = stage("so101")
    planner = PatientPlanner(context.cfg, workers, processes=2)
    planner.at[17] = lambda: workers[0].kill()
    with pytest.raises(WorkerLost, match="planning worker 1 of 1 was killed by signal 9") as caught:
        planner.plan(layouts(context, 64))
    assert "\n" not in str(caught.value)
    assert "taskset" in str(caught.value)


def test_a_worker_that_cannot_start_is_one_clear_error(
    stage: Stage,
    workers: Workers,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(planning_pool, "_WORKER", "mjstack.drivers.no_such_worker")
    context = stage("so101")
    with pytest.raises(WorkerLost, match="planning worker 1 of 1 ended with exit status 1"):
        PatientPlanner(context.cfg, workers, processes=2).plan(layouts(context, 64))
    assert "no_such_worker" in capfd.readouterr().err


def test_interrupt_ends_the_workers(stage: Stage, workers: Workers) -> None:
    context = stage("so101")

    def interrupt(done: int) -> None:
        if done == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as caught:
        PatientPlanner(context.cfg, workers, processes=2).plan(layouts(context, 64), interrupt)
    # They are gone although the traceback, and with it every step, is still alive.
    assert caught.tb is not None
    assert [worker._process.returncode for worker in workers] == [-9]


def test_a_worker_ends_when_nobody_asks_any_more(stage: Stage, workers: Workers) -> None:
    """As when this process is killed."""
    worker = planning_pool._Worker("1 of 1", stage("so101").cfg)
    assert worker.receive() == []
    worker.socket.close()
    assert worker._process.wait(timeout=30.0) == 0


def test_where_no_process_can_be_started_one_plans_all(
    stage: Stage, workers: Workers, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(planning_pool.subprocess, "Popen", refuse)
    context = stage("so101")
    xy = layouts(context, 3)
    tape = PatientPlanner(context.cfg, workers, processes=4).plan(xy)
    assert not workers
    assert (
        tape._knots.numpy().tobytes()
        == OpenLoopPlanner(context.cfg).plan(xy)._knots.numpy().tobytes()
    )


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

    def parallel(
        _: Config, __: Callable, worlds: list[int], ___: np.ndarray, processes: int
    ) -> Iterator[Plan]:
        made.append(processes)
        yield from ((world, *plan) for world in worlds)

    monkeypatch.setattr(planner, "plan_world", lambda *_: plan)
    monkeypatch.setattr(planner_module, "plan_in_parallel", parallel)
    monkeypatch.setattr(planner_module, "available_cores", lambda: cores)
    xy = layouts(context, distinct)[np.arange(nworld) % distinct]
    tape = planner.plan(xy)
    assert made == ([] if processes == 1 else [processes])
    assert np.isfinite(tape._knots.numpy()).all()
