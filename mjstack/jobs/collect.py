"""Job *collect*: demonstrations of the scripted expert as a dataset, batch by batch, until as many
as asked for are there.
"""

from __future__ import annotations

import os
import shlex
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, cast

import torch
from omegaconf import OmegaConf

from mjstack.config.fingerprint import CONTENT, config_hash
from mjstack.config.schema import Backend, CollectJobCfg, Config
from mjstack.datasets import DatasetSpec, require_pyarrow
from mjstack.datasets.reader import check_same, lock_folder, read_info, read_rows
from mjstack.envs import Env, build_env, demonstration_config
from mjstack.episodes.context import RunContext, require_episode
from mjstack.errors import ConfigError, DatasetError, UnwrittenError
from mjstack.jobs.collect_record import read_batches
from mjstack.jobs.collection import DATASET, Collection, CollectPlan
from mjstack.jobs.demonstration_spec import (
    Difference,
    as_override,
    episode_config,
    first_difference,
)
from mjstack.jobs.gates import check_task
from mjstack.jobs.job import Job
from mjstack.jobs.progress import ProgressBar
from mjstack.jobs.result import JobResult
from mjstack.jobs.runner import Record, run_reported
from mjstack.report.record import Status


def collect_folder(cfg: Config) -> Path:
    """Where a configuration's dataset is, so that another call finds it."""
    folder = _job(cfg).folder
    return (
        Path("outputs") / "collect" / config_hash(episode_config(cfg))[:12]
        if folder is None
        else Path(folder)
    )


def check_collect(cfg: Config) -> CollectPlan:
    """Raise for what cannot be done, before anything is written."""
    for key in ("view", "video"):
        if getattr(cfg, key):
            raise ConfigError(
                key, "true", "false with job=collect, which shows no world", "Leave it out"
            )
    require_pyarrow()
    require_episode(cfg)
    context = RunContext(cfg)
    check_task(context)
    plan = plan_collection(context)
    _check_folder(plan.home, plan.spec)
    return plan


def plan_collection(context: RunContext) -> CollectPlan:
    """Plan the configured dataset.

    Raises:
        ConfigError: Its episodes would not differ, or do not fit into the buffer.
    """
    cfg = context.cfg
    shown = demonstration_config(cfg)
    env = build_env(shown, model=context.model, nworld=2, backend=Backend.native, device="cpu")
    try:
        if _job(cfg).episodes > 1:
            _check_starts(env)
        return CollectPlan.of(context, collect_folder(cfg), env)
    finally:
        env.close()


def run_collect_job(plan: CollectPlan, folder: Path, overrides: list[str]) -> JobResult:
    """Add the missing episodes to the dataset, and leave dataset.md and the report.

    Args:
        plan: The dataset.
        folder: Where the report goes; the dataset's place is `collect_folder`'s.
        overrides: What was asked for on the command line.

    Returns:
        How it ended: a pass if the dataset has as many episodes as were asked for.
    """
    cfg = plan.context.cfg

    def work(context: RunContext, bar: ProgressBar, record: Record) -> None:
        bar.start("collect")
        began = time.perf_counter()
        collection = Collection(plan, context)

        def conclude(status: Status, problem: str = "") -> None:
            result = collection.result(status, problem, time.perf_counter() - began)
            if collection.write_table(folder, result):
                context.say(
                    f"dataset: {collection.path}, described in {collection.home / 'dataset.md'}"
                )
            record(result)

        try:
            problem = collection.play()
        except KeyboardInterrupt:
            conclude(Status.interrupted, "interrupted")
            raise
        except (UnwrittenError, OSError) as error:
            with suppress(OSError):  # there may be room for a report
                conclude(Status.failed, str(error))
            raise
        conclude(Status.failed if problem else Status.passed, problem)

    title = f"task {cfg.task.name}, {_job(cfg).episodes:,} demonstrations"
    return run_reported(plan.context, folder, overrides, title, work)


def _job(cfg: Config) -> CollectJobCfg:
    return cast(CollectJobCfg, cfg.job)


def _check_starts(env: Env) -> None:
    """Refuses starts that are the same in every world or under every seed: an episode would be in
    the dataset twice.
    """
    starts = []
    seed = env.cfg.seed
    for other in (seed, seed - 1 if seed else 1):
        env.reset(seed=other)
        parts = (env.sim.qpos, env.sim.qvel, *env.sim.fields.values())
        starts += [
            row.numpy().tobytes()
            for row in torch.cat([part.double().flatten(1) for part in parts], dim=1)
        ]
    if len(set(starts)) < len(starts):
        raise ConfigError(
            "reset",
            f"[{', '.join(env.cfg.reset)}]",
            "starts that differ from world to world and from seed to seed, so that no episode is"
            " there twice",
            "Use reset=randomized or reset=jitter",
        )


def _check_folder(home: Path, spec: DatasetSpec) -> None:
    """Refuses a folder that is not this configuration's.

    Raises:
        DatasetError: Something else is there, or somebody is writing.
    """
    for folder in (home, home / DATASET):
        if folder.exists() and not folder.is_dir():
            raise DatasetError(f"{folder} is a file, expected a folder. Set job.folder to another")
    saved = home / ".hydra" / "config.yaml"
    if (
        saved.exists() and saved.stat().st_size
    ):  # empty: a call that was killed as it wrote the file
        name = OmegaConf.select(OmegaConf.load(saved), "job.name")
        if name != "collect":
            raise DatasetError(
                f"{home} has a run of job={name}, expected none or one of job=collect. Set"
                " job.folder to another"
            )
    if not (home / DATASET).is_dir():
        return
    os.close(lock_folder(home / DATASET))
    info = read_info(home / DATASET)
    if info is None:
        return
    history = info["mjstack"]["provenance"]
    theirs: Mapping[str, Any] = history[-1].get("config", {}) if history else {}
    difference = first_difference(theirs, spec.provenance["config"]) if theirs else None
    if difference is not None and info["mjstack"]["config_sha256"] != spec.config_sha256:
        raise DatasetError(
            f"{home / DATASET} has episodes of another configuration: {difference}. Set job.folder"
            f" to another folder{_way_back(home, difference)}"
        )
    check_same(home / DATASET, info, spec)
    rows = read_rows(home / DATASET, info, ["seed", "world"])
    read_batches(home, [(row["seed"], row["world"]) for row in rows])


def _way_back(home: Path, difference: Difference) -> str:
    """How to go on with a dataset of another configuration: the value to set, or the overrides that
    it was made with.
    """
    if difference.alone:
        value = as_override(difference.found)
        return (
            f", or {difference.key} to"
            f" {'a file with that content' if value.startswith(CONTENT) else value}"
        )
    saved = home / ".hydra" / "overrides.yaml"
    if not (
        saved.exists() and saved.stat().st_size
    ):  # it was made by other means than the command line
        return ""
    return f", or give what it was made with: {shlex.join(map(str, OmegaConf.load(saved)))}"


JOB = Job(check_collect, run_collect_job, folder=collect_folder)
