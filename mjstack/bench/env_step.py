"""The cost of a whole ``env.step``, of its physics and of its managers, interleaved.

A repetition plays random actions from one state three times: the whole step, then from the same
state the physics with the same joint targets, then the managers without any physics. The next
repetition starts where the whole step ended. So each ratio is of one repetition and one state of
the machine. Worlds start at ages spread over an episode, so that in every step some of them time
out and are reset.

The three do not do quite the same work. Physics alone has no resets: a world that ended goes on
from where it was, with the next episode's joint targets, and may touch more, and so cost more, than
the reset one in the whole step. Then env.step's time over that of physics flatters the managers.
The managers alone work on worlds that stand still, which end for other reasons, and they launch
work that the whole step may run beside other work. Hence both ratios, and the residual when both
parts are subtracted from the whole: where it is far from 0, the repetitions differed by more than
the managers.

With cameras, the images of all worlds and cameras are timed too, however slow a camera is.
"""

from collections.abc import Sequence
from functools import partial

import numpy as np
import torch
from torch import Tensor

from mjstack.bench import timing
from mjstack.bench.timing import EnergyMeter, Measurement
from mjstack.config.functions import offered
from mjstack.envs import Env
from mjstack.envs.buffers import Advance
from mjstack.episodes.rollout import restore, snapshot
from mjstack.report.figure import Figure, figures
from mjstack.sim.cameras import image_bytes
from mjstack.sim.graph import StepGraph

_COST = 4.0  # of a repetition over that of its whole steps from the start, when fewer things touch


def measure_env_step(env: Env, name: str, advance: Advance) -> Measurement:
    """Play random actions in interleaved repetitions, as many as the environment's
    ``cfg.gate.throughput`` says.

    Returns:
        Samples of the whole step (``ms_per_env_step``), its physics and its managers.
        ``managers_over_physics`` is the whole's time over that of physics, less 1. With cameras,
        also the time and the rate of their images, which the whole step has in it, and the bytes of
        all images.

    Raises:
        FaultError: Physics was lost.
    """
    sim = env.sim
    decimation = env.cfg.timing.decimation
    t = env.cfg.gate.throughput
    parts = _Parts(env, t.action_share)
    seconds = _COST * (t.repetitions + 1) * parts.warm_up()
    steps = timing.steps_that_fit(t.env_steps, timing.time_budget(env.cfg, sim), seconds)

    # The repetitions; the first one warms up
    times: list[list[float]] = []
    ended = 0.0
    meter = EnergyMeter(str(env.device))
    parts.play(steps, timing.NO_METER)
    for repetition in range(t.repetitions):
        spent, episodes = parts.play(steps, meter)
        ended += episodes
        times.append(spent)
        advance(f"{name}, repetitions", repetition + 1, t.repetitions)
        if timing.settled(env.cfg, [whole / physics for whole, physics, *_ in times]):
            break  # the times themselves are of other states each

    # The result
    out = Measurement(name=name)
    whole, physics, managers, images = np.array(times).T
    graph = env.graph if parts.on_cuda else sim.graph_of(decimation, kinematics=True)
    captured = env.graph.captured and all(part.captured for part in parts.graphs)
    out.add_repetitions(sim, env.cfg, whole.tolist(), steps, meter, graph, captured=captured)
    ms = 1e3 / steps
    samples = {
        "physics_ms_per_step": ms * physics,
        "managers_ms_per_step": ms * managers,
        "managers_alone_over_physics": managers / physics,
        "residual_ms_per_step": ms * (whole - physics - managers - images),
    }
    out.facts += figures(episodes_ended=int(ended))
    out.problem = timing.describe_lost(parts.lost) or parts.problem or out.problem
    cameras = env.cameras.cameras if env.cameras is not None else {}
    out.headline = f"{out.median('env_steps'):,.0f} env-steps/s"
    if cameras:
        samples["images_ms_per_step"] = ms * images
        samples["images"] = rate = len(cameras) * env.nworld * steps / images
        samples["images_over_physics"] = images / physics
        size = image_bytes(sim.model, cameras, env.nworld, mjwarp=sim.backend == "mjwarp")
        out.facts.append(Figure("images", size / 1e6, "MB"))
        out.headline += f" with images, {np.median(rate):,.0f} images/s"
    else:
        samples["managers_over_physics"] = whole / physics - 1.0
        over, alone = (
            100.0 * np.median(samples[f"managers_{name}"])
            for name in ("over_physics", "alone_over_physics")
        )
        out.headline += f", managers {over:+.1f} % (alone {alone:.1f} %)"
    out.samples |= {key: values.tolist() for key, values in samples.items()}
    return out


