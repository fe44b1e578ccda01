"""Content of a dataset and of one episode: names, units and types, checked before writing."""

import numbers
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mjstack.errors import ArgumentError, FolderError

CODECS = ("h264", "av1")
DTYPES = ("float32", "float64", "int32", "int64", "bool")
# Accepted types of an episode's values, and the type that is kept.
VALUE_DTYPES: dict[str, tuple[Any, type]] = {
    "float64": (numbers.Real, float),
    "int64": (numbers.Integral, int),
    "bool": (bool | np.bool_, bool),
    "string": (str, str),
}
# Columns that the writer itself adds to every frame, with their types; LeRobot expects these names.
INDICES = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
OWN_VALUES = {"success": "bool", "seed": "int64", "world": "int64"}  # of every episode's row


@dataclass(frozen=True)
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


@dataclass(frozen=True, kw_only=True)
class Video:
    """A camera's images, which each frame has one of. They are kept as videos.

    Attributes:
        height: Pixels, an even number.
        width: Pixels, an even number.
        codec: One of `CODECS`.
    """

    height: int
    width: int
    codec: str = "h264"


@dataclass(frozen=True, kw_only=True)
class DatasetSpec:
    """Everything that all episodes of a dataset share.

    Attributes:
        robot_type: The robot, such as ``so101``.
        fps: Frames per second of simulated time [Hz].
        features: Columns of the frames by name. LeRobot reads ``observation.state``,
            ``observation.environment_state``, ``action``, ``next.reward``, ``next.done`` and
            ``next.success`` by these names; others are kept as they are.
        config_sha256: Hash of what the episodes depend on. A dataset is gone on with under the same
            hash only.
        videos: Images by name, such as ``observation.images.front``.
        values: Values that each episode has beside success, seed and world, by name, as one of
            `VALUE_DTYPES`.
        provenance: Other facts about this call's episodes, such as seed and versions, in
            JSON's types.
    """

    robot_type: str
    fps: int
    features: Mapping[str, Feature]
    config_sha256: str
    videos: Mapping[str, Video] = field(default_factory=dict)
    values: Mapping[str, str] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not isinstance(self.fps, int) or self.fps < 1:
            raise ArgumentError("fps", self.fps, "a whole number of frames per second, at least 1")
        names = [*INDICES, *self.features, *self.videos]
        for name in names[len(INDICES) :]:
            if "/" in name or names.count(name) > 1:
                expected = f"a name without / that is not another column's or {', '.join(INDICES)}"
                raise ArgumentError("columns", name, expected)
        for name, feature in self.features.items():
            label = f"features['{name}']"
            if feature.dtype not in DTYPES:
                raise ArgumentError(f"{label}.dtype", feature.dtype, f"one of {', '.join(DTYPES)}")
            if not len(feature.names) == len(set(feature.names)) == len(feature.units) > 0:
                raise ArgumentError(
                    f"{label}.names", list(feature.names), "names, each once, and a unit for each"
                )
        for name, video in self.videos.items():
            label = f"videos['{name}']"
            if video.codec not in CODECS:
                raise ArgumentError(f"{label}.codec", video.codec, f"one of {', '.join(CODECS)}")
            if min(video.height, video.width) < 2 or video.height % 2 or video.width % 2:
                size = f"{video.height}x{video.width}"
                expected = "even numbers of pixels, because a video halves the resolution of colour"
                raise ArgumentError(label, size, expected)
        for name, dtype in self.values.items():
            if dtype not in VALUE_DTYPES:
                raise ArgumentError(f"values['{name}']", dtype, f"one of {', '.join(VALUE_DTYPES)}")


@dataclass(eq=False, kw_only=True, slots=True)
class EpisodeData:
    """One finished episode. The writer has copied its numbers when `add` returns, so those arrays
    may be used again.

    Attributes:
        arrays: The frames by feature, each ``(frames, dim)``, or ``(frames,)`` where dim is 1.
        images: The images by video, each ``(frames, height, width, 3)``, uint8. The writer may
            still read them when `add` returns: do not write into them.
        task: The task in words.
        success: Whether it was.
        seed: The seed it was played with.
        world: The world it was played in.
        values: Other values of the episode, by the names of `DatasetSpec.values`.
    """

    arrays: Mapping[str, np.ndarray]
    task: str
    success: bool
    seed: int
    world: int
    values: Mapping[str, float | int | bool | str] = field(default_factory=dict)
    images: Mapping[str, np.ndarray] = field(default_factory=dict)


def typed_episode(
    spec: DatasetSpec, episode: EpisodeData
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """An episode in the dataset's types: the columns that it brings to its row beside its task, and
    its frames, each ``(frames, dim)``, in the order of the features.

    Raises:
        FolderError: A value, a feature or images are missing, unknown, of another shape or type,
            or not finite.
    """

    def misfit(name: str, problem: str, expected: object) -> FolderError:
        where = f"episode of seed {episode.seed}, world {episode.world}"
        fix = "Correct the episode, or change the DatasetSpec"
        return FolderError(f"{where}: {name} {problem}, expected {expected}", fix)

    for noun, names, expected in (
        ("value", episode.values, spec.values),
        ("feature", episode.arrays, spec.features),
        ("video", episode.images, spec.videos),
    ):
        if names.keys() != expected.keys():
            raise misfit(noun, f"names are {', '.join(names) or 'missing'}", ", ".join(expected))

    # Values of the row
    values = {name: getattr(episode, name) for name in OWN_VALUES} | dict(episode.values)
    row = {}
    for name, dtype in {**OWN_VALUES, **spec.values}.items():
        kinds, convert = VALUE_DTYPES[dtype]
        if not isinstance(values[name], kinds):
            raise misfit(name, f"is {values[name]!r}", dtype)
        row[name] = convert(values[name])

    # Frames
    frames = len(episode.arrays[next(iter(spec.features))])
    typed = {}
    for name, feature in spec.features.items():
        array = np.asarray(episode.arrays[name])
        rows = array[:, None] if array.ndim == feature.dim == 1 else array
        if rows.shape != (frames, feature.dim) or not frames:
            shape = f"({frames or 'frames'}, {feature.dim})"
            raise misfit(name, f"has shape {array.shape}", shape)
        if not np.can_cast(rows.dtype, feature.dtype, "same_kind"):
            raise misfit(name, f"is {rows.dtype}", feature.dtype)
        with np.errstate(over="ignore"):
            typed[name] = np.ascontiguousarray(rows, dtype=feature.dtype)
        infinite = np.flatnonzero(~np.isfinite(typed[name]).all(axis=1))
        if len(infinite):
            problem = f"is not finite in {len(infinite)} of {frames} frames (first: {infinite[0]})"
            raise misfit(name, problem, f"finite {feature.dtype}")

    # Images
    for name, video in spec.videos.items():
        images = episode.images[name]
        size = (frames, video.height, video.width, 3)
        if images.shape != size or images.dtype != np.uint8:
            raise misfit(name, f"is {images.dtype} of shape {images.shape}", f"uint8 of {size}")
    return row, typed
