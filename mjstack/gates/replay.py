"""One world of a batch played again, alone: its trajectory, and every acceptance rule with what was found and wanted."""

from __future__ import annotations

import io
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mjstack.config.schema import Backend, Config
from mjstack.control.scripted import Phase
from mjstack.gates.episode import Episode, FrameHook, State, snapshot, start_worlds
from mjstack.gates.gate import GateContext, measured_values
from mjstack.managers.reset import required_fields
from mjstack.math import lowest_corner
from mjstack.report.record import write_atomic
from mjstack.scene import SceneIndex, table_top
from mjstack.sim import Simulation, describe_overflow, make_simulation, resolve_sizes
from mjstack.sim.sizes import BatchSizes
from mjstack.tasks.stack import RULE_TEXT, Rule

_SHARES = 4  # of the contact pool, for a world that is alone


@dataclass(frozen=True, kw_only=True, slots=True)
class RuleFinding:
    """One acceptance rule of one world: whether it held, what was found, and what it wants."""

    rule: Rule
    held: bool
    found: str
    wanted: str

    def __str__(self) -> str:
        verdict = "held" if self.held else f"BROKEN, {RULE_TEXT[self.rule]}"
        return f"{self.rule.name}: {verdict}: {self.found} (wanted: {self.wanted})"


@dataclass(eq=False, kw_only=True, slots=True)
class ReplayedWorld:
    """What a replay leaves behind.

    Attributes:
        episode: The episode of the one world.
        start: Its state before the first frame.
        fields: Model fields that its start wrote, by MuJoCo's name.
        frames: State and task evidence at frame ends, by name, each with frames first.
        findings: The rules, all of them.
        description: Backend and hardware.
        qpos_end: Final positions in the backend's precision, shape ``(nq,)``.
    """

    episode: Episode
    start: State
    fields: dict[str, np.ndarray]
    frames: dict[str, np.ndarray]
    findings: list[RuleFinding]
    description: str
    qpos_end: np.ndarray

    @property
    def failed(self) -> int:
        """Bits of `Rule`."""
        return int(self.episode.verdict.failed[0])

    def write(self, path: Path, *, seed: int, world: int) -> None:
        """Writes the trajectory as an npz file, in one step."""
        arrays: dict[str, Any] = {
            "seed": seed,
            "world": world,
            "backend": self.description,
            "failed": self.failed,
            "start_qpos": self.start.qpos[0],
            "start_qvel": self.start.qvel[0],
            **{f"field.{name}": values for name, values in self.fields.items()},
            **self.frames,
        }
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **arrays)
        write_atomic(path, buffer.getvalue())


def replay_world(
    context: GateContext, *, seed: int, world: int, backend: Backend, device: str, on_frame: FrameHook | None = None
) -> ReplayedWorld:
    """Plays one world as it started in its batch.

    Random numbers depend on the seed, the world's number and the episode, not on the other worlds, so it needs no others.

    Args:
        context: The run's configuration; its ``nworld`` is the batch's.
        seed: The seed.
        world: The world's number in the batch.
        backend: Native or MJWarp.
        device: ``cpu`` or ``cuda:N``.
        on_frame: Called after each frame.
    """
    cfg = replace(context.cfg, seed=seed)
    sim = make_simulation(
        context.model,
        cfg,
        1,
        backend=backend,
        device=device,
        fields=required_fields(cfg.reset),
        sizes=_sizes_alone(resolve_sizes(cfg), cfg.nworld),
    )
    try:
        start_worlds(sim, context.index, cfg, cfg.reset, context.planner, worlds=[world])
        start = snapshot(sim)
        fields = {name: field[0].cpu().numpy().copy() for name, field in sim.fields.items()}
        states: list[State] = []

        def keep(frame: int, sim: Simulation) -> None:
            states.append(snapshot(sim))
            if on_frame is not None:
                on_frame(frame, sim)

        episode = context.run(sim, cfg.reset, seed=seed, worlds=[world], on_frame=keep, record=True)
        frames = _evidence(states, cfg, context.index, context.planner.phases)
        return ReplayedWorld(
            episode=episode,
            start=start,
            fields=fields,
            frames=frames,
            findings=_explain(episode, frames, sim, cfg),
            description=sim.description,
            qpos_end=sim.qpos[0].cpu().numpy().copy(),
        )
    finally:
        sim.close()


def _sizes_alone(sizes: BatchSizes, nworld: int) -> BatchSizes:
    """Buffers for one world. In its batch it could take more than its share of the contact pool, so it gets some more."""

    def room(share: int, pool: int | None) -> int:
        return min(_SHARES * share, share * nworld if pool is None else pool)

    naconmax = room(sizes.nconmax, sizes.naconmax)
    naccdmax = sizes.naccdmax
    if sizes.nccdmax is not None or naccdmax is not None:
        naccdmax = min(room(sizes.nccdmax or sizes.nconmax, naccdmax), naconmax)
    return replace(sizes, nconmax=min(sizes.nconmax, naconmax), naconmax=naconmax, nccdmax=None, naccdmax=naccdmax)


