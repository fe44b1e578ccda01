"""Demonstrations on disk in the layout of LeRobotDataset v3, with pyarrow and ffmpeg."""

from mjstack.datasets.reader import StoredDataset, read_dataset
from mjstack.datasets.spec import DatasetSpec, EpisodeData, Feature, Video
from mjstack.datasets.writer import DatasetWriter

__all__ = [
    "DatasetSpec",
    "DatasetWriter",
    "EpisodeData",
    "Feature",
    "StoredDataset",
    "Video",
    "read_dataset",
]
