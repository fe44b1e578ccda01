"""Environments for tests. Simulations are slow to make, so tests share them, one environment at a
time.
"""

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache, reduce
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import pytest
import torch
from compositions import load_config
from numpy.typing import ArrayLike

from mjstack.config.schema import Backend, Config, TermCfg
from mjstack.envs import Env
from mjstack.episodes.record import EpisodeRecord
from mjstack.episodes.run import Run
from mjstack.episodes.stage import Stage
from mjstack.gates.episodes import judge_episodes
from mjstack.managers import required_fields
from mjstack.report.record import GateResult
from mjstack.scene import SceneIndex, build_model
from mjstack.sim import Simulation, make_simulation
from mjstack.sim.sizes import resolve_sizes

if TYPE_CHECKING:
    from mjstack.sim.mjwarp import MjwarpSimulation

CUDA = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here"),
]
DEVICES = ["cpu", pytest.param("cuda:0", marks=CUDA)]
TASKS = ("stack", "reach")
NOMINAL = {"home": TermCfg(func="mjstack.mdp.reset.home")}
# Of task=reach, episodes of half the length, in which the expert still succeeds
SHORT_REACH = (
    "controller.phases.hold.seconds=0.4",
    "task.episode_steps=70",
    "task.check.window=10",
)
# For tests whose path is one for both robots: the reBot's in test-rest alone
REBOT_LATER = pytest.mark.parametrize(
    "robot", ["so101", pytest.param("rebot", marks=pytest.mark.full)]
)
STATE = ("qpos", "qvel", "act", "ctrl")
POSES = ("xpos", "xquat", "site_xpos", "geom_xpos")
COUNTS = (
    "contact_count",
    "constraint_count",
    "step_count",
    "overflow",
    "peak_contacts",
    "peak_constraints",
)
VIEWS = (*STATE, *POSES, "qfrc_actuator", "sensordata", *COUNTS)
Trace = list[dict[str, torch.Tensor]]
# Types of fixtures
Patch = pytest.MonkeyPatch
Capture = pytest.CaptureFixture[str]
GetStage = Callable[..., Stage]
MakeSim = Callable[..., Simulation]
NewRun = Callable[..., Run]
Refused = Callable[..., str]

_model = cache(lambda robot: build_model(configure(robot=robot)))


def configure(*overrides: str, robot: str = "so101") -> Config:
    """A configuration of the caller's own."""
    return load_config((f"robot={robot}", *overrides))


def on_cuda(test: Callable) -> Callable:
    """Mark a test that needs a CUDA device."""
    return reduce(lambda marked, mark: mark(marked), CUDA, test)


def judge(run: Run, gate: str = "batch") -> GateResult:
    """The result of a gate of episodes."""
    run.gate = gate
    (result,) = judge_episodes(run)
    return result


def few(cases: Iterable[Any], n: int) -> list[Any]:
    """Every n-th case of a test; the others are for test-rest alone."""
    out = []
    for number, case in enumerate(cases):
        values = case if isinstance(case, tuple) else (case,)
        is_first = number % n == 0 or hasattr(case, "marks")
        out.append(case if is_first else pytest.param(*values, marks=pytest.mark.full))
    return out


@contextmanager
def no_host_reads() -> Iterator[None]:
    """Torch raises at every read from the device."""
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode("default")


@cache
def has_gl() -> bool:
    """Whether MuJoCo draws offscreen on this machine; where it does not, there is no scene.png."""
    try:
        mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8).close()
    except Exception:  # OpenGL loaders fail in their own ways
        return False
    return True


@cache
def at_double_speed(robot: str = "so101", task: str = "stack") -> tuple[str, ...]:
    """Overrides that halve the phases' times: both arms still do both tasks, and stacking has the
    same peaks.
    """
    phases = configure(f"task={task}", robot=robot).controller.phases
    return tuple(
        f"controller.phases.{name}.seconds={phase.seconds / 2}" for name, phase in phases.items()
    )


@cache
def one_second_episode() -> tuple[str, ...]:
    """Overrides of an episode that is over, and has failed, after a second."""
    phases = configure().controller.phases
    return ("task.check.window=5", *(f"controller.phases.{name}.seconds=0.1" for name in phases))


