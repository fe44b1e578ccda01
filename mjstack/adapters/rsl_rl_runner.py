"""Parts of rsl_rl's runner as trainer *ppo* uses them."""

import sys
from typing import Any

import torch
from torch import Tensor

from mjstack.adapters.rsl_rl import RslRlVecEnv
from mjstack.config.schema import PpoJobCfg
from mjstack.distributed import Ranks, current_ranks
from mjstack.envs import Env
from mjstack.episodes.live import LiveView
from mjstack.policy.network import FARTHEST

# isort: split
from rsl_rl.models import MLPModel
from rsl_rl.runners import OnPolicyRunner


class ScaledRewards(RslRlVecEnv):
    """Divides rewards by the standard deviation of their discounted sum, over all worlds and steps
    so far.

    Attributes:
        sums: How many discounted sums there were, their sum and that of their squares, shape
            ``(3,)``, float64.
    """

    def __init__(
        self, env: Env, job: PpoJobCfg, ranks: Ranks, live: LiveView | None = None
    ) -> None:
        """Take the environment, and the live view of it, if there is one."""
        super().__init__(env, log_interval=sys.maxsize)
        self._gamma = job.gamma
        self._limit = job.reward_limit
        self._ranks = ranks
        self._live = live
        if live is not None:
            live.start(env)
        self._ahead = torch.zeros(env.nworld, device=env.device)
        self.sums = torch.zeros(3, dtype=torch.float64, device=env.device)

    def step(self, actions: Tensor) -> tuple[Any, Tensor, Tensor, dict[str, Any]]:
        """See `RslRlVecEnv`."""
        obs, rewards, dones, extras = super().step(actions)
        if self._live is not None:
            self._live.after_step(self._steps)
        self._ahead.mul_(self._gamma).add_(rewards)
        values = self._ahead.double()
        new = torch.stack((torch.ones_like(values).sum(), values.sum(), values.square().sum()))
        self._ranks.sum_(new)
        self.sums += new
        self._ahead.masked_fill_(dones.bool(), 0.0)
        count, total, squares = self.sums.unbind()
        std = (squares / count - (total / count).square()).clamp(min=1e-12).sqrt()
        scaled = (rewards / std.float()).clamp(-self._limit, self._limit)
        return obs, scaled, dones, extras


class Network(MLPModel):
    """rsl_rl's network, with normalised observations limited as a `PolicyNetwork` limits them."""

    def get_latent(self, *args: Any, **kwargs: Any) -> Tensor:
        """Normalised observations."""
        return super().get_latent(*args, **kwargs).clamp(-FARTHEST, FARTHEST)


class Runner(OnPolicyRunner):
    """rsl_rl's runner in processes that have joined already, on any device."""

    def _configure_multi_gpu(self) -> None:
        ranks = current_ranks()
        self.gpu_world_size = ranks.size
        self.gpu_global_rank = ranks.rank
        self.is_distributed = False  # it would send the parameters anew with every iteration
        facts = {"global_rank": ranks.rank, "local_rank": ranks.rank, "world_size": ranks.size}
        self.cfg["multi_gpu"] = facts if ranks.size > 1 else None


class Log:
    """Takes the place of rsl_rl's logger, which prints and writes files.

    Attributes:
        losses: Those of the last iteration, by name.
    """

    writer = None

    def __init__(self) -> None:
        self.losses: dict[str, float] = {}

    def init_logging_writer(self) -> None:
        """Nothing is written."""

    def process_env_step(self, *args: Any) -> None:
        """The environment has its own statistics."""

    def log(self, **facts: Any) -> None:
        """Keep the losses."""
        self.losses = facts["loss_dict"]
