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

import torch

from mjstack.bench.timing import (
    NO_METER,
    WARM_UP,
    EnergyMeter,
    Measurement,
    describe_lost,
    lost_worlds,
    steps_that_fit,
    timed,
)
from mjstack.config.functions import offered
from mjstack.envs import Env
from mjstack.envs.buffers import Advance
from mjstack.episodes.rollout import State, restore, snapshot
from mjstack.sim.cameras import image_bytes
from mjstack.sim.graph import StepGraph

_COST = 4.0  # of a repetition over that of its whole steps from the start, when fewer things touch


def measure_env_step(
    env: Env,
    *,
    steps: int,
    repetitions: int,
    seconds: float | None = None,
    meter: EnergyMeter = NO_METER,
    advance: Advance | None = None,
    share: float = 1.0,
    name: str = "env_step",
) -> Measurement:
    """Play random actions in interleaved repetitions.

    Args:
        env: The environment.
        steps: Control steps per repetition.
        repetitions: Measured repetitions; one before them warms up.
        seconds: Shortens the repetitions so that all of them take about this long [s].
        meter: Measures the energy of the whole steps.
        advance: Told about progress.
        share: Share of the action range from which actions are drawn evenly, about its middle.
        name: The measurement's name.

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
    parts = _Parts(env, share)
    step_seconds = parts.warm_up()
    if seconds is not None:
        steps = steps_that_fit(steps, seconds, _COST * (repetitions + 1) * step_seconds)

    # The repetitions
    times: list[tuple[float, float, float, float]] = []
    ended = 0.0
    start = snapshot(sim)
    for repetition in range(repetitions + 1):
        start, spent, episodes = parts.play(start, steps, meter)
        if not repetition:  # it warms up
            meter.clear()
            continue
        ended += episodes
        times.append(spent)
        if advance is not None:
            advance(f"{name}, repetitions", repetition, repetitions)

    # The result
    out = Measurement(name=name)
    whole = [env_seconds for env_seconds, *_ in times]
    graph = env.graph if parts.on_cuda else sim.graph_of(decimation, kinematics=True)
    captured = env.graph.captured and parts.captured
    out.add_repetitions(sim, env.cfg, whole, steps, meter, graph, captured=captured)
    ms = 1e3 / steps
    out.samples |= {
        "physics_ms_per_step": [ms * p for _, p, _, _ in times],
        "managers_ms_per_step": [ms * m for _, _, m, _ in times],
        "managers_alone_over_physics": [m / p for _, p, m, _ in times],
        "residual_ms_per_step": [ms * (e - p - m - i) for e, p, m, i in times],
    }
    out.facts["episodes_ended"] = int(ended)
    out.problem = describe_lost(parts.lost) or parts.problem or out.problem
    if env.cameras is not None:
        cameras = env.cameras.cameras
        images = len(cameras) * env.nworld * steps
        out.samples |= {
            "images_ms_per_step": [ms * i for _, _, _, i in times],
            "images_per_s": [images / i for _, _, _, i in times],
            "images_over_physics": [i / p for _, p, _, i in times],
        }
        mjwarp = sim.backend == "mjwarp"
        size = image_bytes(sim.model, cameras, env.nworld, mjwarp=mjwarp)
        out.facts["images_mb"] = size / 1e6
        out.headline = (
            f"{out.median('env_steps_per_s'):,.0f} env-steps/s with images,"
            f" {out.median('images_per_s'):,.0f} images/s"
        )
        return out
    out.samples["managers_over_physics"] = [e / p - 1.0 for e, p, *_ in times]
    out.headline = (
        f"{out.median('env_steps_per_s'):,.0f} env-steps/s, managers"
        f" {100.0 * out.median('managers_over_physics'):+.1f} % (alone"
        f" {100.0 * out.median('managers_alone_over_physics'):.1f} %)"
    )
    return out


class _Parts:
    """Plays the parts of a repetition, each from the same state.

    Attributes:
        lost: Worlds whose physics was lost or not stepped, shape ``(nworld,)``, bool.
        problem: The terminations by which physics was lost in the whole steps; empty where none.
    """

    def __init__(self, env: Env, share: float) -> None:
        """Prepare random actions, with a generator that no one else uses."""
        manager = env.action_manager
        self._env = env
        self._generator = torch.Generator().manual_seed(0)
        low = manager.low.float().cpu()
        self._span = share * (manager.high.float().cpu() - low)
        self._low = 0.5 * (low + manager.high.float().cpu() - self._span)
        self.on_cuda = env.device.type == "cuda"
        self.lost = torch.zeros(env.nworld, dtype=torch.bool, device=env.device)
        self.problem = ""

    @property
    def captured(self) -> bool:
        """Whether the parts were replayed."""
        return all(part.captured for part in self._parts)

    def warm_up(self) -> float:
        """Start worlds at random ages, compile and capture; return the seconds of a step."""
        env = self._env
        env.reset(seed=env.cfg.seed)
        ages = torch.randint(env.max_episode_steps, (env.nworld,), generator=self._generator)
        env.episode_step.copy_(ages)
        seconds = [timed(env.sim, partial(env.step, action)) for action in self._actions(WARM_UP)]
        self._parts: Sequence[StepGraph] = env.parts() if env.images else env.parts()[:2]
        if self.on_cuda:  # a repetition may be too short to warm them up
            for part in self._parts:
                for _ in range(WARM_UP):
                    part()
        return seconds[-1]

    def play(
        self, start: State, steps: int, meter: EnergyMeter
    ) -> tuple[State, tuple[float, float, float, float], float]:
        """Play one repetition.

        Returns:
            The state after the whole steps; seconds of env, physics, managers and images; and the
            number of episodes that ended.
        """
        env = self._env
        sim = env.sim
        actions = self._actions(steps)
        targets = [torch.empty_like(sim.ctrl) for _ in actions]
        ages = self._ages()

        # The whole step
        restore(sim, start)
        env.read_statistics()
        whole = timed(sim, partial(self._whole, actions, targets), meter)
        counted = env.read_statistics()
        self._find_losses(counted)
        end = snapshot(sim)
        later_ages = self._ages()

        # Physics alone, with the same joint targets
        restore(sim, start)
        physics = timed(sim, lambda: self._physics(targets))
        self.lost |= lost_worlds(sim, steps * env.cfg.timing.decimation)

        # The managers alone
        restore(sim, start)
        self._set_ages(*ages)
        managers = timed(sim, lambda: self._managers(actions))
        env.raise_faults()
        self._set_ages(*later_ages)
        images = timed(sim, lambda: self._images(steps)) if env.images else 0.0
        return end, (whole, physics, managers, images), counted["episodes"]

    def _actions(self, count: int) -> list[torch.Tensor]:
        shape = (count, self._env.nworld, len(self._span))
        noise = torch.rand(shape, generator=self._generator)
        return list((self._low + self._span * noise).to(self._env.device).unbind())

    def _whole(self, actions: list[torch.Tensor], targets: list[torch.Tensor]) -> None:
        for action, target in zip(actions, targets, strict=True):
            self._env.step(action)
            # One small copy; where a world was reset it is the new episode's.
            target.copy_(self._env.sim.ctrl)

    def _physics(self, targets: list[torch.Tensor]) -> None:
        for target in targets:
            self._env.sim.ctrl.copy_(target)
            self._parts[0]()

    def _managers(self, actions: list[torch.Tensor]) -> None:
        for action in actions:
            self._env.action_manager.process(action)
            self._parts[1]()

    def _images(self, steps: int) -> None:
        for _ in range(steps):
            self._parts[2]()

    def _ages(self) -> tuple[torch.Tensor, torch.Tensor]:
        return self._env.episode_step.clone(), self._env.episode.clone()

    def _set_ages(self, step: torch.Tensor, episode: torch.Tensor) -> None:
        self._env.episode_step.copy_(step)
        self._env.episode.copy_(episode)

    def _find_losses(self, counted: dict[str, float]) -> None:
        terms = self._env.cfg.termination.items()
        losses = [n for n, term in terms if offered(term.func, "ends_on")]
        ended = [name for name in losses if counted.get(f"termination/{name}", 0.0) > 0.0]
        if ended:
            self.problem = (
                f"worlds ended by {', '.join(ended)}: raise batch.nconmax or batch.njmax, or act"
                " more gently"
            )
