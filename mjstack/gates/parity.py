"""Gate *parity*: MJWarp against native MuJoCo, one world."""

import math
from contextlib import closing

import torch

from mjstack.config.check import PARITY_FIELDS
from mjstack.config.schema import Backend, Config
from mjstack.episodes.context import RunContext, judge_one, needs_episode
from mjstack.episodes.motion import show_world
from mjstack.episodes.rollout import NOMINAL, State, WorldRecorder, restore
from mjstack.gates.images import compare_images
from mjstack.math import quat_angle
from mjstack.report.record import GateResult, Status
from mjstack.sim import Simulation, describe_overflow, make_simulation

_CAPTURED = 10  # steps of a graph: one of fifty takes longer to capture than to run


@needs_episode
def run_parity(context: RunContext) -> list[GateResult]:
    """Compare steps from equal states, the options of each backend, and the whole task."""
    one = make_simulation(context.model, context.cfg, 1, backend=Backend.mjwarp)
    with closing(one) as mjwarp:
        return [_compare(context, mjwarp)]


def _compare(context: RunContext, mjwarp: Simulation) -> GateResult:
    """The result of the gate, measured in one MJWarp world."""
    cfg = context.cfg
    result = GateResult(
        name="parity",
        status=Status.passed,
        thresholds=context.check.thresholds(),
        notes={"backend": mjwarp.description},
    )
    problems = _compare_states(context, mjwarp, result)
    options = compare_options(cfg, context.nominal.sim, mjwarp)
    for option, (asked, held, uploaded, equal) in options.items():
        line = f"option {option}: requested {asked}, native {held}, uploaded {uploaded}"
        result.details.append(line)
        problems += [] if equal else [line]

    world = WorldRecorder()
    episode = context.play(mjwarp, NOMINAL, [*context.viewers, world])
    status, reason, judged = judge_one(context, episode)
    if status is Status.failed:
        problems.append(reason)
    if int(mjwarp.overflow[0]):
        problems.append(
            f"{describe_overflow(int(mjwarp.overflow[0]))} overflow: raise batch.njmax or"
            " batch.nconmax"
        )
    limits = mjwarp.solver_limits
    result.metrics |= judged | {
        "peak_contacts": int(mjwarp.peak_contacts[0]),
        "peak_constraint_rows": int(mjwarp.peak_constraints[0]),
        "solver_limit_hit": bool(limits is not None and int(limits[0])),
        "episode_s": episode.timing.seconds,
    }
    problems += _compare_ends(context, world, result)
    if cfg.scene.cameras:
        problems += compare_images(context, result)

    headline = context.check.headline(judged)
    context.print_line(f"{cfg.task.name} check: {headline} ({mjwarp.description})")
    context.artifacts.shown = ("parity world", world)
    show_world(context, "parity", "parity, MJWarp", world, failed=status is Status.failed)
    ends = [f"final.{name}.position_m" for name in context.index.objects]
    apart = max((result.metrics[end] for end in ends), default=0.0)
    good = f"{headline}; objects end at most {1e3 * apart:.2f} mm from native's"
    if "images" in result.notes:
        good += "; images were not compared"
    result.reason = "; ".join(problems) or good
    result.status = Status.failed if problems else Status.passed
    return result


def _compare_states(context: RunContext, mjwarp: Simulation, result: GateResult) -> list[str]:
    """Step both backends from the same states of the reference episode; return the
    problems.
    """
    limits = context.cfg.gate.parity
    problems = []
    for name, step in context.parity_steps.items():
        state = context.nominal.states[step]
        for steps, largest in ((1, limits.step1), (50, limits.step50)):
            apart = compare_steps(context.nominal.sim, mjwarp, state, steps)
            for field, limit in largest.items():
                result.metrics[f"{name}.step{steps}.{field}"] = apart[field]
                result.thresholds[f"step{steps}.{field}"] = limit
                if not apart[field] <= limit:
                    problems.append(
                        f"{name}, {steps} steps: {field} differs by {apart[field]:.2g},"
                        f" limit {limit:.2g}"
                    )
    return problems


def _compare_ends(context: RunContext, world: WorldRecorder, result: GateResult) -> list[str]:
    """Poses of all objects at the end of the task; returns the problems."""
    limits = context.cfg.gate.parity
    far = limits.object_position
    turned = limits.object_rotation_deg
    result.thresholds |= {"final.position_m": far, "final.rotation_deg": turned}
    problems = []
    for name, (address, _) in context.index.objects.items():
        a, b = (
            torch.from_numpy(one.qpos[-1, address : address + 7])
            for one in (world, context.nominal.world)
        )
        distance = float((a[:3] - b[:3]).norm())
        angle = math.degrees(float(quat_angle(a[3:], b[3:])))
        result.metrics[f"final.{name}.position_m"] = distance
        result.metrics[f"final.{name}.rotation_deg"] = angle
        if not (distance <= far and angle <= turned):
            problems.append(
                f"{name} ends {1e3 * distance:.2f} mm and {angle:.2f} deg from native's"
            )
    return problems


def compare_steps(
    native: Simulation, mjwarp: Simulation, state: State, steps: int
) -> dict[str, float]:
    """Largest absolute difference of every field after some steps from one state, derived fields
    brought up to date.
    """
    for sim in (native, mjwarp):
        restore(sim, state)
        for first in range(0, steps, _CAPTURED):
            sim.step(min(_CAPTURED, steps - first))
        sim.forward()
        sim.synchronize()
    out = {}
    for name in PARITY_FIELDS:
        a = getattr(native, name).double()
        b = getattr(mjwarp, name).double().cpu()
        if name == "xquat":  # q and -q are one rotation
            b = torch.where((a * b).sum(-1, keepdim=True) < 0.0, -b, b)
        out[name] = float((a - b).abs().amax())
    return out


def compare_options(
    cfg: Config, native: Simulation, mjwarp: Simulation
) -> dict[str, tuple[str, str, str, bool]]:
    """Requested, native's and the uploaded options side by side, and whether they agree; numbers to
    float32.

    The request is ``the file's`` where the configuration leaves an option to the robot's file.
    """
    solver = cfg.solver
    requested: dict[str, float | int | str | None] = {
        "timestep": cfg.timing.physics_dt,
        "integrator": "mjINT_IMPLICITFAST",
        "cone": f"mjCONE_{solver.cone.upper()}",
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
