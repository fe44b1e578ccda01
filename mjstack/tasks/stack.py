"""Task *stack*: one object onto another one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch

from mjstack.config.fields import spec
from mjstack.errors import ParameterError, UnknownName
from mjstack.managers.view import EnvView
from mjstack.mdp.geometry import gripper_opening
from mjstack.tasks.check import EpisodeCheck, Rule
from mjstack.tasks.parts import (
    AtRest,
    Carried,
    InWindow,
    RestWindow,
    Streak,
    airborne,
    millimetres,
    offset,
    on_table,
    on_top,
)
from mjstack.tasks.view import Step


class StackCheck(EpisodeCheck):
    """One object has been lifted, carried, and stands at rest on another one, which stands on the
    table.
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
        lift_steps: int = spec(unit="steps", ge=1)
        """Consecutive steps in the air that make a lift."""
        carry_steps: int = spec(unit="steps", ge=1)
        """Least number of consecutive steps in the air of a carry."""
        carry_distance: float = spec(unit="m", gt=0.0)
        """Horizontal distance from where those steps began."""
        window: int = spec(unit="steps", ge=2)
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

    t: Thresholds
    summaries = {  # noqa: RUF012
        "xy_err_max_m": ("xy_err_m", "max"),
        "dz_min_m": ("dz_m", "min"),
        "dz_max_m": ("dz_m", "max"),
        "peak_speed_max_m_per_s": ("peak_speed_m_per_s", "max"),
        "rest_speed_max_m_per_s": ("rest_speed_m_per_s", "max"),
        "rest_position_max_m": ("rest_position_m", "max"),
        "rest_rotation_max_deg": ("rest_rotation_deg", "max"),
    }

    def build(self) -> list[Rule]:
        """See `EpisodeCheck`."""
        t = self.t
        phases = self.cfg.controller.phases
        for key in ("lift_phases", "carry_phase"):
            for name in [getattr(t, key)] if key == "carry_phase" else t.lift_phases:
                if phases and name not in phases:
                    raise UnknownName(f"task.check.{key}: phase", name, phases)
        self.objects = [t.object, t.onto]
        moved = [t.object]
        up = airborne(t.object, height=t.airborne_height)
        self.stacked = on_top(t.object, t.onto, xy_err=t.xy_err, dz_min=t.dz_min, dz_max=t.dz_max)
        self.supported = on_table(t.onto, gap=t.support_gap)
        lift = Streak(
            "LIFT",
            "{object} not lifted",
            moved,
            up,
            t.lift_steps,
            phases=[t.lift_phases],
            doing="in the air",
        )
        carry = Carried(
            "CARRY",
            "{object} not carried",
            moved,
            up,
            t.carry_steps,
            distance=t.carry_distance,
            phases=[[t.carry_phase]],
            doing="in the air",
            after=lift,
        )
        return [
            lift,
            carry,
            InWindow(
                "STACKED",
                "not stacked",
                self.stacked,
                t.window,
                measure=self.trace,
                found=self.headline,
                wanted=f"xy_err at most {millimetres(t.xy_err)}, dz {1e3 * t.dz_min:g} to"
                f" {millimetres(t.dz_max)}",
            ),
            InWindow(
                "SUPPORTED",
                f"{t.onto} not on the table",
                self.supported,
                t.window,
                wanted=f"within {millimetres(t.support_gap)} of the top, centre on the table",
            ),
            AtRest(
                t.window,
                speed=t.rest_speed,
                position=t.rest_position,
                rotation_deg=t.rest_rotation_deg,
            ),
        ]

    def placed(self, step: Step) -> torch.Tensor:
        """Whether the object is on the other one, and that one on the table."""
        return torch.stack((self.stacked(step), self.supported(step)), dim=1)

    def trace(self, step: Step) -> dict[str, torch.Tensor]:
        """See `EpisodeCheck`."""
        xy_err, dz = offset(step, *self.objects)
        return {"xy_err_m": xy_err, "dz_m": dz}

    def headline(self, values: Mapping[str, float]) -> str:
        """How well the object stands."""
        return f"xy_err {1e3 * values['xy_err_m']:.1f} mm, dz {1e3 * values['dz_m']:.1f} mm"


class StackSuccess:
    """Achieved while an object has stood at rest on another one through the whole window, and the
    gripper is open: rules 4 and 5 of the check, whose thresholds it shares.
    """

    def __init__(self, env: EnvView, *, open_fraction: float) -> None:
        """Allocates the ring.

        Args:
            env: The environment, its task's check a `StackCheck`.
            open_fraction: How far the gripper must be open, from 0 (closed) to 1 (open), as
                measured.

        Raises:
            MjstackError: The fraction is out of range, or the task has another check.
        """
        if not 0.0 <= open_fraction <= 1.0:
            raise ParameterError("open_fraction", open_fraction, "a number from 0 to 1")
        self._open = open_fraction
        self._check = StackCheck(env.cfg)
        t = self._check.t
        self._view = self._check.view(env)
        self._rest = RestWindow(
            self._view,
            t.window,
            speed=t.rest_speed,
            position=t.rest_position,
            rotation_deg=t.rest_rotation_deg,
        )
        # Steps in a row that were stacked and supported.
        self._held = torch.zeros(env.nworld, dtype=torch.int32, device=env.device)

    def __call__(self, env: EnvView) -> torch.Tensor:
        """Processes a step; shape ``(nworld,)``, bool."""
        step = self._view.step()
        stacked = self._check.stacked(step) & self._check.supported(step)
        self._held.add_(1).mul_(stacked)
        self._rest.append(step)
        if not stacked.is_cuda and not bool(stacked.any()):
            # No window that holds this step can pass, in any world.
            return torch.zeros_like(stacked)
        rest = self._rest.compare(step)
        opened = (gripper_opening(env) >= self._open).all(1)
        return (self._held >= self._check.t.window) & rest & opened

    def reset(self, mask: torch.Tensor) -> None:
        """Forgets the masked worlds.

        The ring may keep them: every slot is written anew before `_held` can reach the window.
        """
        self._held.masked_fill_(mask, 0)
