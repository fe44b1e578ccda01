"""Recorded episodes: whole batches at every step end, and single worlds for the plain checker of
the task or for alterations.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from box_checker import check_box_world
from check_cases import BLUE, RED, STOPPED_EARLY, Outcome, Recording, limits
from compositions import load_config
from environments import StubViews, at_double_speed
from stack_checker import check_world

from mjstack.drivers.driver import Driver
from mjstack.envs import Env
from mjstack.episodes.failures import FailureMonitor
from mjstack.episodes.rollout import Episode, Observer, play_episode
from mjstack.episodes.stage import Stage
from mjstack.tasks.check import CheckResult, make_check

NAMES = ("red", "blue")
STATE = ("qpos", "qvel", "sensordata")
Disturb = Callable[[Env, str], None]
"""Interferes at a step's end, after it was judged and kept; told the phase of the last world."""


class Recorder(Observer):
    """Keeps every world's state and phase at every step end."""

    def __init__(self, disturb: Disturb | None = None) -> None:
        self._disturb = disturb
        self._rows: dict[str, list[np.ndarray]] = {name: [] for name in (*STATE, "phase")}

    def start(self, env: Env, driver: Driver) -> None:
        super().start(env, driver)
        self._driver = driver

    def after_step(self, step: int) -> None:
        for name in STATE:
            self._rows[name].append(getattr(self.env.sim, name).double().cpu().numpy().copy())
        phase = self._driver.phase.cpu().numpy().copy()
        self._rows["phase"].append(phase)
        if self._disturb is not None:
            self._disturb(self.env, self._driver.phases[phase[-1]].name)

    def recording(self, stage: Stage, episode: Episode, **others: Any) -> SimpleNamespace:
        """Rows of all steps, what a world ends with, and the result."""
        sim = self.env.sim
        sim.kinematics()
        arrays = {name: np.stack(rows, 1) for name, rows in self._rows.items()}
        for name in ("xpos", "xquat", "step_count", "overflow"):
            arrays[name] = getattr(sim, name).cpu().numpy().copy()
        views = {"stage": stage, "episode": episode, "result": episode.result}
        return SimpleNamespace(**views, **arrays, **others)


@contextmanager
def recording(stage: Stage, disturb: Disturb | None = None) -> Iterator[list[SimpleNamespace]]:
    """Recordings of the episodes that the stage, or one that a gate derives from it, plays."""
    recordings: list[SimpleNamespace] = []

    def play(
        env: Env, driver: Driver, observers: Sequence[Observer] = (), **kwargs: Any
    ) -> Episode:
        recorder = Recorder(disturb)
        episode = play_episode(env, driver, [*observers, recorder], **kwargs)
        watch = next((o for o in observers if isinstance(o, FailureMonitor)), None)
        recordings.append(recorder.recording(stage, episode, watch=watch))
        return episode

    with pytest.MonkeyPatch.context() as patch:
        for module in ("stage", "batches"):
            patch.setattr(f"mjstack.episodes.{module}.play_episode", play)
        yield recordings


def _overrides(robot: str) -> list[str]:
    """Of the task with phases of half their time, but for those that hold a window of the check."""
    faster = [phase for phase in at_double_speed(robot, "box") if "settle" not in phase]
    return ["task=box", f"robot={robot}", *faster]


@cache
def base_stage(robot: str) -> Stage:
    return Stage(load_config(_overrides(robot)))


def faster_stage(robot: str, *overrides: str) -> Stage:
    """For overrides that change neither scene nor plan: both are shared by the robot's stages."""
    return Stage(load_config([*_overrides(robot), *overrides]), base_stage(robot).assets)


def put_cube(env: Env, cube: int, place: list[float] | np.ndarray) -> None:
    """Puts a cube of the last world somewhere, at rest; the place has its x, y, z [m] and, if it is
    longer, its quaternion.
    """
    at = env.index.object_qpos[cube]
    velocity = env.index.object_qvel[cube]
    env.sim.qpos[-1, at : at + len(place)] = torch.as_tensor(place).to(env.sim.qpos)
    env.sim.qvel[-1, velocity : velocity + 6] = 0.0


