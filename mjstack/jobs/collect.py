"""Job *collect*: demonstrations of the expert as a dataset, batch by batch, until as many as
asked for are there.
"""

import json
import os
import time
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import cast

import torch

from mjstack.config.fingerprint import config_hash, differences
from mjstack.config.schema import Backend, CollectJobCfg, Config
from mjstack.datasets import DatasetSpec, lerobot, require_pyarrow
from mjstack.datasets.reader import check_same, read_info
from mjstack.datasets.video import check_encoder
from mjstack.envs import Env, build_env, demonstration_config
from mjstack.episodes.context import RunContext, require_episode
from mjstack.errors import ConfigError, DatasetError, RankError
from mjstack.files import check_unused, lock_folder, write_atomic
from mjstack.jobs.collected import FILE, CollectPlan, read_batches
from mjstack.jobs.collection import DATASET, Collection
from mjstack.jobs.demonstration import ACTION, STATE, episode_config
from mjstack.jobs.gates import check_task
from mjstack.jobs.runner import CheckedJob, Job
from mjstack.report.record import GateResult, Status
from mjstack.report.table import Table, format_value, to_document

NAME = "collect"
LOADING = """\
import json
from pathlib import Path

import pyarrow.parquet as pq

folder = Path("{folder}")
info = json.loads((folder / "meta/info.json").read_text())
episode = pq.read_table(folder / "data", filters=[("episode_index", "==", 0)])
for name in ("observation.state", "action"):
    values = episode[name].combine_chunks().flatten().to_numpy().reshape(len(episode), -1)
    print(name, values.shape, info["features"][name]["names"], info["mjstack"]["units"][name])
"""


def collect_folder(cfg: Config) -> Path:
    """Where a configuration's dataset is, so that another call finds it."""
    name = config_hash(episode_config(cfg))[:12]
    return Path(cast(CollectJobCfg, cfg.job).folder or f"outputs/collect/{name}")


def check_collect(cfg: Config) -> CheckedJob:
    """Raise for what cannot be done, before anything is written."""
    require_pyarrow()
    require_episode(cfg)
    context = RunContext(cfg)
    check_task(context)
    plan = plan_collection(context)
    if context.ranks.writes:  # it may have begun there when the others come
        _check_folder(plan.home / DATASET, plan.spec)
    count = cast(CollectJobCfg, cfg.job).episodes
    title = f"task {cfg.task.name}, {count:,} demonstrations"
    work = partial(run_collect, plan)
    return CheckedJob(
        context=context,
        title=title,
        work=work,
        folder=plan.home,
        own=DATASET,
        resumes=NAME,
        spreads=True,
    )


def plan_collection(context: RunContext) -> CollectPlan:
    """Plan the configured dataset.

    Raises:
        ConfigError: Its episodes would not differ, or do not fit into the buffer.
    """
    cfg = context.cfg
    shown = demonstration_config(cfg)
    made = build_env(shown, model=context.model, nworld=2, backend=Backend.native, device="cpu")
    with closing(made) as env:
        if cast(CollectJobCfg, cfg.job).episodes > 1:
            _check_starts(env)
        plan = CollectPlan.of(context, collect_folder(cfg), env)
        if cfg.scene.cameras:
            _check_images(cfg, plan)
        return plan


def _check_images(cfg: Config, plan: CollectPlan) -> None:
    """Refuse images that cannot be kept or encoded.

    Raises:
        MjstackError: One cannot.
    """
    for name, camera in cfg.scene.cameras.items():
        if "rgb" not in camera.outputs:
            expected = "rgb among them, which a dataset keeps"
            raise ConfigError(f"scene.cameras.{name}.outputs", list(camera.outputs), expected)
    check_encoder(plan.spec.videos, plan.spec.fps)


