"""Check of the stack task: fixed-size check on the device, fed step by step, for every world at
once.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

import numpy as np
import torch

from mjstack.config.schema import Config
from mjstack.errors import ParameterError
from mjstack.managers.base import EnvView
from mjstack.math import lowest_point, not_finite, quat_angle
from mjstack.mdp.geometry import gripper_opening
from mjstack.scene import SceneIndex, table_top
from mjstack.scene.phases import Phase
from mjstack.sim.simulation import LOST_PHYSICS, Simulation
from mjstack.tasks.check import CheckResult, EpisodeCheck, Rules
from mjstack.tasks.stack_report import report_stack
from mjstack.tasks.streaks import extend_carry, extend_run

RULES = Rules(
    {
        "LIFT": "red not lifted",
        "CARRY": "red not carried",
        "STACKED": "not stacked",
        "SUPPORTED": "blue not on the table",
        "REST_SPEED": "cube moving",
        "REST_POSITION": "cube drifting",
        "REST_ROTATION": "cube turning",
    }
)


COLORS = ("red", "blue")  # the order of every dimension over cubes


class CubePair:
    """Both cubes of every world as the rules see them, red first, float32: they read qpos and qvel
    alone, never stale.
    """

    def __init__(self, cfg: Config, index: SceneIndex, device: torch.device) -> None:
        """Reads addresses, thresholds and the table's place."""
        self._t = cfg.gate.acceptance
        self._cubes = [cfg.scene.objects[name] for name in COLORS]
        half = self._cubes[1].size[0]
        self._top = table_top(cfg.scene)
        self._qpos = [index.object_address(name)[0] for name in COLORS]
        self._qvel = [index.object_address(name)[1] for name in COLORS]
        self._center = torch.tensor(cfg.scene.table_center[:2], dtype=torch.float32, device=device)
        self._room = (
            torch.tensor(cfg.scene.table_half[:2], dtype=torch.float32, device=device) - half
        )

    def pose(self, sim: Simulation) -> torch.Tensor:
        """Position [m] and quaternion (wxyz), shape ``(nworld, 2, 7)``."""
        return torch.stack([sim.qpos[:, a : a + 7] for a in self._qpos], dim=1).float()

    def speed(self, sim: Simulation) -> torch.Tensor:
        """Fastest that any point of a cube can be [m/s], shape ``(nworld, 2)``."""
        velocity = torch.stack([sim.qvel[:, a : a + 6] for a in self._qvel], dim=1).float()
        linear, angular = torch.linalg.vector_norm(velocity.unflatten(-1, (2, 3)), dim=-1).unbind(
            -1
        )
        return linear + self._cubes[0].radius * angular

    def clearance(self, pose: torch.Tensor) -> torch.Tensor:
        """Height of each lowest corner above the table [m], shape ``(nworld, 2)``."""
        cube = self._cubes[0]
        return lowest_point(pose[..., :3], pose[..., 3:], cube.shape, cube.size) - self._top

    def offset(self, pose: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Horizontal distance of the centres, and height of red above blue [m], each
        ``(nworld,)``.
        """
        apart = pose[:, 0, :3] - pose[:, 1, :3]
        return torch.linalg.vector_norm(apart[:, :2], dim=1), apart[:, 2]

    def stacked(self, xy_err: torch.Tensor, dz: torch.Tensor) -> torch.Tensor:
        """Whether red is where it belongs on blue, shape ``(nworld,)``, bool."""
        return (xy_err <= self._t.xy_err) & (dz >= self._t.dz_min) & (dz <= self._t.dz_max)

    def supported(self, pose: torch.Tensor, clearance: torch.Tensor) -> torch.Tensor:
        """Whether blue stands on the table, shape ``(nworld,)``, bool."""
        inside = ((pose[:, 1, :2] - self._center).abs() <= self._room).all(1)
        return (clearance[:, 1].abs() <= self._t.support_gap) & inside


class StackCheck(EpisodeCheck):
    """Collects what the rules of the check need. Memory: O(window) per world, whatever the
    episode's length.
    """

    rules = RULES
    summaries: ClassVar = {
        "xy_err_max_m": ("xy_err_m", "max"),
        "dz_min_m": ("dz_m", "min"),
        "dz_max_m": ("dz_m", "max"),
        "peak_speed_max_m_per_s": ("peak_speed_m_per_s", "max"),
        "rest_speed_max_m_per_s": ("rest_speed_m_per_s", "max"),
        "rest_position_max_m": ("rest_position_m", "max"),
        "rest_rotation_max_deg": ("rest_rotation_deg", "max"),
    }

    def __init__(
        self, cfg: Config, index: SceneIndex, phases: list[Phase], nworld: int, device: torch.device
    ) -> None:
        """Allocates for nworld worlds."""
        self._t = cfg.gate.acceptance
        self._timing = cfg.timing
        self._cubes = CubePair(cfg, index, device)
        self._steps = phases[-1].stop
        self._step = torch.zeros(1, dtype=torch.int64, device=device)
        rows = [
            [phase.name in self._t.lift_phases, phase.name == self._t.carry_phase]
            for phase in phases
        ]
        self._counts_for = torch.tensor(rows, device=device)
        self._window = torch.tensor([self._steps - self._t.window, self._steps], device=device)

        def buffer(*shape: int, value: float = 0.0) -> torch.Tensor:
            return torch.full((nworld, *shape), value, dtype=torch.float32, device=device)

        self._ok = torch.ones(
            (3, nworld), dtype=torch.bool, device=device
        )  # finite, stacked, supported
        self._lift_run = buffer()
        self._lift_best = buffer()
        self._carry_run = buffer()
        self._carry_far = buffer()
        self._carry_from = buffer(2)
        self._carried = torch.zeros(nworld, dtype=torch.bool, device=device)
        # A ring that is not filled fails: NaN compares false with everything.
        self._pose = buffer(self._t.window, 2, 7, value=math.nan)
        self._speed = buffer(self._t.window, 2, value=math.nan)
        self._xy_err = buffer(value=math.nan)
        self._dz = buffer(value=math.nan)

    def update(self, sim: Simulation, phase: torch.Tensor) -> None:
        """Takes in the state at the end of a step. Fixed shapes, no host read."""
        t = self._t
        cubes = self._cubes
        going = self._step < self._steps  # steps after the end count for nothing
        in_lift, in_carry = (self._counts_for.index_select(0, phase) & going).unbind(1)
        in_window = (self._step >= self._window[0]) & going
        finite, stacked, supported = self._ok.unbind(0)
        finite &= ~not_finite(sim.qpos, sim.qvel)
        pose = cubes.pose(sim)
        low = cubes.clearance(pose)

        airborne = low[:, 0] > t.airborne_height
        extend_run(self._lift_run, self._lift_best, airborne, in_lift)
        extend_carry(
            self._carry_run, self._carry_far, self._carry_from, pose[:, 0, :2], airborne & in_carry
        )
        self._carried |= (self._carry_run >= t.carry_steps) & (self._carry_far >= t.carry_distance)

        xy_err, dz = cubes.offset(pose)
        self._xy_err.copy_(xy_err)
        self._dz.copy_(dz)
        stacked &= cubes.stacked(xy_err, dz) | ~in_window
        supported &= cubes.supported(pose, low) | ~in_window
        slot = self._step.remainder(t.window)
        self._pose.index_copy_(1, slot, pose[:, None])
        self._speed.index_copy_(1, slot, cubes.speed(sim)[:, None])
        self._step += 1

    def result(self, sim: Simulation) -> CheckResult:
        """Judges the episode; every rule that was not shown to hold has failed."""
        t = self._t
        position, rotation = self._spread()
        rms = self._speed.square().mean(1).sqrt().amax(1)
        finite, stacked, supported = self._ok.unbind(0)
        complete = int(self._step) == self._steps
        wanted = self._steps * self._timing.decimation
        held = {
            "FINITE": finite,
            "STEPS": (sim.step_count == wanted) & complete,
            "OVERFLOW": (sim.overflow & LOST_PHYSICS) == 0,
            "LIFT": self._lift_best >= t.lift_steps,
            "CARRY": self._carried,
            "STACKED": stacked & complete,
            "SUPPORTED": supported & complete,
            "REST_SPEED": rms <= t.rest_speed,
            "REST_POSITION": position <= t.rest_position,
            "REST_ROTATION": rotation <= math.radians(t.rest_rotation_deg),
        }
        peak = self._speed.amax((1, 2))
        return CheckResult.of(
            RULES,
            held,
            {
                "xy_err_m": self._xy_err,
                "dz_m": self._dz,
                "rest_speed_m_per_s": rms,
                "peak_speed_m_per_s": peak,
                "rest_position_m": position,
                "rest_rotation_deg": rotation.double().rad2deg(),
            },
        )

    def placed(self, sim: Simulation) -> torch.Tensor:
        """Whether red is on blue, and blue on the table, right now."""
        cubes = self._cubes
        pose = self._cubes.pose(sim)
        on_blue = cubes.stacked(*cubes.offset(pose))
        return torch.stack((on_blue, cubes.supported(pose, cubes.clearance(pose))), dim=1)

    @classmethod
    def thresholds(cls, cfg: Config) -> dict[str, float]:
        """The rules' numbers, with units."""
        t = cfg.gate.acceptance
        return {
            "xy_err_max_m": t.xy_err,
            "dz_min_m": t.dz_min,
            "dz_max_m": t.dz_max,
            "lift_steps": t.lift_steps,
            "carry_distance_m": t.carry_distance,
            "support_gap_m": t.support_gap,
            "rest_speed_m_per_s": t.rest_speed,
            "rest_position_m": t.rest_position,
            "rest_rotation_deg": t.rest_rotation_deg,
            "window_steps": t.window,
        }

    @classmethod
    def explain(
        cls, cfg: Config, steps: Mapping[str, np.ndarray], values: Mapping[str, float]
    ) -> dict[str, tuple[str, str]]:
        """See `report_stack`."""
        return report_stack(cfg, steps, values)

    @classmethod
    def headline(cls, values: Mapping[str, float]) -> str:
        """How well red stands on blue."""
        return f"xy_err {1e3 * values['xy_err_m']:.1f} mm, dz {1e3 * values['dz_m']:.1f} mm"

    def _spread(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Largest pairwise distance [m] and angle [rad] over the window: the pairs one lag apart at
        a time.
        """
        n = self._t.window
        distance = torch.zeros_like(self._xy_err)
        angle = torch.zeros_like(self._xy_err)
        for lag in range(1, n):
            a = self._pose[:, : n - lag]
            b = self._pose[:, lag:]
            # amax hands NaN on, so that an unfilled or diverged window fails its rule.
            distance = torch.maximum(
                distance, torch.linalg.vector_norm(a[..., :3] - b[..., :3], dim=-1).amax((1, 2))
            )
            angle = torch.maximum(angle, quat_angle(a[..., 3:], b[..., 3:]).amax((1, 2)))
        return distance, angle


class StackSuccess:
    """Achieved while red has stood at rest on blue through the whole window, and the gripper is
    open.

    Rules 4 and 5 of the check, over a ring of the last steps. For the largest distance between any
    two steps of the window, each step keeps its largest distance to the later ones: a new step
    updates all of them at once, and the one that leaves takes its own along. Distances stay
    squared, and angles stay cosines, until they are judged.
    """

    def __init__(self, env: EnvView, *, open_fraction: float) -> None:
        """Allocates the ring.

        Args:
            env: The environment. The thresholds are those of ``gate.acceptance``.
            open_fraction: How far the gripper must be open, from 0 (closed) to 1 (open), as
                measured.

        Raises:
            ParameterError: The fraction is out of range.
        """
        if not 0.0 <= open_fraction <= 1.0:
            raise ParameterError("open_fraction", open_fraction, "a number from 0 to 1")
        self._t = env.cfg.gate.acceptance
        self._open = open_fraction
        self._cubes = CubePair(env.cfg, env.index, env.device)
        n = env.nworld
        window = self._t.window
        device = env.device
        self._slot = torch.zeros(
            1, dtype=torch.int64, device=device
        )  # where the oldest step is, in every world
        self._pos = torch.zeros((n, window, 2, 3), device=device)
        self._quat = torch.zeros((n, window, 2, 4), device=device)
        self._apart, self._product = torch.zeros_like(self._pos), torch.zeros_like(self._quat)
        self._energy = torch.zeros((n, window, 2), device=device)  # squared speed
        self._far = torch.zeros(
            (n, window, 2), device=device
        )  # per step and cube: squared distance to later steps
        self._turned = torch.zeros(
            (n, window, 2), device=device
        )  # likewise: 1 - |cosine of half the angle|
        self._held = torch.zeros(
            n, dtype=torch.int32, device=device
        )  # steps in a row that were stacked and supported

    def __call__(self, env: EnvView) -> torch.Tensor:
        """Takes in a step; shape ``(nworld,)``, bool."""
        t = self._t
        cubes = self._cubes
        pose = cubes.pose(env.sim)
        pos = pose[..., :3]
        quat = pose[..., 3:]
        stacked = cubes.stacked(*cubes.offset(pose)) & cubes.supported(pose, cubes.clearance(pose))
        self._held.add_(1).mul_(stacked)

        # The new step takes the oldest one's place.
        self._slot.add_(1).remainder_(t.window)
        self._pos.index_copy_(1, self._slot, pos[:, None])
        self._quat.index_copy_(1, self._slot, quat[:, None])
        self._energy.index_copy_(1, self._slot, cubes.speed(env.sim).square()[:, None])
        for ring in (self._far, self._turned):
            ring.index_fill_(1, self._slot, 0.0)
        if not stacked.is_cuda and not bool(stacked.any()):
            return torch.zeros_like(
                stacked
            )  # no window that holds this step can pass, in any world
        torch.sub(self._pos, pos[:, None], out=self._apart).square_()
        torch.maximum(self._far, self._apart.sum(-1), out=self._far)
        torch.mul(self._quat, quat[:, None], out=self._product)
        torch.maximum(self._turned, 1.0 - self._product.sum(-1).abs(), out=self._turned)

        rest = (self._energy.mean(1) <= t.rest_speed**2).all(1)
        rest &= self._far.amax((1, 2)) <= t.rest_position**2
        rest &= self._turned.amax((1, 2)) <= 1.0 - math.cos(0.5 * math.radians(t.rest_rotation_deg))
        return (self._held >= t.window) & rest & (gripper_opening(env) >= self._open).all(1)

    def reset(self, mask: torch.Tensor) -> None:
        """Forgets the masked worlds.

        What they leave in the ring does not matter: every slot is written anew before `_held` can
        reach the window.
        """
        self._held.masked_fill_(mask, 0)
