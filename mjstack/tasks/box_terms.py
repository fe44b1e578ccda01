"""Observations and rewards of the box task."""

from __future__ import annotations

import math

import torch

from mjstack.errors import ParameterError
from mjstack.managers.base import EnvView, require_positive, shared
from mjstack.math import quat_to_matrix
from mjstack.mdp.geometry import above_table, grasp_point, jaw_forces, pose_w
from mjstack.scene import table_top
from mjstack.tasks.box import COLORS, CubesAndBox


class ToSlot:
    """From a cube's centre to where it rests at its place in the box [m], shape ``(nworld, 3)``."""

    def __init__(self, env: EnvView, *, object: str) -> None:
        """Finds the place.

        Args:
            env: The environment.
            object: One of the cubes.

        Raises:
            MjstackError: There is no such cube, or no box.
        """
        env.index.object_address(object)
        scene = env.cfg.scene
        box = env.cfg.scene.box
        if box is None:
            raise ParameterError("object", object, "a scene with a box", "Set scene=box")
        slot = scene.places[f"{object}_slot"].xy
        place = [*slot, table_top(scene) + box.floor + scene.objects[object].half_height]
        self._object = object
        self._place = torch.tensor(place, dtype=env.sim.qpos.dtype, device=env.device)

    def __call__(self, env: EnvView) -> torch.Tensor:
        """The offset."""
        return self._place - pose_w(env, self._object)[:, :3]


class Place:
    """Nearness of a cube to its place in the box, while it is off the table: ``1 - tanh(distance /
    scale)``.

    Off the table is a cube whose lowest corner is higher than half the thickness of the box's
    floor, ``scene.box.floor``: also one that rests in the box, however thin that floor is.
    """

    def __init__(self, env: EnvView, *, object: str, scale: float) -> None:
        """Finds the place.

        Args:
            env: The environment.
            object: One of the cubes.
            scale: Distance over which the reward falls [m].

        Raises:
            MjstackError: There is no such cube, no box, or the scale is out of range.
        """
        require_positive("scale", scale)
        self._to_slot = ToSlot(env, object=object)
        self._object = object
        self._scale = scale
        assert env.cfg.scene.box is not None  # there would be no place
        self._off_table = 0.5 * env.cfg.scene.box.floor

    def __call__(self, env: EnvView) -> torch.Tensor:
        """The reward, shape ``(nworld,)``."""
        near = 1.0 - torch.tanh(torch.linalg.vector_norm(self._to_slot(env), dim=1) / self._scale)
        return near * (above_table(env, self._object) > self._off_table)


class InBox:
    """What part of the cubes is in the box, 0 to 1."""

    def __init__(self, env: EnvView) -> None:
        """Reads the box's place."""
        self._cubes = CubesAndBox(env.cfg, env.index, env.device)

    def __call__(self, env: EnvView) -> torch.Tensor:
        """The part, shape ``(nworld,)``."""
        return cubes_inside(env, self._cubes).float().mean(1)


class ReachNext:
    """Nearness of the grasp point to the first cube that is not in the box yet, red first; 1 once
    both are.
    """

    def __init__(self, env: EnvView, *, scale: float) -> None:
        """Reads the box's place.

        Args:
            env: The environment.
            scale: Distance over which the reward falls [m].

        Raises:
            MjstackError: There is no box, or the scale is out of range.
        """
        require_positive("scale", scale)
        self._cubes = CubesAndBox(env.cfg, env.index, env.device)
        self._scale = scale

    def __call__(self, env: EnvView) -> torch.Tensor:
        """The reward, shape ``(nworld,)``."""
        red, blue = cubes_inside(env, self._cubes).unbind(1)
        first, second = (pose_w(env, name)[:, :3] for name in COLORS)
        aim = torch.where(red[:, None], second, first)
        near = 1.0 - torch.tanh(
            torch.linalg.vector_norm(aim - grasp_point(env), dim=1) / self._scale
        )
        return torch.where(red & blue, 1.0, near)


class GraspNext:
    """1 while both jaws press on the first cube that is not in the box yet, red first, or once both
    are; else 0.
    """

    def __init__(self, env: EnvView, *, force: float = 0.05) -> None:
        """Reads the box's place.

        Args:
            env: The environment.
            force: What each jaw must exceed [N].

        Raises:
            MjstackError: There is no box, or the force is out of range.
        """
        if not 0.0 <= force < math.inf:
            raise ParameterError("force", force, "a number that is not negative")
        self._cubes = CubesAndBox(env.cfg, env.index, env.device)
        self._force = force

    def __call__(self, env: EnvView) -> torch.Tensor:
        """The reward, shape ``(nworld,)``."""
        red, blue = cubes_inside(env, self._cubes).unbind(1)
        holds = [(jaw_forces(env, name) > self._force).all(1) for name in COLORS]
        return (torch.where(red, holds[1], holds[0]) | (red & blue)).to(torch.float32)


def cubes_inside(env: EnvView, cubes: CubesAndBox) -> torch.Tensor:
    """Whether each cube is in the box, shape ``(nworld, 2)``, bool. Not to be written into."""

    def compute() -> torch.Tensor:
        pose = cubes.pose(env.sim)
        return cubes.inside(*cubes.bounds(pose[..., :3], quat_to_matrix(pose[..., 3:])))

    return shared((id(env), cubes_inside), compute)
