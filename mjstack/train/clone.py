"""Trainer *clone*: a policy learns by regression to answer as the expert does."""

import copy
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from mjstack.config.fingerprint import config_content
from mjstack.config.schema import Backend, CloneJobCfg, CloneSizes, Config, ObservationGroupCfg
from mjstack.envs import build_env, driven_config
from mjstack.episodes.context import RunContext
from mjstack.errors import FolderError, MjstackError, UnknownName
from mjstack.interrupt import check_interrupt
from mjstack.managers.observation import ObservationManager
from mjstack.policy import Policy, PolicyNetwork, save_policy
from mjstack.policy.checkpoint import read_state, write_state
from mjstack.train.demonstrations import Demonstrations, batches_of, play_expert
from mjstack.train.trainer import BEST, LAST, STATE, Trained, Trainer

_HELD_OUT = 20  # of so many episodes one is for validation
_LEAST = 0.1  # scale of a column, of the largest one of its term
_SHOWN = 10  # batches between two looks at the progress


def check_clone(context: RunContext) -> range:
    """Check the observation and the sizes; see `Trainer`."""
    cfg = context.cfg
    job = cast(CloneJobCfg, cfg.job)
    group = observed_group(cfg)
    env = build_env(
        driven_config(cfg, reset={}),
        model=context.model,
        nworld=1,
        backend=Backend.native,
        device="cpu",
    )
    try:
        env.reset()
        ObservationManager(env, {job.group: group})
    finally:
        env.close()
    batches = batches_of(job, resolve_sizes(job, context.backend[1]), cfg.nworld)
    return range(cfg.seed, cfg.seed + len(batches))


def resolve_sizes(job: CloneJobCfg, device: str) -> CloneSizes:
    """The job's sizes, those of the device where they are null."""
    own = job.sizes["cuda" if device.startswith("cuda") else "cpu"]
    given = {item.name: getattr(job, item.name) for item in fields(own)}
    return replace(own, **{name: value for name, value in given.items() if value is not None})


def observed_group(cfg: Config) -> ObservationGroupCfg:
    """The observation group of the policy: terms of a configured group, and added ones.

    Raises:
        MjstackError: There is no such group or term.
    """
    job = cast(CloneJobCfg, cfg.job)
    if job.group not in cfg.observation:
        raise UnknownName("job.group: observation group", job.group, cfg.observation)
    group = cfg.observation[job.group]
    for name in job.leave_out:
        if name not in group.terms:
            raise UnknownName(f"job.leave_out: term of {job.group}", name, group.terms)
    terms = {k: term for k, term in group.terms.items() if k not in job.leave_out} | job.add
    return replace(group, noise=job.observation_noise, terms=terms)


def train_clone(context: RunContext, folder: Path) -> Trained:
    """Play the expert, and fit a network to its answers; see `Trainer`."""
    cfg = context.cfg
    job = cast(CloneJobCfg, cfg.job)
    sizes = resolve_sizes(job, context.backend[1])
    group = observed_group(cfg)
    made_with = {"sizes": asdict(sizes), "device": context.backend[1].partition(":")[0]}
    earlier = read_state(folder / STATE) if (folder / STATE).exists() else None
    if earlier and (theirs := earlier[1]["made_with"]) != made_with:
        raise FolderError(
            f"{folder} has a training with {theirs}, and this one has {made_with}. Set job.folder"
            " to another folder"
        )
    began = time.perf_counter()
    demonstrations = play_expert(context, sizes, group)
    if len(demonstrations.seen) < 2:
        raise MjstackError(
            f"the expert succeeded in {len(demonstrations.seen)} of {demonstrations.played}"
            " episodes: expected two at least",
            "Ask for more (job.episodes), or look at why with gates=[success]",
        )
    seconds = time.perf_counter() - began
    cfg = replace(cfg, observation={job.group: group})
    learner = Learner(context, cfg, sizes, demonstrations, folder, made_with)
    if earlier:
        learner.restore(*earlier)
    learner.learn()
    last = learner.curve[-1]
    return Trained(
        metrics={
            "expert_episodes": len(demonstrations.seen),
            "expert_episodes_played": demonstrations.played,
            "expert_s": seconds,
            "batches": learner.done,
            "training_s": learner.seconds,
            "loss": last["loss"],
            "validation_loss": last["validation_loss"],
            "best_validation_loss": learner.best,
        },
        notes={
            "policy": str(folder / LAST),
            "seeds": f"{demonstrations.seeds[0]} to {demonstrations.seeds[-1]}",
        },
        curve=learner.curve,
        lines=["loss", "validation_loss"],
    )


