"""Names in a saved run's configuration: what may be imported on its word."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from mjstack.config.session import PROVIDER, is_trusted
from mjstack.errors import CompositionError


def check_trusted(cfg: DictConfig, saved: Path) -> None:
    """Check that every function that a saved configuration names is in the current search path.

    Args:
        cfg: The configuration of an earlier run.
        saved: The folder that Hydra left in that run's.

    Raises:
        CompositionError: A function is elsewhere; names it, and the folder that the run had used.
    """
    for key, name in _functions("", OmegaConf.to_container(cfg, resolve=False)):
        if not is_trusted(name):
            raise CompositionError(
                f"{key}={name}: expected a name of mjstack, of a package registered under"
                f" mjstack.configs, or beside a folder of the search path. {used_folder(saved)}"
            )


def used_folder(saved: Path) -> str:
    """What to do about a name or a file that only the search path of an earlier run has."""
    used = _used_folders(saved)
    had = f"used --config-dir {used[0]}" if used else "had no --config-dir"
    return f"The run {had}: if you trust it, add --config-dir DIR."


def _functions(prefix: str, node: object) -> Iterator[tuple[str, str]]:
    """Every dotted name that terms, checks and gates would import, with its key."""
    items = node.items() if isinstance(node, Mapping) else ()
    for name, value in items:
        key = f"{prefix}{name}"
        if name == "func" and isinstance(value, str):
            yield key, value
        yield from _functions(f"{key}.", value)


def _used_folders(saved: Path) -> list[str]:
    """Search-path entries of the run that left a folder; for messages alone."""
    try:
        runtime = OmegaConf.select(OmegaConf.load(saved / "hydra.yaml"), "hydra.runtime")
        return [str(s.path) for s in runtime.config_sources if s.provider == PROVIDER]
    except Exception:  # the file may be anything
        return []
