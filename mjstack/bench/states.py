"""States of scripted episodes and of random actions, recorded from MJWarp's worlds."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from mjstack.episodes.context import RunContext, lacks_episode
from mjstack.episodes.rollout import Observer, rollout
from mjstack.scene.phases import Phase

if TYPE_CHECKING:
    from mjstack.sim.mjwarp import MjwarpSimulation

RANDOM = "random actions"
_EPISODE = 2.0  # s, of random actions
_RANDOM_EPISODES = 3  # that a world plays at least


@dataclass(frozen=True, slots=True)
class Sample:
    """State of all worlds as a physics step begins.

    Attributes:
        state: qpos, qvel, act, ctrl and qacc_warmstart, each of shape ``(nworld, n)``.
        fields: Per-world model fields.
        kind: What each world was doing, shape ``(nworld,)``.
    """

    state: dict[str, torch.Tensor]
    fields: dict[str, torch.Tensor]
    kind: np.ndarray

    @classmethod
    def of(cls, sim: "MjwarpSimulation", kind: np.ndarray) -> "Sample":
        """Copy the state of all worlds, on their device."""
        from mjstack.sim.warp_setup import wp

        state = {name: getattr(sim, name).clone() for name in ("qpos", "qvel", "act", "ctrl")}
        state["qacc_warmstart"] = wp.to_torch(sim._d.qacc_warmstart).clone()
        return cls(state, {name: field.clone() for name, field in sim.fields.items()}, kind)


def record_states(context: RunContext, sim: "MjwarpSimulation", states: int) -> list[Sample]:
    """Play scripted episodes, then random actions of full range, and record states of both.

    Random joint targets are new in every control step, and a world starts a new episode every 2 s,
    each at its own time. A task without phases has random actions alone.

    Args:
        context: The configuration.
        sim: The worlds.
        states: How many to record at least, half of each; fewer where an episode has not as many
            control steps.
    """
    parts = 1 if lacks_episode(context.cfg) else 2
    count = -(-states // (parts * sim.nworld))
    env = context.start(sim, context.cfg.reset)
    samples: list[Sample] = []
    if parts == 2:
        driver = context.driver(env)
        recorder = _Recorder(sim, max(1, driver.steps // count))
        rollout(env, driver, [recorder], advance=context.advance, label="steps of the episodes")
        samples += recorder.samples

    # Random actions: the samples follow a new joint target by 0, 1, ... physics steps
    decimation = context.cfg.timing.decimation
    age = round(_EPISODE / context.cfg.timing.step_dt)
    steps = max(count, _RANDOM_EPISODES * age)
    every = steps // count
    low, high = torch.as_tensor(sim.model.actuator_ctrlrange).float().to(sim.device).unbind(1)
    generator = torch.Generator(sim.device).manual_seed(context.cfg.seed)
    offset = torch.arange(sim.nworld, device=sim.device) * age // sim.nworld
    kind = np.full(sim.nworld, RANDOM)
    for step in range(steps):
        env.reset(mask=(step + offset) % age == 0 if step else None)
        noise = torch.rand(sim.ctrl.shape, generator=generator, device=sim.device)
        sim.ctrl.copy_(low + (high - low) * noise)
        sampled = step // every % decimation if step % every == every - 1 else -1
        for substep in range(decimation):
            if substep == sampled:
                samples.append(Sample.of(sim, kind))
            sim.step(1)
        context.advance("steps of random actions", step + 1, steps)
    return samples


class _Recorder(Observer):
    """Records every k-th step of an episode."""

    def __init__(self, sim: "MjwarpSimulation", every: int) -> None:
        """The worlds, and k."""
        self.samples: list[Sample] = []
        self._sim = sim
        self._every = every

    def after_step(self, step: int) -> None:
        """See `Observer`."""
        if step % self._every == self._every - 1:
            kinds = np.array(name_kinds(self.driver.phases))
            self.samples.append(Sample.of(self._sim, kinds[self.driver.phase.cpu().numpy()]))


def name_kinds(phases: list[Phase]) -> list[str]:
    """The arm's work on the objects in each phase, in a word."""
    kinds = []
    kind = "before contact"
    for phase in phases:
        if phase.grasped >= 0:
            kind = "grasp"
        elif phase.carried >= 0:
            kind = "carried"
        elif kind != "before contact":
            kind = "put down"
        kinds.append(kind)
    return kinds
