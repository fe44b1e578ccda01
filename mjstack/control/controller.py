"""What drives a scripted episode: commands frame by frame, and the phase that each world is in."""

from __future__ import annotations

from typing import Protocol

import torch

from mjstack.control.phases import Phase
from mjstack.control.planner import CommandTape


class Controller(Protocol):
    """Gives the commands of every world, one frame at a time. Fixed shapes, no host read: a captured graph may hold it.

    Attributes:
        phases: The phases, laid out as a world that is not held up goes through them.
        frames: Length of the episode.
        phase: Number of the phase that each world's last command belonged to, shape ``(nworld,)``, int64.
    """

    phases: list[Phase]
    frames: int
    phase: torch.Tensor

    def command(self) -> torch.Tensor:
        """Commands of the next frame, shape ``(nworld, nu)``."""


class TapeController:
    """Plays a command tape: every world is in the same phase."""

    def __init__(self, tape: CommandTape, phases: list[Phase], nworld: int, device: torch.device) -> None:
        """Takes the tape, which must be on the device."""
        self.tape, self.phases, self.frames = tape, phases, tape.frames
        numbers = [number for number, phase in enumerate(phases) for _ in range(phase.start, phase.stop)]
        self._phase_at = torch.tensor(numbers, device=device)
        self._next = torch.zeros(1, dtype=torch.int64, device=device)
        self.phase = torch.zeros(nworld, dtype=torch.int64, device=device)

    def command(self) -> torch.Tensor:
        """Commands of the next frame, shape ``(nworld, nu)``."""
        out = self.tape.command(self._next)
        self.phase.copy_(self._phase_at.index_select(0, self._next).expand_as(self.phase))
        self._next.add_(1)
        return out
