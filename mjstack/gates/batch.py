"""Gate *batch*: every world does the task, or is named with the rule it broke."""

from mjstack.episodes.context import RunContext, needs_episode
from mjstack.episodes.observers import Snapshots
from mjstack.episodes.seeds import play_seeds
from mjstack.report.record import GateResult, Status


@needs_episode
def run_batch(context: RunContext) -> list[GateResult]:
    """Play the task in nworld worlds that start differently, under every seed, and judge each."""
    cfg = context.cfg
    t = cfg.gate.batch
    # Throughput continues from the first seed.
    carry = context.phase_start(cfg.gate.throughput.from_phase) - 1
    snapshots = Snapshots([carry])
    tally = play_seeds(
        context,
        "batch",
        count=t.seeds,
        noun="worlds" if t.seeds == 1 else "world-episodes",
        observers=lambda seed: [snapshots] if seed == cfg.seed else [],
    )
    context.artifacts.carry_start = snapshots.states.get(carry)
    context.artifacts.timed_episode = tally.first

    metrics = tally.metrics() | {"distinct_final_states": len(tally.ends)}
    if not tally.failed:  # worlds that fail have no speed
        speed = tally.steps / tally.seconds
        metrics |= {"episode_s": tally.seconds, "world_steps_per_s": speed}

    summary = f"{tally.summary}, {len(tally.ends)} distinct"
    problems = tally.problems
    if len(tally.failed) > t.failed_worlds:
        problems.insert(0, tally.failures)
    elif tally.failed:
        summary += f"; {tally.failures}"
    if tally.episodes > 1 and len(tally.ends) < t.distinct_fraction * tally.episodes:
        problems.append(
            f"only {len(tally.ends)} distinct final states of {tally.episodes} {tally.noun}:"
            " identical worlds prove nothing, use reset=jitter"
        )
    thresholds = {"failed_worlds": t.failed_worlds, "distinct_fraction": t.distinct_fraction}
    return [
        GateResult(
            name="batch",
            status=Status.failed if problems else Status.passed,
            reason="; ".join([summary, *problems]) + tally.way_to_look,
            thresholds=context.check.thresholds() | thresholds,
            metrics=metrics,
            notes=tally.notes,
            details=tally.all_details(),
            tables=tally.tables(),
        )
    ]
