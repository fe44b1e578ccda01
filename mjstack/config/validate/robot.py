"""Checks the robot."""

from __future__ import annotations

import math

from mjstack.config.schema import Config
from mjstack.config.validate.values import length, not_negative, positive
from mjstack.errors import ConfigError, UnknownName


def check_robot(cfg: Config) -> None:
    """The robot's lists have its joints' length, and its names are its joints'."""
    robot = cfg.robot
    n_arm = len(robot.arm_joints)
    n_grip = len(robot.gripper_joints)
    length("robot.home", robot.home, n_arm + n_grip)
    length("robot.start", robot.start, n_arm + n_grip)
    length("robot.gripper_open", robot.gripper_open, n_grip)
    length("robot.gripper_closed", robot.gripper_closed, n_grip)
    length("robot.grasp_sites", robot.grasp_sites, 2)
    length("robot.approach_axis", robot.approach_axis, 3)
    if abs(math.hypot(*robot.approach_axis) - 1.0) > 1e-3:
        raise ConfigError(
            "robot.approach_axis", robot.approach_axis, "a vector of length 1, such as [0, 0, -1]"
        )
    for key, names in (
        ("robot.ik_joints", robot.ik_joints),
        ("robot.locked", list(robot.locked)),
        ("robot.roll_joint", [robot.roll_joint] if robot.roll_joint else []),
    ):
        for name in names:
            if name not in robot.arm_joints:
                raise UnknownName(f"{key}: arm joint", name, robot.arm_joints)
    if set(robot.ik_joints) & set(robot.locked):
        raise ConfigError(
            "robot.locked", list(robot.locked), "joints that robot.ik_joints does not move"
        )
    length("robot.locked", list(robot.locked.values()), len(robot.locked))
    if robot.yaw_alignment > 0.0 and robot.roll_joint is None:
        raise ConfigError(
            "robot.roll_joint", "null", "an arm joint", "Or set robot.yaw_alignment=0"
        )
    if robot.arm_force_limit is not None:
        positive("robot.arm_force_limit", robot.arm_force_limit, "N m")
    positive("robot.approach_height", robot.approach_height, "m")
    not_negative("robot.finger_room", robot.finger_room, "m")
