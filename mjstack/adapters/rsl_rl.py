"""RSL-RL's `VecEnv` over an environment, without leaving the device, and its runner."""

import os
from contextlib import redirect_stdout
from io import StringIO
from typing import Any

import torch

from mjstack.config.schema import Config
from mjstack.distributed import Ranks
from mjstack.envs import Env
from mjstack.errors import MissingExtra

try:
    from rsl_rl.env import VecEnv
    from rsl_rl.runners import OnPolicyRunner
    from tensordict import TensorDict
except ImportError as error:
    raise MissingExtra("mjstack.adapters.rsl_rl", str(error.name), "train") from error


class RslRlVecEnv(VecEnv):
    """All worlds of an environment for the runners of rsl-rl-lib 5.

    Every observation group and every image is an entry of the `TensorDict`. The runner's
    configuration says who sees which, such as
    ``"obs_groups": {"actor": ["policy"], "critic": ["policy", "privileged"]}``.

    Actions are clamped to the action manager's bounds, because a Gaussian policy has none.

    Attributes:
        env: The environment.
        num_envs: Number of worlds.
        num_actions: Width of the action.
        max_episode_length: Control steps after which an episode times out.
        device: Where tensors live.
        cfg: The environment's configuration, which loggers store.
    """

    def __init__(self, env: Env, *, log_interval: int = 24) -> None:
        """Take over an environment and start its first episodes; a MjstackError if they cannot.
        ``log_interval`` is the number of steps between two readings of the episode statistics, each
        of which waits for the device. The runner's ``num_steps_per_env`` gives one per iteration.
        """
        self.env = env
        self.num_envs: int = env.nworld
        self.num_actions: int = env.action_manager.action_dim
        self.max_episode_length: int = env.max_episode_steps
        self.device: torch.device = env.device
        self.cfg: Config = env.cfg
        self._low = env.action_manager.low.float()
        self._high = env.action_manager.high.float()
        self._log_interval = log_interval
        self._steps = 0
        env.reset()

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """Control step since each world's last reset, shape ``(num_envs,)``, int64.

        Assigning copies into the environment: runners start worlds at random times of an episode so
        that not all end at once. These are rounded down to the first step of a decision.
        """
        return self.env.episode_step

    @episode_length_buf.setter
    def episode_length_buf(self, value: torch.Tensor) -> None:
        self.env.episode_step.copy_(value - value % self.env.cfg.timing.policy_decimation)

    def get_observations(self) -> TensorDict:
        """The current observations: every group, each ``(num_envs, dim)``, float32."""
        groups = self.env.observation_manager.groups
        return self._tensordict({name: group.clone() for name, group in groups.items()})

    def step(
        self, actions: torch.Tensor
    ) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Advance every world by one decision; worlds that end are reset in the same step.

        Args:
            actions: Shape ``(num_envs, num_actions)``, float32 or float64.

        Returns:
            ``observations``: every group, each ``(num_envs, dim)``, float32.
            ``rewards``: shape ``(num_envs,)``, float32.
            ``dones``: whether the episode ended for any reason, shape ``(num_envs,)``, int64.
            ``extras``: ``time_outs``, ended by the clock alone, shape ``(num_envs,)``, bool; and
                ``log`` every ``log_interval`` steps, means over the episodes that ended since the
                last one.

        Raises:
            MjstackError: The actions cannot be used, or something went wrong in the worlds.
        """
        self.env.action_manager.check(actions)
        actions = torch.clamp(actions, self._low, self._high)
        obs, rewards, terminated, truncated, _ = self.env.step(actions)
        extras: dict[str, Any] = {"time_outs": truncated}
        self._steps += 1
        if self._steps % self._log_interval == 0:
            # The slash keeps the runner's logger from putting other names in front.
            statistics = self.env.read_statistics().items()
            extras["log"] = {f"episode/{name}": value for name, value in statistics}
        return self._tensordict(obs), rewards, (terminated | truncated).long(), extras

    def close(self) -> None:
        """Give the simulation's threads and buffers back."""
        self.env.close()

    def _tensordict(self, obs: dict[str, torch.Tensor]) -> TensorDict:
        # Storage keeps what it gets until after the next step, which draws anew.
        obs = obs | {name: image.clone() for name, image in self.env.images.items()}
        return TensorDict(obs, batch_size=[self.num_envs], device=self.device)


def make_runner(env: RslRlVecEnv, cfg: dict[str, Any], ranks: Ranks) -> OnPolicyRunner:
    """RSL-RL's runner of a configuration, which neither prints nor writes. In ranks its algorithm
    averages gradients over their group: a runner of its own would not take one that is there.
    """
    size = os.environ.pop("WORLD_SIZE", None)  # it takes itself for the only process
    try:
        with redirect_stdout(StringIO()):
            runner = OnPolicyRunner(env, cfg, device=str(env.device))
    finally:
        if size is not None:
            os.environ["WORLD_SIZE"] = size
    if ranks.size > 1:
        runner.alg.is_multi_gpu = True
        runner.alg.gpu_global_rank = ranks.rank
        runner.alg.gpu_world_size = ranks.size
        runner.alg.broadcast_parameters()
    return runner
