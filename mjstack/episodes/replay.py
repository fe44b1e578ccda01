"""One world of a batch played again, alone: its trajectory, and a report on every rule."""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mjstack.config.schema import Backend
from mjstack.drivers.driver import Driver
from mjstack.envs import Env
from mjstack.episodes.context import RunContext
from mjstack.episodes.rollout import Episode, Observer, WorldRecorder
from mjstack.sim import BatchSizes, Simulation, describe_overflow, resolve_sizes
from mjstack.tasks.check import make_check
from mjstack.tasks.view import TaskView

_SHARES = 4  # of the contact pool, for a world that is alone


@dataclass(eq=False, kw_only=True, slots=True)
class ReplayedWorld:
    """The result of a replay.

    Attributes:
        episode: The episode of the one world.
        recorder: Its positions and phases.
        arrays: Its start, and its state and the check's values at step ends, for an npz file.
        findings: A line for each rule.
    """

    episode: Episode
    recorder: WorldRecorder
    arrays: dict[str, Any]
    findings: list[str]


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
    cfg = context.cfg
    with closing(simulate_alone(context, backend, device)) as sim:
        trace = _Trace()
        recorder = WorldRecorder()
        looking = [trace, *observers, recorder]
        episode = context.play(sim, cfg.reset, looking, seed=seed, worlds=[world])
        names = np.array([phase.name for phase in recorder.driver.phases] or [""])
        steps = {name: np.stack(values) for name, values in trace.steps.items()}
        steps["time_s"] = np.arange(1, len(recorder.phase) + 1) * cfg.timing.step_dt
        steps["phase"] = names[recorder.phase]
        facts = {
            "seed": seed,
            "world": world,
            "backend": sim.description,
            "failed": int(episode.failed[0]),
        }
        return ReplayedWorld(
            episode=episode,
            recorder=recorder,
            arrays=facts | trace.start_arrays | steps,
            findings=_explain(episode, steps, sim, context),
        )


class _Trace(Observer):
    """Keeps the start, and the state and the check's values at every step end, by name in the
    file.
    """

    def start(self, env: Env, driver: Driver) -> None:
        """See `Observer`."""
        super().start(env, driver)
        self._check = make_check(env.cfg)
        self._task = self._check.view(env)
        self._objects = TaskView(env, list(env.cfg.scene.free))
        first = {"start_qpos": env.sim.qpos.double(), "start_qvel": env.sim.qvel.double()}
        first |= {f"field.{name}": field for name, field in env.sim.fields.items()}
        self.start_arrays = {name: value[0].cpu().numpy().copy() for name, value in first.items()}
        self.steps: dict[str, list[np.ndarray]] = {}

    def after_step(self, step: int) -> None:
        """See `Observer`."""
        sim = self.env.sim
        objects = self._objects.step()
        values = {
            "qpos": sim.qpos.double(),
            "qvel": sim.qvel.double(),
            "ctrl": sim.ctrl.double(),
            "object_pos_m": objects.pos,
            "object_speed_m_per_s": objects.speed,
            "object_height_m": objects.height,
            **self._check.trace(self._task.step()),
        }
        for name, value in values.items():
            self.steps.setdefault(name, []).append(value[0].cpu().numpy().copy())


def start_of_world(
    context: RunContext, *, seed: int, world: int, backend: Backend, device: str
) -> np.ndarray:
    """Positions at which a world starts, shape ``(nq,)``; arguments as of `replay_world`."""
    with closing(simulate_alone(context, backend, device)) as sim:
        context.start(sim, context.cfg.reset, seed=seed, worlds=[world])
        return sim.qpos[0].cpu().numpy().copy()


def simulate_alone(
    context: RunContext, backend: Backend, device: str, nworld: int = 1
) -> Simulation:
    """Make the simulation of some worlds of the batch, without the others."""
    sizes = _sizes_alone(resolve_sizes(context.cfg), context.cfg.nworld)
    return context.simulation(nworld, backend, device, sizes=sizes)


def _sizes_alone(sizes: BatchSizes, nworld: int) -> BatchSizes:
    """Buffers for one world. In its batch it could take more than its share of the contact pool, so
    it gets some more.
    """
    room = min(_SHARES * sizes.nconmax, sizes.contact_pool(nworld))
    return replace(sizes, nconmax=room, naconmax=None, nccdmax=None, naccdmax=None)


def _explain(
    episode: Episode, steps: dict[str, np.ndarray], sim: Simulation, context: RunContext
) -> list[str]:
    """A line for each rule. Whether it held is the check's own result; the numbers say why."""
    bits = int(episode.failed[0])
    rules = context.check.rules
    finite = np.isfinite(steps["qpos"]).all(1) & np.isfinite(steps["qvel"]).all(1)
    lost = int(finite.argmin())  # the first step, if any
    count = len(finite) * context.cfg.timing.decimation
    always = "always" if finite.all() else f"not in step {lost}, in {steps['phase'][lost]}"
    told = {
        "FINITE": (always, "always"),
        "STEPS": (f"{int(sim.step_count[0])} physics steps", f"{count}"),
        "OVERFLOW": (describe_overflow(int(sim.overflow[0])) or "none", "none"),
        **context.check.report(episode.result),
    }
    return [
        f"{name}: {f'BROKEN, {rules.texts[name]}' if bits & bit else 'held'}: {told[name][0]}"
        f" (wanted: {told[name][1]})"
        for name, bit in rules.items()
    ]
