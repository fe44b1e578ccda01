"""Sweeps: composes and checks their jobs, claims their folder, and shows their table."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from mjstack.config.explain import assign, own_overrides, parse
from mjstack.config.load import compose
from mjstack.errors import ConfigError, MjstackError, is_out_of_memory
from mjstack.files import claim_folder
from mjstack.report.record import Report
from mjstack.report.table import Console


def expand(master: DictConfig, overrides: Sequence[str]) -> list[list[str]]:
    """The jobs of a sweep as Hydra's basic sweeper makes them."""
    params = OmegaConf.select(master, "hydra.sweeper.params") or {}
    texts = [*(f"{key}={value}" for key, value in params.items()), *own_overrides(overrides)]
    parsed = list(map(parse, texts))
    if any(
        override.is_sweep_override() and not override.is_discrete_sweep() for override in parsed
    ):
        raise MjstackError(f"{' '.join(overrides)}: expected a list of values.")
    (jobs,) = BasicSweeper.split_arguments(parsed, None)
    if not jobs:
        raise MjstackError(f"{' '.join(overrides)}: has no jobs, expected at least one value.")
    return jobs


def check_jobs(
    master: DictConfig, jobs: Sequence[list[str]], check: Callable[[DictConfig, list[str]], object]
) -> None:
    """Compose and check every job of a sweep.

    Of jobs in processes of their own, one that needs more memory than there is stops no other.
    """
    folder = hydra_path(master, "sweep.dir")
    separate = not _launcher(master).endswith(".BasicLauncher")
    of_hydra = list(master.hydra.overrides.hydra)
    for job in jobs:
        cfg = compose([*of_hydra, assign("hydra.sweep.dir", folder), *job])
        if cfg.devices is not None:
            fix = "Leave it out: with hydra/launcher=gpus each job has one GPU"
            raise ConfigError("devices", cfg.devices, "null with -m", fix)
        try:
            check(cfg, job)
        except MjstackError as error:
            if not (separate and is_out_of_memory(str(error))):
                raise


def _launcher(master: DictConfig) -> str:
    """The class that launches the jobs of a sweep."""
    return str(OmegaConf.select(master, "hydra.launcher._target_"))


@contextmanager
def claim_sweep(master: DictConfig, jobs: Sequence[list[str]]) -> Iterator[Path]:
    """A sweep's folder, with the list of its jobs: a new one by the hour, or one in which the same
    command goes on.
    """
    from mjstack.jobs.sweep import SWEEP, Queueing, add_jobs, number_jobs

    folder = hydra_path(master, "sweep.dir")
    if _launcher(master).endswith(".GpuLauncher"):
        Queueing.from_launcher(master.hydra.launcher).gpus()
    hourly = "${now:" in OmegaConf.to_yaml(master.hydra.sweep)
    marker = "" if hourly else SWEEP
    key = "hydra.sweep.dir"
    with claim_folder(folder, marker=marker, numbered=hourly, key=key) as claimed:
        master.hydra.sweep.dir = str(claimed)
        master.hydra.overrides.hydra.append(assign("hydra.sweep.dir", claimed))  # of its jobs
        add_jobs(claimed, number_jobs(claimed, jobs))
        yield claimed


def hydra_path(cfg: DictConfig, key: str) -> Path:
    """A path below ``hydra``, as Hydra will find it."""
    HydraConfig.instance().set_config(cfg)  # for what is interpolated
    OmegaConf.set_readonly(cfg.hydra, None)
    return Path(str(OmegaConf.select(cfg, f"hydra.{key}", throw_on_missing=True)))


def print_sweep(folder: Path, reports: dict[int, Report]) -> None:
    """Write and print the table of a sweep: a row for each job."""
    from mjstack.jobs.sweep_table import write_summary

    console = Console(soft_wrap=True)
    table, problem = write_summary(folder, reports, draw=True)
    Console().print(table.to_console())
    if problem:
        console.print(problem)
    console.print(f"summary: {folder}/summary.md")
