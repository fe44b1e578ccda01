"""The network of a clone with the scale of its demonstrations, and the noise on what it sees."""

from collections.abc import Mapping, Sequence
from typing import cast

import mujoco
import torch
from torch import Tensor

from mjstack.config.functions import offered
from mjstack.config.schema import CloneJobCfg, CloneSizes, Config, ObservationTermCfg
from mjstack.distributed import Ranks
from mjstack.managers.observation import column_noise, slide_joints
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


def input_noise(
    cfg: Config, model: mujoco.MjModel, sizes: CloneSizes, widths: Mapping[str, int]
) -> list[float]:
    """Half-width of the noise on each column of the observation in a training.

    Measured jaws have more of it. Their joint target depends on where they are more than any other,
    and a policy that answers with where they are lets them drift.

    Args:
        cfg: The training's configuration.
        model: The scene's.
        sizes: Of the training.
        widths: Numbers of each term of the observation.
    """
    job = cast(CloneJobCfg, cfg.job)
    robot = cfg.robot
    slides = slide_joints(model, robot.joints)
    travel = [abs(a - b) for a, b in zip(robot.gripper_open, robot.gripper_closed, strict=True)]
    found: list[float] = []
    for name, width in widths.items():
        term = cast(ObservationTermCfg, cfg.observation[job.group].terms[name])
        columns = column_noise(term, width // term.history, slides)
        columns = [sizes.input_noise * column for column in columns]
        if offered(term.func, "unit") == "joint" and len(columns) == len(robot.joints):
            jaws = columns[-len(travel) :]
            columns[-len(travel) :] = [
                noise + job.gripper_noise * each for noise, each in zip(jaws, travel, strict=True)
            ]
        found += [term.scale * column for column in term.history * columns]
    return found


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
