"""A run: the stage on which it plays, its folder, its records, and the products of its gates."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from mjstack.config.schema import Backend, Config
from mjstack.envs import Env
from mjstack.episodes.motion import world_fields
from mjstack.episodes.record import EpisodeRecord
from mjstack.episodes.recorder import Snapshots, WorldRecorder
from mjstack.episodes.rollout import Episode, Hook, State
from mjstack.episodes.stage import Stage, TextHook
from mjstack.managers.episode import required_fields
from mjstack.managers.view import offers
from mjstack.report.page import Page, World, frame_stride
from mjstack.report.record import GateResult, Status
from mjstack.report.write import safely_write
from mjstack.sim import Simulation, make_simulation

needs_episode = offers(needs_episode=True)
"""Marks a gate that plays judged episodes. It is skipped for a task that has none."""
spread = offers(spread="worlds")
"""Marks a gate whose ranks play their worlds and gather the results. Of others rank 0 alone plays
all worlds.
"""
each_rank = offers(spread="ranks")
"""Marks a gate that measures the worlds of a rank, in all of them at the same time."""


@dataclass(eq=False, kw_only=True, slots=True)
class NominalRun:
    """The reference episode.

    Attributes:
        sim: Its world.
        episode: The episode.
        world: Its recording.
        states: At the ends of phases, and of steps that gate *parity* compares, by step.
        targets: Joint targets there, as the driver gave them, before servos' ranges bound them;
            those that ``timing.command_delay`` has let through.
    """

    sim: Simulation
    episode: Episode
    world: WorldRecorder
    states: dict[int, State]
    targets: dict[int, np.ndarray]


@dataclass(eq=False, kw_only=True, slots=True)
class Artifacts:
    """Products of gates that later gates and the report use.

    Attributes:
        results: Results so far, by gate.
        carry_start: States of all worlds as the phase ``gate.throughput.from_phase`` begins, from
            *batch*.
        timed_episode: Time of the first seed's episode, from *batch*.
        pictured: The one-world episode that pictures show, its title as label, with positions at
            every step end.
    """

    results: dict[str, GateResult] = field(default_factory=dict)
    carry_start: State | None = None
    timed_episode: Episode | None = None
    pictured: World | None = None


@dataclass(eq=False)
class Run:
    """A run of a job: gates and jobs play on its stage, and hand their results to it.

    Attributes:
        stage: Scene, plan, and all that is made of them.
        folder: Where the run's files go. None for none, such as of ranks that write nothing.
        gate: Name of the gate that is running.
        begin: Gets the name of each part of the run as it begins.
        record: Gets each result as soon as there is one.
        artifacts: Products of gates.
        records: The episodes of *batch* and *success*, by gate, a record for each seed.
        page: What the run shows besides its results.
    """

    stage: Stage
    folder: Path | None = None
    gate: str = ""
    begin: TextHook = lambda name: None
    record: Callable[[GateResult], None] = lambda result: None
    artifacts: Artifacts = field(default_factory=Artifacts)
    records: dict[str, list[EpisodeRecord]] = field(default_factory=dict)
    page: Page = field(default_factory=Page)

    @property
    def cfg(self) -> Config:
        """The configuration."""
        return self.stage.cfg

    def print_line(self, line: str) -> None:
        """Print a line, which has no markup."""
        self.stage.progress.print_line(line)

    def with_stage(self, stage: Stage) -> "Run":
        """The run on another stage, with artifacts of its own."""
        return replace(self, stage=stage, artifacts=Artifacts())

    @cached_property
    def nominal(self) -> NominalRun:
        """One native world from the start of *baseline*: the reference of that gate and parity."""
        stage = self.stage
        reset = self.cfg.gate.baseline.reset
        fields = required_fields(reset)
        sim = make_simulation(stage.model, self.cfg, 1, backend=Backend.native, fields=fields)
        world = WorldRecorder()
        ends = {phase.stop - 1 for phase in stage.phases}
        snapshots = Snapshots(ends.union(self.parity_steps.values()))
        actions: list[np.ndarray] = []
        ctrl: list[np.ndarray] = []

        def keep(step: int, sim: Simulation) -> None:
            actions.append(sent.env.action[0].double().numpy().copy())
            ctrl.append(sim.ctrl.numpy().copy())

        sent = Hook(keep)
        viewers = () if "parity" in self.cfg.gates else stage.observers
        episode = stage.play(sim, reset, [*viewers, world, snapshots, sent])
        delay = int(sent.env.command_delay.steps[0])  # physics has seen these commands
        seen = {step: max(0, step - delay) for step in snapshots.states}
        states = {k: state._replace(ctrl=ctrl[seen[k]]) for k, state in snapshots.states.items()}
        modes = [(t.params.get("joints"), t.params.get("mode")) for t in stage.action.values()]
        absolute = modes == [("arm", "absolute"), ("gripper", "absolute")]
        targets = {
            step: actions[seen[step]] if absolute else state.ctrl[0][stage.index.ctrl]
            for step, state in states.items()
        }
        return NominalRun(sim=sim, episode=episode, world=world, states=states, targets=targets)

    @property
    def parity_steps(self) -> dict[str, int]:
        """Steps after which gate *parity* takes its states, by their names: the last ones of
        phases, the first of them also ``in_motion``, the second ``swung`` and ``twisted``; or,
        without phases, of thirds of the episode, and the very first.
        """
        stage = self.stage
        if stage.phases:
            states = self.cfg.gate.parity.states
            ends = {name: stage.phase(phase).stop - 1 for name, phase in states.items()}
            first, second = [*ends.values(), *ends.values()][:2]
            return {"in_motion": first, "swung": second, "twisted": second, **ends}
        ends = {f"third_{k}": k * stage.episode_steps // 3 - 1 for k in (1, 2, 3)}
        return {"in_motion": 0, **dict.fromkeys(("swung", "twisted"), ends["third_2"]), **ends}

    def draw(self, name: str, save: Callable[..., object], *args: object) -> None:
        """Draw a picture beside the report by a call with its path and ``args``, if there is a
        folder. One that fails is a printed line.
        """
        if self.folder is None:
            return
        if problem := safely_write(self.folder / name, save, *args):
            self.print_line(problem)
        else:
            self.page.pictures.append(name)

    def judge_one(self, name: str, episode: Episode) -> tuple[GateResult, str]:
        """The result of a one-world episode, with the rules that it broke as its reason, and its
        values in a few words.
        """
        check = self.stage.check
        broken, beyond_keys = check.why(episode.failed, episode.values)
        failures = ", ".join(f"{check.rules.texts[rule]}{why}" for rule, why in broken.items())
        values = {key: float(values[0]) for key, values in episode.values.items()}
        measured = [replace(check.figures[key], value=value) for key, value in values.items()]
        result = GateResult(
            name=name,
            status=Status.failed if broken else Status.passed,
            reason=f"failed: {failures}" if failures else "",
            figures=[*check.thresholds(), *measured],
            beyond=beyond_keys,
        )
        return result, check.headline(values)

    def show_world(
        self,
        section: str,
        label: str,
        qpos: np.ndarray,
        episode: Episode,
        env: Env,
        title: str = "",
    ) -> None:
        """Show a world that was played alone, under a label, on the run's page if that has worlds
        in motion; with a title on the run's pictures too. ``section`` is the part of the run that
        has played it, ``qpos`` its positions at every step end, shape ``(steps, nq)``.
        """
        (fields,) = world_fields(self.stage, env, [0])
        if self.page.motion:
            bits = int(episode.failed[0])
            rules = self.stage.check.rules.broken(bits) if bits else []
            frames = qpos[:: frame_stride(self.cfg.timing.step_dt)]
            world = World(label=label, qpos=frames, rules=rules, fields=fields)
            self.page.worlds3d[section] = [world]
        if title:
            self.artifacts.pictured = World(label=title, qpos=qpos, fields=fields)
