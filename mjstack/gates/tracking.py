"""Whether the arm goes where it is sent, and otherwise the cause."""

from collections.abc import Iterator

import mujoco
import numpy as np

from mjstack.config.schema import Config
from mjstack.episodes.rollout import State
from mjstack.episodes.run import Run
from mjstack.robots.guest import WORLD, grasp_jacobian
from mjstack.scene.build import scene_names

_DEEP = 1e-4  # m: contacts at rest are less deep
_KIND = mujoco.mjtConstraint
_CAUSES = {  # of loads, by the kind of constraint that makes them
    "an equality of the robot's file holds it": (_KIND.mjCNSTR_EQUALITY,),
    "it is at the end of its range": (_KIND.mjCNSTR_LIMIT_JOINT, _KIND.mjCNSTR_LIMIT_TENDON),
    "dry friction holds it": (_KIND.mjCNSTR_FRICTION_DOF, _KIND.mjCNSTR_FRICTION_TENDON),
}


def waypoint_errors(run: Run) -> dict[str, float]:
    """Distance of the grasp point at the end of each phase of the nominal episode from where the
    arm's joint targets would have it [m]; fingers count as they are.
    """
    index = run.stage.index
    data = mujoco.MjData(run.stage.model)
    qpos, ctrl = index.robot_qpos[: index.n_arm], index.ctrl[: index.n_arm]

    def grasp_point() -> np.ndarray:
        mujoco.mj_kinematics(run.stage.model, data)
        return data.site_xpos[index.grasp_sites].mean(axis=0)

    errors = {}
    for phase in run.stage.phases:
        state = run.nominal.states[phase.stop - 1]
        data.qpos[:] = state.qpos[0]
        reached = grasp_point()
        data.qpos[qpos] = state.ctrl[0][ctrl]
        errors[phase.name] = float(np.linalg.norm(grasp_point() - reached))
    return errors


def find_cause(run: Run, state: State) -> str:
    """The joint that holds the grasp point farthest off its target in a state of one world, and the
    largest load on it against its servo.
    """
    index, model, data = run.stage.index, run.stage.model, mujoco.MjData(run.stage.model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = (values[0] for values in state)
    mujoco.mj_forward(model, data)
    dofs, ctrl = index.robot_qvel[: index.n_arm], index.ctrl[: index.n_arm]
    off = data.ctrl[ctrl] - data.qpos[index.robot_qpos[: index.n_arm]]
    shares = grasp_jacobian(data, run.cfg.robot)[:, dofs] * off
    worst = int(np.argmax(np.linalg.norm(shares, axis=0)))
    dof, servo, name = dofs[worst], ctrl[worst], run.cfg.robot.arm_joints[worst]
    turns = model.jnt_type[model.dof_jntid[dof]] == mujoco.mjtJoint.mjJNT_HINGE
    unit, newton = ("rad", "N m") if turns else ("m", "N")
    text = f"{name} is {abs(off[worst]):.3g} {unit} off"
    force, most = data.actuator_force[servo], model.actuator_forcerange[servo].max()
    if model.actuator_forcelimited[servo] and abs(force) > 0.99 * most:
        text += f" with its servo's largest force, {most:.3g} {newton} (robot.servos.{name}.effort)"

    def load(rows: np.ndarray) -> float:
        """Of some constraint rows on the joint."""
        out = np.zeros(model.nv)
        mujoco.mj_mulJacTVec(model, data, out, np.where(rows, data.efc_force, 0.0))
        return float(out[dof])

    gravcomp = "" if model.body_gravcomp.any() else "robot.gravcomp=true, or "
    loads = {
        f"gravity: {gravcomp}a stiffer servo": data.qfrc_passive[dof] - data.qfrc_bias[dof],
        "it still moves: more seconds": model.actuator_biasprm[servo][2] * data.qvel[dof],
        **{cause: load(np.isin(data.efc_type, kinds)) for cause, kinds in _CAUSES.items()},
    }
    rows = np.arange(data.nefc)
    contacts = [contact for contact in data.contact if contact.efc_address >= 0]
    ends = [*(contact.efc_address for contact in contacts[1:]), data.nefc]
    for contact, end in zip(contacts, ends, strict=True):
        cause = _touch(run.cfg, model, contact)
        here = (rows >= contact.efc_address) & (rows < end)
        loads[cause] = loads.get(cause, 0.0) + load(here)
    cause, against = min(loads.items(), key=lambda item: item[1] * np.sign(off[worst]))
    return f"{text}; {cause} ({abs(against):.3g} {newton})"


def start_contacts(run: Run) -> Iterator[str]:
    """Where the robot is inside of the scene as the nominal episode starts, a line each."""
    model, data = run.stage.model, mujoco.MjData(run.stage.model)
    data.qpos[:] = run.nominal.episode.start[0]
    mujoco.mj_fwdPosition(model, data)
    depths: dict[tuple[str, ...], float] = {}
    for contact in data.contact:
        owners = [_owner(run.cfg, model, geom) for geom in contact.geom]
        if len({scene for _, scene in owners}) == 2:
            names = tuple(name for name, _ in sorted(owners, key=lambda owner: owner[1]))
            depths[names] = min(depths.get(names, 0.0), contact.dist)
    for (name, other), depth in depths.items():
        if depth < -_DEEP:
            yield f"{name} starts {-1e3 * depth:.1f} mm inside {other}: change robot.home or the scene"


def _touch(cfg: Config, model: mujoco.MjModel, contact: mujoco.MjContact) -> str:
    """The two that touch, and the way out where both are the robot's."""
    owners = [_owner(cfg, model, geom) for geom in contact.geom]
    text = f"{owners[1][0]} presses on {owners[0][0]}"
    if any(scene for _, scene in owners):
        return text
    bodies = [model.body(model.geom_bodyid[geom]).name for geom in contact.geom]
    return f"{text}: robot.exclude=[[{','.join(bodies)}]]"


def _owner(cfg: Config, model: mujoco.MjModel, number: int) -> tuple[str, bool]:
    """The name of a geom's body, of the world's the geom's too; and whether it is the scene's."""
    geom, body = model.geom(number), model.geom_bodyid[number]
    name, root = model.body(body).name, model.body(model.body_rootid[body]).name
    if name != WORLD:
        return name, root in cfg.scene.objects
    mesh = model.mesh(geom.dataid[0]).name if geom.dataid[0] >= 0 else ""
    scene = geom.name in scene_names(cfg.scene)
    return geom.name if scene else f"world's {geom.name or mesh or f'geom {number}'}", scene
