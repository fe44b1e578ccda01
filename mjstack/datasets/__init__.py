"""Demonstrations on disk in the layout of LeRobotDataset v3, with pyarrow and ffmpeg."""

from mjstack.datasets.reader import StoredDataset, read_dataset

__all__ = ["StoredDataset", "read_dataset"]
