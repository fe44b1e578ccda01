"""Facts of a robot's joints that every solver of inverse kinematics needs."""

from __future__ import annotations

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
    low = np.full(len(names), -np.inf)
    high = np.full(len(names), np.inf)
    for k, name in enumerate(names):
        joint = find(model, "joint", name)
        servo = find(model, "actuator", name)
        for limited, span in (
            (model.jnt_limited[joint], model.jnt_range[joint]),
            (model.actuator_ctrllimited[servo], model.actuator_ctrlrange[servo]),
        ):
            if limited:
                low[k] = max(low[k], span[0])
                high[k] = min(high[k], span[1])
    return low, high


def approach_body(model: mujoco.MjModel, robot: RobotCfg) -> int:
    """Index of the body with the robot's approach axis: the last arm joint's, if none is named."""
    if robot.approach_body:
        return find(model, "body", robot.approach_body)
    return int(model.jnt_bodyid[find(model, "joint", robot.arm_joints[-1])])
