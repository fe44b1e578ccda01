"""Trainer *ppo*: a policy learns from the task's rewards, by rsl-rl-lib's PPO."""

import math
import sys
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from typing_extensions import override

from mjstack.adapters.rsl_rl import RslRlVecEnv, make_runner
from mjstack.config.check import starts_midway
from mjstack.config.fingerprint import config_content
from mjstack.config.functions import resolve_func
from mjstack.config.schema import Config, PpoJobCfg, TermCfg
from mjstack.drivers.driver import Driver
from mjstack.envs import Env, build_env
from mjstack.envs.outputs import join_statistics
from mjstack.episodes.batches import BatchPlan, play_batches
from mjstack.episodes.recorder import Channels, Read
from mjstack.episodes.rollout import Observer
from mjstack.episodes.stage import Stage
from mjstack.errors import ConfigError, MjstackError, renamed_keys
from mjstack.managers.term import check_params
from mjstack.mdp.starts.expert_states import VIEWS, write_states
from mjstack.policy import Policy, PolicyNetwork
from mjstack.policy.checkpoint import Facts, read_state
from mjstack.train.learner import Learner
from mjstack.train.trainer import LAST, STATE, Trained, Trainer, observed_group, whole_starts

_STATES = "expert_states.npz"  # in the training's folder
_STRIDE = 5  # control steps between two states


class _Actor(Driver):
    """Stands for rsl_rl's actor where observers expect a driver."""

    @override
    def command(self) -> Tensor:
        raise NotImplementedError


class _Worlds(RslRlVecEnv):
    """Shows every step to observers."""

    def __init__(self, env: Env, observers: Sequence[Observer]) -> None:
        super().__init__(env, log_interval=sys.maxsize)
        self._observers = observers
        for observer in observers:
            observer.start(env, _Actor(env.nworld, sys.maxsize, env.device))

    @override
    def step(self, actions: Tensor) -> Any:
        result = super().step(actions)
        for observer in self._observers:
            observer.after_step(self._steps)
        return result


class PpoLearner(Learner):
    """PPO on an environment. A step is an iteration. The best policy is the one with the largest
    share of successes of the episodes between two saves, then with the largest return.
    """

    trainer = "ppo"
    step = "iteration"

    def __init__(self, stage: Stage, cfg: Config, folder: Path) -> None:
        """Build the environment of a configuration, and networks with random weights: the actor
        sees the observation group ``job.group``, the critic all groups.
        """
        job: PpoJobCfg = cfg.job
        self._job = job
        super().__init__(stage, cfg, folder)
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
        self._seed()
        self._runner = make_runner(
            _Worlds(self._env, stage.observers), self._runner_config(), stage.ranks
        )
        self._alg = alg = self._runner.alg
        self._networks = nn.ModuleDict({"actor": alg.actor, "critic": alg.critic})
        self._optimizer = alg.optimizer
        self._spread = True  # the first episodes, so that they do not all end at once
        widths = self._env.observation_manager.term_dims[job.group]
        actions = self._env.action_manager.action_dim
        self.policy = Policy(
            network=PolicyNetwork(sum(widths.values()), actions, 1, job.hidden),
            group=job.group,
            observation=cfg.observation[job.group],
            widths=widths,
            execute=cfg.timing.policy_decimation,
            config=config_content(cfg),
            action=cfg.action,
        )

    def _runner_config(self) -> Facts:
        """The configuration of rsl_rl's runner."""
        job = self._job
        network = {
            "class_name": "MLPModel",
            "hidden_dims": job.hidden,
            "activation": "elu",
            "obs_normalization": True,
        }
        gaussian = {"class_name": "GaussianDistribution", "init_std": job.std}
        return {
            "num_steps_per_env": job.horizon,
            "obs_groups": {"actor": [job.group], "critic": list(self._cfg.observation)},
            "actor": network | {"distribution_cfg": gaussian},
            "critic": dict(network),
            "algorithm": {
                "class_name": "PPO",
                "num_learning_epochs": job.epochs,
                "num_mini_batches": job.minibatches,
                "learning_rate": job.learning_rate,
                "desired_kl": job.desired_kl,
                "gamma": job.gamma,
                "lam": 0.95,
                "clip_param": job.clip,
                "use_clipped_value_loss": False,  # whose limit suits returns around 1
                "entropy_coef": 0.0,
            },
        }

    def close(self) -> None:
        """Give the worlds back too."""
        self._env.close()
        super().close()

    def learn(self) -> None:
        """See `Learner`. A training without an iteration leaves policies too."""
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
        """One iteration.

        Raises:
            MjstackError: A number of the networks is not finite.
        """
        self._runner.learn(1, init_at_random_ep_len=self._spread)
        self._spread = False
        self._check_finite(self.done + 1)

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
    def score(self, row: Facts) -> tuple[float, ...]:
        return (row["success"], row["return"]) if row["episodes"] > 0.0 else (0.0, -math.inf)

    def _new_row(self) -> Facts:
        """Figures since the last row. Values of reward terms are means over the episodes' steps."""
        actor = self._alg.actor
        self.policy.network.layers.load_state_dict(actor.mlp.state_dict())
        scale = actor.obs_normalizer
        self.policy.network.set_scale("observation", scale.mean.cpu(), scale.std.cpu() + scale.eps)
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
            "std": float(actor.distribution.std_param.detach().mean()),
            "learning_rate": self._alg.learning_rate,
        }

    def _seed(self) -> None:
        """Seed the noise of actions and the order of minibatches, by seed, rank and iteration."""
        numbers = np.random.SeedSequence([self._cfg.seed, self._ranks.rank, self.done])
        torch.manual_seed(int(numbers.generate_state(1)[0]))

    @override
    def facts(self) -> Facts:
        episode = int(self._env.episode.max())
        return super().facts() | {"learning_rate": self._alg.learning_rate, "episode": episode}

    def restore(self, state: dict[str, Tensor], facts: Facts) -> None:
        """See `Learner`. All worlds begin the episode after the latest one."""
        super().restore(state, facts)
        self._alg.learning_rate = facts["learning_rate"]
        self._env.episode.fill_(facts["episode"])
        self._env.reset()
        self._seed()


