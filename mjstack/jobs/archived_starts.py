"""The starts files that a run starts from, kept in its folder byte for byte: the run and its
replays read these.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from mjstack.config.check import reads_starts_file
from mjstack.config.schema import Config, TermCfg
from mjstack.errors import ConfigError, RunError
from mjstack.files import write_atomic

STEM = "starts_played"
_COPY = re.compile(
    rf"{STEM}(_[0-9]+)?\.csv"
)  # not a file of the user's, such as starts_played_backup.csv


def archive_starts(cfg: Config, folder: Path) -> Config:
    """Copies every starts file that worlds start from, and has the run read the copies, whatever
    becomes of the files.

    Args:
        cfg: The run's configuration.
        folder: The run's folder. Copies that an earlier run left in it go.

    Returns:
        The configuration with the copies as its terms' files.

    Raises:
        ConfigError: A file cannot be read.
        OSError: A copy cannot be written.
    """
    names = copy_names(cfg)
    contents = {
        name: _read(cfg, path) for path, name in names.items()
    }  # first, because a file may be an earlier copy
    sources = {Path(path).resolve() for path in names}
    for path in folder.glob(f"{STEM}*.csv"):
        if _COPY.fullmatch(path.name) and path.resolve() not in sources:
            path.unlink()
    for name, content in contents.items():
        write_atomic(folder / name, content)
    return _from_copies(cfg, folder, names)


def archived_starts(cfg: Config, folder: Path) -> Config:
    """An earlier run's configuration, with the copies in its folder as its terms' files.

    Raises:
        RunError: A copy is missing.
    """
    names = copy_names(cfg)
    for path, name in names.items():
        if not (folder / name).is_file():
            raise RunError(
                f"run={folder}: has no {name}, expected a copy of the starts file that it started"
                f" from, {path}. Put one there, unchanged."
            )
    return _from_copies(cfg, folder.resolve(), names)


def copy_names(cfg: Config) -> dict[str, str]:
    """The name of the copy of each file that worlds of a gate start from. Empty if they start
    otherwise.
    """
    own = (
        cfg.gate.success.reset if "success" in cfg.gates else {}
    )  # which that gate has where the others read no file
    reset = cfg.reset if reads_starts_file(cfg.reset) else own
    paths = dict.fromkeys(path for term in reset.values() if (path := _path(term)) is not None)
    return {
        path: f"{STEM}{'' if number == 1 else f'_{number}'}.csv"
        for number, path in enumerate(paths, start=1)
    }


def _path(term: TermCfg) -> str | None:
    return term.params.get("path") if reads_starts_file({"": term}) else None


def _read(cfg: Config, path: str) -> bytes:
    try:
        return Path(path).read_bytes()
    except OSError as error:
        key = "starts" if path == cfg.starts else "path"
        raise ConfigError(key, path, f"a file that can be read ({error.strerror})") from error


def _from_copies(cfg: Config, folder: Path, names: Mapping[str, str]) -> Config:
    def swap(reset: Mapping[str, TermCfg]) -> dict[str, TermCfg]:
        out = dict(reset)
        for name, term in reset.items():
            if (path := _path(term)) in names:
                assert path is not None
                out[name] = replace(term, params=term.params | {"path": str(folder / names[path])})
        return out

    success = replace(cfg.gate.success, reset=swap(cfg.gate.success.reset))
    return replace(cfg, reset=swap(cfg.reset), gate=replace(cfg.gate, success=success))
