"""Where cubes can stand: on the table, apart from each other, clear of the arm."""

from __future__ import annotations

import math
from collections.abc import Sequence

import mujoco
import numpy as np
import torch

from mjstack.config.schema import Config
from mjstack.errors import ParameterError
from mjstack.rng import uniform
from mjstack.scene import SceneIndex, table_top

_TRIALS = 20_000  # imaginary worlds that try a region before it is used


class Placement:
    """Tests places of both cubes in a region around their nominal ones.

    Shapes are rounded up: a cube of any yaw is a disc of half its diagonal, and a geom of the arm is its bounding sphere.
    So what passes is free, and some free places are not used.
    """

    def __init__(
        self,
        cfg: Config,
        model: mujoco.MjModel,
        index: SceneIndex,
        *,
        region: tuple[float, float],
        gap: float,
        pose: Sequence[float],
        noise: float = 0.0,
    ) -> None:
        """Finds what could be in the way.

        Args:
            cfg: The configuration.
            model: The compiled scene.
            index: Its addresses.
            region: Half-widths of the region in x and y [m].
            gap: Free room around a cube [m].
            pose: Where the robot's joints are [rad, m].
            noise: How far each arm joint may be from there [rad].
        """
        scene = cfg.scene
        half = scene.cube_half
        self._radius = math.sqrt(2.0) * half
        self._apart = 2.0 * self._radius + gap
        self._height = table_top(scene) + half
        nominal = torch.tensor([scene.red_xy, scene.blue_xy], dtype=torch.float64)
        center, room = torch.tensor(scene.table_center[:2]).double(), torch.tensor(scene.table_half[:2]).double() - self._radius
        data = mujoco.MjData(model)
        data.qpos[index.robot_qpos] = pose
        mujoco.mj_kinematics(model, data)
        centers, keep = _arm_spheres(cfg, data, index, noise)
        keep += math.sqrt(3.0) * half + gap
        near = np.zeros(len(keep), dtype=bool)
        for xy in (scene.red_xy, scene.blue_xy):
            offset = np.abs(centers - [*xy, self._height]) - [*region, 0.0]
            near |= np.linalg.norm(np.maximum(offset, 0.0), axis=1) < keep
        spheres = torch.from_numpy(np.column_stack((centers, keep))[near])
        self._tensors = [nominal, torch.tensor(region).double(), center, room, spheres]

    def to(self, device: torch.device, dtype: torch.dtype) -> None:
        """Moves the constants to where worlds are placed."""
        self._tensors = [t.to(device, dtype) for t in self._tensors]

    def choose(self, draws: torch.Tensor) -> torch.Tensor:
        """The first candidates that fit.

        Args:
            draws: Numbers in [-1, 1), shape ``(n, 2, candidates, 2)``: red and blue, x and y.

        Returns:
            Offsets from the nominal places [m], shape ``(n, 2, 2)``; 0 for both cubes where nothing fits.
        """
        return self._choose(draws)[0]

    def require_room(self, name: str, value: object, candidates: int) -> None:
        """Tries the region on many imaginary worlds.

        Raises:
            ParameterError: In some of them no candidate fits.
        """
        world = torch.arange(_TRIALS)
        zero = torch.zeros_like(world)
        draws = uniform(seed=0, world=world, episode=zero, step=zero, stream=0, size=4 * candidates).double()
        _, free = self._choose(draws.view(_TRIALS, 2, candidates, 2))
        lacking = int((~free).sum())
        if lacking:
            raise ParameterError(
                name,
                value,
                f"a region with a free place for both cubes; {candidates} draws found none in {lacking} of {_TRIALS} trials",
                "Make the region smaller, the gap smaller, or move the cubes (scene.red_xy, scene.blue_xy)",
            )

    def require_all_free(self, name: str, value: object) -> None:
        """Checks the corners of the region, which is small: every draw must fit.

        Raises:
            ParameterError: A cube could leave the table or touch the other.
        """
        corners = torch.tensor([[x, y] for x in (-1.0, 1.0) for y in (-1.0, 1.0)]).double()
        pairs = torch.stack([torch.stack((a, b)) for a in corners for b in corners])
        _, free = self._choose(pairs[:, :, None])
        if not bool(free.all()):
            raise ParameterError(name, value, "cubes that stay on the table, apart from each other and clear of the arm")

    def _choose(self, draws: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        nominal, region, center, room, spheres = self._tensors
        offsets = draws * region
        places = nominal[None, :, None] + offsets
        free = ((places - center).abs() <= room).all(-1)
        if spheres.shape[0]:
            level = torch.full_like(places[..., :1], self._height)
            away = torch.cat((places, level), -1)[..., None, :] - spheres[:, :3]
            free &= (away.square().sum(-1) >= spheres[:, 3].square()).all(-1)
        rows = torch.arange(draws.shape[0], device=draws.device)
        red = free[:, 0].to(torch.uint8).argmax(1)
        gap = places[:, 1] - places[rows, 0, red][:, None]
        free_blue = free[:, 1] & (gap.square().sum(-1) >= self._apart**2)
        blue = free_blue.to(torch.uint8).argmax(1)
        both = free[:, 0].any(1) & free_blue.any(1)
        chosen = torch.stack((offsets[rows, 0, red], offsets[rows, 1, blue]), dim=1)
        return torch.where(both[:, None, None], chosen, 0.0), both


def _arm_spheres(cfg: Config, data: mujoco.MjData, index: SceneIndex, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Centres ``(n, 3)`` and radii ``(n,)`` of spheres that hold the arm's colliding geoms, wherever noise puts them."""
    model = data.model
    body = model.geom_bodyid
    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    geoms = np.flatnonzero(collides & (body != 0) & ~np.isin(body, list(index.bodies.values())))
    joints = [model.joint(name).id for name in cfg.robot.arm_joints]
    centers = data.geom_xpos[geoms]
    # A joint that is off moves a geom by at most its distance from the joint times the angle.
    levers = np.linalg.norm(data.xanchor[joints][None] - centers[:, None], axis=2)
    return centers, model.geom_rbound[geoms] + noise * levers.sum(1)
