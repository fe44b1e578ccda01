"""Statistics of frames: of one episode, and of all so far without holding their frames."""

from __future__ import annotations

import numpy as np

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
NAMES = ("min", "max", "mean", "std", *QUANTILES)  # `count` stands beside them


def episode_statistics(frames: np.ndarray) -> dict[str, np.ndarray]:
    """Each number's statistics over one episode.

    Args:
        frames: Shape ``(dim, frames)``, float64.

    Returns:
        `NAMES`, each ``(dim,)``; std is that of these frames, not an estimate for more (divided by
        n), quantiles interpolate.
    """
    ranked = np.sort(frames, axis=1)
    out = {
        "min": ranked[:, 0],
        "max": ranked[:, -1],
        "mean": frames.mean(axis=1),
        "std": frames.std(axis=1),
    }
    last = frames.shape[1] - 1
    for name, quantile in QUANTILES.items():
        below = int(quantile * last)
        above = min(below + 1, last)
        out[name] = ranked[:, below] + (quantile * last - below) * (
            ranked[:, above] - ranked[:, below]
        )
    return out


class RunningStatistics:
    """Statistics of all episodes added so far, exact but for the quantiles.

    Those are the episodes' quantiles weighted by frames, as LeRobot has them: those of all frames
    would need all frames.

    Attributes:
        count: Frames so far.
    """

    def __init__(self, dim: int) -> None:
        """Begins with no frame.

        Args:
            dim: How many numbers a frame has.
        """
        self.count = 0
        self._min = np.full(dim, np.inf)
        self._max = np.full(dim, -np.inf)
        self._mean = np.zeros(dim)
        self._squares = np.zeros(dim)  # squares: summed squared distance from the mean
        self._quantiles = {name: np.zeros(dim) for name in QUANTILES}

    def add(self, count: int, episode: dict[str, np.ndarray]) -> None:
        """Takes in one episode by its frames and `episode_statistics` (mean and variance after
        Chan, Golub and LeVeque).
        """
        total = self.count + count
        away = episode["mean"] - self._mean
        self._squares += count * episode["std"] ** 2 + away**2 * (self.count * count / total)
        self._mean += away * (count / total)
        np.minimum(self._min, episode["min"], out=self._min)
        np.maximum(self._max, episode["max"], out=self._max)
        for name, mean in self._quantiles.items():
            mean += (episode[name] - mean) * (count / total)
        self.count = total

    def read(self) -> dict[str, np.ndarray]:
        """`NAMES`, each ``(dim,)``, of what was added."""
        std = np.sqrt(self._squares / max(self.count, 1))
        return {
            "min": self._min,
            "max": self._max,
            "mean": self._mean,
            "std": std,
            **self._quantiles,
        }
