"""Gate *parity*: MJWarp against native MuJoCo, one world."""

import copy
import math
from collections.abc import Mapping
from contextlib import closing
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import torch
from torch import Tensor

from mjstack.config.schema import Backend
from mjstack.episodes.recorder import WorldRecorder
from mjstack.episodes.rollout import State, restore
from mjstack.episodes.run import Run, needs_episode
from mjstack.gates.images import compare_images
from mjstack.gates.parity_states import SWUNG, compared_states
from mjstack.managers.episode import required_fields
from mjstack.math import quat_angle, quat_to_matrix
from mjstack.report.figure import Figure, figures
from mjstack.report.record import GateResult, Status
from mjstack.sim import Simulation, describe_overflow, make_simulation
from mjstack.sim.native import NativeSimulation
from mjstack.sim.rounded import UNIT, RoundedSimulation

COMPARED = ("qpos", "qvel", "xpos", "xquat", "site_xpos", "qfrc_actuator", "contact_count")
_CONVERGED = 1e-12  # tolerance of the solver in float64
_CONVERGED_FLOAT32 = 1e-8  # of what float32 can still tell
_SEVERAL = int(mujoco.mjtDisableBit.mjDSBL_MULTICCD)  # contacts of two searched shapes
_ROUNDED = {1: 32, 50: 16}  # worlds, by steps
_ROUNDED_EPISODES = 8
_ROUNDED_STATES = 16
_LEAST_SIZES = {"qvel": 300.0, "qfrc_actuator": 100.0}  # whose rounding is allowed; else 2
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
    result = GateResult(name="parity", status=Status.passed, notes={"backend": mjwarp.description})
    problems = compare_states(run, mjwarp, result)
    for option, (native, uploaded, equal) in compare_options(run.nominal.sim, mjwarp).items():
        line = f"option {option}: native {native}, uploaded {uploaded}"
        result.details.append(line)
        problems += [] if equal else [line]

    world = WorldRecorder()
    episode = run.stage.play(mjwarp, run.cfg.gate.baseline.reset, [*run.stage.observers, world])
    judged, headline = run.judge_one("parity", episode)
    result.beyond = judged.beyond
    problems += [judged.reason] if judged.reason else []
    if bits := int(mjwarp.overflow[0]):
        problems.append(f"{describe_overflow(bits)} overflow: raise batch.njmax or batch.nconmax")
    peaks = figures(
        peak_contacts=int(mjwarp.peak_contacts[0]),
        peak_constraint_rows=int(mjwarp.peak_constraints[0]),
    )
    result.figures += [*judged.figures, *peaks, Figure("episode", episode.timing.seconds, "s")]
    deviations, ends = _compare_ends(run, world.qpos[-1], result, rounded=not problems)
    problems += deviations
    if run.cfg.scene.cameras:
        problems += compare_images(run, result)

    run.print_line(f"{run.cfg.task.name} check: {headline} ({mjwarp.description})")
    run.show_world("parity", "parity, MJWarp", world.qpos, episode, world.env, "parity world")
    summary = "; ".join([headline, *ends])
    if "images" in result.notes:
        summary += "; images were not compared"
    result.reason = "; ".join(problems) or summary
    result.status = Status.failed if problems else Status.passed
    return result


