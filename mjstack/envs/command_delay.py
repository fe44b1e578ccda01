"""Commands that take effect late, as ``timing.command_delay`` says."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor


class CommandDelay:
    """Holds the commands that physics has not seen yet, the oldest first."""

    def __init__(self, ctrl: Tensor, steps: int) -> None:
        """Hold none yet.

        Args:
            ctrl: The simulation's commands, shape ``(nworld, nu)``, which keep their address.
            steps: Control steps by which they are late; with 0 nothing is held.
        """
        self._ctrl = ctrl
        self._waiting = ctrl.new_zeros((steps, *ctrl.shape))

    @contextmanager
    def late(self) -> Iterator[None]:
        """Take in the current command, and have the late one in its place inside."""
        if not len(self._waiting):
            yield
            return
        command = self._ctrl.clone()
        self._ctrl.copy_(self._waiting[0])
        self._waiting.copy_(torch.cat((self._waiting[1:], command[None])))
        yield
        self._ctrl.copy_(command)

    def reset(self, mask: Tensor) -> None:
        """Let the start's command hold in the masked worlds; the mask is of shape ``(nworld,)``,
        bool.
        """
        if len(self._waiting):
            torch.where(mask[:, None], self._ctrl, self._waiting, out=self._waiting)
