"""The command line: composes, validates before anything is written, runs, and maps errors to exit
codes. Any exception becomes one line here, with its traceback if MJSTACK_DEBUG is set.

Hydra exits with 1 on its own configuration errors, ignores what the main function returns, and
makes the run folder before calling it. So every job is composed, checked and built here, once, and
Hydra runs what was composed.
"""

import logging
import os
import shutil
import sys
import traceback
from argparse import Namespace
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra._internal.hydra import Hydra
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict

import mjstack
from mjstack.config.explain import own_overrides, parse
from mjstack.config.help import help_text, key_help
from mjstack.config.load import compose, extended_search_path, to_config
from mjstack.config.session import (
    CONFIG_NAME,
    hydra_session,
    lacking_folders,
    list_items,
    quoted,
    search_path,
    search_path_args,
)
from mjstack.errors import (
    CompositionError,
    ConfigError,
    MjstackError,
    RankError,
    UnknownName,
    describe_error,
    suggest,
)
from mjstack.files import check_unused, claim_folder, write_atomic
from mjstack.interrupt import EXIT_CODE, begin_job
from mjstack.process import is_rank
from mjstack.report.record import Report, Status
from mjstack.report.table import Console, Table
from mjstack.report.write import read_report

if TYPE_CHECKING:
    from mjstack.jobs import CheckedJob

# mjstack runs its own configuration.
_OTHER_CONFIG = {"--config-name", "-cn", "--config-path", "-cp", "--experimental-rerun"}

_checked: dict[tuple[str, ...], "CheckedJob"] = {}  # by their overrides, until Hydra runs them
_results: list[Report] = []  # of the jobs that ran in this process
_assisting = False  # whether this rank has begun with its part of a job


def run(args: list[str]) -> int:
    """Run a command line and return its exit status."""
    errors = Console(stderr=True, soft_wrap=True, highlight=False, markup=False)
    global _assisting
    _checked.clear()
    _results.clear()
    _assisting = False
    try:
        if "--version" in args:
            print(f"mjstack {mjstack.__version__}")
            return 0
        flags = _parse(args)
        with extended_search_path(flags.overrides, flags.config_dir) as overrides:
            return _dispatch(flags, overrides)
    except KeyboardInterrupt:  # the job has said so
        return EXIT_CODE
    except BrokenPipeError:
        # The reader may not want all of it, such as ``| head``. Python writes once more at its end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return max((result.exit_code for result in _results), default=0)
    except (Exception, SystemExit) as error:
        if os.environ.get("MJSTACK_DEBUG"):
            traceback.print_exception(error)
        problem = describe_error(error, "MJSTACK_DEBUG=1 shows the traceback")
        who = f"rank {os.environ['RANK']}: " if int(os.environ.get("RANK", 0)) else ""
        if not (isinstance(error, RankError) and error.told):
            errors.print(f"mjstack: {who}{problem}")
        return 1 if _results or _assisting else MjstackError.exit_code


def _dispatch(flags: Namespace, overrides: list[str]) -> int:
    """Do what the flags ask for, on the current search path."""
    with hydra_session() as hydra:
        if flags.help:
            _print_help(hydra, overrides)
        elif flags.hydra_help:
            hydra.hydra_help(CONFIG_NAME, args_parser=get_args_parser(), args=flags)
        elif flags.info is not None:
            compose(hydra, overrides)
            hydra.show_info(flags.info, CONFIG_NAME, overrides)
        elif flags.shell_completion:
            if not " ".join(overrides).startswith(("install=", "query=", "uninstall=")):
                raise CompositionError("-sc: expected install=SHELL or uninstall=SHELL alone.")
            hydra.shell_completion(CONFIG_NAME, overrides)
        elif flags.cfg:
            _show(hydra, flags, overrides)
        elif flags.multirun:
            return _sweep(hydra, overrides)
        else:
            return _run_one(hydra, overrides)
    return 0


def _show(hydra: Hydra, flags: Namespace, overrides: list[str]) -> None:
    """Check the values of a configuration and print it."""
    if flags.multirun:
        raise CompositionError("--cfg shows one configuration, and -m makes several. Leave -m out.")
    cfg = compose(hydra, overrides)
    to_config(cfg)
    if flags.package and OmegaConf.select(cfg, flags.package) is None:
        raise UnknownName("package", flags.package, [key for key, _ in list_items(cfg)])
    hydra.show_cfg(CONFIG_NAME, overrides, flags.cfg, flags.package, flags.resolve)


