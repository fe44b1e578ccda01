"""The command line: composes, validates before anything is written, runs, and maps errors to exit
codes. Any exception becomes one line here, with its traceback if MJSTACK_DEBUG is set.

Hydra exits with 1 on its own configuration errors, ignores what the main function returns, and
makes the run folder before calling it. So every job is composed, checked and built here, once, and
Hydra runs what was composed.
"""

import gc
import logging
import os
import re
import shutil
import sys
import traceback
from argparse import Namespace
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from mjstack.cli_sweep import check_jobs, claim_sweep, expand, hydra_path, print_sweep
from mjstack.config.explain import own_overrides
from mjstack.config.help import help_text, key_help, list_text
from mjstack.config.load import compose, extended_search_path, to_config
from mjstack.config.session import (
    CONFIG_NAME,
    added_folders,
    hydra_session,
    list_items,
    search_path,
    search_path_args,
)
from mjstack.errors import MjstackError, RankError, UnknownName, describe_error, suggest
from mjstack.files import claim_folder, write_atomic
from mjstack.interrupt import EXIT_CODE, begin_job
from mjstack.process import is_rank
from mjstack.report.record import Report, Status
from mjstack.report.table import Console
from mjstack.version import __version__

if TYPE_CHECKING:
    from mjstack.jobs import CheckedJob

# mjstack runs its own configuration, and `--cfg` and `--help` show it.
_NOT_OFFERED = {"--config-name", "-cn", "--config-path", "-cp", "--experimental-rerun"}
_NOT_OFFERED |= {"--info", "-i", "--shell-completion", "-sc"}

_checked: dict[tuple[str, ...], "CheckedJob"] = {}  # by their overrides, until Hydra runs them
_results: list[Report] = []  # of the jobs that ran in this process
_assisting = False  # whether this rank has begun with its part of a job


def run(args: list[str]) -> int:
    """Run a command line and return its exit status."""
    global _assisting
    _checked.clear()
    _results.clear()
    _assisting = False
    try:
        if "--version" in args:
            print(f"mjstack {__version__}")
            return 0
        flags = _parse(args)
        with extended_search_path(flags.overrides, flags.config_dir) as overrides:
            return _dispatch(flags, overrides)
    except KeyboardInterrupt:  # the job has said so
        return EXIT_CODE
    except BrokenPipeError:
        # The reader may not want all of it, such as ``| head``. Python writes once more at its end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _status()
    except (Exception, SystemExit) as error:
        if os.environ.get("MJSTACK_DEBUG"):
            traceback.print_exception(error)
        problem = describe_error(error)
        who = f"rank {os.environ['RANK']}: " if int(os.environ.get("RANK", 0)) else ""
        if not (isinstance(error, RankError) and error.printed):
            console = Console(stderr=True, soft_wrap=True, highlight=False, markup=False)
            console.print(f"mjstack: {who}{problem}")
        return 1 if _results or _assisting else MjstackError.exit_code


def _dispatch(flags: Namespace, overrides: list[str]) -> int:
    """Do what the flags ask for, on the current search path."""
    command = overrides[0] if overrides else ""
    with hydra_session() as hydra:
        if command == "list":
            print(list_text(overrides[1:]), flush=True)
        elif command == "new":
            return _write_new(overrides[1:], flags.arm)
        elif command == "doctor":
            from mjstack.jobs.doctor import findings  # it loads Warp

            for name, text in findings(overrides[1:]):
                print(f"{name:<14} {text}", flush=True)
        elif flags.help:
            _print_help(overrides)
        elif flags.hydra_help:
            hydra.hydra_help(CONFIG_NAME, args_parser=get_args_parser(), args=flags)
        elif flags.cfg:
            _show(hydra, flags, overrides)
        elif flags.multirun:
            return _sweep(hydra, overrides)
        else:
            return _run_one(hydra, overrides)
    return 0


