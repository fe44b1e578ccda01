"""Task *stack*: one object onto another one."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor
from typing_extensions import override

from mjstack.config.fields import spec
from mjstack.managers.state import branches
from mjstack.managers.view import EnvView
from mjstack.report.figure import Figure
from mjstack.sim.graph import where_any
from mjstack.tasks import parts
from mjstack.tasks.check import EpisodeCheck, Rule
from mjstack.tasks.placed import HeldSuccess
from mjstack.tasks.view import Step


class StackCheck(EpisodeCheck):
    """One object has been lifted, carried and let go of, and stands at rest on another one, which
    stands on the table.

    Without phases, lift and carry count at any time before the settled window, the carry once the
    lift holds, and only while all jaws press on the object.
    """

    @dataclass(kw_only=True, slots=True)
    class Thresholds:
        """When an episode of the stack task succeeded. Sampled at step ends."""

        object: str = spec()
        """The object that is carried."""
        onto: str = spec()
        """The object that it belongs on."""
        lift_phases: list[str] = spec()
        """Phases in which lifting counts, if the driver has phases."""
        carry_phase: str = spec()
        """Phase in which carrying counts, if the driver has phases."""
        airborne_height: float = spec(unit="m", ge=0.0)
        """Height of its lowest point above the table from which the object is in the air."""
        lift_steps: int = spec(unit="steps", ge=1, le=1_000_000)
        """Consecutive steps in the air that make a lift."""
        carry_steps: int = spec(unit="steps", ge=1, le=1_000_000)
        """Least number of consecutive steps in the air of a carry."""
        carry_distance: float = spec(unit="m", gt=0.0)
        """Horizontal distance from where those steps began."""
        window: int = spec(unit="steps", ge=2, le=10_000)
        """Last steps of the episode, in which everything below must hold."""
        xy_err: float = spec(unit="m", gt=0.0)
        """Largest horizontal distance of the centres."""
        dz_min: float = spec(unit="m")
        """Least height of the object's centre above the other one's."""
        dz_max: float = spec(unit="m")
        """Largest height of the object's centre above the other one's."""
        support_gap: float = spec(unit="m", gt=0.0)
        """Largest distance of the lower object's lowest point from the table top."""
        rest_speed: float = spec(unit="m/s", gt=0.0)
        """Root mean square of the speed that any point of an object may have."""
        rest_position: float = spec(unit="m", gt=0.0)
        """Largest distance of an object between any two steps of the window."""
        rest_rotation_deg: float = spec(unit="deg", gt=0.0)
        """Largest rotation of an object between any two steps of the window."""
        open_fraction: float = spec(gt=0.0, le=1.0)
        """Share of the gripper's opening, as measured, while no jaw touches the object."""

    t: Thresholds
    summaries = {  # noqa: RUF012
        "xy_err_max": ("xy_err_m", "max"),
        "dz_min": ("dz_m", "min"),
        "dz_max": ("dz_m", "max"),
        "peak_speed_max": ("peak_speed_m_per_s", "max"),
        "rest_speed_max": ("rest_speed_m_per_s", "max"),
        "rest_position_max": ("rest_position_m", "max"),
        "rest_rotation_max": ("rest_rotation_deg", "max"),
    }

    @override
    def build(self) -> list[Rule]:
        t = self.t
        self.objects = [t.object, t.onto]
        airborne = parts.airborne(t.object, height=t.airborne_height)
        self.stacked = parts.on_top(
            t.object, t.onto, xy_err=t.xy_err, dz_min=t.dz_min, dz_max=t.dz_max
        )
        self.supported = parts.on_table(t.onto, gap=t.support_gap)
        self.released = parts.released(t.object, open_fraction=t.open_fraction)
        lift = parts.Streak(
            "LIFT",
            "{object} not lifted",
            [t.object],
            airborne,
            t.lift_steps,
            phases=[t.lift_phases],
        )
        carry = parts.Carried(
            *("CARRY", "{object} not carried", [t.object], airborne, t.carry_steps),
            distance=t.carry_distance,
            phases=[[t.carry_phase]],
            after=lift,
        )
        return [
            lift,
            carry,
            parts.InWindow(
                *("STACKED", "not stacked", self.stacked, t.window),
                measure=self.trace,
                measured=[
                    Figure("xy_err", unit="m", high=t.xy_err),
                    Figure("dz", unit="m", low=t.dz_min, high=t.dz_max),
                ],
            ),
            parts.InWindow("SUPPORTED", f"{t.onto} not on the table", self.supported, t.window),
            parts.AtRest(t.window, t.rest_speed, t.rest_position, t.rest_rotation_deg),
            parts.InWindow("RELEASED", f"{t.object} not released", self.released, t.window),
        ]

    @override
    def placed(self, step: Step) -> Tensor:
        """Whether the object is on the other one, and that one on the table."""
        return torch.stack((self.stacked(step), self.supported(step)), dim=1)

    @override
    def goals(self, step: Step) -> dict[str, Tensor]:
        return {self.t.object: parts.on_top_of(step, self.t.onto, self.t.object)}

    @override
    def trace(self, step: Step) -> dict[str, Tensor]:
        xy_err, dz = parts.offset(step, *self.objects)
        return {"xy_err_m": xy_err, "dz_m": dz}

    def headline(self, values: Mapping[str, float]) -> str:
        """How well the object stands."""
        return f"xy_err {1e3 * values['xy_err_m']:.1f} mm, dz {1e3 * values['dz_m']:.1f} mm"


