"""The command line: composes, validates before anything is written, runs, and maps errors to exit
codes.

Hydra exits with 1 on its own configuration errors, ignores what the main function returns, and
makes the run folder before calling it. So every job is composed and checked here first, and Hydra
only runs what has passed.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig
from rich.console import Console

import mjstack
from mjstack.config import Config
from mjstack.config.explain import CompositionError
from mjstack.config.help import help_text
from mjstack.config.load import compose_overrides, to_config
from mjstack.config.overrides import parse
from mjstack.config.session import CONFIG_MODULE, CONFIG_NAME, own_hydra
from mjstack.errors import MjstackError, UnknownName
from mjstack.report.record import Status
from mjstack.report.table import Table
from mjstack.startup import INTERRUPTED, started

if TYPE_CHECKING:
    from mjstack.jobs import JobResult

_OTHER_CONFIG = {"--config-dir", "-cd", "--config-name", "-cn", "--config-path", "-cp"}
_HELP = {"--help", "-h"}
_SWEEP = {"-m", "--multirun"}
_VALUED = {"--cfg", "-c", "--package", "-p"}
_OTHER_FLAGS = {"--resolve", "--run", "-r"}
_WIDE = 3  # gates; with more of them a sweep's table has only their status
_FLAGS_WITHOUT_RUN = {"--hydra-help", "--info", "-i", "--shell-completion", "-sc"}


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point of the console script; leaves with the exit status of the run."""
    raise SystemExit(run(list(sys.argv[1:] if argv is None else argv)))


def run(args: list[str]) -> int:
    """Runs a command line and returns its exit status."""
    errors = Console(stderr=True, soft_wrap=True, highlight=False, markup=False)
    if any(arg.partition("=")[0] in _HELP for arg in args):
        _print_help()
        return 0
    if "--version" in args:
        print(f"mjstack {mjstack.__version__}")
        return 0
    if _FLAGS_WITHOUT_RUN & set(args) or any(
        a.startswith(("--info", "--hydra-help")) for a in args
    ):
        return _run_hydra(args, [])
    sweep = bool(_SWEEP & set(args))
    dry = any(a in ("--cfg", "-c") or a.startswith("--cfg=") for a in args)
    try:
        overrides = _overrides(args)
        jobs = [
            [o for o in job if not _is_hydra(o)]
            for job in (_expand(overrides) if sweep else [overrides])
        ]
        configs = [to_config(compose_overrides(own)) for own in jobs]
        from mjstack.jobs import (
            check_job,
            job_folder,
        )  # loads torch and Warp, which what is misspelt need not wait for

        if not dry:
            for config, own in zip(configs, jobs, strict=True):
                check_job(config, own)
        folder = None if sweep or dry else job_folder(configs[0])
        if folder is not None and not any(o.startswith("hydra.run.dir=") for o in overrides):
            args = [*args, f"hydra.run.dir={folder}"]
            overrides = [*overrides, f"hydra.run.dir={folder}"]
        if not dry:
            check_writable(_output_folder(overrides, sweep))
    except MjstackError as error:
        errors.print(f"mjstack: {error}")
        return error.exit_code
    except KeyboardInterrupt:
        return INTERRUPTED
    outcomes: list[JobResult] = []
    try:
        status = _run_hydra(args, outcomes)
    except KeyboardInterrupt:
        status = INTERRUPTED
    if sweep and outcomes:
        _print_sweep(outcomes)
    return max([status, *(outcome.exit_code for outcome in outcomes)])


def _print_help() -> None:
    """Prints what `--help` says, to a reader that may not want all of it, such as ``| head``."""
    try:
        print(help_text(min(max(shutil.get_terminal_size((120, 24)).columns, 60), 120)), flush=True)
    except BrokenPipeError:
        os.dup2(
            os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno()
        )  # Python writes there once more at its end


def _run_hydra(args: list[str], outcomes: list[JobResult]) -> int:
    """Hands the command line to Hydra; each job adds its outcome."""
    from mjstack.jobs import run_job

    def job(cfg: DictConfig) -> None:
        started()
        folder = Path(HydraConfig.get().runtime.output_dir)
        outcome = run_job(to_config(cfg), folder, overrides=list(HydraConfig.get().overrides.task))
        outcomes.append(outcome)
        if outcome.status is Status.interrupted:
            raise KeyboardInterrupt

    argv = sys.argv
    sys.argv = [argv[0], *args]
    try:
        hydra.main(
            version_base="1.3", config_path=f"pkg://{CONFIG_MODULE}", config_name=CONFIG_NAME
        )(job)()
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 1
    finally:
        sys.argv = argv
    return 0


