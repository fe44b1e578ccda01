"""Episodes of a gate, played and counted seed after seed, and the record of each seed."""

import logging
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path

import numpy as np
from torch import Tensor

from mjstack.envs import Env
from mjstack.episodes.batches import Batch, BatchPlan, play_batches
from mjstack.episodes.failures import FailureMonitor
from mjstack.episodes.motion import load_worlds, motion_recorder, moving_worlds, save_worlds
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
from mjstack.report.page import MOST_WORLDS, Map, Worlds
from mjstack.report.write import safely_write

log = logging.getLogger(__name__)
_MOST_SEEN = 4  # worlds on the page with what their driver saw
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
    """Play ``count`` seeds, from the configured one on, in as many worlds as are configured, and
    record each for a gate, which names the files. A seed that breaks ends it, and those before it
    still count; the first one's error is raised. ``noun`` names what is counted, such as
    ``worlds``; with ``signs``, starts and signs of failure are recorded too; ``observers`` gives
    more of them by seed.
    """
    folder = run.folder
    seeds = range(run.cfg.seed, run.cfg.seed + count)
    name = SUCCESS_FAILING if gate != "batch" and "batch" in run.cfg.gates else FAILING
    tally = EpisodeTally(
        gate=gate,
        noun=noun,
        several=count > 1,
        check=run.stage.check,
        path=None if folder is None else folder / name,
        replayed=run.cfg.job.name == "gates",
    )
    run.records[gate] = tally.records
    monitor = FailureMonitor() if signs else None
    motion = motion_recorder(run.cfg.timing.step_dt)  # of the first seed
    path = folder / f"motion_{gate}.npz" if folder is not None and run.page.motion else None

    def observe(plan: BatchPlan) -> list[Observer]:
        recorder = motion if path is not None and plan.seed == seeds[0] else None
        return [*filter(None, (monitor, *observers(plan.seed), recorder))]

    with closing(run.stage.batch_simulation(len(run.stage.worlds))) as sim:
        tally.notes = {
            "backend": sim.description,
            "sizes": str(sim.sizes or "native MuJoCo has no fixed buffers"),
        }
        plans = _missing(run, tally, seeds, path)
        try:
            for batch in play_batches(run.stage, plans, simulate=lambda _: sim, observers=observe):
                tally.first = tally.first or batch.episode
                part = _record(run.stage, batch, monitor)
                record = EpisodeRecord.join(run.stage.ranks.gather(part))
                # Before the next one can break or be stopped. A full disk takes no result back.
                if folder is not None:
                    file = folder / record_name(gate, record.seed)
                    if problem := safely_write(file, write_npz, record.arrays(), stops=False):
                        tally.details.append(problem)
                if path is not None and record.seed == seeds[0]:
                    _show(run, gate, path, motion.rows.pop("qpos"), batch.env, record.failed)
                _count(run, tally, record)
        except Exception as error:
            check_interrupt()
            if not tally.records or run.stage.ranks.size > 1:
                raise
            seed = seeds[len(tally.records)]
            log.exception("seed %d broke", seed)
            why = first_line(error)
            left = f"seed {seed}" if seed == seeds[-1] else f"seeds {seed} to {seeds[-1]}"
            tally.problems.append(f"{left} not played: {why} (run.log has the traceback)")
        finally:
            tally.write_failing()  # once: it grows with the seeds
    if tally.again:
        again = name_worlds(tally.again, count, what="seeds")
        tally.details.append(f"an earlier call has played {again}")
    if run.cfg.nworld > 1:
        run.page.worlds[gate] = _worlds(tally, run)
    return tally


def _show(run: Run, gate: str, path: Path, qpos: Tensor, env: Env, failed: np.ndarray) -> None:
    """Add a gate's worlds to the page, failing ones first. A file keeps them for a resumed run."""
    chosen = np.argsort(failed[: qpos.shape[1]] == 0, kind="stable")[:MOST_WORLDS].tolist()
    names = {world: f"{world}:" for world in chosen}
    worlds = moving_worlds(run.stage, env, qpos, failed, names, _MOST_SEEN)
    run.page.worlds3d[gate] = worlds
    if problem := safely_write(path, save_worlds, worlds, stops=False):
        run.print_line(problem)


def _missing(run: Run, tally: EpisodeTally, seeds: range, path: Path | None) -> Iterator[BatchPlan]:
    """The seeds that no earlier call of the run has played; its records are counted."""
    folder = run.folder if run.cfg.resume is not None else None
    for seed in seeds:
        read = partial(EpisodeRecord.read, folder, seed, tally.gate)
        record = run.stage.ranks.from_first(read)
        if record is None:
            yield BatchPlan(seed, run.stage.worlds)
            continue
        tally.again.append(seed)
        if path is not None and path.exists() and seed == seeds[0]:
            run.page.worlds3d[tally.gate] = load_worlds(path)
        _count(run, tally, record)


def _count(run: Run, tally: EpisodeTally, record: EpisodeRecord) -> None:
    """Count a seed, and print where there are several."""
    tally.add(record)
    if tally.several:
        run.print_line(
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
        values=[(tally.check.figures[key], v[plotted]) for key, v in tally.values.items()],
    )
    # What the check judges, and what else differs
    moving = run.page.worlds3d.get(tally.gate, [])
    objects = run.stage.index.objects
    judged = tally.check.objects
    starts = tally.places
    marks = {name: place.xy for name, place in scene.places.items()}
    marks |= {name: at for name, at in run.stage.index.fixed.items() if name in judged}
    marks = {name: at[:2] for name, at in marks.items() if name not in starts}
    for name, places in starts.items():
        if name in objects and name not in judged:
            worlds.unjudged.append(name)
            continue
        ways = []
        if name in objects:
            x, _ = objects[name]
            ways = [(world.label, world.failed, world.qpos[:, x : x + 2]) for world in moving]
        xy = places[plotted, :2]
        base = run.stage.index.base
        worlds.maps.append(Map(title=name, xy=xy, table=table, ways=ways, marks=marks, base=base))
    return worlds


def _record(stage: Stage, batch: Batch, monitor: FailureMonitor | None) -> EpisodeRecord:
    """The record of this rank's worlds."""
    sim = batch.env.sim
    episode = batch.episode
    places = episode.places
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
            "measured.ik_error_m": episode.ik_error,
            "measured.peak_contacts": sim.peak_contacts.cpu().numpy().copy(),
            "measured.peak_constraint_rows": sim.peak_constraints.cpu().numpy().copy(),
            **({"start_places": np.stack([*places.values()], 1)} if places else {}),
            **(circumstances(episode, monitor) if monitor else {}),
        },
        object_names=list(places),
        phase_names=[phase.name for phase in monitor.driver.phases] if monitor else [],
        seconds=episode.timing.seconds,
        steps=int(sim.step_count.sum()),
        ranks={stage.worlds.start: place} if stage.ranks.size > 1 else {},
    )
