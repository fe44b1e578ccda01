"""Trainer *ppo* at work: rsl-rl-lib's runner on an environment, and a policy of its actor."""

import io
import math
import sys
import time
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn

from mjstack.adapters.rsl_rl_runner import Log, Network, Runner, ScaledRewards
from mjstack.config.fingerprint import config_content
from mjstack.config.schema import Config, PpoJobCfg, PpoSettings
from mjstack.envs import build_env
from mjstack.envs.statistics import join_statistics
from mjstack.episodes.context import RunContext
from mjstack.interrupt import check_interrupt
from mjstack.policy import Policy, PolicyNetwork, save_policy
from mjstack.policy.checkpoint import write_state
from mjstack.train.trainer import BEST, LAST, STATE, EventWriter, pack_weights, unpack_weights

_MEASURED = 8192  # decisions by which the change of a policy is measured
_RATE = 0.001  # rsl_rl's learning rate at the start, which it keeps within 0.00001 and 0.01


@dataclass(frozen=True, slots=True)
class Plan:
    """A training as its configuration, and the policy that it starts from, have it.

    Attributes:
        cfg: The configuration of its environment.
        start: The policy that it starts from.
        group: Name of the observation group that the policy sees.
        settings: Those of a random network, or of a policy to go on from.
    """

    cfg: Config
    start: Policy | None
    group: str
    settings: PpoSettings


