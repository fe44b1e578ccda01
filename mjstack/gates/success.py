"""Gate *success*: how often the expert or a policy does the task from random starts, and where it
fails.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from typing_extensions import override

from mjstack.config.check import places_objects, reads_starts_file, with_region
from mjstack.config.schema import Config
from mjstack.distributed import Ranks
from mjstack.drivers.driver import Driver
from mjstack.envs import Env
from mjstack.episodes.record import starts_name
from mjstack.episodes.regions import find_regions, regions_table, save_regions
from mjstack.episodes.rollout import CLOSED_LOOP, FEEDBACK, POLICY, Observer
from mjstack.episodes.run import Run, needs_episode, spread
from mjstack.episodes.seeds import play_seeds
from mjstack.files import write_npz
from mjstack.math import wilson_interval
from mjstack.mdp.starts.starts_file import start_arrays
from mjstack.report.record import GateResult
from mjstack.report.text import format_percent
from mjstack.report.write import safely_write


def success_config(cfg: Config) -> Config:
    """The configuration under which the gate plays: its controller, and how its worlds start."""
    t = cfg.gate.success
    reset = dict(cfg.reset if reads_starts_file(cfg.reset) else t.reset)
    region = t.region
    if region is not None:
        reset = with_region(reset, lambda xy: list(region))
    name = cfg.controller.name if cfg.controller.name in FEEDBACK else CLOSED_LOOP
    return replace(cfg, reset=reset, controller=replace(cfg.controller, name=name))


@spread
@needs_episode
def run_success(run: Run) -> list[GateResult]:
    """Play the task from random starts under every seed, and hold the share of episodes that
    succeed against ``rate``.
    """
    success_run = run.on(run.stage.with_config(success_config(run.cfg)))
    cfg = success_run.cfg
    t = cfg.gate.success
    unwritten: list[str] = []
    goals = [Goal(success_run.stage.ranks)] if cfg.controller.name == POLICY else []
    tally = play_seeds(
        success_run,
        "success",
        count=t.seeds,
        noun="episodes",
        signs=True,
        observers=lambda seed: [_StartsWriter(success_run, seed, unwritten), *goals],
    )
    starts = tally.array("start_places")
    retries = tally.array("retries")
    succeeded = tally.array("failed") == 0
    retried = int((retries > 0).sum())
    retried_succeeded = int(((retries > 0) & succeeded).sum())
    regions = find_regions(t, starts, succeeded, tally.records[0].object_names)
    distinct = len(np.unique(np.round(starts, 6).reshape(len(starts), -1), axis=0))
    lost = sum(goal.lost for goal in goals)
    doubts = find_doubts(distinct, tally.episodes, tally.successes, lost, t.rate)
    tally.details = unwritten + doubts + tally.details
    metrics = {
        "distinct_starts": distinct,
        **({"reached_and_lost": lost} if goals else {}),
        "retried": retried,
        "retries": int(retries.sum()),
        "retried_succeeded": retried_succeeded,
        "unreachable": int(tally.array("unreachable").sum()),
        "episode_s": tally.seconds,
    }
    tally.notes["starts"] = _describe_start(cfg)
    parts = [f"{tally.summary}, {format_percent(t.rate)} wanted"]
    if retried:
        parts.append(f"{retried} retried, {retried_succeeded} of them succeeded")
    if all(region["succeeded"] == region["episodes"] for region in regions):
        there = "had a failure" if regions else "(gate.success.cell_episodes): more seeds have more"
        tally.details.append(f"no region of at least {t.cell_episodes} episodes {there}")
    if run.folder is not None and (problem := save_regions(run.folder, regions)):
        tally.details.append(problem)
    result = tally.result(
        parts,
        passed=tally.successes / tally.episodes >= t.rate,
        metrics=metrics,
        thresholds={"success_rate_min": t.rate},
        tables=regions_table(t, regions),
    )
    return [result]


def find_doubts(distinct: int, episodes: int, successes: int, lost: int, rate: float) -> list[str]:
    """What keeps an evaluation from showing a rate, a line each: how many of its starts differ, how
    many of its episodes succeeded at their end, and how many reached the goal and lost it again.
    """
    low, _ = wilson_interval(successes, episodes)
    bound = f"at least {format_percent(low)}, not {format_percent(rate)}"
    doubts = {
        f"{episodes - distinct} of {episodes} starts are there twice": distinct < episodes,
        f"{episodes} episodes show {bound}: play more (nworld, gate.success.seeds)": (
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


class _StartsWriter(Observer):
    """Writes how worlds start into a file of the run, unless they start from that very file."""

    def __init__(self, run: Run, seed: int, unwritten: list[str]) -> None:
        """``unwritten`` gets the problem if the file cannot be written."""
        folder = run.folder
        self._path = None if folder is None else folder / starts_name(seed)
        self._ranks = run.stage.ranks
        self._unwritten = unwritten

    @override
    def start(self, env: Env, driver: Driver) -> None:
        path = self._path
        starts = env.cfg.starts
        parts = self._ranks.gather(start_arrays(env))
        if path is None or (starts is not None and path.resolve() == Path(starts).resolve()):
            return
        # Where the disk is full, the episodes are played all the same
        arrays = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        if problem := safely_write(path, write_npz, arrays):
            self._unwritten.append(problem)


def _describe_start(cfg: Config) -> str:
    """How worlds start, in a few words."""
    if reads_starts_file(cfg.reset):
        return f"starts={cfg.starts}"
    regions = [term.params["xy"] for term in cfg.reset.values() if places_objects(term)]
    where = "".join(f", objects within {x:g} x {y:g} m of their places" for x, y in regions)
    return f"gate.success.reset ({', '.join(cfg.reset)}{where})"
