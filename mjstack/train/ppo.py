"""Trainer *ppo*: a policy learns from the task's rewards, by rsl-rl-lib's PPO."""

from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import torch

from mjstack.config.functions import resolve_func
from mjstack.config.schema import Config, PpoJobCfg, TermCfg
from mjstack.episodes.context import RunContext
from mjstack.errors import ConfigError, PolicyError, UnknownName, renamed_keys
from mjstack.managers.term import check_params
from mjstack.policy import Policy, load_policy
from mjstack.policy.checkpoint import read_state
from mjstack.train.expert_states import record_states, unrecorded, whole_starts, with_states
from mjstack.train.ppo_learner import Learner, Plan
from mjstack.train.trainer import LAST, STATE, Trained, Trainer, filled, observed_group, one_world

_STATES = "expert_states.npz"  # in the training's folder
_TARGETS = "mjstack.mdp.action.JointTargets"


def make_plan(cfg: Config) -> Plan:
    """Find out what is trained.

    Raises:
        MjstackError: There is no such group or term, or the policy to start from cannot be used.
    """
    job = cast(PpoJobCfg, cfg.job)
    start = None
    name = job.group
    if job.start_from is None:
        seen = observed_group(job, job.leave_out)
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
    others = {group: cfg.observation[group] for group in job.critic if group != name}
    settings = filled(job, job.settings["random" if start is None else "start_from"])
    return Plan(replace(cfg, observation={name: seen, **others}), start, name, settings)


def _acting_as(cfg: Config, policy: Policy) -> Config:
    """The configuration with a policy's actions and rate. Of a clone, an action is the part of its
    answer that it plays.
    """
    action = policy.action
    network = policy.network
    if action is None:
        params: dict[str, Any] = {
            name: network.get_buffer(f"action_{name}").double().tolist()
            for name in ("mean", "std", "low", "high")
        }
        params["steps"] = min(network.chunk, policy.execute)
        action = {"targets": TermCfg(func=_TARGETS, params=params)}
    elif network.chunk > 1:
        raise PolicyError(
            f"policy={policy.folder}: answers with {network.chunk} actions at once: expected 1, as"
            " its actions are no joint targets",
            "Name another policy",
        )
    timing = replace(cfg.timing, policy_decimation=policy.execute)
    return replace(cfg, action=action, timing=timing)


def check_ppo(context: RunContext) -> range:
    """Check the terms, the policy to start from and the sizes; see `Trainer`."""
    cfg = context.cfg
    job = cast(PpoJobCfg, cfg.job)
    if job.iterations is None and job.minutes is None:
        raise ConfigError("job.iterations", None, "a number, or a limit in job.minutes")
    worlds = cfg.nworld // context.ranks.size
    if worlds * job.horizon < 2 * job.minibatches:
        expected = f"at most {worlds * job.horizon // 2}, so that each has two decisions"
        expected += f" (nworld={worlds} times job.horizon={job.horizon} are divided)"
        raise ConfigError("job.minibatches", job.minibatches, expected)
    plan = make_plan(cfg)
    first, least, most = plan.settings.std
    if not least <= first <= most:
        expected = (
            "its value at the start, the smallest and the largest, the first within the others"
        )
        raise ConfigError("job.std", plan.settings.std, expected)
    reset = cfg.reset
    if unrecorded(reset):
        for name in reset.keys() - whole_starts(reset).keys():
            label = f"reset.{name}"
            check_params(label, resolve_func(label, reset[name].func), reset[name].params, 1)
        reset = whole_starts(reset)
    seen = f"observation.{plan.group}"
    keys = {seen: f"job.{seen}"} if plan.start is None else {}
    with renamed_keys(keys), one_world(context, replace(plan.cfg, reset=reset)) as env:
        if plan.start is not None:
            plan.start.check_widths(env.observation_manager.term_dims[plan.group])
    return range(cfg.seed, cfg.seed + 1)


def train_ppo(context: RunContext, folder: Path) -> Trained:
    """Let worlds act and learn from it; see `Trainer`."""
    cfg = context.cfg
    job = cast(PpoJobCfg, cfg.job)
    device = torch.device(context.backend[1])
    ranks = context.ranks
    states = folder / _STATES
    if unrecorded(cfg.reset):

        def record() -> None:
            if not states.exists():
                record_states(context, job.expert_worlds, states)

        ranks.from_first(record)
    plan = make_plan(with_states(cfg, states))
    cards = [device] if device.type == "cuda" else []
    with torch.random.fork_rng(devices=cards):
        torch.manual_seed(cfg.seed + ranks.rank)
        learner = Learner(context, plan, folder)
        try:
            if (folder / STATE).exists():
                learner.restore(*read_state(folder / STATE))
            learner.learn()
        finally:
            learner.close()
    last = learner.curve[-1]
    return Trained(
        metrics={
            "iterations": learner.done,
            "decisions": last["decisions"],
            "training_s": learner.seconds,
            "best_training_success": learner.best[0],
        },
        notes={"policy": str(folder / LAST), "seeds": str(cfg.seed)},
        curve=learner.curve,
        lines=["success", *(["progress"] if "progress" in last else [])],
        abscissa="iteration",
        scale="linear",
    )


TRAINER = Trainer(check_ppo, train_ppo, midway=True)