class Learner:
    """PPO on an environment; goes on where an earlier call was stopped.

    Attributes:
        done: Iterations so far.
        seconds: Time of them, in all calls [s].
        best: Largest share of successes of the episodes between two saves, and their return.
        curve: A row for each time that policies were saved.
        change: KL divergence of the policy after the last iteration from the one before.
    """

    def __init__(self, context: RunContext, plan: Plan, folder: Path) -> None:
        """Build the environment and rsl_rl's runner.

        Args:
            context: The run, for its model, its device, its progress and its ranks.
            plan: The training.
            folder: Where policies and state are.
        """
        self._context = context
        self._plan = plan
        self._job = cast(PpoJobCfg, plan.cfg.job)
        self._folder = folder
        self._ranks = ranks = context.ranks
        worlds = context.worlds
        backend, device = context.backend
        env = build_env(
            plan.cfg,
            nworld=len(worlds),
            first_world=worlds.start,
            model=context.model,
            backend=backend,
            device=device,
        )
        self._env = ScaledRewards(env, self._job, ranks, context.live)
        with redirect_stdout(io.StringIO()):  # it prints the networks
            self._runner = Runner(self._env, self._runner_config(), None, device)
        self._log = Log()
        self._runner.logger = self._log
        self._alg = alg = self._runner.alg
        self._policy = self._make_policy()
        if plan.start is not None:
            self._begin_with(plan.start)
        self._networks = nn.ModuleDict({"actor": alg.actor, "critic": alg.critic})
        groups = [{"params": list(each.parameters())} for each in self._networks.values()]
        alg.optimizer = torch.optim.Adam(groups)
        alg.optimizer.register_step_pre_hook(lambda *_: self._set_rates())

        self.done = 0
        self.seconds = 0.0
        self.best = (0.0, -math.inf)
        self.curve: list[dict[str, Any]] = []
        self.change = math.nan
        self._events: EventWriter | None = None
        self._began = time.perf_counter()  # of this call
        self._before = 0.0  # seconds of earlier calls

    def close(self) -> None:
        """Give the worlds back."""
        self._env.close()
        if self._events is not None:
            self._events.close()

    def learn(self) -> None:
        """Make the missing iterations, saving policies and state now and then.

        Raises:
            KeyboardInterrupt: The command was interrupted; the state is saved.
        """
        self._began = time.perf_counter()
        self._before = self.seconds
        if self._ranks.writes:
            self._events = EventWriter(self._folder, self.done, self._context.print_line)
        if self._ranks.size > 1:
            self._alg.broadcast_parameters()
        first = True
        while not self._over():
            self._iterate(spread=first)
            first = False
            self.done += 1
            self.seconds = self._before + time.perf_counter() - self._began
            if self.done % self._job.save_every == 0 or self._over():
                self._save()
            try:
                self._ranks.stop_together()
                self._show()
                check_interrupt()
            except KeyboardInterrupt:
                self._write_state()
                raise
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

    def _iterate(self, *, spread: bool) -> None:
        """One iteration; in the first one of a call the ends of the episodes are spread out."""
        settings = self._plan.settings
        start, end = settings.entropy
        share = min(1.0, self.done / self._job.entropy_iterations)
        self._alg.entropy_coef = start + (end - start) * share
        self._alg.actor.requires_grad_(self.done >= settings.critic_iterations)
        scale = self._alg.actor.obs_normalizer
        before = scale._mean.clone(), scale._std.clone()
        self._runner.learn(1, init_at_random_ep_len=spread)
        self._deviation().data.clamp_(*settings.std[1:])
        if self.done >= settings.critic_iterations:
            # By what learning has changed, not the scale of the observation
            after = scale._mean, scale._std
            scale._mean, scale._std = before
            self._measure_change()
            scale._mean, scale._std = after

    def _set_rates(self) -> None:
        """Set the learning rates of a step of the optimizer. rsl_rl, which has one for both
        networks, adapts it to the change of the policy before every step: the actor's follows.
        """
        actor, critic = self._alg.optimizer.param_groups
        actor["lr"] = self._alg.learning_rate / _RATE * self._plan.settings.learning_rate
        critic["lr"] = self._job.critic_learning_rate

    def _measure_change(self) -> None:
        """Measure how the last iteration changed the policy."""
        actor = self._alg.actor
        storage = self._alg.storage
        decisions = storage.num_envs * storage.num_transitions_per_env
        some = slice(None, None, -(-decisions // _MEASURED))
        with torch.inference_mode():
            before = [p.flatten(0, 1)[some] for p in storage.distribution_params]
            actor(storage.observations.flatten(0, 1)[some], stochastic_output=True)
            change = actor.get_kl_divergence(before, actor.output_distribution_params).mean()
        self._ranks.sum_(change)
        self.change = float(change) / self._ranks.size

    def _show(self) -> None:
        job = self._job
        if job.iterations is not None:
            self._context.advance("iterations", self.done, job.iterations)
        else:
            total = round(60.0 * (job.minutes or 0.0))
            self._context.advance("seconds of training", min(total, round(self.seconds)), total)

    def _save(self) -> None:
        """Add a row to the curve, and write policies and state."""
        row = self._row()
        self.curve.append(row)
        if not self._ranks.writes:
            return
        known = {k: v for k, v in row.items() if not math.isnan(v)}  # JSON has no NaN
        if self._events is not None:
            self._events.add(known, self.done)
        self._take_weights()
        self._policy.training = {"trainer": "ppo", "seed": self._plan.cfg.seed, **known}
        save_policy(self._folder / LAST, self._policy)
        ended = row["episodes"] > 0.0
        reached = (row["success"], row["return"]) if ended else (0.0, -math.inf)
        if reached >= self.best:
            self.best = reached
            save_policy(self._folder / BEST, self._policy)
        self._write_state()
        self._context.print_line(
            f"train: iteration {self.done}: success {row['success']:.3f}, return"
            f" {row['return']:.4g}, {row['decisions_per_s']:,.0f} decisions/s"
        )

    def _row(self) -> dict[str, Any]:
        """Figures since the last row. Values of reward terms are means over the episodes' steps."""
        env = self._env.env
        found = join_statistics(self._ranks.gather(env.read_statistics()))
        steps = found.get("steps", math.nan)
        each = self._job.horizon * self._plan.cfg.nworld
        earlier = self.curve[-1] if self.curve else {"decisions": 0, "training_s": 0.0}
        decisions = each * self.done
        spent = max(1e-9, self.seconds - earlier["training_s"])
        weights = env.reward_manager.weights.tolist()
        terms = {
            name: found.get(f"reward/{name}", math.nan) / (weight * steps) if weight else math.nan
            for name, weight in zip(env.reward_manager.names, weights, strict=True)
        }
        terms.pop("success", None)
        return {
            "iteration": self.done,
            "decisions": decisions,
            "training_s": self.seconds,
            "decisions_per_s": (decisions - earlier["decisions"]) / spent,
            "episodes": found["episodes"],
            "success": found.get("success", math.nan),
            "return": found.get("return", math.nan),
            "steps": steps,
            **terms,
            "value_loss": self._log.losses.get("value", math.nan),
            "kl": self.change,
            "std": float(self._deviation().data.mean()),
            "entropy_weight": self._alg.entropy_coef,
            "learning_rate": self._alg.optimizer.param_groups[0]["lr"],
        }

    # Networks

    def _runner_config(self) -> dict[str, Any]:
        """Configuration of rsl_rl's runner."""
        job = self._job
        plan = self._plan
        seen = list(plan.cfg.observation)
        hidden = job.hidden if plan.start is None else plan.start.hidden
        network = {"class_name": Network, "activation": "elu", "obs_normalization": True}
        gaussian = {"class_name": "GaussianDistribution", "init_std": plan.settings.std[0]}
        return {
            "num_steps_per_env": job.horizon,
            "save_interval": sys.maxsize,
            "check_for_nan": False,  # the environment does
            "obs_groups": {"actor": [plan.group], "critic": seen},
            "actor": network | {"hidden_dims": hidden, "distribution_cfg": gaussian},
            "critic": network | {"hidden_dims": job.hidden},
            "algorithm": {
                "class_name": "PPO",
                "num_learning_epochs": job.epochs,
                "num_mini_batches": job.minibatches,
                "schedule": "adaptive",
                "desired_kl": plan.settings.desired_kl,
                "learning_rate": _RATE,
                "gamma": job.gamma,
                "lam": job.gae_lambda,
                "clip_param": job.clip,
                "use_clipped_value_loss": False,
            },
        }

    def _make_policy(self) -> Policy:
        """The policy that is saved, its weights still to come."""
        plan = self._plan
        env = self._env.env
        start = plan.start
        targets = start is not None and start.action is None  # a clone's
        chunk = plan.cfg.action["targets"].params["steps"] if targets else 1
        hidden = self._job.hidden if start is None else start.hidden
        widths = env.observation_manager.term_dims[plan.group]
        width = self._env.num_actions // chunk
        network = PolicyNetwork(sum(widths.values()), width, chunk, hidden)
        if targets:
            given = cast(Policy, start).network
            network.set_scale("action", given.action_mean, given.action_std)
            network.set_range(given.action_low, given.action_high)
        return Policy(
            network=network,
            group=plan.group,
            observation=plan.cfg.observation[plan.group],
            widths=widths,
            execute=plan.cfg.timing.policy_decimation,
            hidden=list(hidden),
            config=config_content(plan.cfg),
            action=None if targets else plan.cfg.action,
        )

    def _begin_with(self, start: Policy) -> None:
        """Give the actor a policy's weights and the scale of its observation, which stays."""
        actor = self._alg.actor
        with torch.no_grad():
            given = list(start.network.layers.parameters())
            for own, theirs in zip(actor.mlp.parameters(), given, strict=True):
                own.copy_(theirs[: len(own)])  # of the answer, the part that is played
            scale = actor.obs_normalizer
            scale._mean.copy_(start.network.observation_mean)
            scale._std.copy_(start.network.observation_std - scale.eps)
        scale.until = 0

    def _take_weights(self) -> None:
        """Copy the actor's weights and the scale of its observation into the policy."""
        actor = self._alg.actor
        network = self._policy.network
        with torch.no_grad():
            own = network.layers.parameters()
            for mine, theirs in zip(own, actor.mlp.parameters(), strict=True):
                mine.copy_(theirs)
            scale = actor.obs_normalizer
            network.set_scale("observation", scale.mean.cpu(), scale.std.cpu() + scale.eps)

    def _deviation(self) -> Tensor:
        """Standard deviation of each number of an action."""
        return self._alg.actor.distribution.std_param

    # State

    def _parameters(self) -> dict[str, Tensor]:
        """Everything that training changes but the worlds, by name."""
        state = {"random": torch.get_rng_state(), "episode": self._env.env.episode}
        if self._env.device.type == "cuda":
            state["random_cuda"] = torch.cuda.get_rng_state(self._env.device)
        state["rewards"] = self._env.sums
        return state | pack_weights(self._networks, self._alg.optimizer)

    def _write_state(self) -> None:
        if not self._ranks.writes:
            return
        facts = {
            "done": self.done,
            "seconds": self.seconds,
            "best": self.best,
            "curve": self.curve,
            "learning_rate": self._alg.learning_rate,
        }
        write_state(self._folder / STATE, self._parameters(), facts)

    def restore(self, state: dict[str, Tensor], facts: dict[str, Any]) -> None:
        """Go on from the state and facts of an earlier call. Worlds begin their next episodes."""
        unpack_weights(state, self._networks, self._alg.optimizer)
        self._alg.learning_rate = facts["learning_rate"]
        self._env.sums.copy_(state["rewards"])
        if self._ranks.writes:  # the others have their own
            torch.set_rng_state(state["random"])
            if "random_cuda" in state and self._env.device.type == "cuda":
                torch.cuda.set_rng_state(state["random_cuda"], self._env.device)
        episode = state["episode"]
        env = self._env.env
        if len(episode) != env.nworld:  # of another number of ranks, or another share
            episode = episode.max()
        env.episode.copy_(episode)
        env.reset()
        self.done = facts["done"]
        self.seconds = facts["seconds"]
        self.best = (facts["best"][0], facts["best"][1])
        self.curve = facts["curve"]
        self._context.print_line(f"train: goes on after iteration {self.done}")
