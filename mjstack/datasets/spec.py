"""What a dataset holds, and what one episode brings: names, units and types, checked before
anything is written.
"""

from __future__ import annotations

import json
import numbers
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mjstack.errors import ArgumentError, DatasetError, suggest

DTYPES = ("float32", "float64", "int32", "int64", "bool")
# What a value of an episode may be, and what it is kept as.
VALUE_DTYPES: dict[str, tuple[tuple[type, ...], Callable[[Any], Any]]] = {
    "float64": ((numbers.Real,), float),
    "int64": ((numbers.Integral,), int),
    "bool": ((bool, np.bool_), bool),
    "string": ((str,), str),
}
# What the writer itself adds to every frame, with its type; LeRobot expects these names.
INDICES = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
# Columns that every episode's row has; LeRobot's own, then ours.
EPISODE_COLUMNS = (
    "episode_index",
    "tasks",
    "length",
    "dataset_from_index",
    "dataset_to_index",
    "success",
    "seed",
    "world",
)


@dataclass(frozen=True, kw_only=True, slots=True)
class Feature:
    """One column of the frames: a vector of named numbers.

    Attributes:
        dtype: One of `DTYPES`.
        names: A name for each number, such as ``shoulder_pan.pos``.
        units: A unit for each number, such as ``rad``; ``1`` where there is none.
    """

    dtype: str
    names: tuple[str, ...]
    units: tuple[str, ...]

    @property
    def dim(self) -> int:
        """How many numbers a frame has."""
        return len(self.names)


@dataclass(frozen=True, kw_only=True, slots=True)
class DatasetSpec:
    """What is the same for all episodes of a dataset.

    Attributes:
        robot_type: The robot, such as ``so101``.
        fps: Frames per second of simulated time [Hz].
        features: Columns of the frames by name. LeRobot reads ``observation.state``,
            ``observation.environment_state``, ``action``, ``next.reward``, ``next.done`` and
            ``next.success`` by these names; others are kept as they are.
        config_sha256: Hash of what the episodes depend on. A dataset is gone on with under the same
            hash only.
        values: What each episode brings beside success, seed and world, by name, as one of
            `VALUE_DTYPES`.
        provenance: What else is to be known of this call's episodes, such as seed and versions, in
            JSON's types.
    """

    robot_type: str
    fps: int
    features: Mapping[str, Feature]
    config_sha256: str
    values: Mapping[str, str] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if isinstance(self.fps, bool) or not isinstance(self.fps, int) or self.fps < 1:
            raise ArgumentError("fps", self.fps, "a whole number of frames per second, at least 1")
        if not self.features:
            raise ArgumentError("features", "none", "at least one")
        for name, feature in self.features.items():
            _check_feature(name, feature)
        for name, dtype in self.values.items():
            label = f"values['{name}']"
            if not re.fullmatch(r"[A-Za-z_]\w*", name) or name in EPISODE_COLUMNS:
                raise ArgumentError(
                    label,
                    name,
                    f"a name of letters, digits and _ other than {', '.join(EPISODE_COLUMNS)}",
                )
            if dtype not in VALUE_DTYPES:
                raise ArgumentError(label, dtype, f"one of {', '.join(VALUE_DTYPES)}")
        try:
            json.dumps(dict(self.provenance), allow_nan=False)
        except (TypeError, ValueError) as error:
            raise ArgumentError("provenance", error, "what JSON can hold") from error


@dataclass(eq=False, kw_only=True, slots=True)
class EpisodeData:
    """One finished episode. The writer has copied all of it when `add` returns, so the arrays may
    be used again.

    Attributes:
        arrays: The frames by feature, each ``(frames, dim)``, or ``(frames,)`` where dim is 1.
        task: What was to be done, in words.
        success: Whether it was.
        seed: The seed it was played with.
        world: The world it was played in.
        values: What else is to be kept of it, by the names of `DatasetSpec.values`.
    """

    arrays: Mapping[str, np.ndarray]
    task: str
    success: bool
    seed: int
    world: int
    values: Mapping[str, float | int | bool | str] = field(default_factory=dict)