def _run_one(hydra: Hydra, overrides: list[str]) -> int:
    """Compose, check and run one job, perhaps as one of several ranks."""
    if not is_rank():
        cfg, checked = _compose_one(hydra, overrides)
        from mjstack.distributed import launch  # they load torch
        from mjstack.jobs import check_share, count_devices

        if (count := count_devices(checked.context.cfg)) > 1:
            _check_spreads(checked)
            check_share(checked.context.cfg, count)
            return launch([*overrides, *search_path_args()], count)
        return _run_checked(hydra, cfg, checked, overrides)
    from mjstack.distributed import joined
    from mjstack.jobs import check_ranks

    with joined() as ranks:
        problem = ""
        try:
            cfg, checked = ranks.alike(lambda: _compose_one(hydra, overrides))
            ranks.alike(lambda: _check_spreads(checked))
            ranks.alike(lambda: check_ranks(checked.context))
            return _run_checked(hydra, cfg, checked, overrides)
        except RankError:
            raise
        except Exception as error:
            problem = describe_error(error, "MJSTACK_DEBUG=1 shows the traceback")
            raise
        finally:
            ranks.end(problem)


def _compose_one(hydra: Hydra, overrides: list[str]) -> tuple[DictConfig, "CheckedJob"]:
    cfg = compose(hydra, overrides)
    if cfg.hydra.mode is RunMode.MULTIRUN:
        raise CompositionError("hydra.mode=MULTIRUN: expected RUN without -m. Replace it by -m.")
    return cfg, _check(cfg, overrides)


def _check_spreads(checked: "CheckedJob") -> None:
    if not checked.spreads:
        raise CompositionError(
            "torchrun, devices: expected a job whose worlds ranks share: gates, train, collect, or"
            " replay of world=failing. Run this job in one process."
        )


def _run_checked(hydra: Hydra, cfg: DictConfig, checked: "CheckedJob", overrides: list[str]) -> int:
    """Run a job in its folder; of several ranks the first one makes it, and alone writes."""
    ranks = checked.context.ranks
    given = _is_set("hydra.run.dir", overrides)
    resumed = None if given else checked.folder
    folder = resumed or _hydra_path(cfg, "run.dir")
    own = "" if given else checked.own
    begin_job()
    if not ranks.writes:
        global _assisting
        _assisting = True
        checked.assist(ranks.from_first(lambda: folder))
        return 0
    with ExitStack() as stack:
        claim = claim_folder(folder, checked.resumes, own, numbered=not (given or resumed))
        claimed = ranks.from_first(lambda: stack.enter_context(claim))
        cfg.hydra.run.dir = str(claimed)
        hydra.run(CONFIG_NAME, run_job, overrides)
    return max(result.exit_code for result in _results)


def _sweep(hydra: Hydra, overrides: list[str]) -> int:
    """Compose and check every job of a sweep, then run them."""
    if is_rank():
        raise CompositionError("torchrun: expected one job, and -m makes several. Leave one out.")
    jobs = _expand(overrides)
    refused = CompositionError(
        "hydra.sweeper.params: expected none. Give the values on the command line, as in"
        " -m nworld=1,2."
    )
    if jobs and any("hydra.sweeper.params" in override for override in overrides):
        raise refused
    overrides = [*overrides, "hydra.mode=MULTIRUN"]
    master = compose(hydra, overrides, RunMode.MULTIRUN)
    if jobs and OmegaConf.select(master, "hydra.sweeper.params"):
        raise refused
    folder = _hydra_path(master, "sweep.dir")
    numbers = _check_jobs(hydra, master, folder, jobs)
    begin_job()
    given = _is_set("hydra.sweep.dir", overrides)
    claim = claim_folder(folder, numbered=not given, key="hydra.sweep.dir")
    if "GpuLauncher" in str(OmegaConf.select(master, "hydra.launcher._target_")):
        from mjstack.jobs.sweep import SweepJob, find_slots, shared_sweep

        find_slots(OmegaConf.select(master, "hydra.launcher.jobs"))
        known = [SweepJob(number, one, tuple(jobs[number])) for one, number in numbers.items()]
        claim = shared_sweep(folder, known) if given else claim
    with claim as claimed:
        if claimed != folder:
            master.hydra.sweep.dir = str(claimed)
            master.hydra.overrides.hydra.append(f"hydra.sweep.dir={quoted(claimed)}")  # of its jobs
        try:
            returned = hydra.multirun(CONFIG_NAME, run_job, overrides)
            batches = returned if isinstance(returned, list) else []
            # A launcher's own processes return theirs.
            _results[:] = _results or [job.return_value for batch in batches for job in batch]
        finally:
            if _results:
                _print_sweep(claimed, len(jobs))
    return max(result.exit_code for result in _results)


def _check_jobs(
    hydra: Hydra, master: DictConfig, folder: Path, jobs: Sequence[list[str]]
) -> dict[Path, int]:
    """Compose and check every job, and return their numbers by their folders.

    Jobs of a sweeper other than Hydra's basic one are not known before; each is checked as it runs.
    """
    numbers: dict[Path, int] = {}
    for number, job in enumerate(jobs):
        cfg = compose(hydra, job, sweep=master)
        if cfg.devices is not None:
            raise ConfigError(
                "devices",
                cfg.devices,
                "null with -m",
                "Leave it out: with hydra/launcher=gpus each job has one GPU, and"
                " hydra.launcher.jobs is how many run at once",
            )
        _check(cfg, job)
        with open_dict(cfg):
            cfg.hydra.job.num = number
            cfg.hydra.job.id = str(number)
        one = Path(os.path.normpath(folder / _hydra_path(cfg, "sweep.subdir")))
        if not one.is_relative_to(folder):
            check_unused(one, key="hydra.sweep.subdir")
        if numbers.setdefault(one, number) != number:
            raise CompositionError(
                f"hydra.sweep.subdir: jobs {numbers[one]} and {number} would both write into {one},"
                " expected a folder for each job. Leave it out, or let it name what differs."
            )
    return numbers


