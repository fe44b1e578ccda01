"""What happened in the episodes that ended, added up on the device and read by the host now and
then.
"""

import torch
from torch import Tensor


class EpisodeStatistics:
    """Sums over finished episodes. One tensor holds them all, so that reading is one copy."""

    def __init__(
        self, reward_names: list[str], termination_names: list[str], device: torch.device
    ) -> None:
        """Allocates the sums."""
        self._rewards = reward_names
        self._terminations = termination_names
        width = 4 + len(reward_names) + len(termination_names)
        self._one = torch.ones((1, 1), device=device)
        # float64 counts exactly far beyond the 16.7 million at which float32 stops.
        self._sums = torch.zeros(width, dtype=torch.float64, device=device)

    def update(
        self,
        done: Tensor,
        steps: Tensor,
        success: Tensor,
        rewards: Tensor,
        terminations: Tensor,
    ) -> None:
        """Adds the episodes that end in this step.

        Args:
            done: Which end, shape ``(nworld,)``, bool.
            steps: Their lengths, shape ``(nworld,)``.
            success: Whether the task is achieved, shape ``(nworld,)``, bool.
            rewards: Episode sum of every reward term, shape ``(nworld, nterm)``.
            terminations: What every termination term says, shape ``(nworld, nterm)``, bool.
        """
        columns = (
            self._one.expand(len(steps), 1),
            steps[:, None],
            success[:, None],
            rewards.sum(1, keepdim=True),
        )
        # A step count is exact in float32 up to 16.7 million; the sums are float64.
        row = torch.cat([column.float() for column in (*columns, rewards, terminations)], dim=1)
        self._sums += torch.where(done[:, None], row, 0.0).sum(0, dtype=torch.float64)

    def read(self) -> dict[str, float]:
        """Means over the episodes that ended since the last read, and starts anew. Waits for the
        device.

        Returns:
            ``episodes``; and if there were any ``steps``, ``success``, ``return``,
            ``reward/<term>`` (sums per episode) and ``termination/<term>`` (fraction of episodes).
        """
        sums = self._sums.tolist()
        self._sums.zero_()
        episodes = sums[0]
        out = {"episodes": episodes}
        if not episodes:
            return out
        names = ["steps", "success", "return", *(f"reward/{n}" for n in self._rewards)]
        names += [f"termination/{n}" for n in self._terminations]
        return out | {name: value / episodes for name, value in zip(names, sums[1:], strict=True)}
