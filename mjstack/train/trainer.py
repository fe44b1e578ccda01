"""A trainer, as job=train runs it."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from torch import Tensor

from mjstack.config.check import starts_midway, with_region
from mjstack.config.schema import CloneJobCfg, Config, ObservationGroupCfg, PpoJobCfg, TermCfg
from mjstack.episodes.stage import Stage
from mjstack.errors import ConfigError, FolderError, MjstackError, renamed_keys, require_names
from mjstack.policy.checkpoint import Facts, read_state

# In the folder of a training: two policies, and what it needs to go on.
LAST = "last"
BEST = "best"
STATE = "training.safetensors"
ESTIMATED = "estimated"
"""Group of the observation that a policy learns to estimate from its images, and does not see."""
FAILED = "failed."  # a column of the curve: judged episodes that broke the rule of this name


@dataclass(kw_only=True, slots=True)
class Trained:
    """The result of a training."""

    metrics: dict[str, float]  # figures, by name with unit
    notes: dict[str, str]  # facts in words, by name
    curve: list[Facts]  # rows of the training curve: values by column
    lines: list[str] = field(default_factory=lambda: ["success"])  # columns that are drawn
    abscissa: str = "batch"  # the column over which they are drawn
    scale: str = "linear"  # of their axis: log or linear


@dataclass(frozen=True)
class Trainer:
    """One way to train; ``conf/trainer/<name>.yaml`` names it.

    ``check`` raises a `MjstackError` for what cannot be trained, before anything is written, and
    returns the seeds of the starts that training uses. ``train`` trains in a folder, in which it
    goes on with an earlier call's training, and leaves the policies `LAST` and `BEST` there.
    """

    check: Callable[[Stage], range]
    train: Callable[[Stage, Path], Trained]
    midway: bool = False  # whether its worlds may start in the middle of an episode


def whole_starts(reset: dict[str, TermCfg]) -> dict[str, TermCfg]:
    """Reset terms without those that start worlds in the middle of an episode."""
    return {name: term for name, term in reset.items() if not starts_midway(term)}


def observed_group(job: CloneJobCfg | PpoJobCfg) -> ObservationGroupCfg:
    """The observation group of a new policy.

    Raises:
        UnknownName: There is no such group, or no such term as the job names.
    """
    require_names("job.group: observation group", [job.group], job.observation)
    group = job.observation[job.group]
    needed = [name for name in job.leave_out if not name.endswith("?")]
    require_names(f"job.leave_out: term of {job.group}", needed, group.terms)
    left_out = {name.removesuffix("?") for name in job.leave_out}
    terms = {name: term for name, term in group.terms.items() if name not in left_out}
    return replace(group, noise=False, terms=terms)


def with_observation(cfg: Config) -> Config:
    """The configuration, with the observation group of a new policy in place of its groups, and
    what it learns to estimate from images.
    """
    job: CloneJobCfg = cfg.job
    groups = {job.group: observed_group(job)}
    if ESTIMATED in job.observation and job.vision.cameras:
        groups[ESTIMATED] = job.observation[ESTIMATED]
    return replace(cfg, observation=groups)


def training_config(stage: Stage) -> Config:
    """The configuration of the episodes in which a new policy learns."""
    job: CloneJobCfg = stage.cfg.job

    def widen(xy: Any) -> Any:
        with suppress(TypeError):
            return [(1.0 + job.wider) * half for half in xy]
        return xy  # no region; its term says so

    return with_observation(stage.driven(with_region(stage.cfg.reset, widen)))


def observed_widths(stage: Stage) -> dict[str, int]:
    """Numbers of each term of a new policy's observation, in order.

    Raises:
        MjstackError: A term of its episodes cannot be used.
    """
    job: CloneJobCfg = stage.cfg.job
    names = {"observation": "job.observation"}
    try:
        with renamed_keys(names), stage.native_env(training_config(stage)) as env:
            return env.observation_manager.term_dims[job.group]
    except ConfigError as error:
        if job.wider == 0.0 or not (error.key.startswith("reset.") and error.key.endswith(".xy")):
            raise
        raise MjstackError(f"{error}", f"Or set job.wider=0, in place of {job.wider:g}") from error


def made_with(stage: Stage) -> Facts:
    """The machine's part of a training, which goes on only with the same."""
    return {"device": stage.backend[1].partition(":")[0], "processes": stage.ranks.size}


def earlier_state(
    stage: Stage, folder: Path, name: str = STATE
) -> tuple[dict[str, Tensor], Facts] | None:
    """A state that an earlier call has left in a training's folder; None without one.

    Raises:
        FolderError: It had another kind of device or number of processes, or cannot be read.
    """
    path = folder / name
    if not path.exists():
        return None
    tensors, facts = read_state(path)
    now = made_with(stage)
    before = facts["made_with"]
    if before != now:
        problem = f"{folder} has a training with {before}, and this one has {now}"
        raise FolderError(problem, "Set job.folder to another folder")
    if type(done := facts.get("done", 0)) is not int or done < 0:
        raise FolderError(f"{path}: done is {done}", "Remove it to train anew")
    return tensors, facts
