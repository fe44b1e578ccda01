"""Statistics of an episode's frames and of all frames, by the names that LeRobot has for them."""

import math

import numpy as np
import torch

from mjstack.datasets.lerobot import QUANTILES, STATISTICS

_BINS = 2**14  # across the range of a number, which takes at least half of them


def by_name(statistics: np.ndarray, count: int, *, video: bool = False) -> dict[str, list]:
    """Statistics ``(statistics, dim)`` of so many frames by name, as the files have them."""
    shape = (3, 1, 1) if video else (statistics.shape[1],)
    values = statistics.reshape(-1, *shape).tolist()
    return dict(zip(STATISTICS, values, strict=True)) | {"count": [count]}


def frame_statistics(frames: np.ndarray) -> np.ndarray:
    """Statistics of every number over some frames.

    Args:
        frames: Shape ``(frames, dim)``.

    Returns:
        Shape ``(statistics, dim)``, in the order of `STATISTICS`; std is that of these frames
        (divided by n), quantiles interpolate.
    """
    frames = frames.astype(float)  # exact, but for int64 beyond 2^53
    quantiles = np.quantile(frames, [*QUANTILES.values()], axis=0)
    return np.stack([frames.min(0), frames.max(0), frames.mean(0), frames.std(0), *quantiles])


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
    values = np.arange(256.0)
    low, high = (pixels > 0).argmax(1), 255.0 - (pixels[:, ::-1] > 0).argmax(1)
    mean = pixels @ values / pixels.sum(1)
    variance = (pixels * (values - mean[:, None]) ** 2).sum(1) / pixels.sum(1)
    return np.stack([low, high, mean, np.sqrt(variance), *_quantile_bins(pixels)]) / 255.0


def _quantile_bins(counts: np.ndarray) -> np.ndarray:
    """The bins of the quantiles, shape ``(quantiles, dim)``, interpolated between two values as
    NumPy does; ``counts`` are the values in each bin, shape ``(dim, bins)``.
    """
    ranks = np.outer(counts.sum(1) - 1, [*QUANTILES.values()])
    lower, upper = (
        [np.searchsorted(*row, side="right") for row in zip(counts.cumsum(1), rank, strict=True)]
        for rank in (np.floor(ranks), np.ceil(ranks))
    )
    return (lower + (ranks - np.floor(ranks)) * np.subtract(upper, lower)).T


class RunningStatistics:
    """Statistics of frames that come in groups, none of which is kept.

    Quantiles are from bins whose width is a power of two: those of a small range are parts of those
    of a large one, so that the order of the groups makes no difference.
    """

    def __init__(self, dim: int) -> None:
        self.count = 0
        self._mean = np.zeros(dim)
        self._squares = np.zeros(dim)  # sum of squared distances from the mean
        self._range = np.array([[np.inf] * dim, [-np.inf] * dim])
        self._width = np.ones(dim)
        self._origin = np.zeros(dim)  # number of the first bin
        self._bins = np.zeros((dim, _BINS + 1), np.int64)

    def add(self, frames: np.ndarray) -> None:
        """Add frames, shape ``(frames, dim)``."""
        for k, column in enumerate(frames.T):
            self._add(k, column.astype(float))
        self.count += len(frames)

    def _add(self, k: int, values: np.ndarray) -> None:
        """Add values of a number."""
        count = self.count + len(values)
        shift = values.mean() - self._mean[k]
        self._squares[k] += len(values) * (values.var() + shift**2 * self.count / count)
        self._mean[k] += shift * len(values) / count
        low = min(self._range[0, k], values.min())
        high = max(self._range[1, k], values.max())
        # No narrower than what float64 tells apart
        half = max(high / 2 - low / 2, np.spacing(max(abs(low), abs(high))), 1e-290)
        width = math.ldexp(2.0 / _BINS, math.frexp(half)[1])
        origin = np.floor(low / width)
        full = np.flatnonzero(self._bins[k])
        moved = np.floor((self._origin[k] + full) * (self._width[k] / width)) - origin
        bins = np.bincount((np.floor(values / width) - origin).astype(int), minlength=_BINS + 1)
        np.add.at(bins, moved.astype(int), self._bins[k, full])
        self._bins[k] = bins
        self._range[:, k], self._width[k], self._origin[k] = (low, high), width, origin

    def statistics(self) -> np.ndarray:
        """As `frame_statistics` has them, but each quantile up to a bin lower: at most 1/8192 of
        the range.
        """
        quantiles = (self._origin + _quantile_bins(self._bins)) * self._width
        std = np.sqrt(self._squares / self.count)
        return np.stack([*self._range, self._mean, std, *np.clip(quantiles, *self._range)])
