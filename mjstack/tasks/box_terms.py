"""Observations of the box task. They share objects and places with the task's check."""

from torch import Tensor

from mjstack.errors import require_names
from mjstack.managers.view import EnvView, ignores_success, offers
from mjstack.mdp.geometry import pose_w
from mjstack.tasks.box import BoxCheck


@ignores_success
@offers("observation term", unit="m")
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
        require_names("object", [object], check.slots)
        self._object = object
        self._check = check

    def __call__(self, env: EnvView) -> Tensor:
        """The offset."""
        return self._check.at_slot(env, self._object) - pose_w(env, self._object)[:, :3]