def _write_new(args: list[str], arm: str) -> int:
    """Write the files of `mjstack new`; for a robot, show guesses and picture, run *baseline*."""
    from mjstack.robots.new import write_new  # it loads MuJoCo

    paths, guesses = write_new(args, arm)
    print("\n".join(map(str, paths)))
    if not guesses:
        return 0
    from mjstack.jobs.new_robot import show_guesses  # it loads torch

    name, folder = args[1], paths[0].parent.parent
    with search_path([folder]), hydra_session() as hydra:
        overrides = [f"robot={name}", "sim=native", "nworld=1", "gates=[baseline]"]
        show_guesses(guesses, to_config(compose(overrides)), folder.parent / "home.png")
        return _run_one(hydra, overrides)


def _show(hydra: Any, flags: Namespace, overrides: list[str]) -> None:
    """Check the values of a configuration and print it."""
    if flags.multirun:
        raise MjstackError("--cfg shows one configuration, and -m makes several. Leave -m out.")
    cfg = compose(overrides)
    to_config(cfg)
    if flags.package and OmegaConf.select(cfg, flags.package) is None:
        raise UnknownName("package", flags.package, [key for key, _ in list_items(cfg)])
    hydra.show_cfg(CONFIG_NAME, overrides, flags.cfg, flags.package, flags.resolve)


def _run_one(hydra: Any, overrides: list[str]) -> int:
    """Compose, check and run one job, perhaps as one of several ranks."""
    if not is_rank():
        cfg, checked = _compose_one(overrides)
        from mjstack.distributed import launch  # they load torch
        from mjstack.jobs import count_devices

        if (count := count_devices(checked.stage.cfg)) > 1:
            _check_spreads(checked)
            gc.enable()
            return launch([*overrides, *search_path_args()], count)
        return _run_checked(hydra, cfg, checked, overrides)
    from mjstack.distributed import joined
    from mjstack.jobs import check_ranks

    with joined() as ranks:
        cfg, checked = ranks.on_all_ranks(lambda: _compose_one(overrides))
        ranks.on_all_ranks(lambda: _check_spreads(checked))
        ranks.on_all_ranks(lambda: check_ranks(checked.stage))
        return _run_checked(hydra, cfg, checked, overrides)


def _compose_one(overrides: list[str]) -> tuple[DictConfig, "CheckedJob"]:
    cfg = compose(overrides)
    if cfg.hydra.mode is RunMode.MULTIRUN:
        raise MjstackError("hydra.mode=MULTIRUN: expected RUN without -m. Replace it by -m.")
    return cfg, _check(cfg, overrides)


def _check_spreads(checked: "CheckedJob") -> None:
    if not checked.spreads:
        raise MjstackError(
            "torchrun, devices: expected a job whose worlds ranks share: gates, train or collect."
            " Run this job in one process."
        )


def _run_checked(hydra: Any, cfg: DictConfig, checked: "CheckedJob", overrides: list[str]) -> int:
    """Run a job in its folder; of several ranks the first one makes it, and alone writes."""
    ranks = checked.stage.ranks
    chosen = any(override.lstrip("+").startswith("hydra.run.dir=") for override in overrides)
    resumed = None if chosen else checked.folder
    folder = resumed or hydra_path(cfg, "run.dir")
    gc.enable()  # again: all is loaded
    begin_job()
    if not ranks.writes:
        global _assisting
        _assisting = True
        checked.assist(ranks.from_first(lambda: folder))
        return 0
    with ExitStack() as stack:
        claim = claim_folder(folder, checked.resumes, numbered=not (chosen or resumed))
        claimed = ranks.from_first(lambda: stack.enter_context(claim))
        cfg.hydra.run.dir = str(claimed)
        hydra.run(CONFIG_NAME, run_job, overrides)
    return _status()


def _status() -> int:
    """The exit status of the jobs that ran."""
    return max((result.exit_code for result in _results), default=0)