def on_backend(backend: str) -> dict[str, Any]:
    """Backend and device of a simulation, by the name that tests have for both."""
    engine, _, cuda = backend.partition("-")
    return {"backend": Backend(engine), "device": "cuda:0" if cuda else "cpu"}


def new_sim(backend: str, nworld: int, robot: str = "so101") -> Simulation:
    """A simulation with every field that a reset term of mjstack writes, and room for random
    actions.
    """
    cfg = configure("reset=randomized", robot=robot)
    return make_simulation(
        _model(robot),
        cfg,
        nworld,
        **on_backend(backend),
        fields=required_fields(cfg.reset),
        sizes=resolve_sizes(cfg, driven=False),
    )


def fused_sim(
    cfg: Config,
    nworld: int,
    device: str = "cpu",
    *,
    fields: Sequence[str] = (),
    edit: Callable[[mujoco.MjModel], None] | None = None,
) -> "MjwarpSimulation":
    """A simulation on MJWarp with room for random actions, of a model that is edited before."""
    from mjstack.sim.mjwarp import MjwarpSimulation  # loads Warp

    model = build_model(cfg)
    if edit is not None:
        edit(model)
    sizes = resolve_sizes(cfg, driven=False)
    sim = make_simulation(
        model, cfg, nworld, backend=Backend.mjwarp, device=device, sizes=sizes, fields=fields
    )
    assert isinstance(sim, MjwarpSimulation)
    return sim


_shared = cache(new_sim)


def on_shared_sim(backend: str, nworld: int, cfg: Config) -> Env:
    """An environment on the simulation that tests share: it is the tests' only one until the next
    is built.
    """
    sim = _shared(backend, nworld, cfg.robot.name)
    for name, field in sim.fields.items():
        field[:] = torch.from_numpy(getattr(sim.model, name)).to(field)
    sim.reset()
    return Env(sim, SceneIndex(sim.model, cfg.robot, cfg.scene), cfg)


def on_new_sim(backend: str, nworld: int, cfg: Config) -> Env:
    """An environment on a simulation that nobody has used."""
    sim = new_sim(backend, nworld, cfg.robot.name)
    return Env(sim, SceneIndex(sim.model, cfg.robot, cfg.scene), cfg)


def quats(yaw: np.ndarray) -> np.ndarray:
    """Rotations about z [rad], as a starts file has them, shape ``(..., 4)``."""
    zero = np.zeros_like(yaw)
    return np.stack((np.cos(0.5 * yaw), zero, zero, np.sin(0.5 * yaw)), axis=-1)


def report_of(folder: Path) -> dict[str, Any]:
    """The report that a run has left."""
    return json.loads((folder / "report.json").read_text())


def gate_of(folder: Path) -> dict[str, Any]:
    """Its one gate."""
    (gate,) = report_of(folder)["gates"]
    return gate


def record_of(folder: Path, seed: int = 0, gate: str = "batch") -> EpisodeRecord:
    """What a gate has left of the worlds of a seed."""
    record = EpisodeRecord.read(folder, seed, gate)
    assert record is not None
    return record


def two_starts(red_x: float = 0.31, **others: ArrayLike) -> dict[str, np.ndarray]:
    """Those of two worlds, the red cube of the second at an x [m]."""
    red = [(0.33, -0.13, 0.0), (red_x, -0.1, 0.3)]
    return stack_starts(red, [(0.33, 0.06, 0.0), (0.34, 0.08, -0.5)], **others)


def stack_starts(red: ArrayLike, blue: ArrayLike, **others: ArrayLike) -> dict[str, np.ndarray]:
    """The arrays of a starts file with both cubes, from x, y [m] and yaw [rad] of every world."""
    starts = {name: np.asarray(values) for name, values in others.items()}
    for name, rows in (("red", np.array(red)), ("blue", np.array(blue))):
        starts |= {f"{name}_xy": rows[:, :2], f"{name}_quat": quats(rows[:, 2])}
    return starts


def actions(env: Env, steps: int, seed: int = 0) -> list[torch.Tensor]:
    """Random actions between the bounds; world k's are the same in any environment that starts with
    world 0.
    """
    low = env.action_manager.low.cpu()
    high = env.action_manager.high.cpu()
    rows = []
    for world in env.world.tolist():
        generator = torch.Generator().manual_seed(1000 * seed + world)
        rows.append(torch.rand((steps, len(low)), generator=generator, dtype=low.dtype))
    draw = low + (high - low) * torch.stack(rows, dim=1)
    return list(draw.to(env.device))


