"""Whether the arm goes where it is sent, and otherwise the cause."""

from collections.abc import Iterator, Mapping

import mujoco
import numpy as np

from mjstack.episodes.rollout import State
from mjstack.episodes.stage import Stage
from mjstack.robots.guest import OWN_WORLD, WORLD, grasp_jacobian
from mjstack.robots.posture import actuator_moment
from mjstack.scene.build import scene_names
from mjstack.scene.index import gripper_targets, jaws_of

_DEEP = 1e-4  # m: contacts at rest are less deep
_KINDS = mujoco.mjtConstraint
_CAUSES = {  # of loads, by the kind of constraint that makes them
    int(_KINDS.mjCNSTR_EQUALITY): "an equality of the robot's file holds it",
    int(_KINDS.mjCNSTR_FRICTION_DOF): "dry friction holds it",
    int(_KINDS.mjCNSTR_FRICTION_TENDON): "dry friction of a tendon holds it",
    int(_KINDS.mjCNSTR_LIMIT_JOINT): "it is at the end of its range",
    int(_KINDS.mjCNSTR_LIMIT_TENDON): "a tendon is at the end of its range",
}


def waypoint_errors(
    stage: Stage, states: Mapping[int, State], targets: Mapping[int, np.ndarray]
) -> dict[str, float]:
    """Distance of the grasp point at the end of each phase of the nominal episode from where the
    arm's joint targets would have it [m]; fingers count as they are. States and joint targets are
    by step. Empty of a driver without phases, such as a policy.
    """
    index, data = stage.index, mujoco.MjData(stage.model)

    def grasp_point() -> np.ndarray:
        mujoco.mj_kinematics(stage.model, data)
        return data.site_xpos[index.grasp_sites].mean(axis=0)

    errors = {}
    for phase in stage.phases:
        data.qpos[:] = states[phase.stop - 1].qpos[0]
        reached = grasp_point()
        arm = index.robot_qpos[: index.n_arm]
        data.qpos[arm] = targets[phase.stop - 1][: index.n_arm]
        errors[phase.name] = float(np.linalg.norm(grasp_point() - reached))
    return errors


def find_cause(stage: Stage, state: State, target: np.ndarray) -> str:
    """The joint that holds the grasp point farthest off its target in a state of one world, and the
    largest load on it against its servo.
    """
    index, model, data = stage.index, stage.model, mujoco.MjData(stage.model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = (values[0] for values in state)
    mujoco.mj_forward(model, data)

    # The joint
    dofs = index.robot_qvel[: index.n_arm]
    offset = (target - data.qpos[index.robot_qpos])[: index.n_arm]
    shares = grasp_jacobian(data, stage.cfg.robot.grasp_sites)[:, dofs] * offset
    worst = int(np.argmax(np.linalg.norm(shares, axis=0)))
    dof, servo, name = dofs[worst], index.ctrl[worst], stage.cfg.robot.arm_joints[worst]
    joint = model.dof_jntid[dof]
    turns = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE
    unit, newton = ("rad", "N m") if turns else ("m", "N")
    text = f"{name} is {abs(offset[worst]):.3g} {unit} off"
    if not np.isclose(bounded := data.ctrl[servo], target[worst], atol=1e-5):
        return f"{text}; its range bounds its target {target[worst]:.3g} to {bounded:.3g}"
    most = np.inf
    if model.actuator_forcelimited[servo]:
        most = model.actuator_forcerange[servo].max()
    if model.jnt_actfrclimited[joint]:
        most = min(most, model.jnt_actfrcrange[joint].max())
    if abs(data.qfrc_actuator[dof]) > 0.99 * most:
        text += f" at its servo's largest force, {most:.3g} {newton} (robot.servos.{name}.effort)"

    # Loads on it
    gravcomp = "" if model.body_gravcomp.any() else "robot.gravcomp=true, or "
    loads = {
        f"gravity: {gravcomp}a stiffer servo": data.qfrc_passive[dof] - data.qfrc_bias[dof],
        "it still moves: more seconds": model.actuator_biasprm[servo][2] * data.qvel[dof],
    }
    moment = actuator_moment(data)
    for number in np.setdiff1d(np.arange(model.nu), index.ctrl):
        pull = f"actuator {model.actuator(number).name or number} of the robot's file pulls at it"
        loads[pull] = moment[number, dof] * data.actuator_force[number]
    torque = np.zeros(model.nv)
    for row, kind in enumerate(data.efc_type.tolist()):
        cause = _CAUSES.get(kind) or _touch(stage, data.contact[data.efc_id[row]])
        force_of_row = np.where(np.arange(data.nefc) == row, data.efc_force, 0.0)
        mujoco.mj_mulJacTVec(model, data, torque, force_of_row)
        loads[cause] = loads.get(cause, 0.0) + torque[dof]
    cause, load = min(loads.items(), key=lambda item: item[1] * np.sign(offset[worst]))
    return f"{text}; {cause} ({abs(load):.3g} {newton})"


def loose_grips(stage: Stage) -> Iterator[str]:
    """List the objects from which the closed jaws would stay apart, a line for each width."""
    model, robot = stage.model, stage.cfg.robot
    widths = sorted({phase.width or 0.0 for phase in stage.phases if phase.grasped >= 0})
    gaps = jaws_of(model, robot).gap(gripper_targets(model, robot, widths))
    for width, gap in zip(widths, 1e3 * gaps, strict=True):
        if gap > 1e3 * width:
            line = f"the jaws close to {gap:.1f} mm around an object of {1e3 * width:.1f} mm"
            yield f"{line}: robot.gripper_closed"


def start_contacts(stage: Stage, start: np.ndarray) -> list[str]:
    """List where the robot is inside of the scene at a start of shape ``(nq,)``, a line each."""
    data = mujoco.MjData(stage.model)
    data.qpos[:] = start
    mujoco.mj_fwdPosition(stage.model, data)
    depths: dict[str, float] = {}
    for contact in data.contact:
        text = _touch(stage, contact, same_side="")
        depths[text] = max(depths.get(text, 0.0), -contact.dist)
    return [
        f"at the start {text}, {1e3 * depth:.1f} mm deep: another robot.home"
        for text, depth in depths.items()
        if text and depth > _DEEP
    ]


def _touch(
    stage: Stage, contact: mujoco.MjContact, same_side: str = "{}: robot.exclude=[[{},{}]]"
) -> str:
    """Words for a contact, the robot's body first, geoms of the world by their names; ``same_side``
    is for two of the robot, or of the scene.
    """
    model = stage.model
    sides = []
    for number in contact.geom:
        geom, body = model.geom(number), model.geom_bodyid[number]
        name, root = (model.body(n).name for n in (body, model.body_rootid[body]))
        name = WORLD if name == OWN_WORLD else name
        label, in_scene = name, root in stage.cfg.scene.objects
        if name == WORLD:
            in_scene = geom.name in scene_names(stage.cfg.scene)
            mesh = model.mesh(geom.dataid[0]).name if geom.dataid[0] >= 0 else ""
            label = geom.name if in_scene else f"world's {geom.name or mesh or f'geom {number}'}"
        sides.append((in_scene, name == WORLD, name, label))
    (first, _, *robot), (second, _, *obstacle) = sorted(sides)
    text = f"{robot[1]} presses on {obstacle[1]}"
    return same_side.format(text, obstacle[0], robot[0]) if first == second else text
