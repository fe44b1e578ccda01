"""Gate *batch*: every world does the task, or is named with the rule it broke."""

from mjstack.episodes.context import RunContext, needs_episode, spread
from mjstack.episodes.rollout import Snapshots
from mjstack.episodes.seeds import play_seeds
from mjstack.report.record import GateResult


@spread
@needs_episode
def run_batch(context: RunContext) -> list[GateResult]:
    """Play the task in nworld worlds that start differently, under every seed, and judge each."""
    cfg = context.cfg
    t = cfg.gate.batch
    # Throughput continues from the first seed; a policy is in no phase.
    phases = context.phases
    carry = context.phase(cfg.gate.throughput.from_phase).start - 1 if phases else -1
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

    metrics: dict[str, float] = {"distinct_final_states": tally.distinct_ends}
    if not tally.failed:  # worlds that fail have no speed
        speed = tally.steps / tally.seconds
        metrics |= {"episode_s": tally.seconds, "world_steps_per_s": speed}
    if tally.episodes > 1 and tally.distinct_ends < t.distinct_fraction * tally.episodes:
        tally.problems.append(
            f"only {tally.distinct_ends} distinct final states of {tally.episodes} {tally.noun}:"
            " identical worlds prove nothing, use reset=jitter"
        )
    result = tally.result(
        [f"{tally.summary}, {tally.distinct_ends} distinct"],
        good=len(tally.failed) <= t.failed_worlds,
        metrics=metrics,
        thresholds={"failed_worlds": t.failed_worlds, "distinct_fraction": t.distinct_fraction},
    )
    return [result]
