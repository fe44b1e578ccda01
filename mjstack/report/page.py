"""The data of a run's page: its parts fill it in as they go, and the page's writers read it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from mjstack.report.figure import Figure

MOST_WORLDS = 64  # in motion, of a page


@dataclass(kw_only=True, slots=True)
class Map:
    """Where an object or a place was at the starts, and an object went, seen from above.

    Attributes:
        title: Its name.
        xy: Positions [m], shape ``(n, 2)``.
        table: Centre and half size of the table in x and y [m].
        ways: Its ways in some episodes: a label, whether that failed, and positions [m], shape
            ``(frames, 2)``.
        marks: Positions [m] of what is the same in every episode, by name.
        base: Position of the arm's base [m].
    """

    title: str
    xy: np.ndarray
    table: tuple[Sequence[float], Sequence[float]]
    ways: Sequence[tuple[str, bool, np.ndarray]] = ()
    marks: Mapping[str, Sequence[float]] = field(default_factory=dict)
    base: Sequence[float] = (0.0, 0.0)


@dataclass(kw_only=True, slots=True)
class Worlds:
    """The episodes of a gate, for plots.

    Attributes:
        names: Of the episodes, as ``world=`` of job=replay takes them.
        broken: The rules that each episode broke; empty where it succeeded.
        rules: The rules in words, by name.
        values: Measured values, each of shape ``(n,)``, and their figures.
        maps: Where judged objects, moved bodies and drawn places were.
        unjudged: Names of objects that have no map, because the task's check does not read them.
    """

    names: Sequence[str]
    broken: Sequence[Sequence[str]]
    rules: Mapping[str, str]
    values: Sequence[tuple[Figure, np.ndarray]]
    maps: list[Map] = field(default_factory=list)
    unjudged: list[str] = field(default_factory=list)


@dataclass(frozen=True, kw_only=True)
class World:
    """A world in motion.

    Attributes:
        label: Its text, short.
        qpos: Positions at frames, shape ``(frames, nq)``; NaN where it was not played.
        rules: Names of the rules that it broke; the first one colours its table.
        fields: Its model fields that pictures show, those of the model with visuals, by name.
    """

    label: str
    qpos: np.ndarray
    rules: Sequence[str] = ()
    fields: Mapping[str, np.ndarray] = field(default_factory=dict)

    @property
    def caption(self) -> str:
        """Label and broken rules."""
        return ": ".join(filter(None, (self.label, " ".join(self.rules))))


@dataclass(kw_only=True, slots=True)
class Page:
    """Motion that a run shows besides its report.

    Attributes:
        title: Robot and task.
        command: The command that runs it again.
        motion: Whether it shows worlds in motion.
        worlds: Episodes by gate.
        worlds3d: Worlds in motion, by the part of the run that played them.
        pictures: Files that parts of the run have drawn.
        episode: Name of the file with the episode in 3-D; empty without one.
        notes: What it does not show, and why.
    """

    title: str = "mjstack run"
    command: str = ""
    motion: bool = False
    worlds: dict[str, Worlds] = field(default_factory=dict)
    worlds3d: dict[str, list[World]] = field(default_factory=dict)
    pictures: list[str] = field(default_factory=list)
    episode: str = ""
    notes: list[str] = field(default_factory=list)


def frame_stride(step_dt: float, rate: float = 25.0) -> int:
    """Control steps per frame of worlds in motion, at a rate of frames [Hz] that is as near as
    whole steps of ``step_dt`` [s] allow.
    """
    return max(1, round(1.0 / (rate * step_dt)))
