"""Hundreds of random stacks on the GPU: with the primitive box collider all come to rest, with the
convex one some never do.
"""

import math

import mujoco_warp as mjw
import pytest
import torch
from compositions import load_config
from environments import on_cuda

from mjstack.config.schema import Backend
from mjstack.math import quat_from_yaw
from mjstack.scene import SceneIndex, build_model
from mjstack.sim import make_simulation

pytestmark = pytest.mark.full

NWORLD = 512
SECONDS = 5.0


def moving_stacks(*, primitive: bool) -> int:
    """Stacks whose red cube still turns after SECONDS, of NWORLD dropped from half a millimetre."""
    cfg = load_config()
    model = build_model(cfg)
    index = SceneIndex(model, cfg.robot, cfg.scene)
    sim = make_simulation(model, cfg, NWORLD, backend=Backend.mjwarp, device="cuda:0")
    if not primitive:
        sim._m.opt.disableflags &= ~int(mjw.DisableBit.NATIVECCD)
    generator = torch.Generator().manual_seed(7)
    draw = (2.0 * torch.rand((NWORLD, 4), generator=generator) - 1.0).to(sim.device)
    sim.reset()
    half = cfg.scene.objects["red"].half_height
    top = cfg.scene.table_top
    red, blue = index.object_qpos
    spot = torch.tensor([0.42, 0.14], device=sim.device)
    sim.qpos[:, blue : blue + 2] = spot
    sim.qpos[:, blue + 2] = top + half
    sim.qpos[:, blue + 3 : blue + 7] = quat_from_yaw(0.25 * math.pi * draw[:, 2])
    sim.qpos[:, red : red + 2] = spot + 0.008 * draw[:, :2]
    sim.qpos[:, red + 2] = top + 3.0 * half + 5e-4
    sim.qpos[:, red + 3 : red + 7] = quat_from_yaw(0.25 * math.pi * draw[:, 3])
    sim.ctrl[:] = torch.tensor(cfg.robot.home, device=sim.device)
    spin = index.object_qvel[0] + 3
    fastest = torch.zeros(NWORLD, device=sim.device)
    steps = round(SECONDS / cfg.timing.step_dt)
    for step in range(steps):
        sim.step(cfg.timing.decimation)
        if step >= steps - 50:
            fastest = torch.maximum(fastest, sim.qvel[:, spin : spin + 3].norm(dim=1))
    assert not bool(sim.overflow.any())
    assert bool(torch.isfinite(fastest).all())
    return int((fastest > 0.02).sum())


@on_cuda
@pytest.mark.parametrize("primitive", [True, False])
def test_random_stacks_come_to_rest(primitive: bool) -> None:
    """With the convex collider some never do. When MJWarp mends it this fails: then drop the
    primitive one.
    """
    assert (moving_stacks(primitive=primitive) == 0) is primitive
