"""Gate *success*: how often the expert or a policy does the task from random starts, and where it
fails: by rule, by sign, and by where the objects started.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from typing_extensions import override

from mjstack.config.check import places_objects, reads_starts_file, with_region
from mjstack.config.schema import Config, SuccessGateCfg
from mjstack.distributed import Ranks
from mjstack.drivers.driver import Driver, find_driver, with_controller
from mjstack.envs import Env
from mjstack.episodes.record import REGIONS, starts_name
from mjstack.episodes.rollout import Observer
from mjstack.episodes.run import Run, needs_episode, spread
from mjstack.episodes.seeds import play_seeds
from mjstack.episodes.tally import rate_cells
from mjstack.files import to_csv, write_atomic, write_npz
from mjstack.math import rate_interval, wilson_interval
from mjstack.mdp.starts.starts_file import start_arrays
from mjstack.report.figure import Figure, figures
from mjstack.report.record import GateResult
from mjstack.report.table import Table
from mjstack.report.text import format_percent
from mjstack.report.write import safely_write

Region = dict[str, Any]
"""Episodes whose object started in one cell, by column of the file: the ``object``; the bounds that
the cell has, of x and y of its centre [m] and of its direction [deg], as of `radial_yaw_deg`; how
many ``episodes``, and how many ``succeeded``, their ``rate`` and its 95 % interval."""

_BOUNDS = (*("x_min_m", "x_max_m", "y_min_m", "y_max_m"), "yaw_min_deg", "yaw_max_deg")
_EDGE = 1e-9  # cells: a place this close below a cell's edge is on it


def success_config(cfg: Config) -> Config:
    """The configuration under which the gate plays: how its worlds start, and its controller, the
    closed-loop expert in the place of a plan.
    """
    t = cfg.gate.success
    reset = dict(cfg.reset if reads_starts_file(cfg.reset) else t.reset)
    region = t.region
    if region is not None:
        reset = with_region(reset, lambda xy: list(region))
    cfg = with_controller(cfg, "closed_loop") if find_driver(cfg).planned else cfg
    return replace(cfg, reset=reset)


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
    counts = not success_run.stage.driver_class.needs_phases
    goals = [Goal(success_run.stage.ranks)] if counts else []
    tally = play_seeds(
        success_run,
        "success",
        count=t.seeds,
        noun="episodes",
        signs=True,
        observers=lambda seed: [_StartsWriter(success_run, seed, unwritten), *goals],
    )
    places = tally.places
    starts = np.stack([*places.values()], axis=1)
    retries = tally.array("retries")
    succeeded = tally.array("failed") == 0
    retried = int((retries > 0).sum())
    retried_succeeded = int(((retries > 0) & succeeded).sum())
    regions = find_regions(t, starts, succeeded, list(places), run.stage.index.base)
    distinct = len(np.unique(np.round(np.nan_to_num(starts), 6).reshape(len(starts), -1), axis=0))
    lost = sum(goal.lost for goal in goals)
    doubts = find_doubts(distinct, tally.episodes, tally.successes, lost, t.rate)
    tally.details = unwritten + doubts + tally.details
    counts = figures(
        distinct_starts=distinct,
        **({"reached_and_lost": lost} if goals else {}),
        retried=retried,
        retries=int(retries.sum()),
        retried_succeeded=retried_succeeded,
        unreachable=int(tally.array("unreachable").sum()),
    )
    tally.notes["starts"] = _describe_start(cfg)
    parts = [f"{tally.summary}, {format_percent(t.rate)} wanted"]
    if retried:
        parts.append(f"{retried} retried, {retried_succeeded} of them succeeded")
    if all(region["succeeded"] == region["episodes"] for region in regions):
        there = "had a failure" if regions else "(gate.success.cell_episodes): more seeds have more"
        tally.details.append(f"no region of at least {t.cell_episodes} episodes {there}")
    if run.folder is not None:
        table = to_csv(regions, ("object", *_BOUNDS))
        if problem := safely_write(run.folder / REGIONS, write_atomic, table):
            tally.details.append(problem)
    result = tally.result(
        parts,
        passed=tally.successes / tally.episodes >= t.rate,
        figures=[*counts, Figure("episode", tally.seconds, "s")],
        rate=t.rate,
        tables=regions_table(t, regions),
    )
    return [result]


def find_doubts(distinct: int, episodes: int, successes: int, lost: int, rate: float) -> list[str]:
    """Reasons why an evaluation shows no rate, a line each: repeated starts, too few episodes, and
    episodes that reached the goal and lost it again.
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


