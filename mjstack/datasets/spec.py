"""Content of a dataset and of one episode: names, units and types."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

# Columns that the writer itself adds to every frame, with their types; LeRobot expects these names.
INDICES = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}


@dataclass(frozen=True)
class Feature:
    """One column of the frames: a vector of named numbers.

    Attributes:
        dtype: Of NumPy, such as ``float32``.
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
        codec: ``h264`` or ``av1``.
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
        task: The task in words.
        features: Columns of the frames by name. LeRobot reads ``observation.state``,
            ``observation.environment_state``, ``action``, ``next.reward``, ``next.done`` and
            ``next.success`` by these names; others are kept as they are.
        config_sha256: Hash of what the episodes depend on. A dataset is gone on with under the same
            hash only.
        videos: Images by name, such as ``observation.images.front``.
        values: Types of the values that each episode has beside success, seed and world, by name.
        provenance: Other facts about this call's episodes, such as seed and versions, in
            JSON's types.
    """

    robot_type: str
    fps: int
    task: str
    features: Mapping[str, Feature]
    config_sha256: str
    videos: Mapping[str, Video] = field(default_factory=dict)
    values: Mapping[str, str] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)


@dataclass(eq=False, kw_only=True, slots=True)
class EpisodeData:
    """One finished episode.

    Attributes:
        arrays: The frames by feature, each ``(frames, dim)``, or ``(frames,)`` where dim is 1;
            finite, and of types that go into the feature's.
        images: The images by video, each ``(frames, height, width, 3)``, uint8. Encoders read them
            after `PartWriter.write` too: do not write into them.
        row: ``success``, ``seed`` and ``world``, and the values of `DatasetSpec.values`.
    """

    arrays: Mapping[str, np.ndarray]
    row: Mapping[str, float | int | bool | str]
    images: Mapping[str, np.ndarray] = field(default_factory=dict)
