"""The learner of trainers *clone* and *dagger*: fits a network to demonstrations, and
goes on where it was stopped.
"""

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from typing_extensions import override

from mjstack.config.fingerprint import config_content
from mjstack.config.schema import CloneJobCfg
from mjstack.episodes.stage import Stage
from mjstack.policy import Policy, PolicyNetwork
from mjstack.policy.checkpoint import Facts
from mjstack.sim.graph import StepGraph
from mjstack.train.clone_network import Estimator, input_noise, make_network
from mjstack.train.demonstrations import Demonstrations
from mjstack.train.images import Augmentation, ImagePool
from mjstack.train.learner import Learner
from mjstack.train.trainer import made_with, with_observation

_LOSSES = {"absolute": nn.functional.l1_loss, "squared": nn.functional.mse_loss}
_AVERAGING = 0.999  # share of the weights that a batch keeps: they are an average
_VALIDATION_SHARE = 20  # of so many episodes one is for validation
_VALIDATED = 65536  # steps at once


class CloneLearner(Learner):
    """Fits a network to demonstrations, and goes on where an earlier call was stopped.

    The policy is a moving average of the network's weights over the batches.

    A step is a batch. Without rounds a row of the curve is written every ``job.save_every``
    batches, and the best policy is the one with the smallest validation loss. With rounds a row is
    a round, with the success of its policy, and the best one is the first with the largest success.
    """

    _look_every = 10
    _validation: Tensor

    def __init__(
        self,
        stage: Stage,
        demonstrations: Demonstrations,
        folder: Path,
        pool: ImagePool | None,
    ) -> None:
        """Make the network with the scale of the first demonstrations; the folder gets policies
        and state, and the pool has the images, if it sees any.
        """
        cfg = with_observation(stage.cfg)
        job: CloneJobCfg = cfg.job
        self._job = job
        super().__init__(stage, cfg, folder)
        self.trainer = "dagger" if job.rounds else "clone"
        ranks = stage.ranks
        device = demonstrations.seen.device
        size = max(1, job.batch_size // ranks.size)
        self._pool = pool

        # The network, its average and its optimizer
        self._network = make_network(cfg, demonstrations, ranks).to(device)
        self._average = copy.deepcopy(self._network).requires_grad_(False)
        self._networks = nn.ModuleDict({"network": self._network, "average": self._average})
        self._trained: list[nn.Parameter] = list(self._network.parameters())
        self._estimator: Estimator | None = None
        estimated = demonstrations.estimated
        # Terms may give no number, such as headings of round objects: the mean of no error is nan
        if estimated is not None and estimated.shape[1] > 0:
            self._estimator = Estimator(cfg, estimated, ranks).to(device)
            self._networks["estimator"] = self._estimator
            self._trained += self._estimator.parameters()
        self.process(demonstrations)
        # What a batch depends on lies in tensors, so that a graph can hold the batch.
        self._optimizer = torch.optim.AdamW(
            self._trained,
            lr=torch.tensor(job.learning_rate, device=device),
            weight_decay=job.weight_decay,
            fused=True,
            capturable=device.type == "cuda",
        )
        self._replaced = torch.zeros((), device=device)  # share of the average, by a batch
        self._chosen = torch.zeros(size, dtype=torch.int64, device=device)
        self._noise = torch.zeros((size, self._seen.shape[1]), device=device)
        spread = self._network.observation_std.cpu()
        self._widest = input_noise(cfg, stage.model, demonstrations.widths, spread).to(device)
        self._generator = torch.Generator(device)
        self._augment = Augmentation(job.vision, len(job.vision.cameras), size, device)
        facts = (demonstrations.widths, job.execute, config_content(cfg), cfg.controller.action)
        self.policy = Policy(self._average, job.group, cfg.observation[job.group], *facts)

        self._sum = torch.zeros((), device=device)  # of losses since the last row
        self._networks.register_buffer("sum", self._sum)  # so it is part of the state

    def process(self, demonstrations: Demonstrations) -> None:
        """Learn from these demonstrations from now on, whose range of joint targets is the
        policy's. The scale stays that of the first ones.
        """
        counts = demonstrations.ends.new_tensor([len(demonstrations.ends), demonstrations.played])
        self._ranks.sum_(counts)
        self._expert = {
            "episodes": int(counts[0]),
            "episodes_played": int(counts[1]),
            "expert_s": demonstrations.seconds,
            "source": demonstrations.source,
        }
        self._notes = {"episodes": int(counts[0])}
        ranges = self._ranks.gather([part.cpu() for part in demonstrations.labels.aminmax(dim=0)])
        low, high = (torch.stack(parts) for parts in zip(*ranges, strict=True))
        self._average.set_range(low.amin(0), high.amax(0))
        self._seen = demonstrations.seen
        self._labels = demonstrations.labels
        self._estimated = demonstrations.estimated
        episode = demonstrations.episode()
        self._last = demonstrations.ends[episode] - 1  # steps of their episodes
        # Steps to learn from: those that the pool shows, or all; and their rows in the pool
        if self._pool is None:
            rows = steps = demonstrations.usable(self._job)
        else:
            rows = self._pool.rows()
            steps = self._pool.steps[rows]
        share = min(_VALIDATION_SHARE, len(demonstrations.ends))
        validates = episode[steps] % _VALIDATION_SHARE == share - 1
        self._training = steps[~validates]
        self._rows = rows[~validates]
        self._validation = steps[validates]
        self._validation_rows = rows[validates]
        if not len(self._validation):  # of few episodes the expert may drive no chunk that is one
            self._validation, self._validation_rows = self._training, self._rows

    def learn(self, number: int = 1) -> None:
        """Make the missing batches of a round, in which the learning rate falls to 0; see
        `Learner`.
        """
        self._total = number * self._job.batches
        self._batch: Callable[[], None] = self._fit
        if self._seen.is_cuda and self._ranks.size == 1:
            # Demonstrations and weights stay where they are in memory until the last batch.
            mode = self._cfg.graph
            name = "a batch of the training"
            self._batch = StepGraph(self._fit, self._seen.device, mode, name=name, scratch=False)
        precision = torch.get_float32_matmul_precision()
        if self._seen.is_cuda:  # TF32, which training does not notice, and which slows a CPU down
            torch.set_float32_matmul_precision("high")
        try:
            super().learn()
        finally:
            torch.set_float32_matmul_precision(precision)

    def _over(self) -> bool:
        return self.done >= self._total

    def _show(self) -> None:
        self._progress.advance("batches", self.done, self._total)

    def _step(self) -> None:
        """One batch. What it draws follows from the seed and the batch's number, so training goes
        on after any of them.
        """
        batches = self._job.batches
        share = (self.done - (self._total - batches)) / batches
        rate = 0.5 * (1.0 + math.cos(math.pi * share))
        if self._job.warm_up > 0.0:
            rate *= min(1.0, share / self._job.warm_up)
        self._generator.manual_seed(draw_seed(self._cfg.seed, self._ranks.rank, self.done))
        count = len(self._training)
        torch.randint(count, self._chosen.shape, generator=self._generator, out=self._chosen)
        self._noise.uniform_(-1.0, 1.0, generator=self._generator)
        if self._pool is not None:
            self._augment.draw(self._generator)
        # The first networks do not count for long.
        share_kept = min(_AVERAGING, (1.0 + self.done) / (10.0 + self.done))
        self._replaced.fill_(1.0 - share_kept)
        for group in self._optimizer.param_groups:
            group["lr"].fill_(self._job.learning_rate * rate)
        self._batch()

    def _fit(self) -> None:
        """Learn from the drawn steps."""
        weights = self._trained
        steps = self._training[self._chosen]
        images: Sequence[Tensor] = ()
        if self._pool is not None:
            images = self._augment(self._pool.images.values(), self._rows[self._chosen])
        action_loss, loss = self._loss(self._network, steps, images, self._widest * self._noise)
        # Into memory that is laid out as the weights, which the fused optimizer asks for
        for weight, gradient in zip(weights, torch.autograd.grad(loss, weights), strict=True):
            weight.grad = torch.empty_like(weight).copy_(gradient)
        self._ranks.average_gradients(weights)
        if self._job.max_grad_norm is not None:
            nn.utils.clip_grad_norm_(weights, self._job.max_grad_norm)
        self._optimizer.step()
        average = [p.data for p in self._average.parameters()]
        change = torch._foreach_sub([p.data for p in self._network.parameters()], average)
        torch._foreach_mul_(change, self._replaced)
        torch._foreach_add_(average, change)
        self._sum += action_loss.detach()

    def _loss(
        self,
        network: PolicyNetwork,
        steps: Tensor,
        images: Sequence[Tensor],
        noise: Tensor | float = 0.0,
    ) -> tuple[Tensor, Tensor]:
        """Mean error, by ``job.loss``, of the normalised actions at some steps, shape ``(n,)``; and
        the same with the error of what is estimated, of the network that is trained. At an
        episode's end its last joint targets hold.

        Noise on the observation says that the actions are the same a little off the expert's way.
        It also stops the policy from reading elapsed time out of micrometre drift: while the expert
        waits, joints settle. Without noise the policy stalls where that drift differs.
        """
        ahead = torch.arange(network.chunk, device=steps.device)
        later = torch.minimum(steps[:, None] + ahead, self._last[steps][:, None])
        target = self._labels[later] - network.measured(self._seen[steps])
        target = (target - network.action_mean) / network.action_std
        # Convolutions on CUDA in bfloat16. A graph cannot hold the cache of converted weights.
        fast = steps.is_cuda and len(images) > 0
        error = _LOSSES[self._job.loss]
        with torch.autocast(steps.device.type, torch.bfloat16, enabled=fast, cache_enabled=False):
            features = network.encode(images)
            action = network.normalized(self._seen[steps] + noise, features)
            action_loss = loss = error(action.float(), target)
            if self._estimator is not None and network is self._network:
                assert self._estimated is not None
                estimate, truth = self._estimator(features, self._estimated[steps])
                loss = action_loss + self._job.vision.estimate * error(estimate.float(), truth)
        return action_loss, loss

    @torch.no_grad()
    def _validate(self) -> float:
        """The average network's loss in the episodes that are held out."""
        losses = []
        stored = [] if self._pool is None else self._pool.images.values()
        size = len(self._chosen) if stored else _VALIDATED
        parts = self._validation.split(size), self._validation_rows.split(size)
        for steps, rows in zip(*parts, strict=True):
            images = [image[rows].float() for image in stored]
            losses.append(self._loss(self._average, steps, images)[0] * len(steps))
        total = torch.stack(losses).sum()
        count = torch.full_like(total, len(self._validation))
        self._ranks.sum_(total, count)
        return float(total / count)

    def _new_row(self) -> Facts:
        """A row of the curve. The next one has other batches."""
        loss = self._validate()
        earlier = self.curve[-1]["batch"] if self.curve else 0
        mean = self._sum / max(1, self.done - earlier)
        self._sum.zero_()
        self._ranks.sum_(mean)
        return {
            "batch": self.done,
            "loss": float(mean) / self._ranks.size,
            "validation_loss": loss,
            "training_s": self.seconds,
        }

    @override
    def score(self, row: Facts) -> tuple[float, ...]:
        if self._job.rounds:
            return row["success"], -row["round"]
        return (-row["validation_loss"],)

    @override
    def _save(self, **figures: Any) -> None:
        """Save; in a round write the state alone, as the policy's success is not known yet."""
        if self._job.rounds and not figures:
            self._write_state()
        else:
            super()._save(**figures)

    def conclude(self, number: int, figures: Mapping[str, float]) -> None:
        """End a round, with figures of its policy's episodes, ``success`` among them."""
        self._save(round=number, **figures)

    @override
    def facts(self) -> Facts:
        pool = {} if self._pool is None else {"pool": len(self._pool.steps)}
        made = {"made_with": made_with(self._stage), "expert": self._expert}
        return super().facts() | made | pool


def draw_seed(seed: int, rank: int, batch: int) -> int:
    """Seed of what a rank draws for a batch: no other batch or rank of the training has it."""
    return 1_000_003 * (seed + rank) + batch
