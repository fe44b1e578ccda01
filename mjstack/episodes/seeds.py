"""Episodes of a gate, played and counted seed after seed, and the record of each seed."""

import logging
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from mjstack.episodes.batches import Batch, BatchPlan, play_batches
from mjstack.episodes.failures import FailureMonitor
from mjstack.episodes.motion import motion_recorder, restore_batch, show_batch
from mjstack.episodes.record import (
    FAILING,
    SUCCESS_FAILING,
    EpisodeRecord,
    circumstances,
    record_name,
)
from mjstack.episodes.rollout import Observer
from mjstack.episodes.run import Run
from mjstack.episodes.stage import Stage
from mjstack.episodes.tally import EpisodeTally
from mjstack.errors import first_line, name_worlds
from mjstack.files import write_npz
from mjstack.interrupt import check_interrupt
from mjstack.report.page import Map, Worlds
from mjstack.report.write import safely_write
from mjstack.sim import Simulation

log = logging.getLogger(__name__)
_MOST_PLOTTED = 20_000  # episodes on the page; of more, the failing ones


def play_seeds(
    run: Run,
    gate: str,
    *,
    count: int,
    noun: str,
    signs: bool = False,
    observers: Callable[[int], Sequence[Observer]],
) -> EpisodeTally:
    """Play seed after seed in as many worlds as are configured, and record each.

    A seed that breaks ends it, and those before it still count; the first one's error is raised.

    Args:
        run: The run.
        gate: The gate, which names the files.
        count: Number of seeds, from the configured one on.
        noun: The things that are counted, such as ``worlds``.
        signs: Whether starts and signs of failure are recorded too.
        observers: More observers, by seed.
    """
    cfg = run.cfg
    folder = run.folder
    name = SUCCESS_FAILING if gate != "batch" and "batch" in cfg.gates else FAILING
    tally = EpisodeTally(
        gate=gate,
        noun=noun,
        several=count > 1,
        check=run.stage.check,
        path=None if folder is None else folder / name,
        replayed=cfg.job.name == "gates",
    )
    run.records[gate] = tally.records
    with closing(run.stage.batch_simulation(len(run.stage.worlds))) as sim:
        tally.notes = {
            "backend": sim.description,
            "sizes": str(sim.sizes or "native MuJoCo has no fixed buffers"),
        }
        motion = folder / f"motion_{gate}.npz" if folder is not None and run.page.motion else None
        player = _Player(run, tally, signs, observers, motion)
        try:
            player.play(range(cfg.seed, cfg.seed + count), sim)
        finally:
            tally.write_failing()  # once: it grows with the seeds
    if tally.again:
        seeds = name_worlds(tally.again, count, what="seeds")
        tally.details.append(f"an earlier call has played {seeds}")
    if cfg.nworld > 1:
        run.page.worlds[gate] = _worlds(tally, run)
    return tally