def run_collect(plan: CollectPlan, context: RunContext, folder: Path) -> None:
    """Add the missing episodes to the dataset, and leave dataset.md in the folder."""
    context.begin(NAME)
    if not context.ranks.writes:
        context.ranks.from_first(lambda: None)  # which opens the dataset
        Collection(plan, context).play()
        return
    began = time.perf_counter()
    collection = Collection(plan, context)
    context.ranks.from_first(lambda: None)

    def conclude(status: Status, problem: str = "") -> None:
        result = collection.result(status, problem, time.perf_counter() - began)
        if collection.committed:
            _write_table(context.cfg, plan, folder, result)
            where = f"{collection.path}, described in {folder}/dataset.md"
            context.print_line(f"dataset: {where}")
        context.record(result)

    try:
        problem = collection.play()
    except (Exception, KeyboardInterrupt) as error:
        cause = context.ranks.cause(error)
        if isinstance(cause, KeyboardInterrupt):
            conclude(Status.interrupted, "interrupted")
        elif isinstance(cause, RankError):
            conclude(Status.failed, str(cause))
            raise cause from error
        raise
    conclude(Status.failed if problem else Status.passed, problem)


def _write_table(cfg: Config, plan: CollectPlan, folder: Path, result: GateResult) -> None:
    """Write dataset.md: facts, the range of every joint and its target, and the lines that load the
    first episode.
    """
    dataset = plan.home / DATASET
    statistics = json.loads((dataset / lerobot.STATS).read_text())
    ranges = []
    for name in (STATE, ACTION):
        feature = plan.spec.features[name]
        columns = [statistics[name][key] for key in ("min", "mean", "max")]
        for joint, unit, *values in zip(feature.names, feature.units, *columns, strict=True):
            ranges.append([f"{name} {joint}", unit, *(f"{value:.4f}" for value in values)])
    facts = [[key, format_value(value)] for key, value in (result.notes | result.metrics).items()]
    header = ["number", "unit", "smallest", "mean", "largest"]
    tables = [Table(header=["fact", "value"], rows=facts), Table(header=header, rows=ranges)]
    title = f"{cfg.robot.title}, task {cfg.task.name}: demonstrations"
    loading = LOADING.format(folder=dataset)
    text = f"{to_document(title, tables)}\nWith pyarrow alone:\n\n```python\n{loading}```\n"
    write_atomic(folder / "dataset.md", text)


def _check_starts(env: Env) -> None:
    """Refuse starts that are the same in every world or under every seed: an episode would be in
    the dataset twice.
    """
    starts = []
    seed = env.cfg.seed
    for other in (seed, seed - 1 if seed else 1):
        env.reset(seed=other)
        parts = (env.sim.qpos, env.sim.qvel, *env.sim.fields.values())
        rows = torch.cat([part.double().flatten(1) for part in parts], dim=1)
        starts += [row.numpy().tobytes() for row in rows]
    if len(set(starts)) < len(starts):
        raise ConfigError(
            "reset",
            f"[{', '.join(env.cfg.reset)}]",
            "starts that differ from world to world and from seed to seed, so that no episode is"
            " there twice",
            "Use reset=randomized or reset=jitter",
        )


def _check_folder(dataset: Path, spec: DatasetSpec) -> None:
    """Refuse a dataset that is not this configuration's.

    Raises:
        DatasetError: It is of another one.
        FolderError: Another process is writing it, or the job's folder has a run of another job.
    """
    check_unused(dataset.parent, NAME, DATASET)
    if not dataset.exists():
        return
    os.close(lock_folder(dataset))
    info = read_info(dataset)
    if info is None:
        return
    if info["mjstack"]["config_sha256"] != spec.config_sha256:
        theirs = (info["mjstack"]["provenance"] or [{}])[-1].get("config", {})
        found = differences(theirs, spec.provenance["config"])
        raise DatasetError(
            f"{dataset} has episodes of another configuration: {found}. Set job.folder to another"
            " folder, or these keys back"
        )
    check_same(dataset, info, spec)
    read_batches(dataset.parent / FILE)


JOB = Job(check_collect)