def zeros(env: Env, **kwargs: Any) -> torch.Tensor:
    """Actions of 0."""
    shape = (env.nworld, env.action_manager.action_dim)
    return torch.zeros(shape, **({"device": env.device} | kwargs))


def mask_of(env: Env, *worlds: int) -> torch.Tensor:
    """A mask that selects some worlds."""
    mask = torch.zeros(env.nworld, dtype=torch.bool, device=env.device)
    mask[list(worlds)] = True
    return mask


def returned(step: tuple[Any, ...]) -> dict[str, torch.Tensor]:
    """The tensors that `step` or `reset` returned, in one list."""
    obs = step[0]
    extras = step[-1]
    out = {f"obs.{name}": value for name, value in obs.items()}
    if len(step) == 5:
        out |= dict(zip(("reward", "terminated", "truncated"), step[1:4], strict=True))
        out |= {f"final.{name}": value for name, value in extras["final_obs"].items()}
        out["success"] = extras["success"]
    return out


def state_of(env: Env, views: tuple[str, ...] = VIEWS) -> dict[str, torch.Tensor]:
    """Copies of everything that an environment and its simulation keep for each world."""
    out = {name: getattr(env.sim, name).clone() for name in views}
    out |= {f"fields.{name}": field.clone() for name, field in env.sim.fields.items()}
    out |= {
        name: getattr(env, name).clone()
        for name in ("episode", "episode_step", "success", "action", "previous_action")
    }
    out["episode_sums"] = env.reward_manager.episode_sums.clone()
    return out


def play(env: Env, moves: list[torch.Tensor], before: Callable[[int], None] | None = None) -> Trace:
    """Steps through the moves; per step what was returned, and the state, episode and step after
    it.
    """
    trace = []
    for t, move in enumerate(moves):
        if before is not None:
            before(t)
        row = returned(env.step(move))
        views = (*STATE, "site_xpos", "sensordata")
        row |= {name: getattr(env.sim, name).clone() for name in views}
        row |= {name: getattr(env, name).clone() for name in ("episode", "episode_step")}
        trace.append(row)
    return trace


# N. Native MuJoCo's forces of a jaw, 5 to 100 N, move by up to 3e-3 where qpos and qvel are rounded
# to float32 once, and every substep rounds.
FORCE = 2e-2


def assert_same_run(a: torch.Tensor, b: torch.Tensor, backend: str, atol: float = 1e-3) -> None:
    """Bit for bit on the CPU backends. CUDA sums in no fixed order: there two runs agree to
    rounding (docs/design.md).
    """
    if backend.endswith("cuda"):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=atol)
    else:
        assert torch.equal(a, b)


def assert_rows(
    a: dict[str, torch.Tensor],
    b: dict[str, torch.Tensor],
    rows: Any,
    other: Any,
    backend: str,
    where: str = "",
) -> None:
    """Rows of one are the other rows of the other."""
    assert a.keys() == b.keys()
    for name, x in a.items():
        try:
            atol = FORCE if name == "sensordata" else 1e-3
            assert_same_run(x[rows], b[name][other], backend, atol)
        except AssertionError as error:
            raise AssertionError(f"{where} {name}: {x[rows]} is not {b[name][other]}") from error


def assert_traces(a: Trace, b: Trace, rows: Any, other: Any, backend: str) -> None:
    """Likewise step by step."""
    assert len(a) == len(b) > 0
    for t, (x, y) in enumerate(zip(a, b, strict=True)):
        assert_rows(x, y, rows, other, backend, f"step {t}:")


def start_moving(sim: Simulation, stage: Stage) -> None:
    """Home, jittered cubes, and a command that moves every joint."""
    stage.start(sim, stage.cfg.reset)
    sim.ctrl[:, torch.from_numpy(stage.index.ctrl)] += 0.05


class StubViews(SimpleNamespace):
    """Views that a test sets anew at every step, in place of a `Simulation`."""

    def part(self, name: str, columns: Any, *shape: int) -> torch.Tensor:
        view = getattr(self, name)[:, getattr(columns, "at", columns)]
        return view.unflatten(1, shape) if shape else view

    @property
    def no_worlds(self) -> torch.Tensor:
        return torch.zeros(len(self.qpos), dtype=torch.bool)
