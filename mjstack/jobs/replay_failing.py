"""All failing worlds of an earlier run played again: whether they fail again, on each backend."""

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mjstack.config.schema import Backend
from mjstack.episodes.context import RunContext
from mjstack.episodes.earlier_run import EarlierRun
from mjstack.episodes.record import EpisodeRecord
from mjstack.episodes.replay import simulate_alone
from mjstack.episodes.tally import rate_cells
from mjstack.errors import ConfigError
from mjstack.files import to_csv, write_atomic
from mjstack.gates.runner import run_guarded
from mjstack.report.record import GateResult, Status
from mjstack.report.table import Table
from mjstack.sim import resolve_device

TABLE = "replayed_worlds.csv"
_SHOWN = 100  # worlds in report.md


@dataclass(frozen=True, slots=True)
class Failing:
    """The failing worlds of a gate: the bits of the rules that each broke, by seed and world."""

    gate: str
    bits: Mapping[int, Mapping[int, int]]
    episodes: int

    @classmethod
    def of(cls, run: EarlierRun, gate: str) -> "Failing":
        """Those of every seed that the run has finished.

        Raises:
            ConfigError: There are none.
            RunError: A record cannot be read.
        """
        found: dict[int, dict[int, int]] = {}
        episodes = 0
        for seed in range(run.cfg.seed, run.cfg.seed + run.cfg.gate[gate].seeds):
            record = EpisodeRecord.read(run.folder, seed, gate)
            if record is None:
                continue
            episodes += len(record.failed)
            worlds = np.flatnonzero(record.failed).tolist()
            if worlds:
                found[seed] = {world: int(record.failed[world]) for world in worlds}
        if not found:
            expected = f"a world such as 17, as none of gate {gate}'s {episodes} failed"
            raise ConfigError("world", "failing", expected)
        return cls(gate, found, episodes)

    @property
    def first(self) -> str:
        """The first of them, as ``world=`` takes it."""
        seed = min(self.bits)
        return f"{self.gate}:{seed}:{min(self.bits[seed])}"

    def __len__(self) -> int:
        return sum(len(worlds) for worlds in self.bits.values())


def replay_failing(
    failing: Failing, where: Sequence[tuple[Backend, str]], context: RunContext, folder: Path
) -> None:
    """Play them on each backend, and leave a table; ranks share the seeds."""
    rows: dict[tuple[int, int], dict[str, Any]] = {}
    for backend, device in where:
        run = partial(_play, failing, backend, device, rows, folder)
        run_guarded(context, f"replay_{backend}", run, "worlds")


def _play(
    failing: Failing,
    backend: Backend,
    device: str,
    rows: dict[tuple[int, int], dict[str, Any]],
    folder: Path,
    context: RunContext,
) -> list[GateResult]:
    """Play them on one backend: worlds of a seed together, and apart from those that succeeded."""
    ranks = context.ranks
    if ranks.size > 1 and backend is Backend.mjwarp and device.startswith("cuda"):
        device = resolve_device("auto")
    rules = context.check.rules
    mine = list(failing.bits.items())[ranks.rank :: ranks.size]
    found: list[tuple[int, int, int]] = []
    for number, (seed, worlds) in enumerate(mine, 1):
        with closing(simulate_alone(context, backend, device, len(worlds))) as sim:
            episode = context.play(sim, context.cfg.reset, seed=seed, worlds=list(worlds))
        now = episode.failed.tolist()
        found += [(seed, world, bits) for world, bits in zip(worlds, now, strict=True)]
        context.advance("seeds", number, len(mine))
    every = sorted(each for part in ranks.gather(found) for each in part)
    again = same = 0
    for seed, world, bits in every:
        then = failing.bits[seed][world]
        again += bits != 0
        same += bits == then
        row = rows.setdefault((seed, world), {"seed": seed, "world": world})
        row["recorded"] = " ".join(rules.broken(then))
        row[str(backend)] = " ".join(rules.broken(bits)) or "succeeded"
    if ranks.writes:
        write_atomic(folder / TABLE, to_csv(list(rows.values())))
    rate, interval = rate_cells(again, len(every))
    shown = list(rows.values())[:_SHOWN]
    columns = {name: name for name in shown[0]}
    return [
        GateResult(
            name=f"replay_{backend}",
            status=Status.failed if again else Status.passed,
            reason=f"{again} of {len(every)} failing worlds fail again ({rate}, 95 % interval"
            f" {interval}), {same} by the same rules",
            metrics={
                "worlds": len(every),
                "fail_again": again,
                "by_the_same_rules": same,
                "episodes_of_that_run": failing.episodes,
            },
            notes={"backend": f"{backend} on {device}", "table": TABLE},
            tables=[Table.of(columns, shown, f"Failing worlds (all of them: {TABLE})")],
        )
    ]
