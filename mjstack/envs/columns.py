"""Names and units of the numbers that an environment observes and of its joints."""

from collections.abc import Sequence

import mujoco

from mjstack.config.functions import offered
from mjstack.config.schema import ObservationTermCfg
from mjstack.envs.env import Env


def term_columns(term: str, dim: int, history: int) -> list[str]:
    """Names of the ``dim`` numbers of an observation term, over all steps of its ``history``:
    ``red_pose.2``, and ``red_pose.2.t-1`` one step before.
    """
    width = dim // history
    return [
        f"{term}{f'.{i}' if width > 1 else ''}{f'.t-{age}' if age else ''}"
        for age in range(history - 1, -1, -1)
        for i in range(width)
    ]


def joint_units(env: Env) -> tuple[str, ...]:
    """Units of the robot's joints, arm then gripper: rad for hinges, m for slides."""
    model = env.sim.model
    kinds = dict(zip(model.jnt_qposadr.tolist(), model.jnt_type.tolist(), strict=True))
    hinge = int(mujoco.mjtJoint.mjJNT_HINGE)
    return tuple("rad" if kinds[int(address)] == hinge else "m" for address in env.index.robot_qpos)


def group_columns(env: Env, group: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names and units of the numbers of an observation group, as of `term_columns`."""
    joints = joint_units(env)
    names: list[str] = []
    units: list[str] = []
    for term, dim in env.observation_manager.term_dims[group].items():
        cfg: ObservationTermCfg = env.cfg.observation[group].terms[term]
        width = dim // cfg.history
        names += term_columns(term, dim, cfg.history)
        units += cfg.history * _scaled(_term_units(cfg.func, width, joints), cfg.scale)
    return tuple(names), tuple(units)


def _term_units(func: str, width: int, joints: tuple[str, ...]) -> Sequence[str]:
    unit = offered(func, "unit") or "unknown"
    if unit == "joint":  # or the actions of a policy, which need not be joint targets
        return joints if width == len(joints) else ["1"] * width
    if unit == "joint/s":
        return [f"{joint}/s" for joint in joints]
    return [unit] * width if isinstance(unit, str) else unit


def _scaled(units: Sequence[str], scale: float) -> list[str]:
    """Units of 1 after the scaling: ``10 rad/s`` where a speed is multiplied by 0.1."""
    if scale == 0.0:
        return ["unknown"] * len(units)
    factor = "" if scale == 1.0 else f"{1.0 / scale:g} "
    return [u if u == "unknown" else f"{factor}{u}".removesuffix(" 1") for u in units]