class StackSuccess(HeldSuccess):
    """Achieved while an object has stood at rest on another one, let go of, through the whole
    window: rules 4 to 6 of the check, whose thresholds it shares.

    For the largest distance between any two steps of the window, each step keeps its largest
    distance to the later ones: a new step updates all of them at once, and the one that leaves
    takes its own along. Distances stay squared, and angles stay cosines, until they are judged.
    """

    def __init__(self, env: EnvView) -> None:
        """Allocate a ring of the last steps.

        Raises:
            MjstackError: The task has another check.
        """
        check = StackCheck.from_env(env)
        super().__init__(env, [check.placed, check.released], check.t.window)
        self._state = state = env.state
        ring = (check.t.window, len(state.objects))
        # Where the oldest step is, in every world.
        self._slot = torch.zeros(1, dtype=torch.int64, device=env.device)
        self._pose = state.zeros(*ring, 7)
        self._energy = state.zeros(*ring)  # squared speed
        # Squared distance to later steps, and 1 - |cosine of half the angle| to them
        self._spans = state.zeros(*ring, 2)
        t = check.t
        rotation = 1.0 - math.cos(0.5 * math.radians(t.rest_rotation_deg))
        speeds = [t.rest_speed**2] * len(state.objects)
        self._limits = state.constant(*speeds, t.rest_position**2, rotation)

    def __call__(self, env: EnvView) -> Tensor:
        """Process a step; shape ``(nworld,)``, bool."""
        achieved, _ = branches(env.device, partial(super().__call__, env), self._record_step)
        if achieved.is_cuda or bool(achieved.any()):
            largest = torch.cat((self._energy.mean(1), self._spans.amax((1, 2))), dim=1)
            achieved &= (largest <= self._limits).all(1)
        return achieved

    def _record_step(self) -> None:
        """Take a step in place of the oldest one. `reset` may leave the ring alone: every slot is
        written anew before the streak can reach the window.
        """
        self._slot.add_(1).remainder_(self._steps)
        # No window that holds a step without a standing object can pass: its slot is never judged.
        where_any(self._length, self._replace_oldest)

    def _replace_oldest(self) -> None:
        step = self._state
        self._pose.index_copy_(1, self._slot, step.pose[:, None])
        self._energy.index_copy_(1, self._slot, step.speed.square()[:, None])
        self._spans.index_fill_(1, self._slot, 0.0)
        # The newest step against the others
        distance = (self._pose[..., :3] - step.pos[:, None]).square().sum(-1)
        cosine = (self._pose[..., 3:] * step.quat[:, None]).sum(-1).abs()
        spans = torch.stack((distance, 1.0 - cosine), dim=-1)
        torch.maximum(self._spans, spans, out=self._spans)