def _sweep(hydra: Any, overrides: list[str]) -> int:
    """Compose and check every job of a sweep, then run those that are left."""
    if is_rank():
        raise MjstackError("torchrun: expected one job, and -m makes several. Leave one out.")
    if any(re.match("[+~]*hydra[./]sweeper", override) for override in overrides):
        raise MjstackError(
            "hydra.sweeper: expected Hydra's own. Give the values on the command line, as in"
            " -m nworld=1,2."
        )
    gc.enable()  # every job is built to be checked
    overrides = [*overrides, "hydra.mode=MULTIRUN"]
    master = compose(overrides, RunMode.MULTIRUN)
    subdir = OmegaConf.to_container(master.hydra)["sweep"]["subdir"]  # type: ignore[index,call-overload]
    if subdir != "${hydra.job.num}":
        raise MjstackError(
            f"hydra.sweep.subdir={subdir}: expected none, because a job's folder is its"
            " number. Leave it out, also of your YAML."
        )
    jobs = expand(master, overrides)
    check_jobs(master, jobs, _check)
    begin_job()
    from mjstack.jobs.sweep import list_jobs

    reports: dict[int, Report] = {}
    with claim_sweep(master, jobs) as claimed:
        try:
            batches = hydra.multirun(CONFIG_NAME, run_job, overrides)
            _results[:] = [job.return_value for batch in batches for job in batch]
            reports = dict(enumerate(_results))
        finally:
            if reports or any(job.report() for job in list_jobs(claimed)):
                print_sweep(claimed, reports)
    return _status()


def _print_help(args: list[str]) -> None:
    """Print the help, or the keys below the ones among the arguments, as the overrides have
    them.
    """
    width = min(max(shutil.get_terminal_size((120, 24)).columns, 60), 120)
    keys = [arg for arg in args if "=" not in arg and not arg.startswith("~")]
    cfg = to_config(compose([arg for arg in args if arg not in keys]))
    texts = [key_help(cfg, key, width) for key in keys] or [help_text(cfg, width)]
    print("\n".join(texts), flush=True)


def run_job(cfg: DictConfig) -> Report:
    """Run a job in the folder that Hydra made. A launcher may call it in another process, where
    nothing has been checked yet.
    """
    from mjstack.jobs.sweep import SweepJob  # they load torch
    from mjstack.jobs.sweep_table import update_summary

    logging.raiseExceptions = False  # a full disk would print a traceback for each line of run.log
    settings = HydraConfig.get()
    overrides = list(settings.overrides.task)
    with search_path(added_folders(settings.runtime)):
        folder = Path(settings.runtime.output_dir)
        sweep = Path(settings.sweep.dir) if settings.mode is RunMode.MULTIRUN else None
        if sweep is not None:
            job = SweepJob(settings.job.num, folder, tuple(overrides))
            if (done := job.result()) is not None:
                print(f"job {job.number}: {done.status}, done before", flush=True)
                _save_config(cfg, folder)  # Hydra has just put one with interpolations there
                return done
            job.set_aside()
        checked = _checked.pop(tuple(overrides), None) or _check(cfg, overrides)
        with suppress(OSError):  # the job's error
            _save_config(cfg, folder)
        result = checked.run(folder, overrides)
        if sweep is not None:
            update_summary(sweep, {settings.job.num: result})
    _results.append(result)
    if result.status is Status.interrupted:
        raise KeyboardInterrupt
    return result


def _save_config(cfg: DictConfig, folder: Path) -> None:
    """Write the configuration as a replay reads it: values, no interpolations."""
    write_atomic(folder / ".hydra" / "config.yaml", OmegaConf.to_yaml(cfg, resolve=True))


def _check(cfg: DictConfig, overrides: list[str]) -> "CheckedJob":
    """Type and check a composed job, and keep what that built for its run."""
    # It loads torch and Warp, for which a misspelt key need not wait.
    from mjstack.jobs import check_job

    keys = own_overrides(overrides)
    checked = check_job(to_config(cfg), keys)
    _checked[tuple(keys)] = checked
    return checked


def _parse(args: list[str]) -> Namespace:
    """Hydra's reading of the flags, or a `MjstackError`."""

    def refuse(message: str) -> NoReturn:
        raise MjstackError(message)

    parser = get_args_parser()  # Hydra has no public one
    parser.error = refuse  # type: ignore[method-assign]
    parser._optionals.conflict_handler = "resolve"
    parser.add_argument("--config-dir", "-cd", action="append", default=[])  # several add up
    parser.add_argument("--arm", default="")  # of `new robot`
    known = set(parser._option_string_actions) - _NOT_OFFERED
    for arg in args:
        if arg.startswith("-") and arg.partition("=")[0] not in known:
            raise MjstackError(
                f"flag '{arg}' does not exist. {suggest(arg, known)} Keys are set without dashes:"
                " nworld=64."
            )
    return parser.parse_intermixed_args(args)