def compare_states(run: Run, mjwarp: Simulation, result: GateResult) -> list[str]:
    """Compare the models, and steps of both backends from the same states; return the problems.

    The states are those of the reference episode, and some with the gate's own velocities and
    commands. Both solvers go on until they have converged: where they stop below the tolerance of
    the model is chance, and may lie some hundred times the limits from the solution. Every number
    may be off by a multiple of what rounding makes of it in native MuJoCo; the number of contacts
    by what it makes of it, in either backend.

    Meshes, cylinders and ellipsoids have several contacts, of faces that a search chooses. If the
    number is off, both backends make the steps with one contact of two such shapes, the deepest.
    """
    model = copy.copy(run.stage.model)
    model.opt.tolerance = _CONVERGED
    fields = run.nominal.sim.fields  # the task's own reset terms may have changed them
    problems = compare_models(model, mjwarp, leave_out=fields)
    native = NativeSimulation(model, 1, fields=[*fields])
    for name, values in fields.items():
        native.fields[name].copy_(values)
        mjwarp.fields[name].copy_(values)
    rounded = {steps: RoundedSimulation(model, n, fields) for steps, n in _ROUNDED.items()}
    tolerance = mjwarp.solver_tolerance
    assert tolerance is not None
    configured = tolerance.clone()
    tolerance.fill_(_CONVERGED_FLOAT32)
    multiples = {1: run.cfg.gate.parity.step1_ranges, 50: run.cfg.gate.parity.step50_ranges}
    farthest = (False, 0.0, "")
    for name, state, kinds in compared_states(run):
        for steps in kinds:
            sims = (native, mjwarp, rounded[steps])
            ends, deviations, ranges = _measure(*sims, state, steps)
            if _counts_differ(deviations, ranges) and not model.opt.disableflags & _SEVERAL:
                for sim in sims:
                    sim.switch(_SEVERAL, off=True)
                single = _measure(*sims, state, steps)
                for sim in sims:
                    sim.switch(_SEVERAL, off=False)
                if not _counts_differ(*single[1:]):
                    result.details.append(
                        f"{name}, {steps} steps: {int(deviations['contact_count'])} contacts more"
                        " or fewer than native's, of shapes whose contacts are searched for;"
                        " compared with one contact of two such shapes"
                    )
                    ends, deviations, ranges = single
            for field in COMPARED:
                allowed = ranges[field]
                if field != "contact_count":
                    largest = float(ends[field].abs().max())
                    rounding = UNIT * max(largest, _LEAST_SIZES.get(field, 2.0))
                    allowed = multiples[steps] * (allowed + rounding)
                worst = int((deviations[field] / allowed.clamp(min=1e-30)).argmax())
                error, limit = float(deviations[field][worst]), float(allowed[worst])
                group = f"{name}.step{steps}"
                result.figures.append(Figure(field, error, group=group, high=limit))
                if not error <= limit:
                    owner = _owner(model, field, worst)
                    text = f"{field} of {owner} differs by {error:.2g}, limit {limit:.2g}"
                    problems.append(f"{name}, {steps} steps: {text}")
                    if limit:  # an object that is swung shows what is wrong with the arm, too
                        ratio = math.inf if math.isnan(error) else error / limit
                        farthest = max(farthest, (name != SWUNG, ratio, owner))
    tolerance.copy_(configured)
    for sim in (native, *rounded.values()):
        sim.close()
    if suspect := farthest[-1]:
        moves = suspect in run.stage.index.objects
        properties = "shape, mass, friction and contacts" if moves else "servo, damping and range"
        problems.append(f"look first at {suspect}: its {properties}")
    return problems


def _measure(
    native: Simulation, mjwarp: Simulation, rounded: Simulation, state: State, steps: int
) -> tuple[dict[str, Tensor], dict[str, Tensor], dict[str, Tensor]]:
    """Native's fields after steps, how far off MJWarp's are, and how far native's that round."""
    ends = end_state(native, state, steps)
    deviations = differences(ends, end_state(mjwarp, state, steps))
    ranges = differences(ends, end_state(rounded, state, steps))
    if _counts_differ(deviations, ranges):
        deviations["contact_count"] = _nearest_count(mjwarp, state, steps, ends)
    return ends, deviations, ranges


def _counts_differ(deviations: dict[str, Tensor], ranges: dict[str, Tensor]) -> bool:
    """Whether the number of contacts is off by more than its range."""
    return bool((deviations["contact_count"] > ranges["contact_count"]).any())


def _nearest_count(sim: Simulation, state: State, steps: int, ends: dict[str, Tensor]) -> Tensor:
    """Least difference from native's number of contacts after steps from states off by rounding:
    MJWarp's search in float32 misses shapes that overlap by some tenths of a millimetre by chance.
    """
    generator = np.random.default_rng(0)
    gaps = []
    for _ in range(_ROUNDED_STATES):
        errors = UNIT * generator.uniform(-1.0, 1.0, state.qpos.shape)
        other_ends = end_state(sim, state._replace(qpos=state.qpos * (1.0 + errors)), steps)
        gaps.append(differences(ends, other_ends)["contact_count"])
    return torch.stack(gaps).amin(0)


def compare_models(
    model: mujoco.MjModel, sim: Simulation, leave_out: Mapping[str, Tensor]
) -> list[str]:
    """A problem for each array of the model that the simulation holds otherwise than in float32."""
    problems = []
    for name, uploaded in sim.model_values().items():
        expected = getattr(model, name).astype(uploaded.dtype)
        different = np.argwhere((uploaded != expected) & ~(np.isnan(uploaded) & np.isnan(expected)))
        if name in leave_out or not len(different):
            continue
        at = tuple(different[0])
        owner = _element(model, name, int(at[0]))
        problems.append(
            f"model: {name} of {owner} is {uploaded[at]:.6g}, natively {expected[at]:.6g}"
        )
    return problems


def _element(model: mujoco.MjModel, field: str, index: int) -> str:
    """Name of what a row of a model's array belongs to."""
    kind = field.partition("_")[0]
    if kind == "dof":
        kind, index = "jnt", int(model.dof_jntid[index])
    name = {"jnt": "joint", "cam": "camera", "eq": "equality", "mat": "material"}.get(kind, kind)
    named = getattr(model, name, None)
    return f"{name} {(named and named(index).name) or index}"


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


