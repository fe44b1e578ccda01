"""Checks the robot."""

from __future__ import annotations

import math

from mjstack.config.schema import Config
from mjstack.errors import ConfigError, UnknownName


def check_robot(cfg: Config) -> None:
    """The robot's lists have its joints' length, and its names are its joints'."""
    robot = cfg.robot
    n_grip = len(robot.gripper_joints)
    for key, size in (
        ("home", len(robot.arm_joints) + n_grip),
        ("start", len(robot.arm_joints) + n_grip),
        ("gripper_open", n_grip),
        ("gripper_closed", n_grip),
    ):
        values = getattr(robot, key)
        if len(values) != size:
            raise ConfigError(f"robot.{key}", values, f"{size} numbers, one per joint")
    if abs(math.hypot(*robot.approach_axis) - 1.0) > 1e-3:
        expected = "a vector of length 1, such as [0, 0, -1]"
        raise ConfigError("robot.approach_axis", robot.approach_axis, expected)
    for key, names in (
        ("robot.ik_joints", robot.ik_joints),
        ("robot.locked", list(robot.locked)),
        ("robot.roll_joint", [robot.roll_joint] if robot.roll_joint else []),
    ):
        for name in names:
            if name not in robot.arm_joints:
                raise UnknownName(f"{key}: arm joint", name, robot.arm_joints)
    if set(robot.ik_joints) & set(robot.locked):
        expected = "joints that robot.ik_joints does not move"
        raise ConfigError("robot.locked", list(robot.locked), expected)
    if cfg.controller.yaw_alignment > 0.0 and robot.roll_joint is None:
        expected = "0, because robot.roll_joint is null"
        raise ConfigError("controller.yaw_alignment", cfg.controller.yaw_alignment, expected)
