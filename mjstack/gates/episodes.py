"""Gates of episodes, such as *batch* and *success*: how often worlds do the task, and where they
fail.
"""

import logging
from contextlib import closing, suppress
from dataclasses import replace

import numpy as np
import torch
from typing_extensions import override

from mjstack.config.check import gate_reset, places_objects, reads_starts_file
from mjstack.config.schema import Config
from mjstack.distributed import Ranks
from mjstack.drivers.driver import Driver, find_driver, with_controller
from mjstack.envs import Env
from mjstack.episodes.batches import BatchPlan, play_batches
from mjstack.episodes.failures import FailureMonitor
from mjstack.episodes.motion import motion_recorder, moving_worlds
from mjstack.episodes.record import EpisodeRecord, record_name
from mjstack.episodes.recorder import Snapshots
from mjstack.episodes.rollout import Observer
from mjstack.episodes.run import Run, needs_episode, spread
from mjstack.episodes.stage import Stage
from mjstack.episodes.tally import EpisodeTally
from mjstack.errors import MjstackError, first_line
from mjstack.files import write_npz
from mjstack.interrupt import check_interrupt
from mjstack.math import wilson_interval
from mjstack.mdp.starts.starts_file import start_arrays
from mjstack.report.figure import Figure, figures
from mjstack.report.page import MOST_WORLDS
from mjstack.report.record import GateResult
from mjstack.report.table import Table
from mjstack.report.text import format_percent

log = logging.getLogger(__name__)


def gate_config(cfg: Config, gate: str) -> Config:
    """The configuration under which a gate of episodes plays. One with starts of its own has the
    closed-loop expert in the place of a plan, which is made for the configured starts.
    """
    if not cfg.gate[gate].reset:
        return cfg
    cfg = with_controller(cfg, "closed_loop") if find_driver(cfg).planned else cfg
    return replace(cfg, reset=gate_reset(cfg, gate))


@spread
@needs_episode
def judge_episodes(run: Run) -> list[GateResult]:
    """Play the task in nworld worlds under every seed of the running gate, and hold the share of
    episodes that succeed against its ``rate``.
    """
    cfg = gate_config(run.cfg, run.gate)
    if cfg is not run.cfg:
        run = run.with_stage(run.stage.with_config(cfg))
    t = cfg.gate[run.gate]
    tally = EpisodeTally(gate=run.gate, check=run.stage.check, folder=run.folder)
    run.records[run.gate] = tally.records
    phased = run.stage.phases or not cfg.controller.phases  # else its failures' signs have them
    ends = Ends(run.stage) if t.reset and not phased else None
    lost = _play(run, tally, ends)
    if cfg.nworld > 1:
        run.page.worlds[run.gate] = tally.plot(run.stage, run.page.worlds3d.get(run.gate, []))

    succeeded = tally.array("failed") == 0
    rate = float(succeeded.mean())
    states = len(np.unique(tally.array("end")))
    starts = _count_distinct(tally.array("start_qpos"), 4)
    measured = [
        Figure("distinct_final_states", states),
        Figure("distinct_fraction", high=t.distinct_fraction),
        Figure("episode", tally.seconds, "s"),
    ]
    sentences = [f"{tally.summary}, {format_percent(t.rate)} wanted"]
    if succeeded.all():  # worlds that fail have no speed
        steps = sum(record.steps for record in tally.records)
        measured.append(Figure("world_steps", steps / tally.seconds, "/s"))
    # Worlds that start apart may end alike, as a peg in its hole does.
    if tally.episodes > 1 and max(states, starts) < t.distinct_fraction * tally.episodes:
        problem = f"only {states} distinct final states of {tally.episodes} episodes"
        tally.problems.append(f"{problem}: identical worlds prove nothing, use reset=jitter")
    if t.reset:
        rows = np.stack([*tally.start_poses.values()], axis=1)
        distinct = _count_distinct(np.nan_to_num(rows).reshape(len(rows), -1), 6)
        retries = tally.array("retries")
        retried = int((retries > 0).sum())
        retried_succeeded = int(((retries > 0) & succeeded).sum())
        measured += figures(
            distinct_starts=distinct,
            **({} if lost is None else {"reached_and_lost": lost}),
            retried=retried,
            retries=int(retries.sum()),
            retried_succeeded=retried_succeeded,
            unreachable=int(tally.array("unreachable").sum()),
        )
        tally.notes["starts"] = _describe_start(cfg, run.gate)
        if retried:
            sentences.append(f"{retried} retried, {retried_succeeded} of them succeeded")
        tally.details += find_doubts(distinct, tally.episodes, tally.successes, lost or 0, t.rate)
    result = tally.result(sentences, passed=rate >= t.rate, figures=measured, rate=t.rate)
    result.tables += ends.table(tally) if ends else []
    return [result]


