"""Statistics of an episode's frames and of all frames, by the names that LeRobot has for them."""

import numpy as np
import torch

from mjstack.datasets.lerobot import QUANTILES, STATISTICS


def by_name(statistics: np.ndarray, count: int, *, video: bool = False) -> dict[str, list]:
    """Statistics ``(statistics, dim)`` of so many frames by name, as the files have them."""
    values = (statistics[..., None, None] if video else statistics).tolist()
    return dict(zip(STATISTICS, values, strict=True)) | {"count": [count]}


def frame_statistics(frames: np.ndarray) -> np.ndarray:
    """Statistics of every number over some frames, shape ``(frames, dim)``; shape ``(statistics,
    dim)``, in the order of `STATISTICS`. std is that of these frames (divided by n), quantiles
    interpolate.
    """
    values = np.ascontiguousarray(frames.T, dtype=float)  # exact, but for int64 beyond 2^53
    quantiles = np.quantile(values, [*QUANTILES.values()], axis=1)
    return np.stack([values.min(1), values.max(1), values.mean(1), values.std(1), *quantiles])


def sampled_frames(frames: int) -> np.ndarray:
    """The frames of an episode whose images statistics are of, as LeRobot chooses them."""
    count = max(min(100, frames), min(int(frames**0.75), 10_000))
    return np.round(np.linspace(0, frames - 1, count)).astype(int)


def count_pixels(images: np.ndarray) -> np.ndarray:
    """How many pixels of images ``(n, height, width, 3)``, uint8, have each value: shape ``(3,
    256)``, red, green and blue.
    """
    side = max(images.shape[1:3])
    if side >= 300:  # LeRobot leaves pixels of large images out
        images = images[:, :: side // 150, :: side // 150]
    channels = [torch.from_numpy(np.ascontiguousarray(images[..., k])).flatten() for k in range(3)]
    # NumPy's takes six times as long
    return np.stack([torch.bincount(pixels, minlength=256).numpy() for pixels in channels])


def image_statistics(pixels: np.ndarray) -> np.ndarray:
    """Statistics of red, green and blue in 0 to 1, shape ``(statistics, 3)``, of pixels as
    `count_pixels` counts them.
    """
    values, counts = np.arange(256.0), pixels.sum(1, keepdims=True)
    low, high = (pixels > 0).argmax(1), 255.0 - (pixels[:, ::-1] > 0).argmax(1)
    mean = pixels @ values / counts[:, 0]
    std = np.sqrt((pixels * (values - mean[:, None]) ** 2).sum(1) / counts[:, 0])
    sums = pixels.cumsum(1)
    ranks = (counts - 1) * np.array([*QUANTILES.values()])  # between two values as NumPy does
    lower, upper = (
        np.stack([np.searchsorted(*row, side="right") for row in zip(sums, rank, strict=True)])
        for rank in (np.floor(ranks), np.ceil(ranks))
    )
    quantiles = lower + (ranks - np.floor(ranks)) * (upper - lower)
    return np.stack([low, high, mean, std, *quantiles.T]) / 255.0
