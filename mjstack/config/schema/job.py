"""The jobs of the command line."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mjstack.config.fields import MOST_WORLDS, spec


@dataclass(kw_only=True, slots=True)
class JobCfg:
    """A job: the work of one command."""

    name: str = spec()
    """Its name."""
    func: str = spec()
    """Dotted name of its ``mjstack.jobs.Job``."""


@dataclass(kw_only=True, slots=True)
class ScalingJobCfg(JobCfg):
    """Throughput over numbers of worlds, each in a process."""

    nworlds: list[int] = spec(unit="worlds", ge=1, le=MOST_WORLDS)
    """Numbers of worlds, each once."""
    backends: list[str] | None = spec(None, choices=("mjwarp", "native"))
    """Backends; null: native, and MJWarp where there is CUDA, as far as ``sim`` allows."""
    repetitions: int = spec(ge=1)
    """Repetitions of each measurement."""
    large: int = spec(unit="worlds", ge=1)
    """A run of more worlds makes ``repetitions_large`` repetitions."""
    repetitions_large: int = spec(ge=1)
    """Repetitions of each measurement of a large run."""
    native_steps: int = spec(unit="steps", ge=1)
    """Physics steps per repetition on native MuJoCo, whose worlds play no episode."""
    native_env_steps: int = spec(unit="steps", ge=1)
    """Environment steps per repetition on native MuJoCo."""
    run_minutes: float = spec(unit="min", gt=0.0)
    """A run that takes longer has failed."""
    max_minutes: float | None = spec(None, unit="min", gt=0.0)
    """Time budget of a call; the next one goes on. null: unlimited."""
    retry: bool = spec()
    """Whether runs that failed are repeated."""


@dataclass(kw_only=True, slots=True)
class StudyJobCfg(JobCfg):
    """Cost and success of settings of the solver."""

    repetitions: int = spec(ge=1)
    """Repetitions of each variant."""
    steps: int = spec(unit="steps", ge=1)
    """Control steps per repetition, or as many as fit into ``max_seconds``."""
    max_seconds: float = spec(unit="s", gt=0.0)
    """Time budget of a repetition."""
    # Variants are untyped until `type_terms`, so that the command line may add one.
    variants: dict[str, Any] = spec(factory=dict)
    """Variants by name: the keys of ``solver`` that each changes."""


@dataclass(kw_only=True, slots=True)
class ReachabilityJobCfg(JobCfg):
    """A map of the positions that the arm reaches, and the largest region for random starts."""

    step: float = spec(unit="m", gt=0.0)
    """Distance of the map's points."""
    margin: float = spec(unit="m", ge=0.0)
    """A region counts as reached if it is still reached with this margin all round."""


@dataclass(kw_only=True, slots=True)
class CollectJobCfg(JobCfg):
    """Demonstrations of the closed-loop expert, as a dataset."""

    episodes: int = spec(unit="episodes", ge=1)
    """Episodes of the dataset; a call adds the missing ones."""
    keep_failures: bool = spec()
    """Whether failed episodes are kept too, marked; they count."""
    folder: str | None = spec(None)
    """Folder of the dataset; null: ``outputs/collect/<hash>`` of everything episodes depend on."""
    buffer_gib: float = spec(unit="GiB", gt=0.0)
    """Device memory for the steps of one batch of worlds; more worlds are played in turns."""


# Jobs with keys of their own; the others have `JobCfg`.
JOB_SCHEMAS = {
    "study": StudyJobCfg,
    "scaling": ScalingJobCfg,
    "reachability": ReachabilityJobCfg,
    "collect": CollectJobCfg,
}
