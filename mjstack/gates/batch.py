"""Gate *batch*: every world does the task, or is named with the rule it broke."""

import numpy as np

from mjstack.episodes.recorder import Snapshots
from mjstack.episodes.run import Run, needs_episode, spread
from mjstack.episodes.seeds import play_seeds
from mjstack.report.figure import Figure
from mjstack.report.record import GateResult


@spread
@needs_episode
def run_batch(run: Run) -> list[GateResult]:
    """Play the task in nworld worlds that start differently, under every seed, and judge each."""
    cfg = run.cfg
    t = cfg.gate.batch
    # Throughput continues from the first seed; a policy is in no phase.
    phases = run.stage.phases
    carry = run.stage.phase(cfg.gate.throughput.from_phase).start - 1 if phases else -1
    snapshots = Snapshots([carry])
    tally = play_seeds(
        run,
        "batch",
        count=t.seeds,
        noun="worlds" if t.seeds == 1 else "world-episodes",
        observers=lambda seed: [snapshots] if seed == cfg.seed else [],
    )
    run.artifacts.carry_start = snapshots.states.get(carry)
    run.artifacts.timed_episode = tally.first

    distinct = len(np.unique(tally.array("end")))
    failed = tally.episodes - tally.successes
    measured = [
        Figure("distinct_final_states", distinct),
        Figure("failed_worlds", high=t.failed_worlds),
        Figure("distinct_fraction", high=t.distinct_fraction),
    ]
    if not failed:  # worlds that fail have no speed
        speed = sum(record.steps for record in tally.records) / tally.seconds
        measured += [Figure("episode", tally.seconds, "s"), Figure("world_steps", speed, "/s")]
    # Worlds that start apart may end alike, as a peg in its hole does.
    starts = len(np.unique(np.round(tally.array("start_qpos"), 4), axis=0))
    if tally.episodes > 1 and max(distinct, starts) < t.distinct_fraction * tally.episodes:
        problem = f"only {distinct} distinct final states of {tally.episodes} {tally.noun}"
        tally.problems.append(f"{problem}: identical worlds prove nothing, use reset=jitter")
    result = tally.result(
        [f"{tally.summary}, {distinct} distinct"],
        passed=failed <= t.failed_worlds,
        figures=measured,
    )
    return [result]
