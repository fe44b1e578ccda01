"""The jobs of the command line."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from omegaconf import MISSING


@dataclass(kw_only=True, slots=True)
class JobCfg:
    """What the command line runs."""

    name: str = MISSING


@dataclass(kw_only=True, slots=True)
class ScalingJobCfg(JobCfg):
    """Throughput over numbers of worlds, each in a process.

    ``backends`` null: native, and MJWarp where there is CUDA, as far as ``sim`` allows. Above
    ``large`` worlds a run makes ``repetitions_large`` repetitions. ``run_minutes`` ends a run
    that hangs; ``max_minutes`` ends a call, and the next one goes on. ``retry``: runs that failed
    are repeated.
    """

    nworlds: list[int] = MISSING
    backends: list[str] | None = None
    repetitions: int = MISSING
    large: int = MISSING
    repetitions_large: int = MISSING
    native_steps: int = MISSING
    native_env_steps: int = MISSING
    run_minutes: float = MISSING
    max_minutes: float | None = None
    retry: bool = MISSING


@dataclass(kw_only=True, slots=True)
class StudyJobCfg(JobCfg):
    """What settings of the solver cost, and whether every world is still succeeded.

    ``variants`` maps a name to what it changes in `SolverCfg`; typed, each is a whole one.
    ``repetitions`` of ``steps`` steps are timed, or of as many as fit into ``max_seconds``.
    """

    repetitions: int = MISSING
    steps: int = MISSING
    max_seconds: float = MISSING
    # Variants by name, untyped until `type_terms`, so that the command line may add one.
    variants: dict[str, Any] = field(default_factory=dict)


@dataclass(kw_only=True, slots=True)
class ReachabilityJobCfg(JobCfg):
    """What the arm reaches on the table, and how far cubes may stand from their places.

    ``step`` is the distance of the map's points. A region counts as reached if it is still
    ``margin`` wider all round.
    """

    step: float = MISSING
    margin: float = MISSING


@dataclass(kw_only=True, slots=True)
class CollectJobCfg(JobCfg):
    """Demonstrations of the scripted expert, as a dataset.

    ``episodes`` is how many the dataset is to have; a call adds what is missing. ``folder`` null:
    ``outputs/collect/<hash>``, by what episodes depend on. Steps are kept on the device until their
    batch is over: ``buffer_gib`` is the most that they may take, and fewer worlds are played at a
    time where more would not fit.
    """

    episodes: int = MISSING
    keep_failures: bool = MISSING
    folder: str | None = None
    buffer_gib: float = MISSING


# Jobs with keys of their own; the others have `JobCfg`.
JOB_SCHEMAS = {
    "study": StudyJobCfg,
    "scaling": ScalingJobCfg,
    "reachability": ReachabilityJobCfg,
    "collect": CollectJobCfg,
}
