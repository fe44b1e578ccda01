"""NaN, infinite and huge numbers in single worlds of a batch: those worlds fail by a rule, or are
named, and the others end as in a run without them. On CUDA every step is a captured graph.
"""

import itertools
import math

import numpy as np
import pytest
import torch
from compositions import load_config
from environments import at_double_speed

from mjstack.config.schema import Backend
from mjstack.drivers.driver import Driver
from mjstack.envs import Env
from mjstack.episodes.rollout import Observer, play_episode
from mjstack.episodes.stage import Stage
from mjstack.errors import ArgumentError
from mjstack.managers import required_fields
from mjstack.sim import Simulation, make_simulation

VALUES = (math.nan, math.inf, 1e20, 1e38)
Fault = tuple[str, float]
FAULTS: list[Fault] = list(
    itertools.product(("qpos", "qvel", "mass", "friction", "target"), VALUES)
)
FIRST = 2  # world of the first fault; each has a world of its own


class Faults(Observer):
    """Writes every fault into its world at the end of a step, within the captured work."""

    def __init__(self, at: int, faults: list[Fault]) -> None:
        self._at = at
        self._faults = faults

    def start(self, env: Env, driver: Driver) -> None:
        super().start(env, driver)
        sim = env.sim
        red = sim.model.body("red").id
        table = sim.model.geom("table").id
        geom = env.index.geoms["red"][0]
        self._step = torch.zeros(1, dtype=torch.int64, device=env.device)
        self._places = {
            "qpos": (sim.qpos, [env.index.object_qpos[0]]),
            "qvel": (sim.qvel, [env.index.object_qvel[0]]),
            "mass": (sim.fields["body_mass"], [red]),
            "friction": (sim.fields["geom_friction"][..., 0], [geom, table]),
        }
        self._worlds = torch.arange(env.nworld, device=env.device)

    def update(self) -> None:
        now = self._step == self._at
        for number, (target, value) in enumerate(self._faults):
            if target in self._places:
                view, columns = self._places[target]
                for column in columns:
                    view[:, column].masked_fill_(now & (self._worlds == FIRST + number), value)
        self._step.add_(1)


class FaultyDriver:
    """A driver whose joint targets are spoilt in the worlds of such faults, from a step on."""

    def __init__(self, driver: Driver, at: int, faults: list[Fault], finite: bool) -> None:
        self._driver = driver
        self._at = at
        self._step = torch.zeros(1, dtype=torch.int64, device=driver.phase.device)
        worlds = torch.arange(len(driver.phase), device=driver.phase.device)
        self._spoilt = [
            (worlds[:, None] == FIRST + number, value)
            for number, (target, value) in enumerate(faults)
            if target == "target" and math.isfinite(value) >= finite
        ]

    def __getattr__(self, name: str) -> object:
        return getattr(self._driver, name)

    def command(self) -> torch.Tensor:
        command = self._driver.command().clone()
        for world, value in self._spoilt:
            command.masked_fill_(world & (self._step >= self._at), value)
        self._step.add_(1)
        return command


def worlds_of(backend: str, controller: str, faults: int) -> tuple[Stage, Simulation]:
    """Some worlds more than faults, with the model fields that are spoilt."""
    is_cuda = backend.endswith("cuda")
    fields = (
        "+reset.mass={func:mjstack.mdp.reset.ObjectMass,params:{scale:[0.99,1.01]}}",
        "+reset.friction={func:mjstack.mdp.reset.ObjectFriction,params:{sliding:[1.1,1.2]}}",
    )
    cfg = load_config([f"controller={controller}", *fields, *at_double_speed()])
    stage = Stage(cfg)
    return stage, make_simulation(
        stage.model,
        cfg,
        2048 if is_cuda else FIRST + faults + 2,
        backend=Backend.native if backend == "native" else Backend.mjwarp,
        device="cuda:0" if is_cuda else "cpu",
        fields=required_fields(cfg.reset),
    )


@pytest.mark.full
@pytest.mark.parametrize("value", VALUES[:2])
def test_a_target_that_is_not_finite_is_refused_by_its_world(value: float) -> None:
    """On CUDA it counts as 0, and its world fails."""
    stage, sim = worlds_of("native", "open_loop", 1)
    env = stage.start(sim, stage.cfg.reset)
    driver = FaultyDriver(stage.driver(env), 2, [("target", value)], finite=False)
    with pytest.raises(ArgumentError, match=f"{value}.* in world {FIRST}, expected finite numbers"):
        play_episode(env, driver)
    sim.close()


@pytest.mark.full
@pytest.mark.parametrize("controller", ["open_loop", "closed_loop"])
def test_a_fault_stays_in_its_world(backend: str, controller: str) -> None:
    if (backend, controller) == ("mjwarp", "closed_loop"):
        pytest.skip("the expert's kernels take a minute on Warp's CPU device")
    # Warp's CPU device is slow: one fault of each kind
    faults = [*FAULTS[::5], FAULTS[-1]] if backend == "mjwarp" else FAULTS
    stage, sim = worlds_of(backend, controller, len(faults))
    is_cuda = backend.endswith("cuda")
    nworld = sim.nworld
    cfg = stage.cfg
    at = stage.phase("lift_red").start
    episodes = []
    for observers in ([], [Faults(at, faults)]):
        env = stage.start(sim, cfg.reset)
        driver = stage.driver(env)
        if observers:
            # On the CPU a target that is not finite is refused, see above
            driver = FaultyDriver(driver, at, faults, finite=not is_cuda)
        episodes.append((play_episode(env, driver, observers), sim.qpos.cpu().numpy().copy()))
    sim.close()

    (clean, ends), (faulty, others_end) = episodes
    worlds = np.arange(FIRST, FIRST + len(faults))
    others = np.delete(np.arange(nworld), worlds)
    told = {
        faults[world - FIRST]: stage.check.rules.broken(int(faulty.failed[world]))
        for world in worlds
    }
    for (target, value), broken in told.items():
        refused = target == "target" and not is_cuda and not math.isfinite(value)
        # Of two frictions MuJoCo takes the larger: NaN is none, and a huge one holds
        assert broken or refused or target == "friction", told
    assert np.isfinite(others_end[faulty.failed == 0]).all()
    if not is_cuda:
        assert not clean.failed.any()
        np.testing.assert_array_equal(faulty.failed[others], clean.failed[others])
        np.testing.assert_array_equal(others_end[others], ends[others])
        return
    failing = [int((episode.failed[others] != 0).sum()) for episode in (clean, faulty)]
    assert abs(failing[1] - failing[0]) <= 0.005 * nworld, failing
    columns = [a + i for a in stage.index.object_qpos for i in range(3)]
    apart = np.abs(others_end[others][:, columns] - ends[others][:, columns]).max(1)
    assert (apart < 1e-3).mean() > 0.9, np.quantile(apart, (0.5, 0.9, 0.95, 0.99))
