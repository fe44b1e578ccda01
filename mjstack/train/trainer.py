"""A trainer, as job=train runs it."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, TypeVar

from torch import Tensor, nn
from torch.optim import Optimizer

from mjstack.config.schema import (
    Backend,
    CloneJobCfg,
    CloneSizes,
    Config,
    ObservationGroupCfg,
    PpoJobCfg,
    PpoSettings,
)
from mjstack.envs import Env, build_env
from mjstack.episodes.context import RunContext
from mjstack.errors import FolderError, UnknownName
from mjstack.policy.checkpoint import read_state

# In the folder of a training: two policies, and what it needs to go on.
LAST = "last"
BEST = "best"
STATE = "training.safetensors"

Settings = TypeVar("Settings", CloneSizes, PpoSettings)


class EventWriter:
    """Curves of a training as TensorBoard's event files. Without the package it writes nothing."""

    def __init__(self, folder: Path, done: int, print_line: Callable[[str], None]) -> None:
        """Begin a file.

        Args:
            folder: Where it goes.
            done: Where an earlier call was stopped: TensorBoard leaves out its later values.
            print_line: Told where the package is missing.
        """
        self._writer: Any = None
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            print_line("train: no curves for TensorBoard, which pip install tensorboard brings")
            return
        self._writer = SummaryWriter(str(folder), purge_step=done + 1)

    def add(self, values: Mapping[str, float], step: int) -> None:
        """Add values of a step to their curves."""
        if self._writer is not None:
            for name, value in values.items():
                self._writer.add_scalar(f"train/{name}", value, step)
            self._writer.flush()

    def close(self) -> None:
        """Complete the file."""
        if self._writer is not None:
            self._writer.close()


@dataclass(kw_only=True, slots=True)
class Trained:
    """The result of a training.

    Attributes:
        metrics: Figures, by name with unit.
        notes: Facts in words, by name.
        curve: Rows of the training curve: values by column.
        lines: Columns that are drawn.
        abscissa: The column over which they are drawn.
        scale: Of their axis, ``log`` or ``linear``.
    """

    metrics: dict[str, float]
    notes: dict[str, str]
    curve: list[dict[str, Any]]
    lines: list[str] = field(default_factory=list)
    abscissa: str = "batch"
    scale: str = "log"


@dataclass(frozen=True, slots=True)
class Trainer:
    """One way to train; ``conf/trainer/<name>.yaml`` names it.

    Attributes:
        check: Raises a `MjstackError` for what cannot be trained, before anything is written.
            Returns the seeds of the starts that training uses.
        train: Trains in a folder, in which it goes on with an earlier call's training, and leaves
            the policies `LAST` and `BEST` there.
        midway: Whether its worlds may start in the middle of an episode.
    """

    check: Callable[[RunContext], range]
    train: Callable[[RunContext, Path], Trained]
    midway: bool = False


def filled(job: CloneJobCfg | PpoJobCfg, defaults: Settings) -> Settings:
    """Settings of a job, those of ``defaults`` where they are null."""
    given = {item.name: getattr(job, item.name) for item in fields(defaults)}
    return replace(defaults, **{name: value for name, value in given.items() if value is not None})


@contextmanager
def one_world(context: RunContext, cfg: Config) -> Iterator[Env]:
    """A world on native MuJoCo, to find out about terms."""
    env = build_env(cfg, model=context.model, nworld=1, backend=Backend.native, device="cpu")
    with closing(env):
        yield env


def observed_group(job: CloneJobCfg | PpoJobCfg, leave_out: Sequence[str]) -> ObservationGroupCfg:
    """The observation group of a new policy.

    Args:
        job: The training.
        leave_out: Terms of the group that the policy does not see.

    Raises:
        UnknownName: There is no such group, or no such term as the job names.
    """
    if job.group not in job.observation:
        raise UnknownName("job.group: observation group", job.group, job.observation)
    group = job.observation[job.group]
    for name in job.leave_out or []:
        if name not in group.terms:
            raise UnknownName(f"job.leave_out: term of {job.group}", name, group.terms)
    terms = {name: term for name, term in group.terms.items() if name not in leave_out}
    return replace(group, noise=job.observation_noise, terms=terms)


def earlier_state(
    folder: Path, made_with: Mapping[str, Any]
) -> tuple[dict[str, Tensor], dict[str, Any]] | None:
    """The state that an earlier call has left in a training's folder; None without one.

    Raises:
        FolderError: It had other sizes, or another kind of device.
        PolicyError: Its file cannot be read.
    """
    if not (folder / STATE).exists():
        return None
    earlier = read_state(folder / STATE)
    if (theirs := earlier[1]["made_with"]) != made_with:
        raise FolderError(
            f"{folder} has a training with {theirs}, and this one has {made_with}. Set job.folder"
            " to another folder"
        )
    return earlier


def pack_weights(networks: nn.ModuleDict, optimizer: Optimizer) -> dict[str, Tensor]:
    """Weights of networks and moments of an optimizer, by names that start with their own."""
    state = dict(networks.state_dict())
    for number, values in optimizer.state_dict()["state"].items():
        state |= {f"optimizer.{number}.{key}": value for key, value in values.items()}
    return state


def unpack_weights(
    state: Mapping[str, Tensor], networks: nn.ModuleDict, optimizer: Optimizer
) -> None:
    """Take back what `pack_weights` has given; other names are left out."""
    networks.load_state_dict({name: state[name] for name in networks.state_dict()})
    moments: dict[int, dict[str, Tensor]] = {}
    for key, value in state.items():
        owner, _, rest = key.partition(".")
        if owner == "optimizer":
            number, _, name = rest.partition(".")
            moments.setdefault(int(number), {})[name] = value
    optimizer.load_state_dict(optimizer.state_dict() | {"state": moments})