def _play(run: Run, tally: EpisodeTally, ends: "Ends | None") -> int | None:
    """Play, record and count the gate's seeds. A seed that breaks ends it, and those before it
    still count; the first one's error is raised. Return how many episodes reached the goal and lost
    it again, None where nothing computes that.
    """
    stage = run.stage
    ranks = stage.ranks
    cfg = stage.cfg
    t = cfg.gate[run.gate]
    seeds = range(cfg.seed, cfg.seed + t.seeds)
    # Throughput continues from the first seed; a policy is in no phase.
    carry = stage.phase(cfg.gate.throughput.from_phase).start - 1 if stage.phases else -1
    snapshots = Snapshots([carry])
    motion = motion_recorder(cfg.timing.step_dt)
    starts = Starts()
    monitor = FailureMonitor() if t.reset else None
    goal = Goal(ranks) if t.reset and not stage.driver_class.needs_phases else None

    def observe(plan: BatchPlan) -> list[Observer]:
        watching = [starts, monitor, goal, ends] if t.reset else []
        first = [snapshots, motion if run.page.motion else None] if plan.seed == seeds[0] else []
        return [observer for observer in (*watching, *first) if observer is not None]

    plans = [BatchPlan(seed, stage.worlds) for seed in seeds]
    try:
        with closing(play_batches(stage, plans, observers=observe)) as batches:
            for batch in batches:
                rank_record = EpisodeRecord.from_batch(batch, monitor)
                record = EpisodeRecord.join(ranks.gather(rank_record))
                # Before the next one can break or be stopped. A full disk takes no result back.
                tally.write(record_name(run.gate, record.seed), write_npz, record.arrays())
                if t.reset:
                    shares = ranks.gather(starts.arrays)
                    arrays = {k: np.concatenate([share[k] for share in shares]) for k in shares[0]}
                    tally.write(f"{run.gate}_starts_seed{record.seed}.npz", write_npz, arrays)
                if record.seed == seeds[0]:
                    sim = batch.env.sim
                    sizes = str(sim.sizes or "native MuJoCo has no fixed buffers")
                    tally.notes = {"backend": sim.description, "sizes": sizes}
                    run.artifacts.timed_episode = batch.episode
                    run.artifacts.carry_start = snapshots.states.get(carry)
                    if run.page.motion:
                        qpos = motion.rows.pop("qpos")
                        chosen = np.argsort(record.succeeded[: qpos.shape[1]], kind="stable")
                        labels = {row: str(row) for row in chosen[:MOST_WORLDS].tolist()}
                        run.page.worlds3d[run.gate] = moving_worlds(
                            stage, batch.env, qpos, record.failed, labels
                        )
                tally.add(record)
                if t.seeds > 1:
                    counts = f"{int(record.succeeded.sum())} of {cfg.nworld} worlds succeeded"
                    so_far = f"{tally.successes} of {tally.episodes} so far"
                    run.print_line(f"{run.gate}, seed {record.seed}: {counts}, {so_far}")
    except Exception as error:
        check_interrupt()
        if not tally.records or ranks.size > 1:
            raise
        seed = seeds[len(tally.records)]
        log.exception("seed %d broke", seed)
        left = f"seed {seed}" if seed == seeds[-1] else f"seeds {seed} to {seeds[-1]}"
        why = f"{first_line(error)} (run.log has the traceback)"
        tally.problems.append(f"{left} not played: {why}")
    finally:
        tally.write_failing()  # once: it grows with the seeds
    return None if goal is None else goal.lost


