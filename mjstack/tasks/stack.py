"""Acceptance of the stack task: fixed-size evidence on the device, fed frame by frame, for every world at once."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntFlag

import torch

from mjstack.config.schema import Config
from mjstack.control.scripted import Phase
from mjstack.math import lowest_corner, quat_angle
from mjstack.scene import SceneIndex, table_top
from mjstack.sim.simulation import LOST_PHYSICS, Simulation


class Rule(IntFlag):
    """What a world can fail by; a world passes with none set."""

    FINITE = 1 << 0
    STEPS = 1 << 1
    OVERFLOW = 1 << 2
    LIFT = 1 << 3
    CARRY = 1 << 4
    STACKED = 1 << 5
    SUPPORTED = 1 << 6
    REST_SPEED = 1 << 7
    REST_POSITION = 1 << 8
    REST_ROTATION = 1 << 9


RULE_TEXT = {
    Rule.FINITE: "state not finite",
    Rule.STEPS: "step counter off",
    Rule.OVERFLOW: "buffer overflow",
    Rule.LIFT: "red not lifted",
    Rule.CARRY: "red not carried",
    Rule.STACKED: "not stacked",
    Rule.SUPPORTED: "blue not on the table",
    Rule.REST_SPEED: "cube moving",
    Rule.REST_POSITION: "cube drifting",
    Rule.REST_ROTATION: "cube turning",
}


@dataclass(frozen=True, slots=True)
class Verdict:
    """What the evidence says, on the device.

    Attributes:
        failed: Bits of `Rule`, shape ``(nworld,)``, int32.
        xy_err: Horizontal distance of the cube centres at the end [m], shape ``(nworld,)``.
        dz: Height of red above blue at the end [m], shape ``(nworld,)``.
        rest_speed: RMS over the window, larger of both cubes [m/s], shape ``(nworld,)``.
        peak_speed: Largest instead of RMS; reported, not judged.
        rest_position: Largest distance between any two frames of the window, larger of both cubes [m].
        rest_rotation: Likewise [rad].
    """

    failed: torch.Tensor
    xy_err: torch.Tensor
    dz: torch.Tensor
    rest_speed: torch.Tensor
    peak_speed: torch.Tensor
    rest_position: torch.Tensor
    rest_rotation: torch.Tensor


class StackEvidence:
    """Collects what the acceptance rules need. Memory: O(window) per world, whatever the episode's length."""

    def __init__(self, cfg: Config, index: SceneIndex, phases: list[Phase], nworld: int, device: torch.device) -> None:
        """Allocates for nworld worlds."""
        self._t = cfg.gate.acceptance
        self._scene, self._timing = cfg.scene, cfg.timing
        self._qpos, self._qvel = index.cube_qpos, index.cube_qvel
        self._frames = phases[-1].stop
        self._lift = _frames_of(phases, self._t.lift_phases)
        self._carry = _frames_of(phases, [self._t.carry_phase])
        self._frame = 0

        def buffer(*shape: int, value: float = 0.0) -> torch.Tensor:
            return torch.full((nworld, *shape), value, dtype=torch.float32, device=device)

        self._ok = torch.ones((3, nworld), dtype=torch.bool, device=device)  # finite, stacked, supported
        self._lift_run, self._lift_best = buffer(), buffer()
        self._carry_run, self._carry_far, self._carry_from = buffer(), buffer(), buffer(2)
        self._carried = torch.zeros(nworld, dtype=torch.bool, device=device)
        # A ring that is not filled fails: NaN compares false with everything.
        self._pose = buffer(self._t.window, 2, 7, value=math.nan)
        self._speed = buffer(self._t.window, 2, value=math.nan)
        self._xy_err, self._dz = buffer(value=math.nan), buffer(value=math.nan)

    def update(self, sim: Simulation) -> None:
        """Takes in the state at the end of a frame. Reads qpos and qvel alone, which are never stale."""
        frame, t = self._frame, self._t
        finite, stacked, supported = self._ok.unbind(0)
        finite &= torch.isfinite(sim.qpos).all(1) & torch.isfinite(sim.qvel).all(1)
        pose = torch.stack([sim.qpos[:, a : a + 7] for a in self._qpos], dim=1).float()
        velocity = torch.stack([sim.qvel[:, a : a + 6] for a in self._qvel], dim=1).float()
        pos, quat = pose[..., :3], pose[..., 3:]
        low = lowest_corner(pos, quat, self._scene.cube_half) - table_top(self._scene)

        airborne = low[:, 0] > t.airborne_height
        if frame in self._lift:
            self._lift_run.add_(1.0).mul_(airborne)
            torch.maximum(self._lift_best, self._lift_run, out=self._lift_best)
        if frame in self._carry:
            red = pos[:, 0, :2]
            starts = airborne & (self._carry_run == 0.0)
            self._carry_from.copy_(torch.where(starts[:, None], red, self._carry_from))
            self._carry_run.add_(1.0).mul_(airborne)
            away = torch.linalg.vector_norm(red - self._carry_from, dim=1)
            self._carry_far.copy_(torch.where(airborne, torch.maximum(self._carry_far, away), 0.0))
            self._carried |= (self._carry_run >= t.carry_frames) & (self._carry_far >= t.carry_distance)

        torch.linalg.vector_norm(pos[:, 0, :2] - pos[:, 1, :2], dim=1, out=self._xy_err)
        torch.sub(pos[:, 0, 2], pos[:, 1, 2], out=self._dz)
        if frame >= self._frames - t.window:
            stacked &= (self._xy_err <= t.xy_err) & (self._dz >= t.dz_min) & (self._dz <= t.dz_max)
            centre = torch.tensor(self._scene.table_center[:2], dtype=torch.float32, device=pos.device)
            half = torch.tensor(self._scene.table_half[:2], dtype=torch.float32, device=pos.device)
            inside = ((pos[:, 1, :2] - centre).abs() <= half - self._scene.cube_half).all(1)
            supported &= (low[:, 1].abs() <= t.support_gap) & inside
        slot = frame % t.window
        self._pose[:, slot] = pose
        spin = math.sqrt(3.0) * self._scene.cube_half * torch.linalg.vector_norm(velocity[..., 3:], dim=-1)
        self._speed[:, slot] = torch.linalg.vector_norm(velocity[..., :3], dim=-1) + spin
        self._frame += 1

    def verdict(self, sim: Simulation) -> Verdict:
        """Judges the episode; every rule that was not shown to hold has failed."""
        t = self._t
        position, rotation = self._spread()
        rms = self._speed.square().mean(1).sqrt().amax(1)
        finite, stacked, supported = self._ok.unbind(0)
        complete = self._frame == self._frames
        wanted = self._frames * self._timing.substeps
        held = {
            Rule.FINITE: finite,
            Rule.STEPS: (sim.step_count == wanted) & complete,
            Rule.OVERFLOW: (sim.overflow & LOST_PHYSICS) == 0,
            Rule.LIFT: self._lift_best >= t.lift_frames,
            Rule.CARRY: self._carried,
            Rule.STACKED: stacked & complete,
            Rule.SUPPORTED: supported & complete,
            Rule.REST_SPEED: rms <= t.rest_speed,
            Rule.REST_POSITION: position <= t.rest_position,
            Rule.REST_ROTATION: rotation <= math.radians(t.rest_rotation_deg),
        }
        failed = torch.zeros_like(sim.overflow)
        for rule, ok in held.items():
            failed |= int(rule) * (~ok).to(failed.dtype)
        peak = self._speed.amax((1, 2))
        return Verdict(failed, self._xy_err, self._dz, rms, peak, position, rotation)

    def _spread(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Largest pairwise distance [m] and angle [rad] over the window: the pairs one lag apart at a time."""
        n = self._t.window
        distance = torch.zeros_like(self._xy_err)
        angle = torch.zeros_like(self._xy_err)
        for lag in range(1, n):
            a, b = self._pose[:, : n - lag], self._pose[:, lag:]
            # amax hands NaN on, so that an unfilled or diverged window fails its rule.
            distance = torch.maximum(distance, torch.linalg.vector_norm(a[..., :3] - b[..., :3], dim=-1).amax((1, 2)))
            angle = torch.maximum(angle, quat_angle(a[..., 3:], b[..., 3:]).amax((1, 2)))
        return distance, angle


def describe_rules(bits: int) -> str:
    """The rules in a bit set, in words."""
    return ", ".join(RULE_TEXT[rule] for rule in Rule if bits & rule)


def _frames_of(phases: list[Phase], names: list[str]) -> set[int]:
    return {frame for phase in phases if phase.name in names for frame in range(phase.start, phase.stop)}
