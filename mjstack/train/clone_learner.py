"""The learner of trainer *clone*: fits a network to demonstrations, and goes on where it was
stopped.
"""

import copy
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from mjstack.config.fingerprint import config_content
from mjstack.config.schema import CloneJobCfg, CloneSizes, Config
from mjstack.distributed import Ranks
from mjstack.episodes.context import RunContext
from mjstack.interrupt import check_interrupt
from mjstack.policy import Policy, PolicyNetwork, save_policy
from mjstack.policy.checkpoint import write_state
from mjstack.train.demonstrations import Demonstrations
from mjstack.train.trainer import (
    BEST,
    LAST,
    STATE,
    EventWriter,
    pack_weights,
    unpack_weights,
)

_HELD_OUT = 20  # of so many episodes one is for validation
_LEAST = 0.1  # scale of a column, of the largest one of its term
_VALIDATED = 65536  # steps at once
_SHOWN = 10  # batches between two looks at the progress


class Learner:
    """Fits a network to demonstrations, and goes on where an earlier call was stopped.

    The policy is a moving average of the network's weights over the batches.

    Attributes:
        trainer: The trainer's name.
        done: Batches so far.
        seconds: Time of them, in all calls [s].
        best: Smallest validation loss.
        curve: A row for each time that policies were saved.
    """

    trainer = "clone"

    def __init__(
        self,
        context: RunContext,
        cfg: Config,
        sizes: CloneSizes,
        demonstrations: Demonstrations,
        folder: Path,
        made_with: dict[str, Any],
        expert: dict[str, Any],
    ) -> None:
        """Make the network.

        Args:
            context: The run, for its progress and its ranks.
            cfg: The configuration with the policy's observation.
            sizes: How much is trained.
            demonstrations: The expert's episodes.
            folder: Where policies and state are.
            made_with: Sizes and device. An earlier call must have had the same.
            expert: Figures of the demonstrations.
        """
        self._context = context
        job = cast(CloneJobCfg, cfg.job)
        self._job = job
        self._sizes = sizes
        self._folder = folder
        self._made_with = made_with
        self._expert = expert
        self._ranks = ranks = context.ranks
        self.take(demonstrations)
        device = self._seen.device
        self._batch_size = max(1, sizes.batch_size // ranks.size)

        # The network, its average and its optimizer
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(cfg.seed)
            network = PolicyNetwork(
                self._seen.shape[1], self._labels.shape[1], job.chunk, sizes.hidden
            )
        mean, std = _moments(self._labels, ranks)
        network.set_scale("action", mean.cpu(), std.cpu())
        # A column that hardly moves would count as much as the others of its term, and the policy
        # would follow its noise.
        mean, std = _moments(self._seen, ranks)
        parts = [part for part in std.split(list(demonstrations.widths.values())) if len(part)]
        std = torch.cat([torch.maximum(part, _LEAST * part.amax()) for part in parts])
        network.set_scale("observation", mean.cpu(), std.cpu())
        self._network = network.to(device)
        self._average = copy.deepcopy(self._network).requires_grad_(False)
        self._networks = {"network": self._network, "average": self._average}
        self._optimizer = torch.optim.AdamW(
            self._network.parameters(), lr=job.learning_rate, weight_decay=sizes.weight_decay
        )
        self._generator = torch.Generator(device).manual_seed(cfg.seed + ranks.rank)
        self._policy = Policy(
            network=self._average,
            group=job.group,
            observation=cfg.observation[job.group],
            widths=demonstrations.widths,
            execute=job.execute,
            hidden=list(sizes.hidden),
            config=config_content(cfg),
        )

        self.done = 0
        self.seconds = 0.0
        self.best = math.inf
        self.curve: list[dict[str, Any]] = []
        self._sum = torch.zeros((), device=device)  # of losses since the last row
        self._count = 0
        self._events: EventWriter | None = None

    def take(self, demonstrations: Demonstrations) -> None:
        """Learn from these demonstrations from now on. The scale stays that of the first ones."""
        self._seen = demonstrations.seen
        self._labels = demonstrations.labels
        self._last = demonstrations.last()
        episodes = torch.arange(len(demonstrations.ends), device=self._seen.device)
        held_out = episodes % _HELD_OUT == min(_HELD_OUT, len(episodes)) - 1
        held_out = held_out.repeat_interleave(demonstrations.lengths())
        self._training = (~held_out).nonzero()[:, 0]
        self._validation = held_out.nonzero()[:, 0]

    def learn(self, first: int = 0, total: int | None = None) -> None:
        """Make the missing batches, saving policies and state now and then.

        Args:
            first: Batch with which the learning rate begins.
            total: Batch with which it has fallen to 0; those of the sizes if None.

        Raises:
            KeyboardInterrupt: The command was interrupted; the state is saved.
        """
        total = self._sizes.batches if total is None else total
        before = self.seconds - time.perf_counter()
        self._events = self._open_events()
        with _fast_products(self._seen.device):
            while self.done < total:
                share = (self.done - first) / (total - first)
                self._step(0.5 * (1.0 + math.cos(math.pi * share)))
                self.done += 1
                self.seconds = before + time.perf_counter()
                saves = self.done % self._sizes.save_every == 0 or self.done == total
                if saves:
                    self._save()
                if saves or self.done % _SHOWN == 0:
                    try:
                        self._ranks.stop_together()
                        self._context.advance("batches", self.done, total)
                        check_interrupt()
                    except KeyboardInterrupt:
                        # The others' generators may be elsewhere: their last saved state counts.
                        if self._ranks.size == 1:
                            self._write_state()
                        raise
        if self._events is not None:
            self._events.close()

    def _open_events(self) -> EventWriter | None:
        """Where the curves go besides, in the process that writes."""
        if not self._ranks.writes:
            return None
        return EventWriter(self._folder, self.done, self._context.print_line)

    def _step(self, rate: float) -> None:
        """One batch, at a share of the learning rate."""
        job = self._job
        draw = torch.randint(
            len(self._training),
            (self._batch_size,),
            generator=self._generator,
            device=self._seen.device,
        )
        loss = self._loss(self._network, self._training[draw], self._sizes.input_noise)
        for group in self._optimizer.param_groups:
            group["lr"] = job.learning_rate * rate
        self._optimizer.zero_grad()
        loss.backward()
        self._ranks.average_gradients(self._network.parameters())
        self._optimizer.step()
        # The first networks are soon forgotten.
        keep = min(job.averaging, (1.0 + self.done) / (10.0 + self.done))
        average = [p.data for p in self._average.parameters()]
        torch._foreach_lerp_(average, [p.data for p in self._network.parameters()], 1.0 - keep)
        self._sum += loss.detach()
        self._count += 1

    def _loss(self, network: PolicyNetwork, steps: Tensor, noise: float = 0.0) -> Tensor:
        """Mean squared error of the normalised answers at some steps, shape ``(n,)``. At an
        episode's end its last joint targets hold.

        Noise on the observation, in standard deviations, says that the answer is the same a little
        off the expert's way: so the policy comes back to it.
        """
        ahead = torch.arange(network.chunk, device=steps.device)
        then = torch.minimum(steps[:, None] + ahead, self._last[steps][:, None])
        wanted = (self._labels[then] - network.action_mean) / network.action_std
        seen = self._seen[steps]
        if noise > 0.0:
            draw = torch.randn(seen.shape, generator=self._generator, device=seen.device)
            seen = seen + noise * network.observation_std * draw
        return torch.nn.functional.mse_loss(network.normalized(seen), wanted)

    @torch.no_grad()
    def _validate(self) -> float:
        """The average network's loss in the episodes that are held out."""
        parts = self._validation.split(_VALIDATED)
        total = torch.stack([self._loss(self._average, part) * len(part) for part in parts]).sum()
        count = torch.full_like(total, len(self._validation))
        self._ranks.sum_(total, count)
        return float(total / count)

    def _new_row(self) -> dict[str, Any]:
        """A row of the curve, which the policy's file has too. The next one has other batches."""
        loss = self._validate()
        mean = self._sum / max(1, self._count)
        self._ranks.sum_(mean)
        row = {
            "batch": self.done,
            "loss": float(mean) / self._ranks.size,
            "validation_loss": loss,
            "training_s": self.seconds,
        }
        self._sum.zero_()
        self._count = 0
        self._policy.training = {
            "trainer": self.trainer,
            "seed": self._policy.config["seed"],
            "episodes": self._expert["expert_episodes"],
            **row,
        }
        return row

    def _save(self) -> None:
        """Add a row to the curve, and write policies and state."""
        row = self._new_row()
        self.curve.append(row)
        better = row["validation_loss"] <= self.best
        self.best = min(row["validation_loss"], self.best)
        if self._events is not None:
            self._events.add(row, self.done)
            save_policy(self._folder / LAST, self._policy)
            if better:
                save_policy(self._folder / BEST, self._policy)
        self._write_state()

    def _parameters(self) -> dict[str, Tensor]:
        """Everything that training changes, by name."""
        generators = self._ranks.gather(self._generator.get_state())
        state = {f"generator.{rank}": each for rank, each in enumerate(generators)}
        state |= pack_weights(self._networks, self._optimizer)
        return state | {"sum": self._sum}

    def facts(self) -> dict[str, Any]:
        """Everything of the training that is no tensor, in JSON's types."""
        return {
            "made_with": self._made_with,
            "expert": self._expert,
            "done": self.done,
            "seconds": self.seconds,
            "best": self.best,
            "curve": self.curve,
            "count": self._count,
        }

    def _write_state(self) -> None:
        parameters = self._parameters()
        if self._ranks.writes:
            write_state(self._folder / STATE, parameters, self.facts())

    def restore(self, state: dict[str, Tensor], facts: dict[str, Any]) -> None:
        """Go on from the state and facts of an earlier call."""
        self._generator.set_state(state[f"generator.{self._ranks.rank}"])
        unpack_weights(state, self._networks, self._optimizer)
        self._sum.copy_(state["sum"])
        self.done = facts["done"]
        self.seconds = facts["seconds"]
        self.best = facts["best"]
        self.curve = facts["curve"]
        self._count = facts["count"]
        self._context.print_line(f"train: goes on after batch {self.done} of {self._sizes.batches}")


def _moments(values: Tensor, ranks: Ranks) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of each column, over the rows of all processes."""
    variance, mean = torch.var_mean(values, dim=0, correction=0)
    count = torch.full((1,), len(values), dtype=torch.float64, device=values.device)
    first = mean.double() * count
    second = (variance.double() + mean.double() ** 2) * count
    ranks.sum_(count, first, second)
    mean = (first / count).float()
    return mean, (second / count - (first / count) ** 2).clamp(min=0.0).sqrt().float()


@contextmanager
def _fast_products(device: torch.device) -> Iterator[None]:
    """On CUDA products of float32 matrices with TF32, which training does not notice. On a CPU that
    would be slower.
    """
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high" if device.type == "cuda" else before)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)