def _count_distinct(rows: np.ndarray, digits: int) -> int:
    """Number of distinct rows of numbers that are rounded to so many digits."""
    return len(np.unique(np.round(rows, digits), axis=0))


def find_doubts(distinct: int, episodes: int, successes: int, lost: int, rate: float) -> list[str]:
    """Reasons why an evaluation shows no rate, a line each: repeated starts, too few episodes, and
    episodes that reached the goal and lost it again.
    """
    low, _ = wilson_interval(successes, episodes)
    bound = f"at least {format_percent(low)}, not {format_percent(rate)}"
    doubts = {
        f"{episodes - distinct} of {episodes} starts are there twice": distinct < episodes,
        f"{episodes} episodes show {bound}: play more (nworld, seeds)": (
            low < rate <= successes / episodes
        ),
        f"reached the goal and lost it: {lost} of {episodes} episodes, which do not count": lost,
    }
    return [text for text, holds in doubts.items() if holds]


class Goal(Observer):
    """Counts episodes in which the task's goal held in some step, and does not at the end, for
    environments that compute it.

    Attributes:
        lost: How many, of all ranks and of all seeds that it has looked on at.
    """

    def __init__(self, ranks: Ranks) -> None:
        self.lost = 0
        self._ranks = ranks

    @override
    def start(self, env: Env, driver: Driver) -> None:
        super().start(env, driver)
        self._reached = torch.zeros_like(env.success)

    @override
    def update(self) -> None:
        self._reached |= self.env.success

    @override
    def finish(self) -> None:
        self.lost += sum(self._ranks.gather(int((self._reached & ~self.env.success).sum())))


class Ends(Observer):
    """Keeps in which phase each episode ends, as an expert without a clock finds it in the state.

    Attributes:
        phases: Numbers of the phases, an array of all ranks for each seed; none where such an
            expert cannot be asked.
    """

    def __init__(self, stage: Stage) -> None:
        self.phases: list[np.ndarray] = []
        self._stage = stage

    @override
    def start(self, env: Env, driver: Driver) -> None:
        super().start(env, driver)
        from mjstack.drivers.clockless import ClocklessDriver  # it loads Warp

        self._expert: ClocklessDriver | None = None
        with suppress(MjstackError):  # no phases that a state tells, or other actions
            self._expert = ClocklessDriver(env, self._stage.planner.nominal)

    @override
    def finish(self) -> None:
        if self._expert is not None:
            self._expert.command()
            shares = self._stage.ranks.gather(self._expert.due.cpu().numpy())
            self.phases.append(np.concatenate(shares))

    def table(self, tally: EpisodeTally) -> list[Table]:
        """How many failed episodes ended in each phase, by rule; no table if none failed."""
        failed = tally.array("failed")
        names = list(self._stage.cfg.controller.phases)
        if len(self.phases) != len(tally.records) or not failed.any():
            return []
        phases = np.concatenate(self.phases)
        rows = []
        for rule, worlds in tally.check.rules.failing(failed).items():
            counts = np.bincount(phases[worlds], minlength=len(names)).tolist()
            rows.append({"rule": rule, **dict(zip(names, counts, strict=True))})
        met = [name for name in names if any(row[name] for row in rows)]
        columns = {name: name for name in ("rule", *met)}
        return [Table.of(columns, rows, "Phases in which failed episodes ended")]


class Starts(Observer):
    """Keeps how worlds start.

    Attributes:
        arrays: As of a starts file.
    """

    arrays: dict[str, np.ndarray]

    @override
    def start(self, env: Env, driver: Driver) -> None:
        self.arrays = {name: array.copy() for name, array in start_arrays(env).items()}


def _describe_start(cfg: Config, gate: str) -> str:
    """How worlds start, in a few words."""
    for term in cfg.reset.values():
        if reads_starts_file({"": term}):
            return f"starts={cfg.starts or term.params['path']}"
    regions = [term.params["xy"] for term in cfg.reset.values() if places_objects(term)]
    where = "".join(f", objects within {x:g} x {y:g} m of their places" for x, y in regions)
    return f"gate.{gate}.reset ({', '.join(cfg.reset)}{where})"