@dataclass(eq=False)
class _StartsWriter(Observer):
    """Writes how worlds start into a file of the run, unless they start from that very file."""

    run: Run
    seed: int
    unwritten: list[str]  # gets the problem if the file cannot be written

    @override
    def start(self, env: Env, driver: Driver) -> None:
        path = self.run.folder and self.run.folder / starts_name(self.seed)
        starts = env.cfg.starts
        parts = self.run.stage.ranks.gather(start_arrays(env))
        if path is None or (starts is not None and path.resolve() == Path(starts).resolve()):
            return
        # Where the disk is full, the episodes are played all the same
        arrays = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        if problem := safely_write(path, write_npz, arrays):
            self.unwritten.append(problem)


def _describe_start(cfg: Config) -> str:
    """How worlds start, in a few words."""
    if reads_starts_file(cfg.reset):
        return f"starts={cfg.starts}"
    regions = [term.params["xy"] for term in cfg.reset.values() if places_objects(term)]
    where = "".join(f", objects within {x:g} x {y:g} m of their places" for x, y in regions)
    return f"gate.success.reset ({', '.join(cfg.reset)}{where})"


def radial_yaw_deg(places: np.ndarray) -> np.ndarray:
    """Angle of an object relative to the direction in which the arm's base sees it [deg], from 0 to
    90.

    Args:
        places: x and y from the base [m] and rotation about z [rad], shape ``(..., 3)``.
    """
    relative = np.degrees(places[..., 2] - np.arctan2(places[..., 1], places[..., 0]))
    return np.mod(relative, 90.0) % 90.0  # twice: just below 0 rounds to 90


def find_regions(
    cfg: SuccessGateCfg,
    places: np.ndarray,
    succeeded: np.ndarray,
    objects: Sequence[str],
    base: Sequence[float],
) -> list[Region]:
    """Cells of each object's position, of its direction, and of both, that have enough episodes;
    the lowest rate first. In x and y they begin at multiples of their width; the last one in
    direction ends at 90.

    Args:
        cfg: The configuration of the gate, with their widths and the least number of episodes.
        places: x and y [m] and rotation about z [rad] of each object at the start, NaN for a place,
            shape ``(n, objects, 3)``.
        succeeded: Whether each episode was, shape ``(n,)``, bool.
        objects: Names of the objects.
        base: x and y of the arm's base [m].
    """
    out: list[Region] = []
    widths = np.array([cfg.cell, cfg.cell, cfg.yaw_cell_deg])
    ends = np.array([math.inf, math.inf, 90.0])
    for number, name in enumerate(objects):
        yaw = radial_yaw_deg(places[:, number] - [*base, 0.0])
        keys = np.floor(np.column_stack((places[:, number, :2], yaw)) / widths + _EDGE)
        keys[keys[:, 2] * cfg.yaw_cell_deg >= 90.0, 2] = 0.0  # on the edge of 90, which is 0
        for axes in ([0, 1],) if np.isnan(yaw).any() else ([0, 1], [2], [0, 1, 2]):
            cells, which = np.unique(keys[:, axes], axis=0, return_inverse=True)
            for row, key in enumerate(cells):
                outcomes = succeeded[which.ravel() == row]
                n = len(outcomes)
                if n < cfg.cell_episodes:
                    continue
                k = int(outcomes.sum())
                edges = (key * widths[axes], np.minimum((key + 1.0) * widths[axes], ends[axes]))
                names = [_BOUNDS[2 * axis + end] for axis in axes for end in (0, 1)]
                bounds = zip(names, np.column_stack(edges).round(9).ravel().tolist(), strict=True)
                region = {"object": name, **dict(bounds), "episodes": n, "succeeded": k}
                out.append(region | rate_interval("rate", k, n))
    return sorted(out, key=lambda region: (region["rate"], region["rate_high95"]))


def describe_region(region: Region) -> str:
    """The cell in words."""
    texts = {
        "x_min_m": "x {x_min_m:.3f} to {x_max_m:.3f} m, y {y_min_m:.3f} to {y_max_m:.3f} m",
        "yaw_min_deg": "turned {yaw_min_deg:g} to {yaw_max_deg:g} deg",
    }
    parts = [text.format(**region) for name, text in texts.items() if name in region]
    return f"{region['object']}: {', '.join(parts)}"


def regions_table(cfg: SuccessGateCfg, regions: list[Region]) -> list[Table]:
    """The regions with the lowest rates; no table where none has a failure."""
    failing = [r for r in regions if r["succeeded"] < r["episodes"]]
    if not failing:
        return []
    rows = []
    for region in failing[: cfg.worst_regions]:
        n, k = region["episodes"], region["succeeded"]
        rows.append([describe_region(region), str(n), str(k), *rate_cells(k, n)])
    title = (
        f"Worst regions of at least {cfg.cell_episodes} episodes ({len(rows)} of {len(failing)}"
        " with a failure)"
    )
    header = ["where the object started", "episodes", "succeeded", "rate", "95 % interval"]
    return [Table(title=title, header=header, rows=rows)]