def _compare_ends(
    run: Run, end: np.ndarray, result: GateResult, *, rounded: bool
) -> tuple[list[str], list[str]]:
    """Where objects, and joints that the robot does not command, are at the end of the task;
    returns the problems, and lines on the farthest object and the farthest of the other joints.

    With ``rounded``, native MuJoCo plays the task in rounded worlds if one is off by more than the
    limits: they may be off from where it is in the nearest of these instead.
    """

    def shares(target: np.ndarray) -> dict[str, float]:
        return {
            name: float(np.max([gap.value / max(gap.high, 1e-30) for gap in gaps]))
            for name, gaps in _ends_apart(run, end, target).items()
        }

    native = run.nominal.world.qpos[-1]
    share = shares(native)
    exceeding = [name for name, value in share.items() if not value <= 1.0]
    if exceeding and rounded:
        with closing(RoundedSimulation(run.stage.model, _ROUNDED_EPISODES)) as sim:
            run.stage.play(sim, run.cfg.gate.baseline.reset, worlds=[0] * _ROUNDED_EPISODES)
            candidates = [share, *map(shares, sim.qpos.numpy())]
        share = min(candidates, key=lambda candidate: np.max([*candidate.values()]))
        text = f"one of {_ROUNDED_EPISODES} native worlds that round"
        result.details += [f"{n} ends {share[n]:.2g} of the limit from {text}" for n in exceeding]
    problems = []
    farthest: dict[bool, tuple[float, str]] = {}  # object, and other joint
    for name, gaps in _ends_apart(run, end, native).items():
        result.figures += [replace(gap, group=f"final.{name}") for gap in gaps]
        values = [(1e3 * f.value, "mm") if f.unit == "m" else (f.value, f.unit) for f in gaps]
        text = f"{name} ends {' and '.join(f'{v:.2f} {unit}' for v, unit in values)} from native's"
        problems += [] if share[name] <= 1.0 else [text]
        joint = name not in run.cfg.scene.objects
        if share[name] > farthest.get(joint, (-1.0, ""))[0]:
            farthest[joint] = (share[name], text)
    return problems, [text for _, text in farthest.values()]


def _ends_apart(run: Run, *ends: np.ndarray) -> dict[str, list[Figure]]:
    """How far objects and joints that the robot does not command are apart at two ends."""
    model = run.stage.model
    limits = run.cfg.gate.parity
    moved = np.empty(model.nv)
    mujoco.mj_differentiatePos(model, moved, 1.0, *ends)
    by_name: dict[str, list[Figure]] = {}
    limit: dict[str, Any]
    for number, kind in enumerate(model.jnt_type):
        name = model.joint(number).name or f"joint {number}"
        if name in run.cfg.robot.joints:
            continue
        slid, turned = np.split(moved[model.dof_jntid == number], [_SLIDES.get(int(kind), 0)])
        gaps = by_name.setdefault(name, [])
        if slid.size:
            limit = {"high": limits.object_position, "limit": "final.position_m"}
            gaps.append(Figure("position", float(np.linalg.norm(slid)), "m", **limit))
        if turned.size:
            angle = math.degrees(np.linalg.norm(turned))
            if object_cfg := run.cfg.scene.objects.get(name):
                quats = [torch.from_numpy(q[model.jnt_qposadr[number] :][3:7]) for q in ends]
                angle = math.degrees(turn_between(object_cfg.shape, *quats))
            limit = {"high": limits.object_rotation_deg, "limit": "final.rotation_deg"}
            gaps.append(Figure("rotation", angle, "deg", **limit))
    return by_name


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
    return {name: getattr(sim, name).double().cpu().clone() for name in COMPARED}


def differences(a: dict[str, Tensor], b: dict[str, Tensor]) -> dict[str, Tensor]:
    """Largest absolute difference over the worlds of every number of every field, each ``(n,)``."""
    by_name = {}
    for name in COMPARED:
        x, y = a[name], b[name]
        if name == "xquat":  # q and -q are one rotation
            y = torch.where((x * y).sum(-1, keepdim=True) < 0.0, -y, y)
        by_name[name] = (x - y).abs().amax(0).flatten()
    return by_name


def compare_options(native: Simulation, mjwarp: Simulation) -> dict[str, tuple[str, str, bool]]:
    """Native's and the uploaded options side by side, and whether they agree; numbers to float32.

    Gate *baseline* holds native's against the configuration.
    """
    uploaded = mjwarp.option_values()
    return {
        name: (_short(value), _short(uploaded[name]), _agree(name, value, uploaded[name]))
        for name, value in native.option_values().items()
    }


def _agree(name: str, a: float | int | str, b: float | int | str) -> bool:
    if isinstance(a, str) or isinstance(b, str):
        return a == b
    least = 1e-6 if name == "tolerance" else -math.inf  # MJWarp clamps it to float32's resolution
    return math.isclose(max(a, least), max(b, least), rel_tol=1e-5)


def _short(value: float | int | str) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
