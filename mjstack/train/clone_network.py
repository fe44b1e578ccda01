"""The network of a clone with the scale of its demonstrations, and the noise on what it sees."""

from collections.abc import Mapping, Sequence
from typing import cast

import mujoco
import torch
from torch import Tensor, nn

from mjstack.config.schema import CloneJobCfg, Config, ObservationTermCfg
from mjstack.distributed import Ranks
from mjstack.errors import ConfigError
from mjstack.managers.observation import column_noise, slide_joints
from mjstack.policy import PolicyNetwork, Vision
from mjstack.tasks.check import make_check
from mjstack.train.demonstrations import Demonstrations

_JOINTS = "mjstack.mdp.observation.joint_pos"
_LEAST = 0.1  # scale of a column, of the largest one of its term
_NOISE = 0.02  # of the standard deviation of a column, where its term has no noise
_ROUGH = 0.005  # m
_CONSTANT = 1e-3  # a column of what is estimated that varies less has no scale


def make_network(cfg: Config, demonstrations: Demonstrations, ranks: Ranks) -> PolicyNetwork:
    """A network with random weights by the configured seed, on the CPU. Its scale is that of the
    demonstrations of all ranks.
    """
    job: CloneJobCfg = cfg.job
    seen = demonstrations.seen
    labels = demonstrations.labels
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(cfg.seed)
        sizes = (seen.shape[1], labels.shape[1], job.chunk, job.hidden)
        relative, origin = (
            measured_columns(cfg, demonstrations.widths) if job.relative else ([], [])
        )
        network = PolicyNetwork(*sizes, vision_of(cfg, job), relative)
    if relative:
        network.origin.copy_(torch.tensor(origin))
        labels = labels - network.to(labels.device).measured(seen)[:, 0]
        network.cpu()
    mean, std = _moments(labels, ranks)
    network.set_scale("action", mean.cpu(), std.cpu())
    # A column that hardly moves would count as much as others: its noise would be followed.
    mean, std = _moments(seen, ranks)
    parts = [part for part in std.split(list(demonstrations.widths.values())) if len(part)]
    std = torch.cat([torch.maximum(part, _LEAST * part.amax()) for part in parts])
    network.set_scale("observation", mean.cpu(), std.cpu())
    return network


class Estimator(nn.Module):
    """Estimates, from the features of a step's images, what the policy does not see.

    It makes the convolutions learn where objects are, which the actions alone teach them slowly.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, cfg: Config, estimated: Tensor, ranks: Ranks) -> None:
        """Make the layer by the configured seed, on the CPU, with the scale of ``estimated``, shape
        ``(steps, n)``, of all ranks.
        """
        super().__init__()
        job: CloneJobCfg = cfg.job
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(cfg.seed)
            width = job.vision.features * len(job.vision.cameras)
            self.layer = nn.Linear(width, estimated.shape[1])
        mean, std = _moments(estimated, ranks)
        self.register_buffer("mean", mean.cpu())
        self.register_buffer("std", torch.where(std > _CONSTANT, std, 1.0).cpu())

    def forward(self, features: Sequence[Tensor], truth: Tensor) -> tuple[Tensor, Tensor]:
        """The estimate and the truth, shape ``(steps, n)``, both normalised."""
        return self.layer(torch.cat(list(features), dim=1)), (truth - self.mean) / self.std


def input_noise(
    cfg: Config, model: mujoco.MjModel, widths: Mapping[str, int], std: Tensor
) -> Tensor:
    """Half-width of the noise on each column of the observation in a training, shape ``(n,)``. It
    is smaller for a task whose check tolerates less than `_ROUGH` [m]: noise hides what is finer.

    ``widths`` are the numbers of each term. The noise of terms without some follows from ``std``,
    the standard deviation of each column in the demonstrations, shape ``(n,)``: a policy that
    learned without any leaves the expert's path and does not come back.
    """
    job: CloneJobCfg = cfg.job
    scale = job.input_noise * min(1.0, make_check(cfg).tolerance / _ROUGH)
    slides = slide_joints(model, cfg.robot.joints)
    widest: list[float] = []
    for (name, width), spread in zip(widths.items(), std.split([*widths.values()]), strict=True):
        term = cast(ObservationTermCfg, cfg.observation[job.group].terms[name])
        if term.noise:
            columns = column_noise(term, width // term.history, slides)
            widest += [scale * term.scale * column for column in term.history * columns]
        else:
            widest += (scale * _NOISE * spread).tolist()
    return torch.tensor(widest)


def measured_columns(cfg: Config, widths: Mapping[str, int]) -> tuple[list[int], list[float]]:
    """Columns of the observation with the latest measured joints, and what these count from."""
    job: CloneJobCfg = cfg.job
    home = cfg.robot.home
    start = 0
    for name, width in widths.items():
        start += width
        term = cfg.observation[job.group].terms[name]
        relative = term.func == f"{_JOINTS}_relative"
        if (relative or term.func == _JOINTS) and term.scale == 1.0 and term.clip is None:
            return [*range(start - len(home), start)], home if relative else [0.0] * len(home)
    expected = f"false, because the policy sees no {_JOINTS}, as it is"
    raise ConfigError("job.relative", True, expected)


def vision_of(cfg: Config, job: CloneJobCfg) -> Vision:
    """The images that a policy of the job sees."""
    sizes = {name: cfg.scene.cameras[name].size for name in job.vision.cameras}
    return Vision(sizes=sizes, channels=job.vision.channels, features=job.vision.features)


def _moments(values: Tensor, ranks: Ranks) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of each column, over the rows of all processes."""
    variance, mean = torch.var_mean(values, dim=0, correction=0)
    count = torch.full((1,), len(values), dtype=torch.float64, device=values.device)
    first = mean.double() * count
    second = (variance.double() + mean.double() ** 2) * count
    ranks.sum_(count, first, second)
    mean = (first / count).float()
    return mean, (second / count - (first / count) ** 2).clamp(min=0.0).sqrt().float()
