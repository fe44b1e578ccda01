"""Records the states of an expert's episodes, in which ``reset=expert_states`` starts worlds."""

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import torch

from mjstack.config.check import starts_midway
from mjstack.config.schema import Config, TermCfg
from mjstack.drivers.driver import Driver
from mjstack.envs import Env
from mjstack.episodes.context import RunContext
from mjstack.episodes.rollout import Observer, play_episode
from mjstack.errors import MjstackError
from mjstack.files import write_npz
from mjstack.mdp.starts.expert_states import EPISODE, FIELD, STATE

_EVERY = 5  # control steps between two states


def whole_starts(reset: dict[str, TermCfg]) -> dict[str, TermCfg]:
    """Reset terms without those that start worlds in the middle of an episode."""
    return {name: term for name, term in reset.items() if not starts_midway(term)}


def unrecorded(reset: dict[str, TermCfg]) -> bool:
    """Whether a term starts worlds in the middle of an episode, and names no file of states."""
    return any(starts_midway(t) and t.params.get("path") is None for t in reset.values())


def with_states(cfg: Config, path: Path) -> Config:
    """A configuration whose worlds start in the states of a file, where no other is named."""
    reset = {
        name: replace(term, params=term.params | {"path": str(path)})
        if starts_midway(term) and term.params.get("path") is None
        else term
        for name, term in cfg.reset.items()
    }
    return replace(cfg, reset=reset)


class StateRecorder(Observer):
    """Keeps the state of every world after every step, on the device.

    Attributes:
        states: By name of the view, each ``(steps, nworld, width)``.
    """

    states: dict[str, torch.Tensor]

    def start(self, env: Env, driver: Driver) -> None:
        """See `Observer`."""
        super().start(env, driver)
        self.states = {}
        for name in STATE:
            view = getattr(env.sim, name)
            if view.shape[1]:
                self.states[name] = view.new_zeros((driver.steps, *view.shape))
        self._next = torch.zeros(1, dtype=torch.int64, device=env.device)

    def update(self) -> None:
        """See `Observer`."""
        for name, kept in self.states.items():
            kept.index_copy_(0, self._next, getattr(self.env.sim, name)[None])
        self._next.add_(1)


def record_states(context: RunContext, worlds: int, path: Path) -> None:
    """Play the expert in a batch of worlds, and write states of its accepted episodes, from all
    phases.

    Args:
        context: The run; its starts are used, but for those in the middle of an episode.
        worlds: How many episodes.
        path: The file.

    Raises:
        MjstackError: No episode was accepted.
        OSError: The file cannot be written.
    """
    cfg = context.cfg
    with closing(context.batch_simulation(worlds)) as sim:
        env = context.start(sim, whole_starts(cfg.reset))
        recorder = StateRecorder()
        label = "steps of the expert"
        driver = context.driver(env)
        episode = play_episode(env, driver, [recorder], advance=context.advance, label=label)
        good = (episode.result.failed == 0).nonzero()[:, 0]
        context.print_line(f"train: {len(good)} of {worlds} episodes of the expert succeeded")
        if not len(good):
            raise MjstackError(
                f"the expert succeeded in none of {worlds} episodes, expected some to start from",
                "Look at why with gates=[success]",
            )
        tensors = {
            name: kept[::_EVERY, good].flatten(0, 1) for name, kept in recorder.states.items()
        }
        steps = len(tensors["qpos"]) // len(good)
        tensors[EPISODE] = torch.arange(len(good), device=sim.device).repeat(steps)
        tensors |= {FIELD + name: field[good] for name, field in sim.fields.items()}
        write_npz(path, {name: values.cpu().numpy() for name, values in tensors.items()})
