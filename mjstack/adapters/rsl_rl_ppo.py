"""rsl_rl's PPO as trainer *ppo* uses it: networks, algorithm and scaled rewards."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from typing_extensions import override

from mjstack.adapters.rsl_rl import RslRlVecEnv
from mjstack.config.schema import PpoJobCfg
from mjstack.distributed import Ranks
from mjstack.policy.network import FARTHEST

# isort: split
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage

RATE = 0.001  # rsl_rl's learning rate at the start, which it keeps within 0.00001 and 0.01


class Network(MLPModel):
    """rsl_rl's network, with normalised observations limited as a `PolicyNetwork` limits them."""

    @override
    def get_latent(self, *args: Any, **kwargs: Any) -> Tensor:
        return super().get_latent(*args, **kwargs).clamp(-FARTHEST, FARTHEST)


def make_ppo(
    env: RslRlVecEnv, job: PpoJobCfg, ranks: Ranks, group: str, hidden: Sequence[int]
) -> PPO:
    """Make actor, critic, storage and algorithm, with random weights. The actor sees one
    observation group and has its own widths of hidden layers, the critic sees all groups.
    """
    device = str(env.device)
    obs = env.get_observations()
    groups = {"actor": [group], "critic": list(env.cfg.observation)}
    gaussian = {"class_name": "GaussianDistribution", "init_std": job.std[0]}
    actor = Network(
        *(obs, groups, "actor", env.num_actions, list(hidden)),
        obs_normalization=True,
        distribution_cfg=gaussian,
    )
    critic = Network(obs, groups, "critic", 1, job.hidden, obs_normalization=True)
    facts = {"global_rank": ranks.rank, "world_size": ranks.size}
    return PPO(
        actor.to(device),
        critic.to(device),
        RolloutStorage("rl", env.num_envs, job.horizon, obs, [env.num_actions], device),
        num_learning_epochs=job.epochs,
        num_mini_batches=job.minibatches,
        desired_kl=job.desired_kl,
        learning_rate=RATE,
        gamma=job.gamma,
        lam=job.gae_lambda,
        clip_param=job.clip,
        use_clipped_value_loss=False,
        device=device,
        multi_gpu_cfg=facts if ranks.size > 1 else None,
    )


class RewardScale:
    """Divides rewards by the standard deviation of their discounted sum, over all worlds and steps
    so far.

    Attributes:
        sums: How many discounted sums there were, their sum and that of their squares, shape
            ``(3,)``, float64.
    """

    def __init__(self, job: PpoJobCfg, ranks: Ranks, nworld: int, device: torch.device) -> None:
        """Allocate for a rank's worlds."""
        self._gamma = job.gamma
        self._limit = job.reward_limit
        self._ranks = ranks
        self._ahead = torch.zeros(nworld, device=device)
        self.sums = torch.zeros(3, dtype=torch.float64, device=device)

    def __call__(self, rewards: Tensor, dones: Tensor) -> Tensor:
        """Scaled rewards of a step, from its rewards and ends, each shape ``(nworld,)``."""
        self._ahead.mul_(self._gamma).add_(rewards)
        values = self._ahead.double()
        new = torch.stack((torch.ones_like(values).sum(), values.sum(), values.square().sum()))
        self._ranks.sum_(new)
        self.sums += new
        self._ahead.masked_fill_(dones.bool(), 0.0)
        count, total, squares = self.sums.unbind()
        std = (squares / count - (total / count).square()).clamp(min=1e-12).sqrt()
        return (rewards / std.float()).clamp(-self._limit, self._limit)
