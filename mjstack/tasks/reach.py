"""Task *reach*: the grasp point to a point above a cube."""

import torch
from torch import Tensor

from mjstack.config.fields import Count, Positive
from mjstack.managers.view import EnvView
from mjstack.mdp.observation import grasp_point_to_object
from mjstack.tasks.parts import HeldSuccess


class ReachSuccess(HeldSuccess):
    """Achieved while the grasp point has been near the point for some steps in a row."""

    def __init__(
        self, env: EnvView, *, object: str, height: float, distance: Positive, steps: Count
    ) -> None:
        """Take the thresholds.

        Args:
            env: The environment.
            object: The cube.
            height: How far above its centre the point is [m].
            distance: Largest distance that counts as near [m].
            steps: How many steps in a row.

        Raises:
            MjstackError: There is no such object.
        """

        def near() -> Tensor:
            offset = grasp_point_to_object(env, object=object, height=height)
            return torch.linalg.vector_norm(offset, dim=1) <= distance

        super().__init__(env, near, steps)
