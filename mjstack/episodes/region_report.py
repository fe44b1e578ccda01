"""Start regions of failing episodes, as a table, a file and a picture."""

from __future__ import annotations

import logging
from dataclasses import asdict, fields

import numpy as np

from mjstack.config.schema import Config
from mjstack.episodes.context import RunContext
from mjstack.episodes.record import PICTURE, REGIONS
from mjstack.episodes.regions import Region
from mjstack.episodes.tally import EpisodeTally, rate_cells
from mjstack.files import to_csv, write_atomic
from mjstack.report.success import save_places
from mjstack.report.table import Table
from mjstack.report.write import safely_draw

log = logging.getLogger(__name__)


def regions_table(cfg: Config, regions: list[Region]) -> list[Table]:
    """The regions with the lowest rates; no table where none has a failure."""
    t = cfg.gate.success
    failing = [r for r in regions if r.succeeded < r.episodes]
    if not failing:
        return []
    shown = failing[: t.worst_regions]
    rows = [
        [r.where, str(r.episodes), str(r.succeeded), *rate_cells(r.succeeded, r.episodes)]
        for r in shown
    ]
    title = (
        f"Worst regions of at least {t.cell_episodes} episodes ({len(shown)} of {len(failing)} with"
        " a failure)"
    )
    header = ["where the object started", "episodes", "succeeded", "rate", "95 % interval"]
    return [Table(title=title, header=header, rows=rows)]


def save_regions(
    context: RunContext, regions: list[Region], starts: np.ndarray, tally: EpisodeTally
) -> list[str]:
    """Write the table of regions and the picture of all starts. A failure takes no result back.

    Returns:
        The files that could not be written, a line each.
    """
    folder = context.folder
    assert folder is not None
    lost = []
    try:
        rows = to_csv([asdict(region) for region in regions], [f.name for f in fields(Region)])
        write_atomic(folder / REGIONS, rows)
    except OSError as error:
        log.exception("%s was not written", REGIONS)
        lost.append(f"{REGIONS} could not be written ({error.strerror})")
    scene = context.cfg.scene
    table = (scene.table_center[:2], scene.table_half[:2])
    title = f"{context.cfg.robot.title}: {tally.summary}"
    colors = {name: thing.color for name, thing in scene.free.items()}
    succeeded = np.concatenate(tally.succeeded)
    problem = safely_draw(folder / PICTURE, save_places, starts, succeeded, table, title, colors)
    if problem:
        return [*lost, problem]
    context.artifacts.pictures.append(PICTURE)
    return lost