def typed_arrays(spec: DatasetSpec, episode: EpisodeData) -> dict[str, np.ndarray]:
    """The episode's frames in the dataset's types, each ``(frames, dim)``, in the order of the
    features.

    Raises:
        DatasetError: A feature is missing, unknown, of another shape or type, or not finite.
    """
    where = f"episode of seed {episode.seed}, world {episode.world}"
    _check_names(where, "feature", episode.arrays, spec.features)
    frames = None
    typed = {}
    for name, feature in spec.features.items():
        array = np.asarray(episode.arrays[name])
        rows = array[:, None] if array.ndim == 1 and feature.dim == 1 else array
        expected = f"({'frames' if frames is None else frames}, {feature.dim})"
        if (
            rows.ndim != 2
            or rows.shape[1] != feature.dim
            or len(rows) == 0
            or frames not in (None, len(rows))
        ):
            raise DatasetError(
                f"{where}: {name} has shape {array.shape}, expected {expected}. Give every frame's"
                f" {name}"
            )
        frames = len(rows)
        if not np.can_cast(rows.dtype, feature.dtype, "same_kind"):
            raise DatasetError(
                f"{where}: {name} is {rows.dtype}, expected {feature.dtype}. Convert it, or change"
                " the feature"
            )
        with np.errstate(over="ignore"):
            typed[name] = np.ascontiguousarray(rows, dtype=feature.dtype)
        if feature.dtype.startswith("int") and not np.array_equal(typed[name], rows):
            raise DatasetError(
                f"{where}: {name} has numbers too large for {feature.dtype}, expected its range."
                " Use int64"
            )
        bad = np.flatnonzero(~np.isfinite(typed[name]).all(axis=1))
        if len(bad):
            raise DatasetError(
                f"{where}: {name} is not finite in {len(bad)} of {frames} frames (first: {bad[0]}),"
                f" expected finite {feature.dtype}. Leave the episode out"
            )
    return typed


def typed_row(spec: DatasetSpec, episode: EpisodeData) -> dict[str, Any]:
    """The columns that an episode brings to its row, in the dataset's types.

    Raises:
        DatasetError: A value is missing, unknown or of another type.
    """
    where = f"episode of seed {episode.seed}, world {episode.world}"
    _check_names(where, "value", episode.values, spec.values)
    if not episode.task.strip():
        raise DatasetError(
            f"{where}: found an empty task, expected its text. Give EpisodeData.task"
        )
    row: dict[str, Any] = {"tasks": [episode.task]}
    own: dict[str, tuple[str, Any]] = {
        "success": ("bool", episode.success),
        "seed": ("int64", episode.seed),
        "world": ("int64", episode.world),
    }
    for name, (dtype, value) in (
        own | {k: (dtype, episode.values[k]) for k, dtype in spec.values.items()}
    ).items():
        kinds, convert = VALUE_DTYPES[dtype]
        fits = isinstance(value, kinds) and (dtype == "bool" or not isinstance(value, bool))
        if not fits or (dtype == "int64" and not -(2**63) <= value < 2**63):
            raise DatasetError(
                f"{where}: {name} is {value!r}, expected {dtype}. Convert it, or change the"
                " DatasetSpec"
            )
        row[name] = convert(value)
    return row


def _check_feature(name: str, feature: Feature) -> None:
    label = f"features['{name}']"
    if not name or "/" in name or name in INDICES:
        raise ArgumentError(
            label,
            repr(name),
            f"a name without / other than {', '.join(INDICES)}, which the writer adds",
        )
    if feature.dtype not in DTYPES:
        raise ArgumentError(f"{label}.dtype", feature.dtype, f"one of {', '.join(DTYPES)}")
    if not feature.names or len(set(feature.names)) != len(feature.names):
        raise ArgumentError(
            f"{label}.names", list(feature.names), "at least one name, and each once"
        )
    if len(feature.units) != feature.dim:
        raise ArgumentError(
            f"{label}.units", list(feature.units), f"{feature.dim} units, one for each name"
        )


def _check_names(
    where: str, what: str, found: Mapping[str, Any], expected: Mapping[str, Any]
) -> None:
    for name in found.keys() - expected.keys():
        raise DatasetError(
            f"{where}: {what} '{name}' is not in the DatasetSpec."
            f" {suggest(name, expected).rstrip('.')}"
        )
    missing = [name for name in expected if name not in found]
    if missing:
        raise DatasetError(
            f"{where}: no {what} '{missing[0]}', expected {', '.join(expected)}. Give it, or change"
            " the DatasetSpec"
        )
