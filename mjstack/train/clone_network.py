"""The network of a clone, with the scale of its demonstrations."""

from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor

from mjstack.config.schema import CloneJobCfg, Config
from mjstack.distributed import Ranks
from mjstack.policy import PolicyNetwork, Vision
from mjstack.train.demonstrations import Demonstrations

_LEAST = 0.1  # scale of a column, of the largest one of its term


def make_network(
    cfg: Config, hidden: Sequence[int], demonstrations: Demonstrations, ranks: Ranks
) -> PolicyNetwork:
    """A network with random weights, on the CPU. Its scale is that of all ranks' demonstrations.

    Args:
        cfg: The training's configuration; its seed gives the weights.
        hidden: Widths of the layers.
        demonstrations: Those of this rank.
        ranks: The processes of the training.
    """
    job = cast(CloneJobCfg, cfg.job)
    seen = demonstrations.seen
    labels = demonstrations.labels
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(cfg.seed)
        network = PolicyNetwork(
            seen.shape[1], labels.shape[1], job.chunk, hidden, vision_of(cfg, job)
        )
    mean, std = _moments(labels, ranks)
    network.set_scale("action", mean.cpu(), std.cpu())
    # A column that hardly moves would count as much as the others of its term, and the policy would
    # follow its noise.
    mean, std = _moments(seen, ranks)
    parts = [part for part in std.split(list(demonstrations.widths.values())) if len(part)]
    std = torch.cat([torch.maximum(part, _LEAST * part.amax()) for part in parts])
    network.set_scale("observation", mean.cpu(), std.cpu())
    return network


def vision_of(cfg: Config, job: CloneJobCfg) -> Vision:
    """The images that a policy of the job sees."""
    settings = job.vision
    if not settings.cameras:
        return Vision()
    cameras = cfg.scene.cameras
    return Vision(
        sizes={name: (cameras[name].size[0], cameras[name].size[1]) for name in settings.cameras},
        channels=settings.channels,
        features=settings.features,
    )


def _moments(values: Tensor, ranks: Ranks) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of each column, over the rows of all processes."""
    variance, mean = torch.var_mean(values, dim=0, correction=0)
    count = torch.full((1,), len(values), dtype=torch.float64, device=values.device)
    first = mean.double() * count
    second = (variance.double() + mean.double() ** 2) * count
    ranks.sum_(count, first, second)
    mean = (first / count).float()
    return mean, (second / count - (first / count) ** 2).clamp(min=0.0).sqrt().float()
