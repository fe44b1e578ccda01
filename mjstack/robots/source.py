"""Robot descriptions as MjSpec: our own mesh-free MJCF, or MuJoCo Menagerie's model."""

from __future__ import annotations

import os
from pathlib import Path

import mujoco
import numpy as np

from mjstack.config.schema import ModelCfg, ModelSource, RobotCfg
from mjstack.errors import SourceError

BUILTIN = Path(__file__).parent


def robot_spec(robot: RobotCfg, model: ModelCfg) -> mujoco.MjSpec:
    """Loads a robot and makes it ready for the task.

    Args:
        robot: The robot's profile.
        model: Where its description comes from.

    Returns:
        A spec with the robot's two grasp_point sites and, where the profile says so, the arm's
        raised force limit.

    Raises:
        SourceError: The description cannot be found or read.
    """
    path = builtin_path(robot) if model.source is ModelSource.builtin else menagerie_path(robot)
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except (ValueError, FileNotFoundError) as error:
        raise SourceError(
            f"{path} cannot be read: {str(error).splitlines()[0]}. Use model=builtin."
        ) from error
    if model.source is ModelSource.menagerie:
        if robot.replace_collision:
            _replace_collision(spec, robot)
        _add_grasp_sites(spec, robot)
    for key in list(spec.keys):  # a robot's keyframes have no place for the scene's cubes
        spec.delete(key)
    if robot.arm_force_limit is not None:
        for name in robot.arm_joints:
            spec.actuator(name).forcerange = [-robot.arm_force_limit, robot.arm_force_limit]
    return spec


def builtin_path(robot: RobotCfg) -> Path:
    """The MJCF file that ships with mjstack; it opens in MuJoCo's viewer as it is."""
    return BUILTIN / f"{robot.name}.xml"


def menagerie_path(robot: RobotCfg) -> Path:
    """The file in MuJoCo Menagerie: below ``MENAGERIE_ROOT`` if that is set, else fetched and
    cached by its package.
    """
    root = os.environ.get("MENAGERIE_ROOT")
    if root:
        path = Path(root) / robot.menagerie_name / robot.menagerie_file
        if not path.is_file():
            raise SourceError(
                f"MENAGERIE_ROOT={root}: there is no {robot.menagerie_name}/{robot.menagerie_file}"
                " below it, expected a checkout of MuJoCo Menagerie. Correct or unset it, or use"
                " model=builtin."
            )
        return path
    import mujoco_menagerie

    try:
        return Path(mujoco_menagerie.get(robot.menagerie_name).path()) / robot.menagerie_file
    except (mujoco_menagerie.MenagerieError, OSError) as error:
        raise SourceError(
            f"model=menagerie: {robot.menagerie_name} is neither cached nor can it be fetched"
            f" ({type(error).__name__}). Set MENAGERIE_ROOT to a checkout of MuJoCo Menagerie, or"
            " use model=builtin."
        ) from error


def _replace_collision(spec: mujoco.MjSpec, robot: RobotCfg) -> None:
    """Puts the built-in robot's collision geoms in place of the file's own."""
    for geom in list(spec.geoms):
        if geom.contype or geom.conaffinity:
            geom.contype = geom.conaffinity = 0
    ours = mujoco.MjSpec.from_file(str(builtin_path(robot))).compile()
    for i in range(ours.ngeom):
        if not (ours.geom_contype[i] or ours.geom_conaffinity[i]):
            continue
        spec.body(ours.body(ours.geom_bodyid[i]).name).add_geom(
            name=ours.geom(i).name,
            type=ours.geom_type[i],
            pos=ours.geom_pos[i],
            quat=ours.geom_quat[i],
            size=ours.geom_size[i],
            contype=ours.geom_contype[i],
            conaffinity=ours.geom_conaffinity[i],
            condim=ours.geom_condim[i],
            friction=ours.geom_friction[i],
            solref=ours.geom_solref[i],
            solimp=ours.geom_solimp[i],
            priority=ours.geom_priority[i],
            group=3,
        )


def _add_grasp_sites(spec: mujoco.MjSpec, robot: RobotCfg) -> None:
    for site in robot.grasp_sites:
        if site in robot.grasp_geoms:
            geoms = [spec.geom(name) for name in robot.grasp_geoms[site]]
            body = geoms[0].parent
            pos = np.mean([geom.pos for geom in geoms], axis=0)
        else:
            body = spec.body(robot.grasp_bodies[site])
            pos = np.zeros(3)
        body.add_site(name=site, pos=pos, group=4)