def _print_help(hydra: Hydra, args: list[str]) -> None:
    """Print the help, or the keys below the ones among the arguments, as the overrides have
    them.
    """
    width = min(max(shutil.get_terminal_size((120, 24)).columns, 60), 120)
    keys = [arg for arg in args if "=" not in arg and not arg.startswith("~")]
    cfg = to_config(compose(hydra, [arg for arg in args if arg not in keys]))
    texts = [key_help(cfg, key, width) for key in keys] or [help_text(cfg, width)]
    print("\n".join(texts), flush=True)


def run_job(cfg: DictConfig) -> Report:
    """Run a job in the folder that Hydra made. A launcher may call it in another process, where
    nothing has been checked yet.
    """
    logging.raiseExceptions = False  # a full disk would print a traceback for each line of run.log
    own = HydraConfig.get()
    overrides = list(own.overrides.task)
    with search_path(lacking_folders(own.runtime.config_sources)):
        folder = Path(own.runtime.output_dir)
        if own.mode is RunMode.MULTIRUN and cfg.job.name == "gates":
            # A cluster may have started the job before.
            earlier = read_report(folder)
            if earlier is not None and earlier.status is Status.interrupted:
                cfg.resume = str(folder)
                _checked.clear()
                _save_config(cfg, folder)  # Hydra has just put one with interpolations there
        checked = _checked.pop(tuple(overrides), None) or _check(cfg, overrides)
        with suppress(OSError):  # the job says so
            _save_config(cfg, folder)
        result = checked.run(folder, overrides)
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

    own = own_overrides(overrides)
    checked = check_job(to_config(cfg), own)
    _checked[tuple(own)] = checked
    return checked


def _parse(args: list[str]) -> Namespace:
    """Hydra's reading of the flags, or a `CompositionError`."""

    def refuse(message: str) -> NoReturn:
        raise CompositionError(message)

    parser = get_args_parser()
    parser.error = refuse  # type: ignore[method-assign]
    known = set(parser._option_string_actions) - _OTHER_CONFIG
    for arg in args:
        if arg.startswith("-") and arg.partition("=")[0] not in known:
            raise CompositionError(
                f"flag '{arg}' does not exist. {suggest(arg, known)} Keys are set without dashes:"
                " nworld=64."
            )
    return parser.parse_intermixed_args(args)


def _expand(overrides: Sequence[str]) -> list[list[str]]:
    """The jobs of a sweep as Hydra's basic sweeper makes them; none for another sweeper."""
    if any(o.startswith("hydra/sweeper=") and o != "hydra/sweeper=basic" for o in overrides):
        return []
    parsed = [parse(override) for override in own_overrides(overrides)]
    try:
        batches = BasicSweeper.split_arguments(parsed, max_batch_size=None)
    except HydraException as error:  # a glob
        raise CompositionError(f"{' '.join(overrides)}: expected a list of values.") from error
    jobs = [list(job) for batch in batches for job in batch]
    if not jobs:
        raise CompositionError(f"{' '.join(overrides)}: has no jobs, expected at least one value.")
    return jobs


def _is_set(key: str, overrides: Sequence[str]) -> bool:
    return any(override.lstrip("+").startswith(f"{key}=") for override in overrides)


def _hydra_path(cfg: DictConfig, key: str) -> Path:
    """A path below ``hydra``, as Hydra will find it."""
    HydraConfig.instance().set_config(cfg)  # for what is interpolated
    OmegaConf.set_readonly(cfg.hydra, None)
    return Path(str(OmegaConf.select(cfg, f"hydra.{key}", throw_on_missing=True)))


def _print_sweep(folder: Path, count: int) -> None:
    """One row per job that has begun, also written beside the jobs as summary.md."""
    names = dict.fromkeys(gate.name for result in _results for gate in result.gates)
    columns = ["job", "overrides", *names, "status"]
    rows = [
        {gate.name: f"{gate.status}: {gate.reason}" for gate in result.gates}
        | {"job": str(job), "overrides": " ".join(result.overrides), "status": result.status}
        for job, result in enumerate(_results)
    ]
    jobs = max(count, len(rows))
    title = f"sweep of {jobs} job{'s' if jobs > 1 else ''}"
    table = Table.of({name: name for name in columns}, rows, title)
    Console().print(table.to_console())
    if len(rows) > 1:
        write_atomic(folder / "summary.md", "\n".join(table.to_markdown()) + "\n")
        Console(soft_wrap=True).print(f"summary: {folder}/summary.md")
