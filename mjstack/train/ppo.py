"""Trainer *ppo*: a policy learns from the task's rewards, by rsl-rl-lib's PPO."""

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import torch

from mjstack.config.check import starts_midway
from mjstack.config.functions import resolve_func
from mjstack.config.schema import Config, PpoJobCfg, TermCfg
from mjstack.drivers.driver import Driver
from mjstack.envs import Env
from mjstack.episodes.batches import BatchPlan, play_batches
from mjstack.episodes.recorder import Channels, Read
from mjstack.episodes.stage import Stage
from mjstack.errors import ConfigError, MjstackError, renamed_keys
from mjstack.managers.term import check_params
from mjstack.mdp.starts.expert_states import VIEWS, write_states
from mjstack.policy.checkpoint import read_state
from mjstack.train.ppo_learner import PpoLearner
from mjstack.train.trainer import LAST, STATE, Trained, Trainer, observed_group, whole_starts

_STATES = "expert_states.npz"  # in the training's folder
_STRIDE = 5  # control steps between two states


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
