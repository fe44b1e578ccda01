"""Gate *parity*: MJWarp against native MuJoCo, one world."""

from __future__ import annotations

import math

import numpy as np
import torch

from mjstack.config.schema import Config
from mjstack.config.validate import PARITY_FIELDS
from mjstack.episodes.context import GateContext, judge_one
from mjstack.episodes.observers import WorldRecorder
from mjstack.episodes.rollout import NOMINAL, State, restore
from mjstack.math import quat_angle
from mjstack.report.record import GateResult, Status
from mjstack.sim import Simulation, describe_overflow


def run_parity(context: GateContext) -> list[GateResult]:
    """Compares steps from equal states, the whole task, and the options each backend holds."""
    cfg = context.cfg
    reference = context.nominal
    native = reference.sim
    mjwarp = context.parity_simulation()
    problems: list[str] = []
    details: list[str] = []
    metrics: dict[str, float] = {}
    thresholds: dict[str, float] = dict(context.check.thresholds(cfg))

    for name, phase in cfg.gate.parity.states.items():
        state = reference.states[context.phase_end(phase)]
        for steps, limits in ((1, cfg.gate.parity.step1), (50, cfg.gate.parity.step50)):
            found = compare_steps(native, mjwarp, state, steps)
            for field, limit in limits.items():
                metrics[f"{name}.step{steps}.{field}"] = found[field]
                thresholds[f"step{steps}.{field}"] = limit
                if not found[field] <= limit:
                    problems.append(
                        f"{name}, {steps} steps: {field} differs by {found[field]:.2g}, limit"
                        f" {limit:.2g}"
                    )

    for option, (asked, held, uploaded, equal) in compare_options(cfg, native, mjwarp).items():
        line = f"option {option}: requested {asked}, native {held}, uploaded {uploaded}"
        details.append(line)
        if not equal:
            problems.append(line)

    world = WorldRecorder()
    episode = context.play(mjwarp, NOMINAL, [*context.viewers, world])
    status, reason, judged = judge_one(context.check.rules, episode.result)
    if status is Status.failed:
        problems.append(reason)
    if int(mjwarp.overflow[0]):
        problems.append(
            f"{describe_overflow(int(mjwarp.overflow[0]))} overflow: raise batch.njmax or"
            " batch.nconmax"
        )
    metrics.update(judged)
    metrics["peak_contacts"] = int(mjwarp.peak_contacts[0])
    metrics["peak_constraint_rows"] = int(mjwarp.peak_constraints[0])
    bits = getattr(mjwarp, "solver_limits", None)
    metrics["solver_limit_hit"] = bool(bits is not None and int(bits[0]))
    metrics["episode_s"] = episode.timing.seconds
    for cube, (address, _) in context.index.objects.items():
        ours = world.qpos[-1, address : address + 7]
        theirs = reference.world.qpos[-1, address : address + 7]
        distance = float(np.linalg.norm(ours[:3] - theirs[:3]))
        angle = math.degrees(
            float(quat_angle(torch.from_numpy(ours[3:]), torch.from_numpy(theirs[3:])))
        )
        metrics[f"final.{cube}.position_m"] = distance
        metrics[f"final.{cube}.rotation_deg"] = angle
        if not (
            distance <= cfg.gate.parity.cube_position and angle <= cfg.gate.parity.cube_rotation_deg
        ):
            problems.append(
                f"{cube} cube ends {1e3 * distance:.2f} mm and {angle:.2f} deg from native's"
            )
    thresholds["final.position_m"] = cfg.gate.parity.cube_position
    thresholds["final.rotation_deg"] = cfg.gate.parity.cube_rotation_deg
    headline = context.check.headline(judged)
    context.say(f"{cfg.task.name} check: {headline} ({mjwarp.description})")
    context.shown = world
    context.shown_by = "parity world"
    mjwarp.close()
    summary = "; ".join(problems) or (
        f"{headline}; red {1e3 * metrics['final.red.position_m']:.2f} mm from native's"
    )
    return [
        GateResult(
            name="parity",
            status=Status.failed if problems else Status.passed,
            reason=summary,
            thresholds=thresholds,
            metrics=metrics,
            notes={"backend": mjwarp.description},
            details=details,
        )
    ]


def compare_steps(
    native: Simulation, mjwarp: Simulation, state: State, steps: int
) -> dict[str, float]:
    """Largest absolute difference of every field after some steps from one state, derived fields
    brought up to date.
    """
    for sim in (native, mjwarp):
        restore(sim, state)
        sim.step(steps)
        sim.forward()
        sim.synchronize()
    out = {}
    for field in PARITY_FIELDS:
        a = getattr(native, field).double()
        b = getattr(mjwarp, field).double().cpu()
        if field == "xquat":  # q and -q are one rotation
            b = torch.where((a * b).sum(-1, keepdim=True) < 0.0, -b, b)
        out[field] = float((a - b).abs().amax())
    return out


def compare_options(
    cfg: Config, native: Simulation, mjwarp: Simulation
) -> dict[str, tuple[str, str, str, bool]]:
    """Requested, native's and the uploaded options side by side, and whether they agree; numbers to
    float32.

    What the configuration leaves to the robot's file is requested as ``the file's``.
    """
    solver = cfg.solver
    requested: dict[str, float | int | str | None] = {
        "timestep": cfg.timing.physics_dt,
        "integrator": "mjINT_IMPLICITFAST",
        "cone": f"mjCONE_{solver.cone.value.upper()}",
        "box_box": "primitive",
        "iterations": solver.iterations,
        "ls_iterations": solver.ls_iterations,
        "impratio": solver.impratio,
        "tolerance": solver.tolerance,
    }
    uploaded = mjwarp.option_values()
    out = {}
    for name, held in native.option_values().items():
        asked = requested.get(name)
        equal = _agree(name, held, uploaded[name]) and (asked is None or _agree(name, asked, held))
        out[name] = (
            "the file's" if asked is None else _short(asked),
            _short(held),
            _short(uploaded[name]),
            equal,
        )
    return out


def _agree(name: str, asked: float | int | str, got: float | int | str) -> bool:
    if isinstance(asked, str) or isinstance(got, str):
        return asked == got
    if name == "tolerance":  # MJWarp clamps it to what float32 can resolve
        asked = max(asked, 1e-6)
        got = max(got, 1e-6)
    return math.isclose(asked, got, rel_tol=1e-5)


def _short(value: float | int | str) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
