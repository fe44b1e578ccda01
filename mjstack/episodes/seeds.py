"""Episodes of a gate, played and counted seed after seed, and the record of each seed."""

import itertools
import logging
import socket
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from mjstack.episodes.context import RunContext
from mjstack.episodes.failures import FailureMonitor
from mjstack.episodes.motion import MotionRecorder, records_motion, restore_batch, show_batch
from mjstack.episodes.record import FAILING, SUCCESS_FAILING, Circumstances, EpisodeRecord
from mjstack.episodes.rollout import Episode, Observer
from mjstack.episodes.tally import EpisodeTally
from mjstack.errors import RunError, first_line
from mjstack.interrupt import check_interrupt
from mjstack.report.html import Worlds
from mjstack.report.svg import Map
from mjstack.sim import Simulation

log = logging.getLogger(__name__)


def play_seeds(
    context: RunContext,
    gate: str,
    *,
    count: int,
    noun: str,
    circumstances: bool = False,
    observers: Callable[[int], Sequence[Observer]],
) -> EpisodeTally:
    """Play seed after seed in as many worlds as are configured, and record each.

    A seed that breaks ends it, and those before it still count; the first one's error is raised.

    Args:
        context: The run.
        gate: The gate, which names the files.
        count: Number of seeds, from the configured one on.
        noun: The things that are counted, such as ``worlds``.
        circumstances: Whether starts and signs of failure are recorded too.
        observers: More observers, by seed.
    """
    cfg = context.cfg
    folder = context.folder
    name = SUCCESS_FAILING if gate != "batch" and "batch" in cfg.gates else FAILING
    tally = EpisodeTally(
        gate=gate,
        noun=noun,
        several=count > 1,
        check=context.check,
        path=None if folder is None else folder / name,
        replayed=cfg.job.name == "gates",
    )
    sim = context.batch_simulation(len(context.worlds))
    tally.notes = {
        "backend": sim.description,
        "sizes": str(sim.sizes or "native MuJoCo has no fixed buffers"),
    }
    player = _Player(context, tally, sim, circumstances, observers)
    try:
        player.play(range(cfg.seed, cfg.seed + count))
    finally:
        sim.close()
        tally.write_failing()  # once: its rows grow with the seeds
    if tally.again:
        seeds = ", ".join(_runs(tally.again))
        tally.details.append(f"an earlier call has played seeds {seeds}")
    if cfg.nworld > 1:
        context.page.worlds[gate] = _worlds(tally, context)
    return tally


@dataclass(eq=False, slots=True)
class _Player:
    """Plays seeds into a tally; fields as the arguments of `play_seeds`."""

    context: RunContext
    tally: EpisodeTally
    sim: Simulation
    circumstances: bool
    observers: Callable[[int], Sequence[Observer]]

    def play(self, seeds: range) -> None:
        """Play or read back seed after seed, and count them."""
        tally = self.tally
        for seed in seeds:
            try:
                record = self._play_or_read(seed)
                tally.add(record)
            except Exception as error:
                check_interrupt()
                if not tally.seeds or self.context.ranks.size > 1:
                    raise
                log.exception("seed %d broke", seed)
                why = first_line(error)
                left = f"seed {seed}" if seed == seeds[-1] else f"seeds {seed} to {seeds[-1]}"
                tally.problems.append(f"{left} not played: {why} (run.log has the traceback)")
                break
            if tally.several:
                self.context.print_line(
                    f"{tally.gate}, seed {seed}: {int(record.succeeded.sum())} of"
                    f" {len(record.failed)} worlds succeeded, {tally.good} of {tally.episodes}"
                    " so far"
                )

    def _play_or_read(self, seed: int) -> EpisodeRecord:
        """A seed's record: an earlier call's, or played, written and shown now."""
        context = self.context
        tally = self.tally
        shows = records_motion(context) and seed == context.cfg.seed
        record = context.ranks.from_first(partial(self._read, seed))
        if record is not None:
            tally.again.append(seed)
            if shows:
                restore_batch(context, tally.gate)
            return record
        monitors = [FailureMonitor()] if self.circumstances else []
        recorders = [MotionRecorder()] if shows else []
        looking = [*monitors, *self.observers(seed), *recorders, *context.spectators]
        episode = context.play(
            self.sim, context.cfg.reset, looking, seed=seed, worlds=context.worlds
        )
        if tally.first is None:
            tally.first = episode
        part = _record(context, self.sim, seed, episode, monitors)
        record = EpisodeRecord.join(context.ranks.gather(part))
        self._write(record)
        for recorder in recorders:
            show_batch(context, tally.gate, recorder, record.failed)
        return record

    def _read(self, seed: int) -> EpisodeRecord | None:
        """The results of a seed that an earlier call of the run has left."""
        cfg = self.context.cfg
        folder = self.context.folder
        if cfg.resume is None or folder is None:
            return None
        record = EpisodeRecord.read(folder, seed, self.tally.gate, whole=True)
        if record is not None and len(record.failed) != cfg.nworld:
            raise RunError(
                f"resume={folder}: has {len(record.failed)} worlds of seed {seed}, expected"
                f" {cfg.nworld}. Name another folder."
            )
        return record

    def _write(self, record: EpisodeRecord) -> None:
        """Write the seed's record, before the next one can break or be stopped. A full disk takes
        no result back.
        """
        tally = self.tally
        if tally.path is None:
            return
        try:
            record.write(tally.path.parent, tally.gate)
        except OSError as error:
            log.exception("the record of seed %d was not written", record.seed)
            tally.details.append(
                f"seed {record.seed}: no record of its {tally.noun} could be written"
                f" ({error.strerror})"
            )


