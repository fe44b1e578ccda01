"""How worlds start."""

from __future__ import annotations

import torch

from mjstack.config.schema import ResetCfg, RobotCfg
from mjstack.math import quat_from_yaw
from mjstack.rng import uniform
from mjstack.scene import SceneIndex
from mjstack.sim import Simulation

CUBE_STREAM = 1


def reset_home(sim: Simulation, index: SceneIndex, robot: RobotCfg, mask: torch.Tensor) -> None:
    """Puts the arm of the masked worlds at its home command, at rest. Writes qpos, qvel and ctrl."""
    home = torch.tensor(robot.home, dtype=sim.qpos.dtype, device=sim.device)
    rows = mask[:, None]
    for column, joint, actuator in zip(range(len(robot.home)), index.robot_qpos, index.ctrl, strict=True):
        sim.qpos[:, joint] = torch.where(mask, home[column], sim.qpos[:, joint])
        sim.ctrl[:, actuator] = torch.where(mask, home[column].to(sim.ctrl.dtype), sim.ctrl[:, actuator])
    sim.qvel.masked_fill_(rows, 0.0)


def reset_cubes(
    sim: Simulation,
    index: SceneIndex,
    reset: ResetCfg,
    mask: torch.Tensor,
    *,
    seed: int,
    episode: torch.Tensor,
    world0: int = 0,
) -> None:
    """Moves both cubes of the masked worlds off the model's own places, at random. Writes qpos.

    Args:
        sim: The worlds, at qpos0.
        index: Addresses.
        reset: Ranges.
        mask: Worlds to write, shape ``(nworld,)``, bool.
        seed: The run's seed.
        episode: Episode of each world, shape ``(nworld,)``, int64.
        world0: Number of the first world, where this simulation holds a part of a larger batch.
    """
    world = torch.arange(world0, world0 + sim.nworld, device=sim.device)
    draw = uniform(seed=seed, world=world, episode=episode, step=torch.zeros_like(world), stream=CUBE_STREAM, size=6).to(
        sim.qpos.dtype
    )
    for cube, address in enumerate(index.cube_qpos):
        dx, dy, yaw = draw[:, 3 * cube : 3 * cube + 3].unbind(1)
        pose = sim.qpos[:, address : address + 7].clone()
        pose[:, 0] += reset.cube_xy * dx
        pose[:, 1] += reset.cube_xy * dy
        pose[:, 3:] = quat_from_yaw(reset.cube_yaw * yaw)
        sim.qpos[:, address : address + 7] = torch.where(mask[:, None], pose, sim.qpos[:, address : address + 7])