@dataclass
class _Player:
    """Plays seeds into a tally; ``path`` is the file of worlds in motion, None if there is none,
    and the other attributes are arguments of `play_seeds`.
    """

    run: Run
    tally: EpisodeTally
    signs: bool
    observers: Callable[[int], Sequence[Observer]]
    path: Path | None

    def play(self, seeds: range, sim: Simulation) -> None:
        """Play or read back seed after seed, and count them."""
        run = self.run
        tally = self.tally
        missing = self._missing(seeds)
        try:
            batches = play_batches(
                run.stage, missing, simulate=lambda count: sim, observers=self._observe
            )
            for batch in batches:
                tally.first = tally.first or batch.episode
                part = _record(run.stage, batch, self._monitor)
                record = EpisodeRecord.join(run.stage.ranks.gather(part))
                # Before the next one can break or be stopped. A full disk takes no result back.
                if tally.path is not None:
                    path = tally.path.with_name(record_name(tally.gate, record.seed))
                    if problem := safely_write(path, write_npz, record.arrays(), stops=False):
                        tally.details.append(problem)
                if self._motion is not None and self.path is not None:
                    qpos = self._motion.rows["qpos"]
                    page = (run.stage, run.page, self.path, tally.gate)
                    show_batch(*page, qpos, sim, record.failed)
                self._count(record)
        except Exception as error:
            check_interrupt()
            if not tally.records or run.stage.ranks.size > 1:
                raise
            seed = seeds[len(tally.records)]
            log.exception("seed %d broke", seed)
            why = first_line(error)
            left = f"seed {seed}" if seed == seeds[-1] else f"seeds {seed} to {seeds[-1]}"
            tally.problems.append(f"{left} not played: {why} (run.log has the traceback)")

    def _missing(self, seeds: range) -> Iterator[BatchPlan]:
        """The seeds that no earlier call of the run has played; its records are counted."""
        run = self.run
        folder = run.folder if run.cfg.resume is not None else None
        for seed in seeds:
            read = partial(EpisodeRecord.read, folder, seed, self.tally.gate)
            record = run.stage.ranks.from_first(read)
            if record is None:
                yield BatchPlan(seed, run.stage.worlds)
                continue
            self.tally.again.append(seed)
            if self.path is not None and seed == run.cfg.seed:
                restore_batch(run.page, self.path, self.tally.gate)
            self._count(record)

    def _observe(self, plan: BatchPlan) -> list[Observer]:
        """The observers of a seed."""
        cfg = self.run.cfg
        in_motion = self.path is not None and plan.seed == cfg.seed
        self._monitor = FailureMonitor() if self.signs else None
        self._motion = motion_recorder(cfg.timing.step_dt) if in_motion else None
        watchers = [self._monitor, *self.observers(plan.seed), self._motion]
        return [watcher for watcher in watchers if watcher is not None]

    def _count(self, record: EpisodeRecord) -> None:
        """Count a seed, and print where there are several."""
        tally = self.tally
        tally.add(record)
        if tally.several:
            self.run.print_line(
                f"{tally.gate}, seed {record.seed}: {int(record.succeeded.sum())} of"
                f" {len(record.failed)} worlds succeeded, {tally.successes} of {tally.episodes}"
                " so far"
            )


def _worlds(tally: EpisodeTally, run: Run) -> Worlds:
    """The episodes as the run's page plots them."""
    scene = run.cfg.scene
    table = (scene.table_center[:2], scene.table_half[:2])
    rules = tally.check.rules
    bits = tally.array("failed")
    plotted = np.flatnonzero((bits != 0) | (np.arange(len(bits)) < _MOST_PLOTTED))
    if len(plotted) < len(bits):
        tally.details.append(
            f"report.html shows {len(plotted):,} of the {len(bits):,} {tally.noun}: the first ones,"
            " and all that failed"
        )
    worlds = Worlds(
        names=tally.names(plotted),
        broken=[rules.broken(failed) for failed in bits[plotted].tolist()],
        rules=rules.texts,
        values={name: values[plotted] for name, values in tally.values.items()},
    )
    start = tally.array("start_qpos")[plotted]
    moving = run.page.worlds3d.get(tally.gate, [])
    for name, (at, _) in run.stage.index.objects.items():
        xy = slice(at, at + 2)
        ways = [(world.label, world.failed, world.qpos[:, xy]) for world in moving]
        worlds.maps.append(Map(title=name, xy=start[:, xy], table=table, ways=ways))
    return worlds


def _record(stage: Stage, batch: Batch, monitor: FailureMonitor | None) -> EpisodeRecord:
    """The record of this rank's worlds."""
    sim = batch.env.sim
    episode = batch.episode
    place = f"rank {stage.ranks.rank}: {socket.gethostname()}, {sim.device}"
    return EpisodeRecord(
        seed=batch.plan.seed,
        backend=sim.backend,
        device=str(sim.device),
        worlds={
            "failed": episode.failed,
            "qpos": sim.qpos.cpu().numpy().copy(),
            "start_qpos": episode.start,
            **{f"value.{name}": values for name, values in episode.values.items()},
            "measured.waypoint_error_m": episode.waypoint_error,
            "measured.peak_contacts": sim.peak_contacts.cpu().numpy().copy(),
            "measured.peak_constraint_rows": sim.peak_constraints.cpu().numpy().copy(),
            **(circumstances(episode, monitor) if monitor else {}),
        },
        object_names=list(stage.index.objects) if monitor else [],
        phase_names=[phase.name for phase in monitor.driver.phases] if monitor else [],
        seconds=episode.timing.seconds,
        steps=int(sim.step_count.sum()),
        ranks={stage.worlds.start: place} if stage.ranks.size > 1 else {},
    )