class _Parts:
    """Plays the parts of a repetition, each from the same state. The next repetition goes on where
    the whole steps ended.
    """

    def __init__(self, env: Env, share: float) -> None:
        """Prepare random actions, by a generator of this measurement."""
        manager = env.action_manager
        self._env = env
        self._generator = torch.Generator().manual_seed(0)
        low, high = (limit.float().cpu() for limit in (manager.low, manager.high))
        self._span = share * (high - low)
        self._low = 0.5 * (low + high - self._span)
        self.on_cuda = env.device.type == "cuda"
        self.lost = torch.zeros(env.nworld, dtype=torch.bool, device=env.device)  # or not stepped
        self.problem = ""  # the terminations by which physics was lost in the whole steps

    def warm_up(self) -> float:
        """Start worlds at random ages, compile and capture; return the seconds of a step."""
        env = self._env
        env.reset(seed=env.cfg.seed)
        ages = torch.randint(env.max_episode_steps, (env.nworld,), generator=self._generator)
        env.episode_step.copy_(ages)
        actions = self._actions(timing.WARM_UP)
        seconds = [timing.timed(env.sim, partial(env.step, action)) for action in actions]
        # Physics, managers and, with cameras, images
        self.graphs: Sequence[StepGraph] = env.parts() if env.images else env.parts()[:2]
        if self.on_cuda:  # a repetition may be too short to warm them up
            for graph in self.graphs:
                for _ in range(timing.WARM_UP):
                    graph()
        self._start = snapshot(env.sim)
        return seconds[-1]

    def play(self, steps: int, meter: EnergyMeter) -> tuple[list[float], float]:
        """Play one repetition.

        Returns:
            Seconds of env, physics, managers and images; and the number of episodes that ended.
        """
        env = self._env
        sim = env.sim
        start = self._start
        ages = torch.stack((env.episode_step, env.episode))
        physics, managers, *images = self.graphs
        actions = self._actions(steps)
        targets = [torch.empty_like(sim.ctrl) for _ in actions]

        def play_whole() -> None:
            for action, target in zip(actions, targets, strict=True):
                env.step(action)
                # One small copy; where a world was reset it is the new episode's.
                target.copy_(sim.ctrl)

        def play_physics() -> None:
            for target in targets:
                sim.ctrl.copy_(target)
                physics()

        def play_managers() -> None:
            for action in actions:
                env.action_manager.process(action)
                managers()

        def play_images() -> None:
            for graph in images * steps:
                graph()

        # The whole step
        restore(sim, start)
        env.read_statistics()
        times = [timing.timed(sim, play_whole, meter)]
        counted = env.read_statistics()
        self._find_losses(counted)
        self._start = snapshot(sim)
        end_ages = torch.stack((env.episode_step, env.episode))

        # Physics alone, with the same joint targets
        restore(sim, start)
        times.append(timing.timed(sim, play_physics))
        self.lost |= timing.lost_worlds(sim, steps * env.cfg.timing.decimation)

        # The managers alone
        restore(sim, start)
        self._set_ages(ages)
        times.append(timing.timed(sim, play_managers))
        env.faults.raise_first()
        self._set_ages(end_ages)
        times.append(timing.timed(sim, play_images) if images else 0.0)
        return times, counted["episodes"]

    def _set_ages(self, ages: Tensor) -> None:
        for counter, age in zip((self._env.episode_step, self._env.episode), ages, strict=True):
            counter.copy_(age)

    def _actions(self, count: int) -> list[Tensor]:
        shape = (count, self._env.nworld, len(self._span))
        noise = torch.rand(shape, generator=self._generator)
        return list((self._low + self._span * noise).to(self._env.device).unbind())

    def _find_losses(self, counted: dict[str, float]) -> None:
        ended = [
            name
            for name, term in self._env.cfg.termination.items()
            if offered(term.func, "ends_on") and counted.get(f"termination/{name}", 0.0) > 0.0
        ]
        if ended:
            self.problem = (
                f"worlds ended by {', '.join(ended)}: raise batch.nconmax or batch.njmax, or act"
                " more gently"
            )
