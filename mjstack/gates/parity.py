"""Gate *parity*: MJWarp against native MuJoCo, one world."""

import copy
import math
from collections.abc import Mapping
from contextlib import closing
from dataclasses import asdict

import mujoco
import numpy as np
import torch
from torch import Tensor

from mjstack.config.check import PARITY_FIELDS
from mjstack.config.schema import Backend, Config
from mjstack.episodes.recorder import WorldRecorder
from mjstack.episodes.rollout import State, restore
from mjstack.episodes.run import Run, needs_episode
from mjstack.gates.images import compare_images
from mjstack.managers.episode import required_fields
from mjstack.math import quat_angle, quat_to_matrix
from mjstack.report.record import GateResult, Status
from mjstack.sim import Simulation, describe_overflow, make_simulation
from mjstack.sim.native import NativeSimulation

SWUNG = "swung"
_SPINS = {"in_motion": 50.0, SWUNG: 0.0}  # rad/s; these states get velocities of the gate's own
_SEARCHED = [
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind}")) for kind in ("CYLINDER", "ELLIPSOID", "MESH")
]
_CONVERGED = 1e-12  # tolerance of the solver in float64
_CONVERGED_FLOAT32 = 1e-8  # of what float32 can still tell
_DISPLACED = 32  # worlds
_PLACES = ("geom_pos", "geom_quat")
_OFF = 1e-5  # m and parts of a quaternion: ten times the tolerance of MuJoCo's search
_RANGES = 2.0
_SLIDES = {int(mujoco.mjtJoint.mjJNT_FREE): 3, int(mujoco.mjtJoint.mjJNT_SLIDE): 1}  # else turns
_WIDTHS = {"xpos": 3, "xquat": 4, "site_xpos": 3}
_CAPTURED = 10  # steps of a graph: one of fifty takes longer to capture than to run


@needs_episode
def run_parity(run: Run) -> list[GateResult]:
    """Compare steps from equal states, the options of each backend, and the whole task."""
    fields = required_fields(run.cfg.gate.baseline.reset)
    world = make_simulation(run.stage.model, run.cfg, 1, backend=Backend.mjwarp, fields=fields)
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
    problems = compare_states(run, mjwarp, result)
    options = compare_options(cfg, run.nominal.sim, mjwarp)
    for option, (requested, native, uploaded, equal) in options.items():
        line = f"option {option}: requested {requested}, native {native}, uploaded {uploaded}"
        result.details.append(line)
        problems += [] if equal else [line]

    world = WorldRecorder()
    episode = run.stage.play(mjwarp, run.cfg.gate.baseline.reset, [*run.viewers, world])
    status, reason, judged, result.beyond = run.judge_one(episode)
    if status is Status.failed:
        problems.append(reason)
    if bits := int(mjwarp.overflow[0]):
        problems.append(f"{describe_overflow(bits)} overflow: raise batch.njmax or batch.nconmax")
    result.metrics |= judged | {
        "peak_contacts": int(mjwarp.peak_contacts[0]),
        "peak_constraint_rows": int(mjwarp.peak_constraints[0]),
        "episode_s": episode.timing.seconds,
    }
    apart, ends = _compare_ends(run, world.qpos[-1], result)
    problems += apart
    if cfg.scene.cameras:
        problems += compare_images(run, result)

    headline = run.stage.check.headline(judged)
    run.print_line(f"{cfg.task.name} check: {headline} ({mjwarp.description})")
    run.show_world("parity", "parity, MJWarp", world.qpos, status, world.env, "parity world")
    summary = "; ".join([headline, *ends])
    if "images" in result.notes:
        summary += "; images were not compared"
    result.reason = "; ".join(problems) or summary
    result.status = Status.failed if problems else Status.passed
    return result


