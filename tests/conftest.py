"""Shared scenes, planners and simulations. Everything here works offline and writes only below
pytest's temporary folder.
"""

import gc
import os
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import pytest
from compositions import load_config
from environments import (
    CUDA,
    DEVICES,
    Capture,
    GetStage,
    MakeSim,
    NewRun,
    Patch,
    Refused,
    on_backend,
)
from recordings import recording

from mjstack.config.schema import Config
from mjstack.episodes.run import Run
from mjstack.episodes.stage import Stage
from mjstack.sim import Simulation, make_simulation

ROBOTS = ("so101", "rebot")


def pytest_collection_finish() -> None:
    """Spare the garbage collector the modules, which stay to the end."""
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def _outside_the_checkout(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """MuJoCo writes its log into the working folder, so that folder is a temporary one."""
    before = os.getcwd()
    os.chdir(tmp_path_factory.mktemp("cwd"))
    yield
    os.chdir(before)


@pytest.fixture(scope="session")
def get_stage() -> GetStage:
    """Configuration, model, index and planner of a robot under some overrides, each made once in
    the session.
    """
    made: dict[tuple[str, ...], Stage] = {}

    def get(robot: str, *overrides: str) -> Stage:
        key = (f"robot={robot}", *overrides)
        if key not in made:
            made[key] = Stage(load_config(key))
        return made[key]

    return get


@pytest.fixture(scope="session")
def new_run(get_stage: GetStage) -> NewRun:
    """A run of its own for some overrides that change neither scene nor, but for its
    phases, plan: both are shared.
    """

    def make(*overrides: str, robot: str = "so101") -> Run:
        phases = [text for text in overrides if text.startswith("controller.phases.")]
        shared = get_stage(robot, *phases)
        return Run(Stage(load_config([f"robot={robot}", *overrides]), shared.assets))

    return make


@pytest.fixture(scope="session")
def make_sim(get_stage: GetStage) -> MakeSim:
    """Simulations by (backend, nworld, overrides), reset and shared by all tests: MJWarp's are slow
    to build.
    """
    made: dict[tuple, Simulation] = {}

    def make(backend: str, nworld: int, *overrides: str, robot: str = "so101") -> Simulation:
        key = (backend, nworld, robot, overrides)
        if key not in made:
            cfg = load_config([f"robot={robot}", *overrides])
            model = get_stage(robot).model
            made[key] = make_simulation(model, cfg, nworld, **on_backend(backend))
        made[key].reset()
        return made[key]

    return make


@pytest.fixture(scope="session")
def recorded(get_stage: GetStage, make_sim: MakeSim) -> Callable[[str], SimpleNamespace]:
    """A native episode of four jittered worlds per robot."""

    @cache
    def get(robot: str) -> SimpleNamespace:
        stage = get_stage(robot)
        with recording(stage) as recordings:
            stage.play(make_sim("native", 4, robot=robot), stage.cfg.reset)
        return recordings[0]

    return get


@pytest.fixture(params=ROBOTS)
def robot(request: pytest.FixtureRequest) -> str:
    """Either robot."""
    return request.param


@pytest.fixture(params=DEVICES)
def device(request: pytest.FixtureRequest) -> str:
    """Warp's CPU device, and CUDA where there is one."""
    return request.param


BACKENDS = ["native", "mjwarp", pytest.param("mjwarp-cuda", marks=CUDA)]


@pytest.fixture(params=BACKENDS)
def backend(request: pytest.FixtureRequest) -> str:
    """Every backend this machine has; MJWarp on Warp's CPU device, and on CUDA where
    there is one.
    """
    return request.param


@pytest.fixture
def error_line(capsys: Capture) -> Callable[[], str]:
    """The line that a command has written to standard error, and no other."""

    def read() -> str:
        (line,) = capsys.readouterr().err.splitlines()
        return line

    return read


@pytest.fixture
def refused(tmp_path: Path, monkeypatch: Patch, error_line: Callable[[], str]) -> Refused:
    """The line in which a command is refused, before it writes anything."""

    def refuse(*args: str) -> str:
        from mjstack.cli import run

        monkeypatch.chdir(tmp_path)
        before = sorted(tmp_path.rglob("*"))
        assert run(list(args)) == 2
        assert sorted(tmp_path.rglob("*")) == before
        return error_line()

    return refuse


@pytest.fixture(scope="session")
def so101_cfg() -> Config:
    """The default configuration."""
    return load_config([])
