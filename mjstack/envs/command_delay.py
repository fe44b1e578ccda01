"""Commands as they reach the joints: late, as ``timing.command_delay`` and ``random_delay`` say,
and through the play of ``robot.backlash``.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from mjstack.managers.view import EnvView, random_uniform


class CommandDelay:
    """Holds the commands that physics has not seen yet, the oldest first. Those of each world are
    late by ``steps`` control steps, shape ``(nworld,)``, int64. With backlash a joint's servo is
    not moved before the command has come so far from it.
    """

    def __init__(self, env: EnvView) -> None:
        """Hold none yet."""
        timing = env.cfg.timing
        self._env = env
        self._least = timing.command_delay
        self._choices = 1 + timing.random_delay
        self.steps = torch.full_like(env.world, self._least)
        most = self._least + timing.random_delay
        ctrl = env.sim.ctrl
        self._waiting = ctrl.new_zeros((most, *ctrl.shape))
        self._play: Tensor | None = None
        if env.cfg.robot.backlash:
            self._play = torch.zeros_like(ctrl[0])
            self._play[torch.from_numpy(env.index.ctrl[: env.index.n_arm])] = env.cfg.robot.backlash
        self._moved = torch.zeros_like(ctrl)  # by the last commands, with backlash

    @contextmanager
    def late(self) -> Iterator[None]:
        """Take in the current command, and have the late one in its place inside."""
        if not len(self._waiting) and self._play is None:
            yield
            return
        ctrl = self._env.sim.ctrl
        command = ctrl.clone()
        if len(self._waiting):
            commands = torch.cat((self._waiting, command[None]))
            row = (len(self._waiting) - self.steps)[None, :, None]
            ctrl.copy_(commands.gather(0, row.expand(1, *ctrl.shape))[0])
            self._waiting.copy_(commands[1:])
        if self._play is not None:
            ctrl.copy_(torch.clamp(self._moved, ctrl - self._play, ctrl + self._play))
            self._moved.copy_(ctrl)
        yield
        ctrl.copy_(command)

    def reset(self, mask: Tensor) -> None:
        """Let the start's command hold in the masked worlds, and draw how late their next ones are;
        the mask is of shape ``(nworld,)``, bool.
        """
        if self._play is not None:
            torch.where(mask[:, None], self._env.sim.ctrl, self._moved, out=self._moved)
        if not len(self._waiting):
            return
        torch.where(mask[:, None], self._env.sim.ctrl, self._waiting, out=self._waiting)
        if self._choices > 1:
            # In float64 the product cannot round up to the number of choices
            share = 0.5 * (random_uniform(self._env, "timing.random_delay", 1)[:, 0].double() + 1.0)
            steps = self._least + (share * self._choices).long()
            torch.where(mask, steps, self.steps, out=self.steps)
