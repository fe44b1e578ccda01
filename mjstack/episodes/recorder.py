"""Recording of rollouts: channels of every world, with rows at chosen steps, on the device."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mjstack.drivers.driver import Driver
from mjstack.envs import Env
from mjstack.episodes.rollout import Observer, State

Read = Callable[[], Mapping[str, Tensor]]


def start_and_every_step(steps: int) -> range:
    """The start of an episode, and the ends of all its steps: row i is what step i begins from."""
    return range(steps + 1)


@dataclass(frozen=True)
class Channels:
    """Values to record, by name.

    Attributes:
        bind: Gets environment and driver at the start of an episode, and returns the function that
            reads the values of that moment, each ``(worlds, ...)``. It reads nothing to the host.
        ends: The recorded step ends of an episode of so many steps, ascending; 0 is the start.
    """

    bind: Callable[[Env, Driver], Read]
    ends: Callable[[int], Sequence[int]] = lambda steps: range(1, steps + 1)


class Recorder(Observer):
    """Records channels. What is recorded at every step belongs to the captured step; the rest is
    copied between steps.

    Attributes:
        channels: What is recorded.
        rows: By name of the channel, each ``(recorded ends, worlds, ...)``. Steps that were not
            made have NaN, or -1 where the values are integers.
    """

    channels: tuple[Channels, ...] = ()

    def __init__(self, *channels: Channels) -> None:
        """Take the channels, whose names differ; by default those of the class."""
        self.rows: dict[str, Tensor] = {}
        self.channels = channels or self.channels

    def start(self, env: Env, driver: Driver) -> None:
        """Allocate the rows, and write those of the start."""
        super().start(env, driver)
        self.rows = {}
        self._captured: list[tuple[Read, Tensor]] = []  # with the row of the next step
        self._copied: list[tuple[Read, dict[int, int]]] = []  # with the row of each recorded end
        for channels in self.channels:
            ends = channels.ends(driver.steps)
            read = channels.bind(env, driver)
            for name, value in read().items():
                empty = torch.nan if value.is_floating_point() else -1
                self.rows[name] = value.new_full((len(ends), *value.shape), empty)
                if 0 in ends:
                    self.rows[name][0] = value
            if len(ends) >= driver.steps:
                first = torch.full((1,), len(ends) - driver.steps, device=env.device)
                self._captured.append((read, first))
            else:
                self._copied.append((read, {end: row for row, end in enumerate(ends)}))

    def update(self) -> None:
        """Record what is recorded at every step."""
        for read, row in self._captured:
            for name, value in read().items():
                self.rows[name].index_copy_(0, row, value[None])
            row.add_(1)

    def after_step(self, step: int) -> None:
        """Record what is recorded at this step, but not at every one."""
        for read, row_of_end in self._copied:
            if step + 1 in row_of_end:
                for name, value in read().items():
                    self.rows[name][row_of_end[step + 1]] = value


def _read_world(env: Env, driver: Driver) -> Read:
    qpos = env.sim.qpos
    return lambda: {"qpos": qpos[:1].double()}


class WorldRecorder(Recorder):
    """Records positions of world 0 at every step end."""

    channels = (Channels(_read_world),)

    @property
    def qpos(self) -> np.ndarray:
        """Positions, shape ``(steps, nq)``, float64; NaN in steps not made."""
        return self.rows["qpos"][:, 0].cpu().numpy()


def read_commands(env: Env, driver: Driver) -> Read:
    """Read the joint targets that went to the actuators as ``ctrl``, float32."""
    ctrl = env.sim.ctrl
    columns = env.index.on(env.device, ctrl.dtype).ctrl
    return lambda: {"ctrl": columns.read(ctrl).float()}


def read_state(env: Env, driver: Driver) -> Read:
    """Read the parts of a `State`, in its precision."""
    sim = env.sim
    return lambda: {name: getattr(sim, name).double() for name in State._fields}


class Snapshots(Recorder):
    """Records the state of all worlds after some steps."""

    def __init__(self, steps: Collection[int]) -> None:
        """``steps`` after which the state is recorded."""
        self._steps = sorted(step for step in steps if step >= 0)
        super().__init__(Channels(read_state, lambda _: [step + 1 for step in self._steps]))

    @property
    def states(self) -> dict[int, State]:
        """The states by step; none before an episode."""
        states = zip(*(rows.cpu().numpy() for rows in self.rows.values()), strict=True)
        return {step: State(*state) for step, state in zip(self._steps, states, strict=False)}
