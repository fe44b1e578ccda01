"""Facts of a robot's joints that every solver of inverse kinematics needs."""

from collections.abc import Sequence

import mujoco
import numpy as np

from mjstack.config.schema import RobotCfg
from mjstack.scene.index import find


def joint_limits(model: mujoco.MjModel, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """Narrower of each joint's range and its servo's.

    Args:
        model: A compiled model that contains the robot.
        names: The joints.

    Returns:
        Low and high limits [rad, m], each of shape ``(n,)``; infinite where there is none.
    """
    joints = [find(model, "joint", name) for name in names]
    servos = [find(model, "actuator", name) for name in names]
    low, high = zip(
        *(
            np.where(limited[:, None], span, [-np.inf, np.inf]).T
            for limited, span in (
                (model.jnt_limited[joints], model.jnt_range[joints]),
                (model.actuator_ctrllimited[servos], model.actuator_ctrlrange[servos]),
            )
        ),
        strict=True,
    )
    return np.maximum(*low), np.minimum(*high)


def locked_home(robot: RobotCfg) -> np.ndarray:
    """The robot's home with the locked joints where they are locked [rad, m], shape ``(nu,)``."""
    pairs = zip(robot.joints, robot.home, strict=True)
    return np.array([robot.locked.get(name, value) for name, value in pairs])


def approach_body(model: mujoco.MjModel, robot: RobotCfg) -> int:
    """Index of the body with the robot's approach axis: the last arm joint's, if none is named."""
    if robot.approach_body:
        return find(model, "body", robot.approach_body)
    return int(model.jnt_bodyid[find(model, "joint", robot.arm_joints[-1])])
