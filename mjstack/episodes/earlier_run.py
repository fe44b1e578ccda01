"""The folder of an earlier run: its configuration, report, records, and copies of starts files."""

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mjstack.config.check import reads_starts_file
from mjstack.config.load import load_saved
from mjstack.config.schema import Config, TermCfg
from mjstack.config.session import read_yaml
from mjstack.episodes.record import EpisodeRecord
from mjstack.errors import MjstackError, RunError
from mjstack.files import reading, write_atomic

REPORT = "report.json"
STEM = "starts_played"


@dataclass(frozen=True, kw_only=True, slots=True)
class EarlierRun:
    """A run of job=gates, finished or not.

    Attributes:
        folder: Where it is.
        cfg: Its whole configuration.
        provenance: Its report's: versions, device, hashes.
    """

    folder: Path
    cfg: Config
    provenance: dict[str, Any]

    @classmethod
    def read(cls, name: str, key: str = "run") -> "EarlierRun":
        """Read a run's folder, which a configuration key names.

        Raises:
            RunError: There is no such run; the message says what is missing.
        """
        folder = Path(name)
        saved = folder / ".hydra" / "config.yaml"
        report = folder / REPORT
        for path in (saved, report):
            if not path.is_file():
                raise RunError(
                    f"{key}={name}: has no {path.relative_to(folder)}, expected the folder of a"
                    " run, such as outputs/2026-11-21/04-02-05 (of a sweep: one of its jobs'). Name"
                    " another folder."
                )
        job = _named_job(saved)  # before the rest, which has keys of that job alone
        if job not in (None, "gates"):
            raise RunError(
                f"{key}={name}: is a run of job={job}, expected one of job=gates. Name that run's"
                " folder."
            )
        try:
            cfg = load_saved(saved)
        except MjstackError as error:
            raise RunError(
                f"{key}={name}: .hydra/config.yaml is no configuration of this mjstack: {error}"
            ) from error
        with reading(report, RunError, "Name another folder"):
            provenance = dict(json.loads(report.read_text())["provenance"])
            provenance["versions"] = dict(provenance["versions"])
        return cls(folder=folder, cfg=cfg, provenance=provenance)

    def record(self, seed: int, gate: str) -> EpisodeRecord:
        """The record of a gate under a seed.

        Raises:
            RunError: The gate did not get there, or the record cannot be read or is of another
                number of worlds.
        """
        record = EpisodeRecord.read(self.folder, seed, gate)
        found = "no record" if record is None else f"a record of {len(record.failed)} worlds"
        if record is None or len(record.failed) != self.cfg.nworld:
            raise RunError(
                f"run={self.folder}: gate {gate} has left {found} of seed {seed}, expected one of"
                f" {self.cfg.nworld} worlds. Run that gate again."
            )
        return record


def archive_starts(cfg: Config, folder: Path) -> Config:
    """Copy every starts file that worlds start from, byte for byte, for the run and its replays.

    Args:
        cfg: The run's configuration.
        folder: The run's folder.

    Returns:
        The configuration with the copies as its terms' files.

    Raises:
        OSError: A file cannot be read, or a copy cannot be written.
    """
    names = copy_names(cfg)
    for path, name in names.items():
        write_atomic(folder / name, Path(path).read_bytes())
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
    """The name of the copy of each file that worlds of a gate start from; empty if none does."""
    reset = cfg.reset
    if "success" in cfg.gates and not reads_starts_file(reset):
        reset = cfg.gate.success.reset
    files = [term.params.get("path") for term in reset.values() if reads_starts_file({"": term})]
    paths = dict.fromkeys(path for path in files if path is not None)
    return {path: f"{STEM}{f'_{n}' if n > 1 else ''}.csv" for n, path in enumerate(paths, 1)}


def _from_copies(cfg: Config, folder: Path, names: Mapping[str, str]) -> Config:
    def swap(reset: Mapping[str, TermCfg]) -> dict[str, TermCfg]:
        out = dict(reset)
        for key, term in reset.items():
            if (name := names.get(term.params.get("path", ""))) is not None:
                out[key] = replace(term, params=term.params | {"path": str(folder / name)})
        return out

    success = replace(cfg.gate.success, reset=swap(cfg.gate.success.reset))
    return replace(cfg, reset=swap(cfg.reset), gate=replace(cfg.gate, success=success))


def _named_job(saved: Path) -> str | None:
    """The job of a saved configuration; None if the file does not name one."""
    with suppress(Exception):  # `load_saved` says what is wrong with it
        return str(read_yaml(saved)["job"]["name"]).partition("\n")[0]
    return None