def compare_states(run: Run, mjwarp: Simulation, result: GateResult) -> list[str]:
    """Step both backends from the same states of the reference episode; return the problems.

    Both solvers go on until they have converged: where they stop below the tolerance of the model
    is chance, and may lie some hundred times the limits from the solution. Every number may be off
    by the configured limit of its field and by twice the range of native MuJoCo's own, where
    contacts of curved shapes lie a hundredth of a millimetre elsewhere.
    """
    limits = run.cfg.gate.parity
    model = copy.copy(run.stage.model)
    model.opt.tolerance = _CONVERGED
    fields = run.nominal.sim.fields  # the task's own reset terms may have changed them
    native = NativeSimulation(model, 1, fields=[*fields])
    near = _displaced(model, fields)
    for name, values in fields.items():
        native.fields[name].copy_(values)
        mjwarp.fields[name].copy_(values)
    tolerance = mjwarp.solver_tolerance
    assert tolerance is not None
    configured = tolerance.clone()
    tolerance.fill_(_CONVERGED_FLOAT32)
    problems = []
    farthest = (False, 0.0, "")
    for name, step in run.parity_steps.items():
        state = run.nominal.states[step]
        kinds = [(1, limits.step1), (50, limits.step50)]
        if name in _SPINS:  # for one step alone
            state = state._replace(qvel=_motion(model, state.qpos, _SPINS[name]))
            del kinds[1]
        for steps, largest in kinds:
            ends = end_state(native, state, steps)
            apart = differences(ends, end_state(mjwarp, state, steps))
            ranges = differences(ends, end_state(near, state, steps)) if near else {}
            for field, least in largest.items():
                allowed = least + _RANGES * ranges.get(field, torch.zeros_like(apart[field]))
                worst = int((apart[field] / allowed.clamp(min=1e-30)).argmax())
                error, limit = float(apart[field][worst]), float(allowed[worst])
                key = f"step{steps}.{field}"
                result.metrics[f"{name}.{key}"] = error
                result.thresholds[key if limit == least else f"{name}.{key}"] = limit
                if not error <= limit:
                    owner = _owner(model, field, worst)
                    text = f"{field} of {owner} differs by {error:.2g}, limit {limit:.2g}"
                    problems.append(f"{name}, {steps} steps: {text}")
                    if limit:  # an object that is swung shows what is wrong with the arm, too
                        ratio = math.inf if math.isnan(error) else error / limit
                        farthest = max(farthest, (name != SWUNG, ratio, owner))
    tolerance.copy_(configured)
    for sim in filter(None, (native, near)):
        sim.close()
    if look := farthest[-1]:
        moves = look in run.stage.index.objects
        parts = "shape, mass, friction and contacts" if moves else "servo, damping and range"
        problems.append(f"look first at {look}: its {parts}")
    return problems


def _displaced(model: mujoco.MjModel, fields: Mapping[str, Tensor]) -> Simulation | None:
    """Native worlds in which shapes whose contacts MuJoCo has to search for, such as cylinders, lie
    elsewhere by less than a search in float32 can tell; None if there are no such shapes. The
    fields are those of the one world.
    """
    solid = (model.geom_contype | model.geom_conaffinity) > 0
    geoms = np.flatnonzero(np.isin(model.geom_type, _SEARCHED) & solid)
    if not len(geoms):
        return None
    sim = NativeSimulation(model, _DISPLACED, fields=[*_PLACES, *fields])
    for name, values in fields.items():
        sim.fields[name].copy_(values)
    generator = torch.Generator().manual_seed(0)
    for name in _PLACES:
        field = sim.fields[name]
        shape = (_DISPLACED, len(geoms), field.shape[-1])
        field[:, geoms] += _OFF * (2.0 * torch.rand(shape, generator=generator).double() - 1.0)
    return sim


def _motion(model: mujoco.MjModel, qpos: np.ndarray, spin: float) -> np.ndarray:
    """Velocities with which masses, friction and damping count, shape ``(1, nv)``: joints move to
    the middle of their ranges, because one at its limit may be on either side of it in float32;
    free objects spin about their z axes [rad/s].
    """
    qvel = np.ones((1, model.nv))
    beyond = qpos[0, model.jnt_qposadr] > model.jnt_range.mean(1)
    qvel[0, model.jnt_dofadr[beyond & (model.jnt_limited == 1)]] = -1.0
    for dof in model.jnt_dofadr[model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)]:
        qvel[0, dof : dof + 6] = [0.0, 0.0, 0.0, 0.0, 0.0, spin]
    return qvel


