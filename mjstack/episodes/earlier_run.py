"""The folder of an earlier run: its configuration, report and records, and its starts file."""

from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mjstack.config.check import gate_reset, reads_starts_file
from mjstack.config.load import load_saved
from mjstack.config.schema import Config
from mjstack.config.session import read_yaml
from mjstack.episodes.record import EpisodeRecord
from mjstack.errors import FolderError, MjstackError
from mjstack.files import made_by, read_json, reading, write_atomic

REPORT = "report.json"


@dataclass(frozen=True, kw_only=True)
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
    def read(cls, name: str) -> "EarlierRun":
        """Read a run's folder.

        Raises:
            FolderError: There is no such run; the message says what is missing.
        """
        folder = Path(name)
        saved = folder / ".hydra" / "config.yaml"
        report = folder / REPORT
        for path in (saved, report):
            if not path.is_file():
                raise FolderError(
                    f"run={name}: has no {path.relative_to(folder)}, expected the folder of a"
                    " run, such as outputs/2026-11-21/04-02-05 (of a sweep: one of its jobs'). Name"
                    " another folder."
                )
        job = "gates"
        with suppress(Exception):  # `load_saved` says what is wrong with it
            job = str(read_yaml(saved)["job"]["name"]).partition("\n")[0]
        if job != "gates":  # before the rest, which has keys of that job alone
            problem = f"run={name}: is a run of job={job}, expected one of job=gates"
            raise FolderError(problem, "Name that run's folder")
        try:
            cfg = load_saved(saved)
        except MjstackError as error:
            keys = "ConfigKeyError" in str(error) or " is missing" in str(error)
            fix = "A run of another version is replayed by that version" if keys else ""
            raise FolderError(f"run={name}{made_by(folder)}: {error}", fix) from error
        with reading(report, "Name another folder"):
            provenance = dict(read_json(report, "provenance"))
            provenance["versions"] = dict(provenance["versions"])
        return cls(folder=folder, cfg=cfg, provenance=provenance)

    def record(self, seed: int, gate: str) -> EpisodeRecord:
        """The record of a gate under a seed.

        Raises:
            FolderError: The gate did not get there, or the record cannot be read or is of another
                number of worlds.
        """
        record = EpisodeRecord.read(self.folder, seed, gate)
        left = "no record" if record is None else f"a record of {len(record.failed)} worlds"
        if record is None or len(record.failed) != self.cfg.nworld:
            raise FolderError(
                f"run={self.folder}: gate {gate} has left {left} of seed {seed}, expected one of"
                f" {self.cfg.nworld} worlds. Run that gate again."
            )
        return record


def archive_starts(cfg: Config, folder: Path) -> Config:
    """Copy the starts files that worlds of gates start from into a run's folder, byte for byte, for
    the run and its replays, and return the configuration with the copies as the files of its terms.

    Raises:
        OSError: A file cannot be read, or a copy cannot be written.
    """
    for path, copy in _copies(cfg, folder).items():
        write_atomic(copy, Path(path).read_bytes())
    return archived_starts(cfg, folder)


def archived_starts(cfg: Config, folder: Path) -> Config:
    """A run's configuration, with the copies in its folder as the files of its terms.

    Raises:
        FolderError: A copy is missing.
    """
    copies = _copies(cfg, folder)
    for path, copy in copies.items():
        if not copy.is_file():
            raise FolderError(
                f"run={folder}: has no {copy.name}, expected a copy of the starts file that it"
                f" started from, {path}. Put one there, unchanged."
            )

    cfg = deepcopy(cfg)
    for reset in (cfg.reset, *(gate.reset for gate in cfg.gate.episodes().values())):
        for term in reset.values():
            if term.params.get("path") in copies:
                term.params["path"] = str(copies[term.params["path"]])
    return cfg


def _copies(cfg: Config, folder: Path) -> dict[str, Path]:
    """Copies of the starts files from which gates play, by the path of each file."""
    resets = [cfg.reset, *(gate_reset(cfg, gate) for gate in cfg.episode_gates)]
    terms = [term for reset in resets for term in reset.values() if reads_starts_file({"": term})]
    paths = dict.fromkeys(path for term in terms if (path := term.params["path"]))
    numbers = ["", *(f"_{number}" for number in range(2, len(paths) + 1))]
    names = [f"starts_played{number}.npz" for number in numbers]
    return {path: folder.resolve() / name for path, name in zip(paths, names, strict=False)}
