"""Trainer *ppo*: a policy learns from the task's rewards, by rsl-rl-lib's PPO."""

from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import torch

from mjstack.config.check import starts_midway
from mjstack.config.functions import resolve_func
from mjstack.config.schema import Config, PpoJobCfg, TermCfg
from mjstack.drivers.driver import Driver
from mjstack.envs import Env
from mjstack.episodes.batches import BatchPlan, play_batches
from mjstack.episodes.recorder import Channels, Read
from mjstack.episodes.stage import Stage
from mjstack.errors import ConfigError, FolderError, MjstackError, UnknownName, renamed_keys
from mjstack.managers.term import check_params
from mjstack.mdp.starts.expert_states import STATE as STATE_VIEWS
from mjstack.mdp.starts.expert_states import write_states
from mjstack.policy import Policy, load_policy
from mjstack.policy.checkpoint import read_state
from mjstack.train.ppo_learner import PpoLearner
from mjstack.train.trainer import (
    LAST,
    STATE,
    Trained,
    Trainer,
    observed_group,
    one_world,
    whole_starts,
)

_STATES = "expert_states.npz"  # in the training's folder
_STRIDE = 5  # control steps between two states
_TARGETS = "mjstack.mdp.action.JointTargets"


def _environment(cfg: Config) -> tuple[Config, Policy | None, str]:
    """The configuration of the environment, the policy that training starts from, if one is named,
    and the name of the observation group that the policy sees.

    Raises:
        MjstackError: There is no such group or term, or the policy to start from cannot be used.
    """
    job = cast(PpoJobCfg, cfg.job)
    start = None
    name = job.group
    if job.start_from is None:
        seen = observed_group(job)
    else:
        start = load_policy(Path(job.start_from))
        start.check_fit(cfg)
        if start.network.vision.sizes:
            expected = "a policy that sees no images"
            raise ConfigError("job.start_from", job.start_from, expected)
        name = start.group
        seen = start.observation
        cfg = _acting_as(cfg, start)
    for group in job.critic:
        if group not in cfg.observation:
            raise UnknownName("job.critic: observation group", group, cfg.observation)
    critic = {group: cfg.observation[group] for group in job.critic if group != name}
    return replace(cfg, observation={name: seen, **critic}), start, name


def _acting_as(cfg: Config, policy: Policy) -> Config:
    """The configuration with a policy's actions and rate. Of joint targets, an action is the part
    of a chunk that the policy plays.
    """
    action = policy.action
    network = policy.network
    if action == cfg.controller.action:
        params: dict[str, Any] = {
            name: network.get_buffer(f"action_{name}").double().tolist()
            for name in ("mean", "std", "low", "high")
        }
        params["steps"] = min(network.chunk, policy.execute)
        action = {"targets": TermCfg(func=_TARGETS, params=params)}
    elif network.chunk > 1:
        raise FolderError(
            f"policy={policy.folder}: has chunks of {network.chunk} actions: expected 1, as its"
            " actions are no joint targets",
            "Name another policy",
        )
    timing = replace(cfg.timing, policy_decimation=policy.execute)
    return replace(cfg, action=action, timing=timing)


def _unrecorded(reset: dict[str, TermCfg]) -> dict[str, TermCfg]:
    """Terms that start worlds in the middle of an episode, and name no file of states."""
    terms = {name: term for name, term in reset.items() if starts_midway(term)}
    return {name: term for name, term in terms.items() if term.params.get("path") is None}


def _read_state(env: Env, driver: Driver) -> Read:
    views = {name: getattr(env.sim, name) for name in STATE_VIEWS}
    return lambda: {name: view for name, view in views.items() if view.shape[1]}


def _record_states(stage: Stage, path: Path) -> None:
    """Play the expert in a batch of worlds from whole starts, and write states of its accepted
    episodes, from all phases.

    Raises:
        MjstackError: No episode was accepted.
        OSError: The file cannot be written.
    """
    cfg = stage.cfg
    worlds = cast(PpoJobCfg, cfg.job).expert_worlds
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
            raise MjstackError(
                f"the expert succeeded in none of {worlds} episodes, expected some to start from",
                "Look at why with gates=[success]",
            )
        states = {name: rows[:, accepted].flatten(0, 1) for name, rows in batch.rows.items()}
        fields = {name: field[accepted] for name, field in batch.env.sim.fields.items()}
        write_states(path, states, fields, len(accepted))


def check_ppo(stage: Stage) -> range:
    """Check the terms, the policy to start from and the sizes; see `Trainer`."""
    cfg = stage.cfg
    job = cast(PpoJobCfg, cfg.job)
    if job.iterations is None and job.minutes is None:
        raise ConfigError("job.iterations", None, "a number, or a limit in job.minutes")
    worlds = cfg.nworld // stage.ranks.size
    if worlds * job.horizon < 2 * job.minibatches:
        expected = f"at most {worlds * job.horizon // 2}, so that each has two decisions"
        expected += f" (nworld={worlds} times job.horizon={job.horizon} are divided)"
        raise ConfigError("job.minibatches", job.minibatches, expected)
    env_cfg, start, group = _environment(cfg)
    first, least, most = job.std
    if not least <= first <= most:
        expected = (
            "its value at the start, the smallest and the largest, the first within the others"
        )
        raise ConfigError("job.std", job.std, expected)
    unrecorded = _unrecorded(cfg.reset)  # there is no file to build them with yet
    for name, term in unrecorded.items():
        label = f"reset.{name}"
        check_params(label, resolve_func(label, term.func), term.params, 1)
    reset = {name: term for name, term in cfg.reset.items() if name not in unrecorded}
    seen = f"observation.{group}"
    keys = {seen: f"job.{seen}"} if start is None else {}
    with renamed_keys(keys), one_world(stage, replace(env_cfg, reset=reset)) as env:
        if start is not None:
            start.check_widths(env.observation_manager.term_dims[group])
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
    environment = _environment(replace(cfg, reset=reset))
    cards = [device] if device.type == "cuda" else []
    with torch.random.fork_rng(devices=cards):
        torch.manual_seed(cfg.seed + ranks.rank)
        with closing(PpoLearner(stage, *environment, folder)) as learner:
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