@dataclass
class World:
    """A recorded world, to be checked or altered."""

    stage: Stage
    phase: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    sensordata: np.ndarray
    xpos: np.ndarray
    xquat: np.ndarray
    step_count: int
    overflow: int = 0

    @classmethod
    def of(cls, rec: SimpleNamespace, k: int = 0) -> "World":
        arrays = {n: getattr(rec, n)[k].copy() for n in (*STATE, "phase", "xpos", "xquat")}
        counts = {name: int(getattr(rec, name)[k]) for name in ("step_count", "overflow")}
        return cls(stage=rec.stage, **counts, **arrays)

    @property
    def t(self) -> Any:
        """Thresholds."""
        return limits(self.stage.cfg)

    @property
    def window(self) -> slice:
        """The last steps, in which everything rests."""
        return slice(-self.t.window, None)

    def steps(self, *names: str) -> np.ndarray:
        """Numbers of the steps of some phases."""
        numbers = [i for i, p in enumerate(self.stage.planner.phases) if p.name in names]
        return np.flatnonzero(np.isin(self.phase, numbers))

    @property
    def order(self) -> list[str]:
        """Names of the phases in the order in which they were gone through."""
        first = np.flatnonzero(np.diff(self.phase, prepend=-1))
        return [self.stage.planner.phases[number].name for number in self.phase[first]]

    @property
    def poses(self) -> np.ndarray:
        """A view of both cubes' poses, shape ``(steps, 2, 7)``."""
        at = self.stage.index.object_qpos[RED]
        return self.qpos[:, at : at + 14].reshape(-1, 2, 7)

    @property
    def velocities(self) -> np.ndarray:
        """A view of their velocities, shape ``(steps, 2, 6)``."""
        at = self.stage.index.object_qvel[RED]
        return self.qvel[:, at : at + 12].reshape(-1, 2, 6)

    def pose(self, cube: int) -> np.ndarray:
        """A view of a cube's pose, shape ``(steps, 7)``."""
        return self.poses[:, cube]

    def velocity(self, cube: int) -> np.ndarray:
        """A view of its velocity, shape ``(steps, 6)``."""
        return self.velocities[:, cube]

    def jaw(self, cube: int, jaw: int) -> np.ndarray:
        """A view of a jaw's force on it, shape ``(steps, 3)``."""
        at = self.stage.index.jaw_force[NAMES[cube]][jaw]
        return self.sensordata[:, at : at + 3]

    def support(self, cube: int, number: int = 0) -> np.ndarray:
        """A view of the world's force on it, the other cube's or the box's, ``(steps, 3)``."""
        at = self.stage.index.support_force[NAMES[cube]][number]
        return self.sensordata[:, at : at + 3]

    @property
    def gripper(self) -> np.ndarray:
        """A view of the gripper's first joint, shape ``(steps,)``."""
        index = self.stage.index
        return self.qpos[:, index.robot_qpos[index.n_arm]]

    @property
    def recording(self) -> Recording:
        index = self.stage.index
        supports = [
            np.stack([self.support(cube, j) for j in range(len(index.support_force[name]))], 1)
            for cube, name in enumerate(NAMES)
            if name in index.support_force
        ]
        names = np.array([p.name for p in self.stage.planner.phases])
        poses = [c for a in index.object_qpos for c in range(a, a + 7)]
        return Recording(
            phase=names[self.phase],
            pose=self.poses,
            velocity=self.velocities,
            jaw_force=np.stack(
                [np.stack([self.jaw(c, j) for j in (0, 1)], 1) for c in (RED, BLUE)], 1
            ),
            support_force=np.stack(supports, 1) if supports else None,
            gripper=self.qpos[:, index.robot_qpos[index.n_arm :]],
            xpos=self.xpos,
            xquat=self.xquat,
            step_count=self.step_count,
            overflow=bool(self.overflow & ~STOPPED_EARLY),
            finite_elsewhere=bool(np.isfinite(np.delete(self.qpos, poses, axis=1)).all()),
        )

    @property
    def outcome(self) -> Outcome:
        """The verdict of the plain checker."""
        return self._judged(self.recording)

    @property
    def outcome_without_phases(self) -> Outcome:
        """The same of a driver without phases."""
        return self._judged(replace(self.recording, phase=None))

    def _judged(self, recording: Recording) -> Outcome:
        if self.stage.cfg.task.name == "stack":
            return check_world(recording, self.stage.cfg)
        return check_box_world(recording, self.stage.cfg, self.stage.model)


def feed(
    worlds: list[World], dtype: torch.dtype = torch.float64, *, phased: bool = True
) -> CheckResult:
    """Plays recordings of one robot, equally long and with the same phases, through the check, as
    of a driver with phases or without.
    """
    stage = worlds[0].stage
    phases = stage.planner.phases
    stacked = {name: np.stack([getattr(w, name) for w in worlds]) for name in (*STATE, "phase")}
    cpu = torch.device("cpu")
    sim = StubViews(
        model=stage.model,
        device=cpu,
        step_count=torch.tensor([w.step_count for w in worlds]),
        overflow=torch.tensor([w.overflow for w in worlds], dtype=torch.int32),
        kinematics=lambda: None,
        xpos=torch.tensor(np.stack([w.xpos for w in worlds]), dtype=dtype),
        xquat=torch.tensor(np.stack([w.xquat for w in worlds]), dtype=dtype),
    )
    views = {"sim": sim, "cfg": stage.cfg, "index": stage.index}
    env = SimpleNamespace(**views, nworld=len(worlds), device=cpu, given_places={})

    def take(step: int) -> None:
        for name in STATE:
            setattr(sim, name, torch.tensor(stacked[name][:, step], dtype=dtype))

    take(0)
    check = make_check(stage.cfg)
    check.start(env, phases[-1].stop, phases if phased else ())
    for step in range(stacked["phase"].shape[1]):
        take(step)
        check.update(torch.tensor(stacked["phase"][:, step]) if phased else None)
    return check.result()