class Learner:
    """Fits a network to demonstrations, and goes on where an earlier call was stopped.

    The policy is a moving average of the network's weights over the batches.

    Attributes:
        done: Batches so far.
        seconds: Time of them, in all calls [s].
        best: Smallest validation loss.
        curve: A row for each time that policies were saved.
    """

    def __init__(
        self,
        context: RunContext,
        cfg: Config,
        sizes: CloneSizes,
        demonstrations: Demonstrations,
        folder: Path,
        made_with: dict[str, Any],
    ) -> None:
        """Make the network.

        Args:
            context: The run, for its progress.
            cfg: The configuration with the policy's observation.
            sizes: How much is trained.
            demonstrations: The expert's episodes.
            folder: Where policies and state are.
            made_with: Sizes and device. An earlier call must have had the same.
        """
        self._context = context
        job = cast(CloneJobCfg, cfg.job)
        self._job = job
        self._sizes = sizes
        self._folder = folder
        self._made_with = made_with
        self._seen = demonstrations.seen
        self._labels = demonstrations.labels
        device = self._seen.device
        episodes = torch.arange(len(self._seen), device=device)
        held_out = episodes % _HELD_OUT == min(_HELD_OUT, len(episodes)) - 1
        self._training = episodes[~held_out]
        self._validation = episodes[held_out]

        # The network, its average and its optimizer
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(cfg.seed)
            network = PolicyNetwork(
                self._seen.shape[2], self._labels.shape[2], job.chunk, sizes.hidden
            )
        std, mean = torch.std_mean(self._labels.flatten(0, 1), dim=0)
        network.set_scale("action", mean.cpu(), std.cpu())
        # A column that hardly moves would count as much as the others of its term, and the policy
        # would follow its noise.
        std, mean = torch.std_mean(self._seen.flatten(0, 1), dim=0)
        parts = [part for part in std.split(list(demonstrations.widths.values())) if len(part)]
        std = torch.cat([torch.maximum(part, _LEAST * part.amax()) for part in parts])
        network.set_scale("observation", mean.cpu(), std.cpu())
        self._network = network.to(device)
        self._average = copy.deepcopy(self._network).requires_grad_(False)
        self._optimizer = torch.optim.AdamW(
            self._network.parameters(), lr=job.learning_rate, weight_decay=job.weight_decay
        )
        self._generator = torch.Generator(device).manual_seed(cfg.seed)
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

    def learn(self) -> None:
        """Make the missing batches, saving policies and state now and then.

        Raises:
            KeyboardInterrupt: The command was interrupted; the state is saved.
        """
        total = self._sizes.batches
        before = self.seconds - time.perf_counter()
        with _fast_products(self._seen.device):
            while self.done < total:
                self._step(0.5 * (1.0 + math.cos(math.pi * self.done / total)))
                self.done += 1
                self.seconds = before + time.perf_counter()
                saves = self.done % self._sizes.save_every == 0 or self.done == total
                if saves:
                    self._save()
                if saves or self.done % _SHOWN == 0:
                    try:
                        self._context.advance("batches", self.done, total)
                        check_interrupt()
                    except KeyboardInterrupt:
                        self._write_state()
                        raise

    def _step(self, rate: float) -> None:
        """One batch, at a share of the learning rate."""
        job = self._job
        episodes = self._training
        steps = self._seen.shape[1]
        draw = torch.randint(
            len(episodes) * steps,
            (self._sizes.batch_size,),
            generator=self._generator,
            device=self._seen.device,
        )
        loss = self._loss(self._network, episodes[draw // steps], draw % steps)
        for group in self._optimizer.param_groups:
            group["lr"] = job.learning_rate * rate
        self._optimizer.zero_grad()
        loss.backward()
        self._optimizer.step()
        # The first networks are soon forgotten.
        keep = min(job.averaging, (1.0 + self.done) / (10.0 + self.done))
        average = [p.data for p in self._average.parameters()]
        torch._foreach_lerp_(average, [p.data for p in self._network.parameters()], 1.0 - keep)
        self._sum += loss.detach()
        self._count += 1

    def _loss(self, network: PolicyNetwork, episodes: Tensor, steps: Tensor) -> Tensor:
        """Mean squared error of the normalised answers at some steps of some episodes, each
        ``(n,)``. At an episode's end its last joint targets hold.
        """
        ahead = torch.arange(network.chunk, device=steps.device)
        then = (steps[:, None] + ahead).clamp(max=self._labels.shape[1] - 1)
        wanted = self._labels[episodes[:, None], then]
        wanted = (wanted - network.action_mean) / network.action_std
        answer = network.normalized(self._seen[episodes, steps])
        return torch.nn.functional.mse_loss(answer, wanted)

    @torch.no_grad()
    def _validate(self) -> float:
        """The average network's loss in the episodes that are held out."""
        steps = torch.arange(self._seen.shape[1], device=self._seen.device)
        losses = [
            self._loss(self._average, episode.expand(len(steps)), steps)
            for episode in self._validation
        ]
        return float(torch.stack(losses).mean())

    def _save(self) -> None:
        """Add a row to the curve, and write policies and state."""
        loss = self._validate()
        row = {
            "batch": self.done,
            "loss": float(self._sum) / max(1, self._count),
            "validation_loss": loss,
            "training_s": self.seconds,
        }
        self._sum.zero_()
        self._count = 0
        self.curve.append(row)
        self._policy.training = {
            "trainer": "clone",
            "seed": self._policy.config["seed"],
            "episodes": len(self._seen),
            **row,
        }
        save_policy(self._folder / LAST, self._policy)
        if loss <= self.best:
            self.best = loss
            save_policy(self._folder / BEST, self._policy)
        self._write_state()

    def _parameters(self) -> dict[str, Tensor]:
        """Everything that training changes, by name."""
        state: dict[str, Tensor] = {"generator": self._generator.get_state()}
        for name, network in (("network", self._network), ("average", self._average)):
            state |= {f"{name}.{k}": v for k, v in network.state_dict().items()}
        moments = self._optimizer.state_dict()["state"]
        for number, values in moments.items():
            state |= {f"optimizer.{number}.{k}": v for k, v in values.items()}
        return state | {"sum": self._sum}

    def _write_state(self) -> None:
        facts = {
            "made_with": self._made_with,
            "done": self.done,
            "seconds": self.seconds,
            "best": self.best,
            "curve": self.curve,
            "count": self._count,
        }
        write_state(self._folder / STATE, self._parameters(), facts)

    def restore(self, state: dict[str, Tensor], facts: dict[str, Any]) -> None:
        """Go on from the state and facts of an earlier call."""
        self._generator.set_state(state["generator"])
        for name, network in (("network", self._network), ("average", self._average)):
            own = {k.removeprefix(f"{name}."): v for k, v in state.items() if k.startswith(name)}
            network.load_state_dict(own)
        moments: dict[int, dict[str, Tensor]] = {}
        for key, value in state.items():
            kind, _, rest = key.partition(".")
            if kind == "optimizer":
                number, _, name = rest.partition(".")
                moments.setdefault(int(number), {})[name] = value
        optimizer = self._optimizer.state_dict()
        self._optimizer.load_state_dict({**optimizer, "state": moments})
        self._sum.copy_(state["sum"])
        self.done = facts["done"]
        self.seconds = facts["seconds"]
        self.best = facts["best"]
        self.curve = facts["curve"]
        self._count = facts["count"]
        self._context.print_line(f"train: goes on after batch {self.done} of {self._sizes.batches}")


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


TRAINER = Trainer(check_clone, train_clone)
