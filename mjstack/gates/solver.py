"""Gate *solver*: the cost of other settings of the solver, and whether every world still succeeds.

It informs: it passes if it measured.
"""

import statistics
from collections.abc import Mapping
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from typing import Any

from mjstack.bench.episode import HeldPhysics, play_to_phase
from mjstack.bench.timing import describe_lost, steps_that_fit
from mjstack.config.complete import typed
from mjstack.config.fields import spec
from mjstack.config.schema import GateFuncCfg, SolverCfg
from mjstack.episodes.run import Run, needs_episode
from mjstack.episodes.stage import Assets, Stage
from mjstack.errors import MjstackError
from mjstack.managers.view import offers
from mjstack.report.record import GateResult, Status
from mjstack.sim import Simulation, SolverLimit
from mjstack.sim.sizes import resolve_measuring_sizes

_KEY = "gate.solver.changes"


@dataclass(slots=True)
class SolverGateCfg(GateFuncCfg):
    """A variant of the solver, and how it is measured."""

    changes: dict[str, Any] = spec({})
    """Keys of ``solver`` that the variant changes; none: a second copy of the configured one."""
    repetitions: int = spec(ge=1)
    """Repetitions of the variant, and as many of the configured solver beside them."""
    steps: int = spec(unit="steps", ge=1)
    """Control steps per repetition, or as many as fit into ``max_seconds``."""
    max_seconds: float = spec(unit="s", gt=0.0)
    """Time budget of a repetition."""

    def __post_init__(self) -> None:
        """Check that the solver has such keys, and that they take these values."""
        if isinstance(self.changes, dict):  # OmegaConf makes one without
            self.apply(asdict(SolverCfg()))

    def apply(self, solver: Mapping[str, Any]) -> SolverCfg:
        """The variant of a solver."""
        return typed(_KEY, {**solver, **self.changes}, SolverCfg)


@needs_episode
@offers(config=SolverGateCfg)
def run_solver(run: Run) -> list[GateResult]:
    """Measure the variant in turns with the configured solver, in the same process.

    The metrics are, of the variant's whole episode, ``worlds``, ``succeeded``, ``peak_rows`` (most
    constraint rows of a world), the check's summaries, and on MJWarp ``iteration_limit_worlds`` and
    ``line_search_limit_worlds`` (worlds whose solver stopped at its limit in some step); then,
    object in hand, ``ms_per_batched_step`` (median of the repetitions, with ``ms_min`` and
    ``ms_max``), ``base_ms`` (of the configured solver) and ``ratio`` (of neighbouring repetitions:
    median, ``ratio_min``, ``ratio_max``).
    """
    stage = run.stage
    gate: SolverGateCfg = run.cfg.gate["solver"]
    before = asdict(run.cfg.solver)
    solver = gate.apply(before)
    changes = [f"{key}={value}" for key, value in asdict(solver).items() if value != before[key]]
    result = GateResult(name="solver", status=Status.passed)
    name = "_".join(f"{key}_{value}" for key, value in gate.changes.items())
    result.notes = {"variant": name or "base", "changes": ", ".join(changes) or "nothing"}
    cfg = replace(run.cfg, solver=solver)
    assets = Assets(cfg)
    assets.planner = stage.planner  # inverse kinematics has no contacts
    variant = stage.with_config(cfg, assets=assets, measured=stage.measured)
    _measure(stage, variant, gate, result)
    m = result.metrics
    result.reason = (
        f"{m['ms_per_batched_step']:.3g} ms per step, {m['ratio']:.2f} of the configured solver,"
        f" {m['succeeded']} of {m['worlds']} succeeded"
    )
    if broken := result.notes["broken_rules"]:
        result.reason += f" ({broken})"
    return [result]


def _measure(stage: Stage, variant: Stage, gate: SolverGateCfg, result: GateResult) -> None:
    """Play the variant's judged episode, then repetitions with the object in hand beside those of
    the configured solver, from one state.

    Raises:
        MjstackError: Worlds lost physics, so that their time is void.
    """
    decimation = stage.cfg.timing.decimation
    with closing(_simulation(stage)) as base_sim, closing(_simulation(variant)) as sim:
        base = HeldPhysics(base_sim, play_to_phase(stage, base_sim), decimation)
        steps = steps_that_fit(gate.steps, gate.max_seconds, base.warm_up())
        _play_episode(variant, sim, result)

        # The repetitions; each goes first in turn: what drifts, drifts for both.
        physics = HeldPhysics(sim, base.state, decimation)
        physics.warm_up()
        times: dict[HeldPhysics, list[float]] = {base: [], physics: []}
        for repetition in range(gate.repetitions):
            for side in list(times)[:: 1 if repetition % 2 else -1]:
                times[side].append(1e3 * side.play(steps) / (steps * decimation))
                if problem := describe_lost(side.lost):
                    raise MjstackError(f"no time: {problem} (of {sim.nworld}).")
            stage.progress.advance("repetitions", repetition + 1, gate.repetitions)
    ratios = [a / b for a, b in zip(times[physics], times[base], strict=True)]
    for name, values in (("ms", times[physics]), ("ratio", ratios)):
        result.metrics |= {f"{name}_min": min(values), f"{name}_max": max(values)}
    result.metrics |= {
        "ms_per_batched_step": statistics.median(times[physics]),
        "base_ms": statistics.median(times[base]),
        "ratio": statistics.median(ratios),
    }


def _play_episode(stage: Stage, sim: Simulation, result: GateResult) -> None:
    """Play the whole judged episode, and add what the check found."""
    episode = stage.play(sim, stage.cfg.reset).result
    result.notes["backend"] = sim.description
    failed = episode.failed.cpu().numpy()
    rules = stage.check.rules
    result.metrics |= {
        "worlds": sim.nworld,
        "succeeded": int((failed == 0).sum()),
        "peak_rows": int(sim.peak_constraints.max()),
    }
    result.notes["broken_rules"] = ", ".join(
        f"{rules.texts[name]} in {len(worlds)}" for name, worlds in rules.failing(failed).items()
    )
    for metric, (value, end) in stage.check.summaries.items():
        result.metrics[metric] = float(getattr(episode.values[value], end)())
    if (limits := sim.solver_limits) is not None:
        result.metrics |= {
            "iteration_limit_worlds": int((limits & SolverLimit.ITERATIONS != 0).sum()),
            "line_search_limit_worlds": int((limits & SolverLimit.LS_ITERATIONS != 0).sum()),
        }


def _simulation(stage: Stage) -> Simulation:
    """Worlds with room to spare: buffer sizes are not what is compared."""
    sizes = resolve_measuring_sizes(stage.cfg)
    return stage.simulation(stage.cfg.nworld, *stage.backend, sizes=sizes)