def _owner(model: mujoco.MjModel, field: str, index: int) -> str:
    """Name of the joint or body that a number of a field belongs to."""
    if field == "contact_count":
        return "the world"
    if field in _WIDTHS:
        number = index // _WIDTHS[field]
        body = model.site_bodyid[number] if field == "site_xpos" else number
        return model.body(body).name
    in_qpos = int(np.searchsorted(model.jnt_qposadr, index, side="right")) - 1
    joint = in_qpos if field == "qpos" else model.dof_jntid[index]
    return model.joint(joint).name


def _compare_ends(run: Run, end: np.ndarray, result: GateResult) -> tuple[list[str], list[str]]:
    """Where objects, and joints that the robot does not command, are at the end of the task;
    returns the problems, and lines on the farthest object and the farthest of the other joints.
    """
    limits = run.cfg.gate.parity
    allowed = {"position_m": limits.object_position, "rotation_deg": limits.object_rotation_deg}
    result.thresholds |= {f"final.{key}": limit for key, limit in allowed.items()}
    model = run.stage.model
    ends = (end, run.nominal.world.qpos[-1])
    moved = np.empty(model.nv)
    mujoco.mj_differentiatePos(model, moved, 1.0, *ends)
    problems = []
    farthest: dict[bool, tuple[float, str]] = {}  # object, and other joint
    for number, kind in enumerate(model.jnt_type):
        name = model.joint(number).name or f"joint {number}"
        if name in run.cfg.robot.joints:
            continue
        slid, turned = np.split(moved[model.dof_jntid == number], [_SLIDES.get(int(kind), 0)])
        pairs = zip(allowed, (slid, np.degrees(turned)), strict=True)
        apart = {key: float(np.linalg.norm(part)) for key, part in pairs if part.size}
        if thing := run.cfg.scene.objects.get(name):
            quats = [torch.from_numpy(q[model.jnt_qposadr[number] :][3:7]) for q in ends]
            apart["rotation_deg"] = math.degrees(turn_between(thing.shape, *quats))
        result.metrics |= {f"final.{name}.{key}": value for key, value in apart.items()}
        values = [(v, "deg") if "deg" in key else (1e3 * v, "mm") for key, v in apart.items()]
        text = f"{name} ends {' and '.join(f'{v:.2f} {unit}' for v, unit in values)} from native's"
        share = float(np.max([v / max(allowed[key], 1e-30) for key, v in apart.items()]))
        problems += [] if share <= 1.0 else [text]
        if share > farthest.get(thing is None, (-1.0, ""))[0]:
            farthest[thing is None] = (share, text)
    return problems, [text for _, text in farthest.values()]


def turn_between(shape: str, a: Tensor, b: Tensor) -> float:
    """Angle between two orientations [rad]; of a shape of revolution, between its axes."""
    if shape == "box":
        return float(quat_angle(a, b))
    if shape == "sphere":
        return 0.0
    axes = [quat_to_matrix(quat)[:, 0 if shape == "capsule" else 2] for quat in (a, b)]
    return math.atan2(float(torch.linalg.cross(*axes).norm()), float(axes[0] @ axes[1]))


def end_state(sim: Simulation, state: State, steps: int) -> dict[str, Tensor]:
    """Every field after some steps from one state, derived fields brought up to date, shape
    ``(nworld, ...)``, float64 on the CPU.
    """
    restore(sim, state)
    for first in range(0, steps, _CAPTURED):
        sim.step(min(_CAPTURED, steps - first))
    sim.forward()
    sim.synchronize()
    return {name: getattr(sim, name).double().cpu().clone() for name in PARITY_FIELDS}


def differences(a: dict[str, Tensor], b: dict[str, Tensor]) -> dict[str, Tensor]:
    """Largest absolute difference over the worlds of every number of every field, each ``(n,)``."""
    out = {}
    for name in PARITY_FIELDS:
        x, y = a[name], b[name]
        if name == "xquat":  # q and -q are one rotation
            y = torch.where((x * y).sum(-1, keepdim=True) < 0.0, -y, y)
        out[name] = (x - y).abs().amax(0).flatten()
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
