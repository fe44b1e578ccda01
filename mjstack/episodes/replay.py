"""One world of a batch played again, alone: its trajectory, and a report on every rule."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mjstack.config.schema import Backend, Config
from mjstack.drivers.driver import Driver
from mjstack.envs import Env
from mjstack.episodes.context import RunContext
from mjstack.episodes.observers import Episode, WorldRecorder
from mjstack.episodes.record import measured_values
from mjstack.episodes.rollout import Observer, State, snapshot
from mjstack.files import write_atomic
from mjstack.managers.reset import required_fields
from mjstack.sim import Simulation, describe_overflow, make_simulation, resolve_sizes
from mjstack.sim.sizes import BatchSizes
from mjstack.tasks.check import make_check
from mjstack.tasks.view import TaskView

_SHARES = 4  # of the contact pool, for a world that is alone


@dataclass(frozen=True, kw_only=True, slots=True)
class RuleFinding:
    """One rule of one world: whether it held, what was found, and what it wants."""

    rule: str
    text: str
    held: bool
    found: str
    wanted: str

    def __str__(self) -> str:
        result = "held" if self.held else f"BROKEN, {self.text}"
        return f"{self.rule}: {result}: {self.found} (wanted: {self.wanted})"


@dataclass(eq=False, kw_only=True, slots=True)
class ReplayedWorld:
    """What a replay leaves behind.

    Attributes:
        episode: The episode of the one world.
        recorder: Its positions and phases.
        start: Its state before the first step.
        fields: Model fields that its start wrote, by MuJoCo's name.
        steps: State and task check at step ends, by name, each with steps first.
        findings: The rules, all of them.
        description: Backend and hardware.
        qpos_end: Final positions in the backend's precision, shape ``(nq,)``.
    """

    episode: Episode
    recorder: WorldRecorder
    start: State
    fields: dict[str, np.ndarray]
    steps: dict[str, np.ndarray]
    findings: list[RuleFinding]
    description: str
    qpos_end: np.ndarray

    @property
    def failed(self) -> int:
        """Bits of the task's rules."""
        return int(self.episode.result.failed[0])

    def write(self, path: Path, *, seed: int, world: int) -> None:
        """Writes the trajectory as an npz file, in one step."""
        arrays: dict[str, Any] = {
            "seed": seed,
            "world": world,
            "backend": self.description,
            "failed": self.failed,
            "start_qpos": self.start.qpos[0],
            "start_qvel": self.start.qvel[0],
            **{f"field.{name}": values for name, values in self.fields.items()},
            **self.steps,
        }
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **arrays)
        write_atomic(path, buffer.getvalue())


def replay_world(
    context: RunContext,
    *,
    seed: int,
    world: int,
    backend: Backend,
    device: str,
    observers: Sequence[Observer] = (),
) -> ReplayedWorld:
    """Play one world as it started in its batch.

    Random numbers depend on the seed, the world's number and the episode, not on the other worlds,
    so it needs no others.

    Args:
        context: The run's configuration; its ``nworld`` is the batch's.
        seed: The seed.
        world: The world's number in the batch.
        backend: Native or MJWarp.
        device: ``cpu`` or ``cuda:N``.
        observers: Look on.
    """
    cfg = replace(context.cfg, seed=seed)
    sim = _alone(context, backend, device)
    try:
        trace = _Trace()
        recorder = WorldRecorder()
        episode = context.play(
            sim, cfg.reset, [trace, *observers, recorder], seed=seed, worlds=[world]
        )
        steps = _steps(trace, recorder, cfg, context)
        return ReplayedWorld(
            episode=episode,
            recorder=recorder,
            start=trace.initial,
            fields=trace.fields,
            steps=steps,
            findings=_explain(episode, steps, sim, cfg, context),
            description=sim.description,
            qpos_end=sim.qpos[0].cpu().numpy().copy(),
        )
    finally:
        sim.close()


