"""Task *reach*: the grasp point to a point above a cube."""

import torch
from torch import Tensor

from mjstack.managers.term import require_positive
from mjstack.managers.view import EnvView
from mjstack.mdp.geometry import grasp_point_to_object


class ReachSuccess:
    """Achieved while the grasp point has been near the point for some steps in a row."""

    def __init__(
        self, env: EnvView, *, object: str, height: float, distance: float, steps: int
    ) -> None:
        """Takes the thresholds.

        Args:
            env: The environment.
            object: The cube.
            height: How far above its centre the point is [m].
            distance: What counts as near [m].
            steps: How many steps in a row.

        Raises:
            MjstackError: There is no such object, or a number is out of range.
        """
        env.index.object_address(object)
        require_positive("distance", distance)
        require_positive("steps", steps)
        self._object = object
        self._height = height
        self._distance = distance
        self._steps = steps
        self._run = torch.zeros(env.nworld, dtype=torch.int32, device=env.device)

    def __call__(self, env: EnvView) -> Tensor:
        """Processes a step; shape ``(nworld,)``, bool."""
        offset = grasp_point_to_object(env, self._object, self._height)
        near = torch.linalg.vector_norm(offset, dim=1) <= self._distance
        self._run.add_(1).mul_(near)
        return self._run >= self._steps

    def reset(self, mask: Tensor) -> None:
        """Forgets the masked worlds."""
        self._run.masked_fill_(mask, 0)