def _overrides(args: list[str]) -> list[str]:
    """The key=value arguments; Hydra's own flags and their values are left out."""
    flags = {*_HELP, "--version", *_FLAGS_WITHOUT_RUN, *_SWEEP, *_VALUED, *_OTHER_FLAGS}
    out = []
    skip = False
    for number, arg in enumerate(args):
        if skip:
            skip = False
        elif arg.partition("=")[0] in _OTHER_CONFIG:
            raise CompositionError(
                f"argument '{arg}': mjstack runs its own configuration. Change it with key=value"
                " overrides."
            )
        elif arg in _VALUED:
            skip = True
        elif arg.startswith("-"):
            if arg.partition("=")[0] not in flags:
                override = arg.lstrip("-")
                key, given, _ = override.partition("=")
                if key.partition(".")[0] in {field.name for field in fields(Config)}:
                    follows = args[number + 1 : number + 2]
                    value = (
                        follows[0]
                        if follows and not follows[0].startswith("-") and "=" not in follows[0]
                        else "VALUE"
                    )
                    meant = override if given else f"{key}={value}"
                    raise CompositionError(
                        f"flag '{arg}' does not exist. Write {meant}, an override without dashes."
                    )
                raise UnknownName("flag", arg, flags)
        elif "=" not in arg and not arg.startswith("~"):
            raise CompositionError(
                f"argument '{arg}' is not an override. Write key=value, such as nworld=64."
            )
        else:
            out.append(arg)
    return out


def _expand(overrides: list[str]) -> list[list[str]]:
    """The jobs of a sweep, as Hydra's basic sweeper makes them."""
    from hydra._internal.core_plugins.basic_sweeper import BasicSweeper

    parsed = [parse(override) for override in overrides]
    try:
        return [
            list(job)
            for batch in BasicSweeper.split_arguments(parsed, max_batch_size=None)
            for job in batch
        ]
    except HydraException as error:
        raise CompositionError(
            f"this sweep cannot be expanded: {str(error).splitlines()[0]}. List its values, such as"
            " robot=so101,rebot."
        ) from error


def _is_hydra(override: str) -> bool:
    return override.lstrip("+~").startswith(("hydra.", "hydra/"))


def _output_folder(overrides: list[str], sweep: bool) -> Path:
    """The folder Hydra would make for these arguments, without making it."""
    from hydra import compose

    with own_hydra():
        # Hydra's own part is composed alone: the rest of the configuration has been checked by now.
        try:
            cfg = compose(
                CONFIG_NAME,
                overrides=[o for o in overrides if _is_hydra(o)],
                return_hydra_config=True,
            )
            return Path(cfg.hydra.sweep.dir if sweep else cfg.hydra.run.dir)
        except Exception as error:
            raise CompositionError(
                f"hydra's own settings cannot be used: {str(error).splitlines()[0]}."
            ) from error


def check_writable(folder: Path) -> None:
    """Checks that a folder can be made and written, by a file that is gone at once."""
    existing = folder.absolute()
    try:
        while not existing.exists():
            existing = existing.parent
        if not existing.is_dir():
            raise NotADirectoryError(20, "Not a directory")
        with tempfile.TemporaryFile(dir=existing):
            pass
    except OSError as error:
        raise CompositionError(
            f"outputs folder {folder}: {existing} cannot be written ({error.strerror}), expected a"
            " writable folder. Run from another folder, or set hydra.run.dir."
        ) from error


def _print_sweep(outcomes: list[JobResult]) -> None:
    """One row per job, also written beside the jobs as summary.md."""
    names = list(dict.fromkeys(gate.name for outcome in outcomes for gate in outcome.gates))
    rows = []
    for number, outcome in enumerate(outcomes):
        by_name = {gate.name: gate for gate in outcome.gates}
        cells = [
            (
                f"{by_name[name].status.value}: {by_name[name].reason}"
                if name in by_name
                else "not run"
            )
            for name in names
        ]
        rows.append([str(number), " ".join(outcome.overrides), *cells, outcome.status.value])
    title = f"sweep of {len(outcomes)} jobs"
    table = Table(title=title, header=["job", "overrides", *names, "status"], rows=rows)
    lines = table.to_markdown()
    if len(names) > _WIDE:
        table.rows = [
            [number, job, *(cell.partition(":")[0] for cell in cells), status]
            for number, job, *cells, status in rows
        ]
    Console().print(table.to_console())
    sweep_folder = os.path.commonpath([str(outcome.folder) for outcome in outcomes])
    if len(outcomes) > 1:
        (Path(sweep_folder) / "summary.md").write_text("\n".join(lines) + "\n")
        Console(soft_wrap=True).print(f"summary: {sweep_folder}/summary.md")
