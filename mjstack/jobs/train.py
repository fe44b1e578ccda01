"""Job *train*: a policy is trained, and judged as gate *success* judges, from starts that training
has not used.
"""

import copy
import json
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from mjstack.config.fingerprint import config_content, config_hash, differences
from mjstack.config.functions import find_instance
from mjstack.config.schema import Config, TrainJobCfg
from mjstack.drivers.driver import with_controller
from mjstack.episodes.rollout import require_episode
from mjstack.episodes.run import Run
from mjstack.episodes.stage import Assets, Stage
from mjstack.errors import ConfigError, FolderError
from mjstack.files import made_by, reading, to_csv, write_atomic
from mjstack.gates.episodes import judge_episodes
from mjstack.gates.runner import run_guarded
from mjstack.jobs.gates import check_task
from mjstack.jobs.runner import CheckedJob, Job
from mjstack.jobs.showing import check_showing
from mjstack.report.curves import Plot, save_curves
from mjstack.report.figure import Figure
from mjstack.report.record import GateResult, Status
from mjstack.report.table import Table
from mjstack.train.trainer import FAILED, LAST, Trainer, whole_starts

NAME = "train"
CONFIG = "training.json"  # the configuration of the training in the folder


def training_fingerprint(cfg: Config) -> dict[str, Any]:
    """Everything that a training depends on, in JSON's types."""
    return config_content(cfg, "training", "episodes")


def check_train(cfg: Config) -> CheckedJob:
    """Raise for what cannot be done, before anything is written."""
    require_episode(cfg)
    job: TrainJobCfg = cfg.job
    trainer = find_instance("job.trainer", job.trainer, Trainer)
    stage = Stage(cfg)
    used = trainer.check(stage)  # first: it starts neither Warp nor an expert
    reset = whole_starts(cfg.reset) if trainer.midway else cfg.reset
    check_task(stage.with_config(replace(cfg, reset=reset)))
    check_showing(cfg)
    tested = range(job.test_seed, job.test_seed + cfg.gate.success.seeds)
    if used.start < tested.stop and tested.start < used.stop:
        expected = f"seeds that training does not use, which are {used.start} to {used.stop - 1}"
        raise ConfigError("job.test_seed", job.test_seed, expected)
    name = config_hash(training_fingerprint(cfg))[:12]
    folder = Path(job.folder or f"outputs/train/{name}")
    if stage.ranks.writes:  # it may have begun there when the others come
        _check_folder(folder, cfg)
    return CheckedJob(
        stage=stage,
        title=f"task {cfg.task.name}, training",
        work=partial(_run, trainer),
        folder=folder,
        resumes=NAME,
        spreads=True,
    )


def _check_folder(folder: Path, cfg: Config) -> None:
    """Refuse a folder with another training."""
    path = folder / CONFIG
    if not path.exists():
        return
    with reading(path, "Set job.folder to another folder"):
        changes = differences(json.loads(path.read_text()), training_fingerprint(cfg))
    if changes:
        problem = f"{folder} has a training{made_by(folder)} of another configuration: {changes}"
        raise FolderError(problem, "Set job.folder to another folder, or these keys back")


def _run(trainer: Trainer, run: Run, folder: Path) -> None:
    """Train, and judge the last policy."""
    if run.stage.ranks.writes:
        _check_folder(folder, run.cfg)  # hydra.run.dir may name one
        write_atomic(folder / CONFIG, json.dumps(training_fingerprint(run.cfg), indent=1) + "\n")
    run_guarded(run, NAME, partial(_train, trainer, folder), "worlds")
    if run.artifacts.results[NAME].status is Status.passed:
        judged = run.with_stage(judged_stage(run.stage, folder / LAST))
        run_guarded(judged, "success", judge_episodes)
        trained = run.artifacts.results[NAME]
        judgement = Figure("judgement", judged.artifacts.results["success"].seconds, "s")
        times = [figure for figure in trained.figures if figure.unit == "s"]
        rows = [[f.label, f"{f.value:.1f} s"] for f in (*times, judgement)]
        trained.tables.append(Table(title="Time", header=["part", "time"], rows=rows))


def judged_stage(stage: Stage, policy: Path) -> Stage:
    """The stage on which a policy is judged: it starts as training does, or as the command line has
    it for gate *success*, under seeds that training has not used.
    """
    cfg = stage.cfg
    gate = copy.copy(cfg.gate)
    gate.success = replace(gate.success, reset=whole_starts(gate.success.reset))
    judged = replace(
        with_controller(cfg, "policy"), seed=cfg.job.test_seed, policy=str(policy), gate=gate
    )
    assets = Assets(judged)
    assets.model = stage.model
    return stage.with_config(judged, assets=assets)


def _train(trainer: Trainer, folder: Path, run: Run) -> list[GateResult]:
    """The training as a result of the report."""
    began = time.perf_counter()
    trained = trainer.train(run.stage, folder)
    run.stage.ranks.gather(None)  # rank 0 has written the policy that all read next
    rows = trained.curve
    last = rows[-1]
    titles = {name: name.replace("_", " ") for name in last}
    if run.stage.ranks.writes:
        write_atomic(folder / f"{NAME}.csv", to_csv(rows))
        title = f"{run.cfg.robot.title}, task {run.cfg.task.name}: training"
        curves = {titles[name]: name for name in trained.lines}
        plot = Plot(
            title=title, over=trained.abscissa, lines=[], panels={"": curves}, log=trained.log
        )
        run.draw(f"{NAME}.png", save_curves, plot, rows)
    seconds = time.perf_counter() - began
    reached = ", ".join(f"{titles[name]} {last[name]:.4g}" for name in trained.lines)
    rules = {name.removeprefix(FAILED): name for name in last if name.startswith(FAILED)}
    columns = {titles[name]: name for name in last if name not in rules.values()}
    tables = [Table.of(columns, rows, "Curve")]
    if rules:
        counted = {name: name for name in (trained.abscissa, "judged")}
        tables.append(Table.of(counted | rules, rows, "Judged episodes that broke a rule"))
    return [
        GateResult(
            name=NAME,
            status=Status.passed,
            reason=f"{trained.notes['policy']} after {trained.abscissa}"
            f" {last[trained.abscissa]:,}: {reached}",
            seconds=seconds,
            figures=trained.figures,
            notes=trained.notes,
            tables=tables,
        )
    ]


JOB = Job(check_train, views=("view",))