class _Trace(Observer):
    """Keeps the start, the state at every step end, and what the check looks at."""

    def start(self, env: Env, driver: Driver) -> None:
        """See `Observer`."""
        self._sim = env.sim
        self._check = make_check(env.cfg)
        self._task = self._check.view(env)
        self._objects = TaskView(env, list(env.cfg.scene.free))
        self.initial = snapshot(env.sim)
        self.fields = {name: f[0].cpu().numpy().copy() for name, f in env.sim.fields.items()}
        self.states: list[State] = []
        self.values: dict[str, list[np.ndarray]] = {}

    def after_step(self, step: int) -> None:
        """See `Observer`."""
        self.states.append(snapshot(self._sim))
        objects = self._objects.step()
        values = {
            "cube_pos_m": objects.pos,
            "cube_speed_m_per_s": objects.speed,
            "cube_height_m": objects.height,
            **self._check.trace(self._task.step()),
        }
        for name, value in values.items():
            self.values.setdefault(name, []).append(value[0].cpu().numpy().copy())


def start_of_world(
    context: RunContext, *, seed: int, world: int, backend: Backend, device: str
) -> np.ndarray:
    """Positions at which a world starts, shape ``(nq,)``; arguments as of `replay_world`."""
    sim = _alone(context, backend, device)
    try:
        context.start(sim, context.cfg.reset, seed=seed, worlds=[world])
        return sim.qpos[0].cpu().numpy().copy()
    finally:
        sim.close()


def _alone(context: RunContext, backend: Backend, device: str) -> Simulation:
    """A simulation for one world of the batch."""
    cfg = context.cfg
    return make_simulation(
        context.model,
        cfg,
        1,
        backend=backend,
        device=device,
        fields=required_fields(cfg.reset),
        sizes=_sizes_alone(resolve_sizes(cfg), cfg.nworld),
    )


def _sizes_alone(sizes: BatchSizes, nworld: int) -> BatchSizes:
    """Buffers for one world. In its batch it could take more than its share of the contact pool, so
    it gets some more.
    """

    def room(share: int, pool: int | None) -> int:
        return min(_SHARES * share, share * nworld if pool is None else pool)

    naconmax = room(sizes.nconmax, sizes.naconmax)
    naccdmax = sizes.naccdmax
    if sizes.nccdmax is not None or naccdmax is not None:
        naccdmax = min(room(sizes.nccdmax or sizes.nconmax, naccdmax), naconmax)
    return replace(
        sizes,
        nconmax=min(sizes.nconmax, naconmax),
        naconmax=naconmax,
        nccdmax=None,
        naccdmax=naccdmax,
    )


def _steps(
    trace: _Trace, recorder: WorldRecorder, cfg: Config, context: RunContext
) -> dict[str, np.ndarray]:
    """State and what the check looks at, at step ends, objects in the scene's order."""
    names = np.array([phase.name for phase in context.planner.phases])
    states = {
        name: np.concatenate([getattr(state, name) for state in trace.states])
        for name in ("qpos", "qvel", "ctrl")
    }
    return {
        "time_s": np.arange(1, len(trace.states) + 1) * cfg.timing.step_dt,
        "phase": names[recorder.phase],
        **states,
        **{name: np.stack(values) for name, values in trace.values.items()},
    }


def _explain(
    episode: Episode,
    steps: dict[str, np.ndarray],
    sim: Simulation,
    cfg: Config,
    context: RunContext,
) -> list[RuleFinding]:
    """Every rule with what was found. Whether it held is the check's own result; the numbers say
    why.
    """
    bits = int(episode.result.failed[0])
    rules = context.check.rules
    values = {name: float(v[0]) for name, v in measured_values(episode.result).items()}
    finite = np.isfinite(steps["qpos"]).all(1) & np.isfinite(steps["qvel"]).all(1)
    lost = int(finite.argmin())  # the first step, if any
    told = {
        "FINITE": (
            "always" if finite.all() else f"not in step {lost}, in {steps['phase'][lost]}",
            "always",
        ),
        "STEPS": (
            f"{int(sim.step_count[0])} steps",
            f"{len(finite) * cfg.timing.decimation} steps",
        ),
        "OVERFLOW": (describe_overflow(int(sim.overflow[0])) or "none", "none"),
        **context.check.report(values),
    }
    return [
        RuleFinding(
            rule=name,
            text=rules.texts[name],
            held=not bits & bit,
            found=told[name][0],
            wanted=told[name][1],
        )
        for name, bit in rules.items()
    ]
