"""Episodes for a policy to imitate: what the policy would have seen, and the joint targets that the
expert has given.
"""

import itertools
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from mjstack.config.schema import CloneJobCfg
from mjstack.episodes.batches import Batch
from mjstack.episodes.stage import Stage
from mjstack.train.images import AT_ONCE, ImagePool
from mjstack.train.trainer import ESTIMATED

_ROWS = ("seen", "labels", "driven", "qpos", "estimated")
_SUMS = ("played", "judged", "succeeded", "seconds")


@dataclass(frozen=True, kw_only=True)
class Demonstrations:
    """Episodes, one after the other, with the expert's answers in every step: ``steps`` of all
    episodes together.
    """

    seen: Tensor  # observations before each step, shape ``(steps, inputs)``
    labels: Tensor  # the expert's joint targets, shape ``(steps, nu)``
    ends: Tensor  # the step after the last one of each episode, shape ``(episodes,)``, int64
    widths: dict[str, int]  # numbers of each term of the observation, in order
    driven: Tensor | None = None  # where the expert drove, ``(steps,)``, int8; None: everywhere
    played: int = 0  # episodes that were played, kept or not
    judged: int = 0  # of these, those in which the policy drove alone, or the expert in its own
    succeeded: int = 0  # of these, those that the task's check accepted
    broken: Mapping[str, int] = field(default_factory=dict)  # of the judged ones, by broken rule
    seconds: float = 0.0  # in which they were played or read
    source: str = ""  # in words
    # With images: positions before each step, from which they can be rendered, ``(steps, nq)``, in
    # the backend's precision; and the truths that a policy learns to estimate, ``(steps, n)``
    qpos: Tensor | None = None
    estimated: Tensor | None = None
    # Model fields of the episodes' worlds by name, each ``(episodes, ...)``
    fields: Mapping[str, Tensor] = field(default_factory=dict)

    @classmethod
    def of(
        cls, batch: Batch, worlds: Tensor, job: CloneJobCfg, pool: ImagePool | None
    ) -> "Demonstrations":
        """Those of a batch's worlds with these numbers; the pool gets their images."""
        rows = batch.rows
        steps = len(rows["label"])

        def before(name: str) -> Tensor:
            return batch.select(name, worlds)[:, :steps].flatten(0, 1)

        part = cls(
            seen=before("observation"),
            labels=before("label"),
            ends=steps * torch.arange(1, len(worlds) + 1, device=worlds.device),
            widths=batch.env.observation_manager.term_dims[job.group],
            driven=before("driven"),
        )
        if pool is None:
            return part

        def read(step: Tensor) -> Mapping[str, Tensor]:
            query = step % steps // job.execute
            world = worlds[step // steps]
            return {name: rows[name][query, world] for name in job.vision.cameras}

        pool.add(part.usable(job), len(part.seen), read)
        fields = {name: values[worlds] for name, values in batch.env.sim.fields.items()}
        estimated = before(ESTIMATED) if ESTIMATED in rows else None
        return replace(part, qpos=before("qpos"), estimated=estimated, fields=fields)

    @classmethod
    def join(cls, parts: Sequence["Demonstrations"]) -> "Demonstrations":
        """The episodes of all parts, in their order."""

        def joined(name: str) -> Any:
            values = [getattr(part, name) for part in parts]
            return None if values[0] is None else torch.cat(values)

        first = [0, *itertools.accumulate(len(part.seen) for part in parts)]
        return cls(
            **{name: joined(name) for name in _ROWS},
            ends=torch.cat([part.ends + at for part, at in zip(parts, first, strict=False)]),
            widths=parts[0].widths,
            **{name: sum(getattr(part, name) for part in parts) for name in _SUMS},
            broken=sum((Counter(part.broken) for part in parts), Counter()),
            source=parts[0].source,
            fields={
                name: torch.cat([part.fields[name] for part in parts]) for name in parts[0].fields
            },
        )

    def episode(self) -> Tensor:
        """The episode that each step belongs to, shape ``(steps,)``, int64."""
        lengths = self.ends.diff(prepend=self.ends.new_zeros(1))
        return torch.repeat_interleave(lengths)

    def usable(self, job: CloneJobCfg) -> Tensor:
        """Steps to learn from, ascending, shape ``(n,)``, int64: the expert drove all steps of the
        chunk but the last one, and a policy that sees images is queried there.
        """
        episode = self.episode()
        first = torch.cat([self.ends.new_zeros(1), self.ends[:-1]])[episode]
        last = self.ends[episode] - 1
        steps = torch.arange(len(last), device=last.device)
        usable = (steps - first) % (job.execute if job.vision.cameras else 1) == 0
        if self.driven is not None:
            for ahead in range(job.chunk - 1):
                usable &= self.driven[torch.minimum(steps + ahead, last)].bool()
        return usable.nonzero()[:, 0]

    def render(self, stage: Stage, pool: ImagePool) -> None:
        """Give the pool the images that it got when these episodes were played."""
        job: CloneJobCfg = stage.cfg.job
        episode = self.episode()
        names = job.vision.cameras
        renderer = stage.color_renderer(min(AT_ONCE, len(episode)), list(self.fields), names)

        def read(step: Tensor) -> Mapping[str, Tensor]:
            assert self.qpos is not None
            fields = {name: values[episode[step]] for name, values in self.fields.items()}
            images = renderer.draw(self.qpos[step], fields)
            return {name: images[f"images.{name}"] for name in names}

        with closing(renderer):
            pool.add(self.usable(job), len(episode), read)


@dataclass(frozen=True)
class Source:
    """Demonstrations that are there already: ``job.source`` names it, ``job.dataset`` its folder.

    Attributes:
        check: Raises a `MjstackError` for what a policy cannot learn from, given the stage and the
            numbers of each term of its observation. Returns the seeds of the starts.
        read: The episodes, given the same.
    """

    check: Callable[[Stage, Mapping[str, int]], range]
    read: Callable[[Stage, dict[str, int]], Demonstrations]
