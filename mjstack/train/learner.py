"""Base class of the learners: it counts steps, keeps a curve, saves policies and state, and goes
on where it was stopped.
"""

import math
import time
from abc import ABC, abstractmethod
from functools import cached_property
from pathlib import Path
from typing import Any

from torch import Tensor, nn
from torch.optim import Optimizer

from mjstack.config.schema import Config
from mjstack.episodes.stage import Stage
from mjstack.errors import MjstackError
from mjstack.interrupt import check_interrupt, interrupted
from mjstack.policy import Policy, save_policy
from mjstack.policy.checkpoint import Facts, write_state
from mjstack.train.trainer import BEST, LAST, STATE


class Learner(ABC):
    """Makes the steps of a training, and goes on after the last one of an earlier call.

    Now and then it saves: a row for the curve, the policy in the folder `LAST`, and in `BEST` where
    no row before has a higher score, and everything with which a later call goes on.

    A subclass sets ``policy``, ``_networks`` and ``_optimizer``.
    """

    trainer = ""
    step = "batch"  # the noun for a step
    _look_every = 1  # steps between two looks at the progress
    policy: Policy
    _networks: nn.ModuleDict
    _optimizer: Optimizer

    def __init__(self, stage: Stage, cfg: Config, folder: Path) -> None:
        """Begin without a step; ``job.save_every`` steps lie between two saves in the folder."""
        self._stage = stage
        self._cfg = cfg
        self._progress = stage.progress
        self._ranks = stage.ranks
        self._folder = folder
        self._save_every = cfg.job.save_every
        self.done = 0  # steps so far
        self.seconds = 0.0  # of them, in all calls
        self.curve: list[Facts] = []  # a row for each time that policies were saved
        self._before = 0.0  # seconds of earlier calls
        self._notes: Facts = {}  # what the policy's file says of its training beside the row

    def learn(self) -> None:
        """Make the missing steps, saving policies and state now and then.

        Raises:
            KeyboardInterrupt: The command was interrupted; the state is saved.
        """
        self._before = self.seconds
        began = time.perf_counter()
        try:
            while not self._over():
                self._step()
                self.done += 1
                self.seconds = self._before + time.perf_counter() - began
                saves = self.done % self._save_every == 0 or self._over()
                if saves:
                    self._save()
                if saves or self.done % self._look_every == 0:
                    if self._ranks.any(interrupted()):  # one alone would leave the others waiting
                        raise KeyboardInterrupt
                    self._show()
                    check_interrupt()
        except KeyboardInterrupt:
            self._write_state()
            raise

    @cached_property
    def _events(self) -> Any:
        """Writer of the curve as TensorBoard's event files; None without the package."""
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            missing = "train: no curves for TensorBoard, which pip install tensorboard brings"
            self._progress.print_line(missing)
            return None
        # It leaves out what an earlier call has written from this step on.
        return SummaryWriter(str(self._folder), purge_step=self.done)

    def close(self) -> None:
        """Complete what is written."""
        if (events := vars(self).get("_events")) is not None:
            events.close()

    @abstractmethod
    def score(self, row: Facts) -> tuple[float, ...]:
        """How good the policy of a row is: the first number decides, equal ones go by the next."""

    @abstractmethod
    def _over(self) -> bool:
        """Whether there is no step left to make."""

    @abstractmethod
    def _step(self) -> None:
        """Make a step."""

    @abstractmethod
    def _show(self) -> None:
        """Show the progress."""

    @abstractmethod
    def _new_row(self) -> Facts:
        """Figures since the last row. The policy's network is up to date afterwards."""

    def _save(self, **figures: Any) -> None:
        """Add a row to the curve, with figures in front of it, and write policies and state."""
        row = figures | self._new_row()
        self._check_finite(self.done)
        best = all(self.score(row) >= self.score(earlier) for earlier in self.curve)
        self.curve.append(row)
        # JSON has no NaN
        known = {name: value for name, value in row.items() if not math.isnan(value)}
        names = {"trainer": self.trainer, "seed": self._cfg.seed}
        self.policy.training = names | self._notes | known
        if self._ranks.writes:
            for folder in [LAST, BEST] if best else [LAST]:
                save_policy(self._folder / folder, self.policy)
            if self._events is not None:
                for name, value in known.items():
                    self._events.add_scalar(f"train/{name}", value, self.done)
                self._events.flush()
        self._write_state()

    def _check_finite(self, done: int) -> None:
        """Raise a `MjstackError` if a number of the networks is not finite after so many steps."""
        if not all(bool(value.isfinite().all()) for value in self._networks.state_dict().values()):
            raise MjstackError(
                f"train: the networks' numbers are not finite after {self.step} {done};"
                f" {self._folder} keeps what was saved before",
                "Lower job.learning_rate, or look at observations and rewards",
            )

    def facts(self) -> Facts:
        """Everything of the training that is no tensor, in JSON's types."""
        return {"done": self.done, "seconds": self.seconds, "curve": self.curve}

    def _tensors(self) -> dict[str, Tensor]:
        """Weights, moments of the optimizer and the like, by name."""
        state = dict(self._networks.state_dict())
        for number, values in self._optimizer.state_dict()["state"].items():
            state |= {f"optimizer.{number}.{name}": value for name, value in values.items()}
        return state

    def _write_state(self) -> None:
        if self._ranks.writes:
            write_state(self._folder / STATE, self._tensors(), self.facts())

    def restore(self, state: dict[str, Tensor], facts: Facts) -> None:
        """Go on from the state and facts of an earlier call."""
        self._networks.load_state_dict({name: state[name] for name in self._networks.state_dict()})
        moments: dict[int, dict[str, Tensor]] = {}
        for key, value in state.items():
            if key.startswith("optimizer."):
                _, number, name = key.split(".", 2)
                moments.setdefault(int(number), {})[name] = value
        self._optimizer.load_state_dict(self._optimizer.state_dict() | {"state": moments})
        self.done = facts["done"]
        self.seconds = facts["seconds"]
        self.curve = facts["curve"]
        self._progress.print_line(f"train: goes on after {self.step} {self.done}")