def _evidence(states: list[State], cfg: Config, index: SceneIndex, phases: list[Phase]) -> dict[str, np.ndarray]:
    """State and what the acceptance looks at, at frame ends; red is 0 and blue is 1."""
    qpos, qvel, ctrl = (np.concatenate([getattr(s, name) for s in states]) for name in ("qpos", "qvel", "ctrl"))
    pose = torch.from_numpy(np.stack([qpos[:, a : a + 7] for a in index.cube_qpos], 1)).float()
    velocity = np.stack([qvel[:, a : a + 6] for a in index.cube_qvel], 1)
    half = cfg.scene.cube_half
    low = lowest_corner(pose[..., :3], pose[..., 3:], half).numpy() - np.float32(table_top(cfg.scene))
    spin = math.sqrt(3.0) * half * np.linalg.norm(velocity[..., 3:], axis=-1)
    red, blue = pose[:, 0, :3].numpy(), pose[:, 1, :3].numpy()  # float32, as the acceptance computes
    return {
        "time_s": np.arange(1, len(states) + 1) * cfg.timing.frame_dt,
        "phase": np.array([phase.name for phase in phases for _ in range(phase.start, phase.stop)]),
        "qpos": qpos,
        "qvel": qvel,
        "ctrl": ctrl,
        "cube_pos_m": pose[..., :3].numpy(),
        "xy_err_m": np.linalg.norm(red[:, :2] - blue[:, :2], axis=1),
        "dz_m": red[:, 2] - blue[:, 2],
        "cube_speed_m_per_s": np.linalg.norm(velocity[..., :3], axis=-1) + spin,
        "cube_height_m": low,
    }


def _explain(episode: Episode, frames: dict[str, np.ndarray], sim: Simulation, cfg: Config) -> list[RuleFinding]:
    """Every rule with what was found. Whether it held is the acceptance's own verdict; the numbers say why."""
    t, scene = cfg.gate.acceptance, cfg.scene
    bits = int(episode.verdict.failed[0])
    value = {name: float(values[0]) for name, values in measured_values(episode.verdict).items()}
    red_xy, blue_xy = frames["cube_pos_m"][:, 0, :2], frames["cube_pos_m"][:, 1, :2]
    airborne = frames["cube_height_m"][:, 0] > t.airborne_height
    lift = _runs(airborne, red_xy, np.isin(frames["phase"], t.lift_phases))
    carry = _runs(airborne, red_xy, frames["phase"] == t.carry_phase)
    far = max((distance for length, distance in carry if length >= t.carry_frames), default=0.0)
    finite = np.isfinite(frames["qpos"]).all(1) & np.isfinite(frames["qvel"]).all(1)
    lost = int(finite.argmin())  # the first frame, if any

    window = slice(-t.window, None)
    xy, dz = frames["xy_err_m"][window], frames["dz_m"][window]
    gap = np.abs(frames["cube_height_m"][window, 1])
    inside = (np.abs(blue_xy[window] - scene.table_center[:2]) <= np.array(scene.table_half[:2]) - scene.cube_half).all(1)
    steps = len(finite) * cfg.timing.substeps

    found = {
        Rule.FINITE: "always" if finite.all() else f"not in frame {lost}, in {frames['phase'][lost]}",
        Rule.STEPS: f"{int(sim.step_count[0])} steps",
        Rule.OVERFLOW: describe_overflow(int(sim.overflow[0])) or "none",
        Rule.LIFT: f"{max((length for length, _ in lift), default=0)} frames in the air in a row",
        Rule.CARRY: f"{far:.3f} m in {max((length for length, _ in carry), default=0)} frames in the air in a row",
        Rule.STACKED: f"xy_err up to {_mm(xy.max())}, dz {1e3 * dz.min():.1f} to {_mm(dz.max())}",
        Rule.SUPPORTED: f"lowest corner up to {_mm(gap.max())} off the top{'' if inside.all() else ', centre beyond its edge'}",
        Rule.REST_SPEED: f"{value['rest_speed_m_per_s']:.3g} m/s RMS, peak {value['peak_speed_m_per_s']:.3g}",
        Rule.REST_POSITION: _mm(value["rest_position_m"]),
        Rule.REST_ROTATION: f"{value['rest_rotation_deg']:.3g} deg",
    }
    wanted = {
        Rule.FINITE: "always",
        Rule.STEPS: f"{steps} steps",
        Rule.OVERFLOW: "none",
        Rule.LIFT: f"at least {t.lift_frames} in {' and '.join(t.lift_phases)}",
        Rule.CARRY: f"at least {t.carry_distance:g} m and {t.carry_frames} frames, in {t.carry_phase}",
        Rule.STACKED: f"at most {_mm(t.xy_err)}, {1e3 * t.dz_min:g} to {_mm(t.dz_max)}, in the last {t.window} frames",
        Rule.SUPPORTED: f"at most {_mm(t.support_gap)}, centre on the table",
        Rule.REST_SPEED: f"at most {t.rest_speed:g} m/s RMS",
        Rule.REST_POSITION: f"at most {_mm(t.rest_position)}",
        Rule.REST_ROTATION: f"at most {t.rest_rotation_deg:g} deg",
    }
    return [RuleFinding(rule=rule, held=not bits & rule, found=found[rule], wanted=wanted[rule]) for rule in Rule]


def _runs(airborne: np.ndarray, xy: np.ndarray, judged: np.ndarray) -> list[tuple[int, float]]:
    """Length [frames] and largest distance [m] from its own start of every uninterrupted run in the judged frames."""
    runs: list[tuple[int, float]] = []
    start: np.ndarray | None = None
    for frame in np.flatnonzero(judged):
        if not airborne[frame]:
            start = None
            continue
        if start is None:
            start = xy[frame]
            runs.append((0, 0.0))
        length, distance = runs[-1]
        runs[-1] = length + 1, max(distance, float(np.linalg.norm(xy[frame] - start)))
    return runs


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.3g} mm"