def _worlds(tally: EpisodeTally, context: RunContext) -> Worlds:
    """The episodes as the run's page plots them."""
    scene = context.cfg.scene
    table = (scene.table_center[:2], scene.table_half[:2])
    rules = tally.check.rules
    held = {
        name: np.concatenate([values[name] for _, _, values in tally.shown])
        for name in tally.shown[0][2]
    }
    start = held.pop("start")
    bits = held.pop("failed").tolist()
    if len(bits) < tally.episodes:
        tally.details.append(
            f"report.html shows {len(bits):,} of the {tally.episodes:,} {tally.noun}: the first"
            " ones, and all that failed"
        )
    worlds = Worlds(
        names=[n for seed, which, _ in tally.shown for n in tally.names(seed, which.tolist())],
        broken=[rules.broken(failed) if failed else [] for failed in bits],
        rules=rules.texts,
        values=held,
    )
    moving = [world for world in context.page.worlds3d.get(tally.gate, []) if not world.twin]
    for name, (at, _) in context.index.objects.items():
        xy = slice(at, at + 2)
        ways = [(world.label, world.failed, world.qpos[:, xy]) for world in moving]
        worlds.maps.append(Map(title=name, xy=start[:, xy], table=table, ways=ways))
    return worlds


def _record(
    context: RunContext,
    sim: Simulation,
    seed: int,
    episode: Episode,
    monitors: Sequence[FailureMonitor],
) -> EpisodeRecord:
    """The record of this rank's worlds."""
    place = f"rank {context.ranks.rank}: {socket.gethostname()}, {sim.device}"
    return EpisodeRecord(
        seed=seed,
        backend=sim.backend,
        device=str(sim.device),
        failed=episode.failed,
        values=episode.values,
        qpos=sim.qpos.cpu().numpy().copy(),
        start=episode.start,
        circumstances=Circumstances.of(episode, monitors[0]) if monitors else None,
        measured={
            "waypoint_error_m": episode.waypoint_error,
            "peak_contacts": sim.peak_contacts.cpu().numpy().copy(),
            "peak_constraint_rows": sim.peak_constraints.cpu().numpy().copy(),
        },
        seconds=episode.timing.seconds,
        steps=int(sim.step_count.sum()),
        ranks={context.worlds.start: place} if context.ranks.size > 1 else {},
    )


def _runs(numbers: Sequence[int]) -> Iterator[str]:
    """Ascending numbers in words, neighbours as ``3 to 7``."""
    for _, group in itertools.groupby(enumerate(numbers), lambda pair: pair[1] - pair[0]):
        run = [number for _, number in group]
        yield str(run[0]) if len(run) == 1 else f"{run[0]} to {run[-1]}"
