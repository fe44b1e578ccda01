"""The learner of trainer *clone*: fits a network to demonstrations, and goes on where it was
stopped.
"""

import copy
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn

from mjstack.config.fingerprint import config_content
from mjstack.config.schema import CloneJobCfg, CloneSizes, Config
from mjstack.episodes.context import RunContext
from mjstack.interrupt import check_interrupt
from mjstack.policy import Policy, PolicyNetwork, save_policy
from mjstack.policy.checkpoint import write_state
from mjstack.sim.graph import StepGraph
from mjstack.train.clone_network import input_noise, make_network
from mjstack.train.demonstrations import Demonstrations
from mjstack.train.images import Augmentation, ImagePool
from mjstack.train.trainer import BEST, LAST, STATE, EventWriter, pack_weights, unpack_weights

_HELD_OUT = 20  # of so many episodes one is for validation
_VALIDATED = 65536  # steps at once
_VALIDATED_IMAGES = 4096  # steps, at most
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
    _validation: Tensor

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
        device = demonstrations.seen.device
        self._batch_size = max(1, sizes.batch_size // ranks.size)

        # The network, its average and its optimizer
        self._network = make_network(cfg, sizes.hidden, demonstrations, ranks).to(device)
        vision = self._network.vision
        self._average = copy.deepcopy(self._network).requires_grad_(False)
        self._networks = nn.ModuleDict({"network": self._network, "average": self._average})
        self.take(demonstrations)
        # What a batch depends on lies in tensors, so that a graph can hold the batch.
        self._optimizer = torch.optim.AdamW(
            self._network.parameters(),
            lr=torch.tensor(job.learning_rate, device=device),
            weight_decay=sizes.weight_decay,
            fused=True,
            capturable=device.type == "cuda",
        )
        self._forget = torch.zeros((), device=device)  # share of the average that a batch replaces
        self._drawn = torch.zeros(self._batch_size, dtype=torch.int64, device=device)
        self._noise = torch.zeros((self._batch_size, self._seen.shape[1]), device=device)
        widest = input_noise(cfg, context.model, sizes, demonstrations.widths)
        self._widest = torch.tensor(widest, device=device)
        self._generator = torch.Generator(device)
        # Images
        self._pool: ImagePool | None = None
        self._shown: ImagePool | None = None
        self._pools: list[ImagePool] = []
        if vision.sizes:
            seed = draw_seed(cfg.seed, ranks.rank, 0)
            own = (vision, demonstrations)
            size = self._batch_size
            self._pool = ImagePool(context, job.vision, *own, self._training, size, seed)
            every = -(-len(self._validation) // _VALIDATED_IMAGES)
            self._validation = self._validation[::every]
            all_of_them = replace(job.vision, pool=len(self._validation))
            self._shown = ImagePool(context, all_of_them, *own, self._validation, size, seed)
            self._pools = [self._pool, self._shown]
            self._augment = Augmentation(job.vision, len(vision.sizes), size, device)
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
        self._batch: Callable[[], None] = self._fit

    def take(self, demonstrations: Demonstrations) -> None:
        """Learn from these demonstrations from now on, whose range of joint targets is the
        policy's. The scale stays that of the first ones.
        """
        self._average.set_range(*demonstrations.labels.aminmax(dim=0))
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
        for pool in self._pools:
            pool.fill(self.done - 1)
        self._events = self._open_events()
        self._batch = self._fit
        if self._seen.is_cuda and self._ranks.size == 1:
            # Demonstrations and weights stay where they are in memory until the last batch.
            mode = self._context.cfg.graph
            name = "a batch of the training"
            self._batch = StepGraph(self._fit, self._seen.device, mode, name=name, scratch=False)
        with _fast_products(self._seen.device):
            try:
                while self.done < total:
                    share = (self.done - first) / (total - first)
                    self._step(0.5 * (1.0 + math.cos(math.pi * share)))
                    self.done += 1
                    self.seconds = before + time.perf_counter()
                    saves = self.done % self._sizes.save_every == 0 or self.done == total
                    if saves:
                        self._save()
                    if saves or self.done % _SHOWN == 0:
                        self._ranks.stop_together()
                        self._context.advance("batches", self.done, total)
                        check_interrupt()
            except KeyboardInterrupt:
                self._write_state()
                raise
            finally:
                for pool in self._pools:
                    pool.close()
        if self._events is not None:
            self._events.close()

    def _open_events(self) -> EventWriter | None:
        """Where the curves go besides, in the process that writes."""
        if not self._ranks.writes:
            return None
        return EventWriter(self._folder, self.done, self._context.print_line)

    def _step(self, rate: float) -> None:
        """One batch, at a share of the learning rate. What it draws follows from the seed and the
        batch's number, so training goes on after any of them.
        """
        seed = draw_seed(self._policy.config["seed"], self._ranks.rank, self.done)
        self._generator.manual_seed(seed)
        among = len(self._training if self._pool is None else self._pool.steps)
        torch.randint(among, self._drawn.shape, generator=self._generator, out=self._drawn)
        self._noise.uniform_(-1.0, 1.0, generator=self._generator)
        if self._pool is not None:
            self._augment.draw(self._generator)
            self._pool.advance(self.done)
        # The first networks are soon forgotten.
        keep = min(self._job.averaging, (1.0 + self.done) / (10.0 + self.done))
        self._forget.fill_(1.0 - keep)
        for group in self._optimizer.param_groups:
            group["lr"].fill_(self._job.learning_rate * rate)
        self._batch()
        self._count += 1

    def _fit(self) -> None:
        """Learn from the drawn steps."""
        weights = list(self._network.parameters())
        images: Sequence[Tensor] = ()
        if self._pool is None:
            steps = self._training[self._drawn]
        else:
            steps = self._pool.steps[self._drawn]
            images = self._augment(self._pool.images, self._drawn)
        loss = self._loss(self._network, steps, images, self._widest * self._noise)
        # Into memory that is laid out as the weights, which the fused optimizer asks for
        for weight, gradient in zip(weights, torch.autograd.grad(loss, weights), strict=True):
            weight.grad = torch.empty_like(weight).copy_(gradient)
        self._ranks.average_gradients(weights)
        self._optimizer.step()
        average = [p.data for p in self._average.parameters()]
        change = torch._foreach_sub([p.data for p in weights], average)
        torch._foreach_mul_(change, self._forget)
        torch._foreach_add_(average, change)
        self._sum += loss.detach()

    def _loss(
        self,
        network: PolicyNetwork,
        steps: Tensor,
        images: Sequence[Tensor],
        noise: Tensor | float = 0.0,
    ) -> Tensor:
        """Mean squared error of the normalised answers at some steps, shape ``(n,)``. At an
        episode's end its last joint targets hold.

        Noise on the observation says that the answer is the same a little off the expert's way. It
        also hides from the network what only tells the time: while the expert waits, joints settle
        by micrometers, and a policy that reads these waits for ever where they are others.
        """
        ahead = torch.arange(network.chunk, device=steps.device)
        then = torch.minimum(steps[:, None] + ahead, self._last[steps][:, None])
        wanted = (self._labels[then] - network.action_mean) / network.action_std
        # Convolutions on CUDA in bfloat16. A graph cannot hold the cache of converted weights.
        fast = torch.autocast(
            steps.device.type,
            torch.bfloat16,
            enabled=steps.is_cuda and len(images) > 0,
            cache_enabled=False,
        )
        with fast:
            answer = network.normalized(self._seen[steps] + noise, images)
        return torch.nn.functional.mse_loss(answer.float(), wanted)

    @torch.no_grad()
    def _validate(self) -> float:
        """The average network's loss in the episodes that are held out."""
        losses = []
        size = _VALIDATED if self._shown is None else self._batch_size
        for first in range(0, len(self._validation), size):
            rows = slice(first, first + size)
            images = [] if self._shown is None else [each[rows] for each in self._shown.images]
            part = self._validation[rows]
            shown = [each.float() for each in images]
            losses.append(self._loss(self._average, part, shown) * len(part))
        total = torch.stack(losses).sum()
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
        if self._ranks.writes:
            weights = pack_weights(self._networks, self._optimizer)
            write_state(self._folder / STATE, weights | {"sum": self._sum}, self.facts())

    def restore(self, state: dict[str, Tensor], facts: dict[str, Any]) -> None:
        """Go on from the state and facts of an earlier call."""
        unpack_weights(state, self._networks, self._optimizer)
        self._sum.copy_(state["sum"])
        self.done = facts["done"]
        self.seconds = facts["seconds"]
        self.best = facts["best"]
        self.curve = facts["curve"]
        self._count = facts["count"]
        self._context.print_line(f"train: goes on after batch {self.done} of {self._sizes.batches}")


def draw_seed(seed: int, rank: int, batch: int) -> int:
    """Seed of what a rank draws for a batch: no other batch or rank of the training has it."""
    return 1_000_003 * (seed + rank) + batch


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
