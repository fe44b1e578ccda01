"""Observations and rewards of the box task. They share objects, places and thresholds with the
task's check.
"""

import torch
from torch import Tensor

from mjstack.config.fields import NotNegative, Positive
from mjstack.errors import UnknownName
from mjstack.managers.term import shared
from mjstack.managers.view import EnvView, offers
from mjstack.mdp.geometry import above_table, nearness, place_xy, pose_w
from mjstack.mdp.observation import grasp_point_pos, jaw_force
from mjstack.tasks.box import BoxCheck


@offers(unit="m")
class ToSlot:
    """From an object's centre to where it rests at its place in the box [m], shape ``(nworld,
    3)``.
    """

    def __init__(self, env: EnvView, *, object: str) -> None:
        """Find the place.

        Args:
            env: The environment.
            object: One of the objects.

        Raises:
            MjstackError: There is no such object, or no box.
        """
        check = BoxCheck(env.cfg)
        if object not in check.slots:
            raise UnknownName("object", object, check.slots)
        self._object = object
        self._place = check.slots[object]
        scene = env.cfg.scene
        self.floor = check.box.floor
        self._height = scene.table_top + self.floor + scene.objects[object].half_height

    def __call__(self, env: EnvView) -> Tensor:
        """The offset."""
        xy, z = pose_w(env, self._object)[:, :3].split((2, 1), dim=1)
        return torch.cat((place_xy(env, self._place) - xy, self._height - z), dim=1)


class Place:
    """Nearness of a cube to its place in the box, while it is off the table; see `nearness`.

    Off the table is a cube whose lowest corner is higher than half the thickness of the box's
    floor, ``scene.box.floor``: also one that rests in the box, however thin that floor is.
    """

    def __init__(self, env: EnvView, *, object: str, scale: Positive) -> None:
        """Find the place.

        Args:
            env: The environment.
            object: One of the cubes.
            scale: Distance over which the reward falls [m].

        Raises:
            MjstackError: There is no such cube, or no box.
        """
        self._to_slot = ToSlot(env, object=object)
        self._object = object
        self._scale = scale
        self._off_table = 0.5 * self._to_slot.floor

    def __call__(self, env: EnvView) -> Tensor:
        """The reward, shape ``(nworld,)``."""
        near = nearness(self._to_slot(env), self._scale)
        return near * (above_table(env, self._object) > self._off_table)


class _ByObject:
    """A term that asks which objects are in the box, and raises a `MjstackError` without one."""

    def __init__(self, env: EnvView) -> None:
        self._check = BoxCheck(env.cfg)
        self._view = self._check.view(env)

    def _inside(self, env: EnvView) -> Tensor:
        """Whether each object is in the box, shape ``(nworld, objects)``, bool. Not to be written
        into.
        """
        return shared((id(env), _ByObject), lambda: self._check.placed(self._view.step()))

    def _next(self, env: EnvView, values: list[Tensor]) -> Tensor:
        """The value, ``(nworld, n)`` each, of the first object that is not in the box, or of the
        last one.
        """
        inside = self._inside(env)
        out = values[-1]
        for column in reversed(range(len(values) - 1)):
            out = torch.where(inside[:, column : column + 1], out, values[column])
        return out


class InBox(_ByObject):
    """Share of the objects that is in the box, 0 to 1."""

    def __call__(self, env: EnvView) -> Tensor:
        """The share, shape ``(nworld,)``."""
        return self._inside(env).float().mean(1)


class ReachNext(_ByObject):
    """Nearness of the grasp point to the first object that is not in the box yet; 1 once all
    are.
    """

    def __init__(self, env: EnvView, *, scale: Positive) -> None:
        """Take the distance over which the reward falls [m]."""
        super().__init__(env)
        self._scale = scale

    def __call__(self, env: EnvView) -> Tensor:
        """The reward, shape ``(nworld,)``."""
        aim = self._next(env, [pose_w(env, name)[:, :3] for name in self._check.objects])
        near = nearness(aim - grasp_point_pos(env), self._scale)
        return torch.where(self._inside(env).all(1), 1.0, near)


class GraspNext(_ByObject):
    """1 while all jaws press on the first object that is not in the box yet, or once all are; else
    0.
    """

    def __init__(self, env: EnvView, *, force: NotNegative = 0.05) -> None:
        """Take the force that each jaw must exceed [N]."""
        super().__init__(env)
        self._force = force

    def __call__(self, env: EnvView) -> Tensor:
        """The reward, shape ``(nworld,)``."""
        held = [jaw_force(env, object=name) > self._force for name in self._check.objects]
        grasped = self._next(env, held).all(1)
        return (grasped | self._inside(env).all(1)).to(torch.float32)
