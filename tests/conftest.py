"""Shared scenes, planners and simulations. Everything here works offline and writes only below
pytest's temporary folder.
"""

from __future__ import annotations

import gc
import os
from collections.abc import Callable, Iterator
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from compositions import load_config

from mjstack.config.schema import Backend, Config
from mjstack.episodes.context import RunContext
from mjstack.episodes.rollout import Hook
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
def stage() -> Callable[..., RunContext]:
    """Configuration, model, index and planner of a robot under some overrides, each made once in
    the session.
    """
    made: dict[tuple[str, ...], RunContext] = {}

    def get(robot: str, *overrides: str) -> RunContext:
        key = (f"robot={robot}", *overrides)
        if key not in made:
            made[key] = RunContext(cfg=load_config(key))
        return made[key]

    return get


@pytest.fixture(scope="session")
def new_context(stage: Callable[..., RunContext]) -> Callable[..., RunContext]:
    """A gate context of its own for some overrides that change neither scene nor, but for its
    phases, plan: both are shared.
    """

    def make(*overrides: str, robot: str = "so101") -> RunContext:
        shared = stage(
            robot,
            *(override for override in overrides if override.startswith("controller.phases.")),
        )
        return RunContext(load_config([f"robot={robot}", *overrides]), shared.stage)

    return make


@pytest.fixture(scope="session")
def make_sim(stage: Callable[[str], RunContext]) -> Callable[..., Simulation]:
    """Simulations by (backend, nworld, overrides), reset and shared by all tests: MJWarp's are slow
    to build.
    """
    made: dict[tuple, Simulation] = {}

    def make(backend: str, nworld: int, *overrides: str, robot: str = "so101") -> Simulation:
        key = (backend, nworld, robot, overrides)
        if key not in made:
            cfg = load_config([f"robot={robot}", *overrides])
            kind = Backend.native if backend == "native" else Backend.mjwarp
            device = "cuda:0" if backend == "mjwarp-cuda" else "cpu"
            made[key] = make_simulation(
                stage(robot).model, cfg, nworld, backend=kind, device=device
            )
        made[key].reset()
        return made[key]

    return make


@pytest.fixture(scope="session")
def recorded(
    stage: Callable[[str], RunContext], make_sim: Callable[..., Simulation]
) -> Callable[[str], SimpleNamespace]:
    """A native episode of four jittered worlds per robot: cube poses and velocities at every step
    end, and the result.
    """
    made: dict[str, SimpleNamespace] = {}

    def get(robot: str) -> SimpleNamespace:
        if robot not in made:
            context = stage(robot)
            sim = make_sim("native", 4, robot=robot)
            pose = []
            velocity = []
            force = []
            gripper = []

            def keep(_: int, sim: Simulation) -> None:
                pose.append(
                    np.stack(
                        [sim.qpos[:, a : a + 7].numpy().copy() for a in context.index.object_qpos],
                        1,
                    )
                )
                velocity.append(
                    np.stack(
                        [sim.qvel[:, a : a + 6].numpy().copy() for a in context.index.object_qvel],
                        1,
                    )
                )
                force.append(sim.sensordata.numpy().copy())
                fingers = context.index.robot_qpos[context.index.n_arm :]
                gripper.append(sim.qpos[:, fingers].numpy().copy())

            episode = context.play(sim, context.cfg.reset, [Hook(keep)])
            made[robot] = SimpleNamespace(
                pose=np.stack(pose, 1),
                velocity=np.stack(velocity, 1),
                force=np.stack(force, 1),
                gripper=np.stack(gripper, 1),
                jaw_force=context.index.jaw_force,
                result=episode.result,
                step_count=sim.step_count.numpy().copy(),
                cfg=context.cfg,
                phases=context.planner.phases,
            )
        return made[robot]

    return get


@pytest.fixture(params=ROBOTS)
def robot(request: pytest.FixtureRequest) -> str:
    """Either robot."""
    return request.param


BACKENDS = [
    "native",
    "mjwarp",
    pytest.param(
        "mjwarp-cuda",
        marks=[
            pytest.mark.gpu,
            pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here"),
        ],
    ),
]


@pytest.fixture(params=BACKENDS)
def backend(request: pytest.FixtureRequest) -> str:
    """Every backend this machine has; MJWarp on Warp's CPU device, and on CUDA where
    there is one.
    """
    return request.param


@pytest.fixture(scope="session")
def so101_cfg() -> Config:
    """The default configuration."""
    return load_config([])
