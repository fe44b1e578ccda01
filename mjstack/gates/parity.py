"""Gate *parity*: MJWarp against native MuJoCo, one world."""

import math
from contextlib import closing
from dataclasses import asdict

import torch

from mjstack.config.check import PARITY_FIELDS
from mjstack.config.schema import Backend, Config
from mjstack.episodes.recorder import WorldRecorder
from mjstack.episodes.rollout import NOMINAL, State, restore
from mjstack.episodes.run import Run, needs_episode
from mjstack.gates.images import compare_images
from mjstack.math import quat_angle
from mjstack.report.record import GateResult, Status
from mjstack.sim import Simulation, describe_overflow, make_simulation

_CAPTURED = 10  # steps of a graph: one of fifty takes longer to capture than to run


@needs_episode
def run_parity(run: Run) -> list[GateResult]:
    """Compare steps from equal states, the options of each backend, and the whole task."""
    world = make_simulation(run.stage.model, run.cfg, 1, backend=Backend.mjwarp)
    with closing(world) as mjwarp:
        return [_compare(run, mjwarp)]


def _compare(run: Run, mjwarp: Simulation) -> GateResult:
    """The result of the gate, measured in one MJWarp world."""
    cfg = run.cfg
    result = GateResult(
        name="parity",
        status=Status.passed,
        thresholds=run.stage.check.thresholds(),
        notes={"backend": mjwarp.description},
    )
    problems = _compare_states(run, mjwarp, result)
    options = compare_options(cfg, run.nominal.sim, mjwarp)
    for option, (requested, native, uploaded, equal) in options.items():
        line = f"option {option}: requested {requested}, native {native}, uploaded {uploaded}"
        result.details.append(line)
        problems += [] if equal else [line]

    world = WorldRecorder()
    episode = run.stage.play(mjwarp, NOMINAL, [*run.viewers, world])
    status, reason, judged, result.beyond = run.judge_one(episode)
    if status is Status.failed:
        problems.append(reason)
    if bits := int(mjwarp.overflow[0]):
        problems.append(f"{describe_overflow(bits)} overflow: raise batch.njmax or batch.nconmax")
    limits = mjwarp.solver_limits
    result.metrics |= judged | {
        "peak_contacts": int(mjwarp.peak_contacts[0]),
        "peak_constraint_rows": int(mjwarp.peak_constraints[0]),
        "solver_limit_hit": bool(limits is not None and int(limits[0])),
        "episode_s": episode.timing.seconds,
    }
    problems += _compare_ends(run, world, result)
    if cfg.scene.cameras:
        problems += compare_images(run.stage, run.nominal.world.qpos, run.folder, run.draw, result)

    headline = run.stage.check.headline(judged)
    run.print_line(f"{cfg.task.name} check: {headline} ({mjwarp.description})")
    run.show_world("parity", "parity, MJWarp", world.qpos, status, mjwarp, "parity world")
    ends = [f"final.{name}.position_m" for name in run.stage.index.objects]
    apart = max((result.metrics[end] for end in ends), default=0.0)
    summary = f"{headline}; objects end at most {1e3 * apart:.2f} mm from native's"
    if "images" in result.notes:
        summary += "; images were not compared"
    result.reason = "; ".join(problems) or summary
    result.status = Status.failed if problems else Status.passed
    return result


def _compare_states(run: Run, mjwarp: Simulation, result: GateResult) -> list[str]:
    """Step both backends from the same states of the reference episode; return the
    problems.
    """
    limits = run.cfg.gate.parity
    problems = []
    for name, step in run.parity_steps.items():
        state = run.nominal.states[step]
        for steps, largest in ((1, limits.step1), (50, limits.step50)):
            apart = compare_steps(run.nominal.sim, mjwarp, state, steps)
            for field, limit in largest.items():
                result.metrics[f"{name}.step{steps}.{field}"] = apart[field]
                result.thresholds[f"step{steps}.{field}"] = limit
                if not apart[field] <= limit:
                    text = f"{field} differs by {apart[field]:.2g}, limit {limit:.2g}"
                    problems.append(f"{name}, {steps} steps: {text}")
    return problems


def _compare_ends(run: Run, world: WorldRecorder, result: GateResult) -> list[str]:
    """Poses of all objects at the end of the task; returns the problems."""
    limits = run.cfg.gate.parity
    far = limits.object_position
    turned = limits.object_rotation_deg
    result.thresholds |= {"final.position_m": far, "final.rotation_deg": turned}
    problems = []
    recordings = (world, run.nominal.world)
    for name, (address, _) in run.stage.index.objects.items():
        a, b = (torch.from_numpy(w.qpos[-1, address : address + 7]) for w in recordings)
        distance = float((a[:3] - b[:3]).norm())
        angle = math.degrees(float(quat_angle(a[3:], b[3:])))
        result.metrics[f"final.{name}.position_m"] = distance
        result.metrics[f"final.{name}.rotation_deg"] = angle
        if not (distance <= far and angle <= turned):
            apart = f"{1e3 * distance:.2f} mm and {angle:.2f} deg"
            problems.append(f"{name} ends {apart} from native's")
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
    requested = asdict(cfg.solver) | {
        "timestep": cfg.timing.physics_dt,
        "integrator": "mjINT_IMPLICITFAST",
        "cone": f"mjCONE_{cfg.solver.cone.upper()}",
        "box_box": "primitive",
    }
    uploaded = mjwarp.option_values()
    options = {}
    for name, value in native.option_values().items():
        request = requested.get(name)
        equal = _agree(name, value, uploaded[name])
        equal = equal and (request is None or _agree(name, request, value))
        text = "the file's" if request is None else _short(request)
        options[name] = (text, _short(value), _short(uploaded[name]), equal)
    return options


def _agree(name: str, a: float | int | str, b: float | int | str) -> bool:
    if isinstance(a, str) or isinstance(b, str):
        return a == b
    least = 1e-6 if name == "tolerance" else -math.inf  # MJWarp clamps it to float32's resolution
    return math.isclose(max(a, least), max(b, least), rel_tol=1e-5)


def _short(value: float | int | str) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