def _environment(cfg: Config) -> Config:
    """The configuration of the environment: the policy's observation group beside or in place of
    the task's, all of which the critic sees.
    """
    job: PpoJobCfg = cfg.job
    return replace(cfg, observation=cfg.observation | {job.group: observed_group(job)})


def _unrecorded(reset: dict[str, TermCfg]) -> dict[str, TermCfg]:
    """Terms that start worlds in the middle of an episode, and name no file of states."""
    return {
        name: term
        for name, term in reset.items()
        if starts_midway(term) and term.params.get("path") is None
    }


def _read_state(env: Env, driver: Driver) -> Read:
    views = {name: getattr(env.sim, name) for name in VIEWS}
    return lambda: {name: view for name, view in views.items() if view.shape[1]}


def _record_states(stage: Stage, path: Path) -> None:
    """Play the expert in a batch of worlds from whole starts, and write states of its accepted
    episodes, from all phases.

    Raises:
        MjstackError: No episode was accepted.
        OSError: The file cannot be written.
    """
    cfg = stage.cfg
    worlds = cfg.job.expert_worlds
    channels = Channels(_read_state, lambda steps: range(1, steps + 1, _STRIDE))
    for batch in play_batches(
        stage,
        [BatchPlan(cfg.seed, range(worlds))],
        [channels],
        cfg=stage.driven(whole_starts(cfg.reset)),
        label="steps of the expert",
    ):
        accepted = batch.succeeded.nonzero()[:, 0]
        stage.progress.print_line(
            f"train: {len(accepted)} of {worlds} episodes of the expert succeeded"
        )
        if not len(accepted):
            problem = f"the expert succeeded in none of {worlds} episodes, expected some"
            raise MjstackError(f"{problem} to start from", "Look at why with gates=[success]")
        states = {name: rows[:, accepted].flatten(0, 1) for name, rows in batch.rows.items()}
        fields = {name: field[accepted] for name, field in batch.env.sim.fields.items()}
        write_states(path, states, fields, len(accepted))


def check_ppo(stage: Stage) -> range:
    """Check the terms and the sizes; see `Trainer`."""
    cfg = stage.cfg
    job: PpoJobCfg = cfg.job
    if job.iterations is None and job.minutes is None:
        raise ConfigError("job.iterations", None, "a number, or a limit in job.minutes")
    worlds = cfg.nworld // stage.ranks.size
    if worlds * job.horizon < 2 * job.minibatches:
        expected = f"at most {worlds * job.horizon // 2}, so that each has two decisions"
        expected += f" (nworld={worlds} times job.horizon={job.horizon} are divided)"
        raise ConfigError("job.minibatches", job.minibatches, expected)
    unrecorded = _unrecorded(cfg.reset)  # there is no file to build them with yet
    for name, term in unrecorded.items():
        label = f"reset.{name}"
        check_params(label, resolve_func(label, term.func), term.params, 1)
    reset = {name: term for name, term in cfg.reset.items() if name not in unrecorded}
    keys = {f"observation.{job.group}": f"job.observation.{job.group}"}
    with renamed_keys(keys), stage.native_env(replace(_environment(cfg), reset=reset)):
        pass
    return range(cfg.seed, cfg.seed + 1)


def train_ppo(stage: Stage, folder: Path) -> Trained:
    """Let worlds act and learn from it; see `Trainer`."""
    cfg = stage.cfg
    device = torch.device(stage.backend[1])
    ranks = stage.ranks
    states = folder / _STATES
    reset = dict(cfg.reset)
    for name, term in _unrecorded(reset).items():
        ranks.from_first(lambda: None if states.exists() else _record_states(stage, states))
        reset[name] = replace(term, params=term.params | {"path": str(states)})
    with (
        torch.random.fork_rng(devices=[device] if device.type == "cuda" else []),
        closing(PpoLearner(stage, _environment(replace(cfg, reset=reset)), folder)) as learner,
    ):
        if (folder / STATE).exists():
            learner.restore(*read_state(folder / STATE))
        learner.learn()
    last = learner.curve[-1]
    return Trained(
        metrics={
            "iterations": learner.done,
            "decisions": last["decisions"],
            "training_s": learner.seconds,
            "best_training_success": max(map(learner.score, learner.curve))[0],
        },
        notes={"policy": str(folder / LAST), "seeds": str(cfg.seed)},
        curve=learner.curve,
        lines=["success", *(["progress"] if "progress" in last else [])],
        abscissa="iteration",
    )


TRAINER = Trainer(check_ppo, train_ppo, midway=True)
