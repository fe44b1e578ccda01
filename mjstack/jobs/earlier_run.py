"""What an earlier run left in its folder: its configuration, its report, and its batch's worlds."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from mjstack.config.load import load_saved
from mjstack.config.schema import Config
from mjstack.episodes.record import EpisodeRecord
from mjstack.errors import MjstackError, RunError


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
    def read(cls, name: str) -> EarlierRun:
        """Reads a run's folder.

        Raises:
            RunError: There is no such run; the message says what is missing.
        """
        folder = Path(name)
        expected = (
            "expected the folder of a run, such as outputs/2026-11-21/04-02-05 (of a sweep: one of"
            " its jobs')"
        )
        if not folder.is_dir():
            raise RunError(f"run={name}: no such folder, {expected}. Name an existing one.")
        saved = folder / ".hydra" / "config.yaml"
        report = folder / "report.json"
        for path in (saved, report):
            if not path.is_file():
                raise RunError(
                    f"run={name}: has no {path.relative_to(folder)}, {expected}. Name another"
                    " folder."
                )
        try:
            job = OmegaConf.select(OmegaConf.load(saved), "job.name")
        except Exception:  # what is wrong with the file, `load_saved` says
            job = None
        if job not in (None, "gates"):
            raise RunError(
                f"run={name}: is a run of job={job}, expected one of job=gates. Name that run's"
                " folder."
            )
        try:
            cfg = load_saved(saved)
        except MjstackError as error:
            raise RunError(
                f"run={name}: .hydra/config.yaml is no configuration of this mjstack: {error} Use"
                " the one that ran it."
            ) from error
        try:
            provenance = json.loads(report.read_text())["provenance"]
            if not isinstance(provenance, dict):
                raise TypeError(provenance)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise RunError(
                f"run={name}: report.json cannot be read ({type(error).__name__}), expected"
                " mjstack's. Name another folder."
            ) from error
        return cls(folder=folder, cfg=cfg, provenance=provenance)

    def record(self, seed: int, gate: str) -> EpisodeRecord | None:
        """The record of a gate under a seed; None if the gate did not get there.

        Raises:
            RunError: The record cannot be read, or is not this run's.
        """
        record = EpisodeRecord.read(self.folder, seed, gate)
        if record is not None and (record.seed != seed or len(record.failed) != self.cfg.nworld):
            raise RunError(
                f"run={self.folder}: the record of seed {seed} has {len(record.failed)} worlds of"
                f" seed {record.seed}, expected {self.cfg.nworld}, the run's nworld. Run that gate"
                " again."
            )
        return record
