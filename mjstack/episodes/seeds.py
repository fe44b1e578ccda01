"""Plays a gate's episodes, seed after seed, and records each."""

import logging
from collections.abc import Callable, Sequence

from mjstack.episodes.context import RunContext
from mjstack.episodes.failures import FailureMonitor
from mjstack.episodes.record import FAILING, SUCCESS_FAILING, Circumstances, EpisodeRecord
from mjstack.episodes.rollout import Observer
from mjstack.episodes.tally import EpisodeTally
from mjstack.errors import first_line
from mjstack.files import to_csv, write_atomic
from mjstack.interrupt import check_interrupt

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
    # The tally, and the worlds
    cfg = context.cfg
    folder = context.folder
    name = SUCCESS_FAILING if gate != "batch" and "batch" in cfg.gates else FAILING
    tally = EpisodeTally(
        gate=gate,
        noun=noun,
        several=count > 1,
        check=context.check,
        path=None if folder is None else folder / name,
    )
    sim = context.batch_simulation(cfg.nworld)
    tally.notes = {
        "backend": sim.description,
        "sizes": str(sim.sizes or "native MuJoCo has no fixed buffers"),
    }

    # Seed after seed
    last = cfg.seed + count - 1
    try:
        for seed in range(cfg.seed, last + 1):
            try:
                monitors = [FailureMonitor()] if circumstances else []
                looking = [*monitors, *observers(seed)]
                episode = context.play(sim, cfg.reset, looking, seed=seed)
                record = EpisodeRecord(
                    seed=seed,
                    backend=sim.backend,
                    device=str(sim.device),
                    failed=episode.failed,
                    values=episode.values,
                    qpos=sim.qpos.cpu().numpy().copy(),
                    start=episode.start,
                )
                for monitor in monitors:
                    record.circumstances = Circumstances.of(episode, monitor)
                tally.add(record, episode, sim)
            except Exception as error:
                check_interrupt()
                if seed == cfg.seed:
                    raise
                log.exception("seed %d broke", seed)
                why = first_line(error)
                left = f"seed {seed}" if seed == last else f"seeds {seed} to {last}"
                tally.problems.append(f"{left} not played: {why} (run.log has the traceback)")
                break
            _write(record, tally)
            if count > 1:
                context.print_line(
                    f"{gate}, seed {seed}: {int(record.succeeded.sum())} of {cfg.nworld} worlds"
                    f" succeeded, {tally.good} of {tally.episodes} so far"
                )
    finally:
        sim.close()
    return tally


def _write(record: EpisodeRecord, tally: EpisodeTally) -> None:
    """Write the seed's record, before the next one can break or be stopped. A full disk takes no
    result back.
    """
    if tally.path is None:
        return
    try:
        record.write(tally.path.parent, tally.gate)
        if tally.rows:
            write_atomic(tally.path, to_csv(tally.rows))
    except OSError as error:
        log.exception("the record of seed %d was not written", record.seed)
        tally.details.append(
            f"seed {record.seed}: no record of its {tally.noun} could be written ({error.strerror})"
        )
