"""Trainer *ppo* at work: rsl-rl-lib's PPO on an environment, and a policy of its actor."""

import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn
from typing_extensions import override

from mjstack.adapters.rsl_rl import RslRlVecEnv
from mjstack.adapters.rsl_rl_ppo import RATE, RewardScale, make_ppo
from mjstack.config.fingerprint import config_content
from mjstack.config.schema import Config, PpoJobCfg
from mjstack.drivers.driver import Driver
from mjstack.envs import build_env
from mjstack.envs.statistics import join_statistics
from mjstack.episodes.stage import Stage
from mjstack.policy import Policy, PolicyNetwork
from mjstack.train.learner import Learner

_MEASURED = 8192  # decisions by which the change of a policy is measured


class _Actor(Driver):
    """Stands for rsl_rl's actor where observers expect a driver."""

    @override
    def command(self) -> Tensor:
        raise NotImplementedError


class PpoLearner(Learner):
    """PPO on an environment. A step is an iteration. The best policy is the one with the largest
    share of successes of the episodes between two saves, then with the largest return.

    Attributes:
        change: KL divergence of the policy after the last iteration from the one before.
    """

    trainer = "ppo"
    step = "iteration"

    def __init__(
        self, stage: Stage, cfg: Config, start: Policy | None, group: str, folder: Path
    ) -> None:
        """Build the environment of a configuration, and the networks of a policy that sees the
        group: with random weights, or those of ``start``.
        """
        self._job = job = cast(PpoJobCfg, cfg.job)
        super().__init__(stage, cfg, folder, job.save_every)
        worlds = stage.worlds
        backend, device = stage.backend
        self._env = build_env(
            cfg,
            nworld=len(worlds),
            first_world=worlds.start,
            model=stage.model,
            backend=backend,
            device=device,
        )
        self._worlds = RslRlVecEnv(self._env, log_interval=sys.maxsize)
        self._steps = 0
        self._observers = stage.observers
        for observer in self._observers:
            observer.start(self._env, _Actor(len(worlds), sys.maxsize, self._env.device))
        self._scale = RewardScale(job, stage.ranks, len(worlds), self._env.device)
        hidden = job.hidden if start is None else start.network.hidden
        self._alg = alg = make_ppo(self._worlds, job, stage.ranks, group, hidden)
        self._value_loss = math.nan  # of the last iteration
        self.policy = self._make_policy(start, group, hidden)
        if start is not None:
            self._begin_with(start)
        self._networks = nn.ModuleDict({"actor": alg.actor, "critic": alg.critic})
        self._networks.register_buffer("rewards", self._scale.sums)  # so it is part of the state
        groups = [{"params": list(net.parameters())} for net in self._networks.values()]
        self._optimizer = alg.optimizer = torch.optim.Adam(groups)
        alg.optimizer.register_step_pre_hook(lambda *_: self._set_rates())
        self.change = math.nan

    def close(self) -> None:
        """Give the worlds back too."""
        self._env.close()
        super().close()

    def learn(self) -> None:
        """See `Learner`. A training without an iteration leaves policies too."""
        if self._ranks.size > 1:
            self._alg.broadcast_parameters()
        # Episodes do not all end at once
        worlds = self._worlds
        steps = worlds.episode_length_buf
        worlds.episode_length_buf = torch.randint_like(steps, high=worlds.max_episode_length)
        super().learn()
        if not self.curve:
            self._save()

    def _over(self) -> bool:
        """Whether a limit is reached, in any process."""
        job = self._job
        in_call = self.seconds - self._before
        over = (
            self.done >= (job.iterations or math.inf)
            or self.seconds >= 60.0 * (job.minutes or math.inf)
            or in_call >= 60.0 * (job.max_minutes or math.inf)
        )
        return self._ranks.any(over)

    def _step(self) -> None:
        """One iteration."""
        job = self._job
        start, end = job.entropy
        share = min(1.0, self.done / job.entropy_iterations)
        self._alg.entropy_coef = start + (end - start) * share
        self._alg.actor.requires_grad_(self.done >= job.critic_iterations)
        scale = self._alg.actor.obs_normalizer
        before = scale._mean.clone(), scale._std.clone()
        self._roll_out()
        self._value_loss = self._alg.update()["value"]
        self._deviation().data.clamp_(*job.std[1:])
        if self.done >= job.critic_iterations:
            # By what learning has changed, not the scale of the observation
            after = scale._mean, scale._std
            scale._mean, scale._std = before
            self._measure_change()
            scale._mean, scale._std = after

    @torch.inference_mode()
    def _roll_out(self) -> None:
        """Let the worlds act for an iteration, and compute returns."""
        worlds = self._worlds
        obs = worlds.get_observations()
        for _ in range(self._job.horizon):
            obs, rewards, dones, extras = worlds.step(self._alg.act(obs))
            self._steps += 1
            for observer in self._observers:
                observer.after_step(self._steps)
            self._alg.process_env_step(obs, self._scale(rewards, dones), dones, extras)
        self._alg.compute_returns(obs)

    def _set_rates(self) -> None:
        """Set the learning rates of a step of the optimizer. rsl_rl, which has one for both
        networks, adapts it to the change of the policy before every step: the actor's follows.
        """
        actor, critic = self._alg.optimizer.param_groups
        actor["lr"] = self._alg.learning_rate / RATE * self._job.learning_rate
        critic["lr"] = self._job.critic_learning_rate

    def _measure_change(self) -> None:
        """Measure how the last iteration changed the policy."""
        actor = self._alg.actor
        storage = self._alg.storage
        decisions = storage.num_envs * storage.num_transitions_per_env
        sample = slice(None, None, -(-decisions // _MEASURED))
        with torch.inference_mode():
            before = [p.flatten(0, 1)[sample] for p in storage.distribution_params]
            actor(storage.observations.flatten(0, 1)[sample], stochastic_output=True)
            change = actor.get_kl_divergence(before, actor.output_distribution_params).mean()
        self._ranks.sum_(change)
        self.change = float(change) / self._ranks.size

    def _show(self) -> None:
        job = self._job
        if job.iterations is not None:
            self._progress.advance("iterations", self.done, job.iterations)
        else:
            total = round(60.0 * (job.minutes or 0.0))
            self._progress.advance("seconds of training", min(total, round(self.seconds)), total)

    @override
    def _save(self, **figures: Any) -> None:
        super()._save(**figures)
        row = self.curve[-1]
        self._progress.print_line(
            f"train: iteration {self.done}: success {row['success']:.3f}, return"
            f" {row['return']:.4g}, {row['decisions_per_s']:,.0f} decisions/s"
        )

    @override
    def score(self, row: Mapping[str, Any]) -> tuple[float, ...]:
        return (row["success"], row["return"]) if row["episodes"] > 0.0 else (0.0, -math.inf)

    def _new_row(self) -> dict[str, Any]:
        """Figures since the last row. Values of reward terms are means over the episodes' steps."""
        self._take_weights()
        env = self._env
        means = join_statistics(self._ranks.gather(env.read_statistics()))
        steps = means.get("steps", math.nan)
        earlier = self.curve[-1] if self.curve else {"decisions": 0, "training_s": 0.0}
        decisions = self._job.horizon * self._cfg.nworld * self.done
        spent = max(1e-9, self.seconds - earlier["training_s"])
        weights = env.reward_manager.weights.tolist()
        terms = {
            name: means.get(f"reward/{name}", math.nan) / (weight * steps) if weight else math.nan
            for name, weight in zip(env.reward_manager.names, weights, strict=True)
        }
        terms.pop("success", None)
        return {
            "iteration": self.done,
            "decisions": decisions,
            "training_s": self.seconds,
            "decisions_per_s": (decisions - earlier["decisions"]) / spent,
            "episodes": means["episodes"],
            "success": means.get("success", math.nan),
            "return": means.get("return", math.nan),
            "steps": steps,
            **terms,
            "value_loss": self._value_loss,
            "kl": self.change,
            "std": float(self._deviation().data.mean()),
            "entropy_weight": self._alg.entropy_coef,
            "learning_rate": self._alg.optimizer.param_groups[0]["lr"],
        }

    # Networks

    def _make_policy(self, start: Policy | None, group: str, hidden: Sequence[int]) -> Policy:
        """The policy that is saved, its weights still to come."""
        cfg = self._cfg
        widths = self._env.observation_manager.term_dims[group]
        actions = self._worlds.num_actions
        width = actions if start is None else start.network.width
        network = PolicyNetwork(sum(widths.values()), width, actions // width, hidden)
        if start is not None:
            network.set_scale("action", start.network.action_mean, start.network.action_std)
            network.set_range(start.network.action_low, start.network.action_high)
        action = cfg.action if start is None else start.action
        facts = (widths, cfg.timing.policy_decimation, config_content(cfg), action)
        return Policy(network, group, cfg.observation[group], *facts)

    def _begin_with(self, start: Policy) -> None:
        """Give the actor a policy's weights and the scale of its observation, which stays."""
        actor = self._alg.actor
        with torch.no_grad():
            sources = list(start.network.layers.parameters())
            for weight, source in zip(actor.mlp.parameters(), sources, strict=True):
                weight.copy_(source[: len(weight)])  # of a chunk, the part that is played
            scale = actor.obs_normalizer
            scale._mean.copy_(start.network.observation_mean)
            scale._std.copy_(start.network.observation_std - scale.eps)
        scale.until = 0

    def _take_weights(self) -> None:
        """Copy the actor's weights and the scale of its observation into the policy."""
        actor = self._alg.actor
        network = self.policy.network
        network.layers.load_state_dict(actor.mlp.state_dict())
        scale = actor.obs_normalizer
        network.set_scale("observation", scale.mean.cpu(), scale.std.cpu() + scale.eps)

    def _deviation(self) -> Tensor:
        """Standard deviation of each number of an action."""
        return self._alg.actor.distribution.std_param

    # State

    @override
    def _tensors(self) -> dict[str, Tensor]:
        env = self._env
        state = {"random": torch.get_rng_state(), "episode": env.episode}
        if env.device.type == "cuda":
            state["random_cuda"] = torch.cuda.get_rng_state(env.device)
        return super()._tensors() | state

    @override
    def facts(self) -> dict[str, Any]:
        return super().facts() | {"learning_rate": self._alg.learning_rate}

    def restore(self, state: dict[str, Tensor], facts: dict[str, Any]) -> None:
        """See `Learner`. Worlds begin their next episodes."""
        super().restore(state, facts)
        env = self._env
        self._alg.learning_rate = facts["learning_rate"]
        if self._ranks.writes:  # the others have their own
            torch.set_rng_state(state["random"])
            if "random_cuda" in state and env.device.type == "cuda":
                torch.cuda.set_rng_state(state["random_cuda"], env.device)
        episode = state["episode"]
        # With another number of ranks, or another share, all worlds begin the latest episode.
        env.episode.copy_(episode if len(episode) == env.nworld else episode.max())
        env.reset()
