"""Task *reach*: the grasp point to a point above a cube."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from mjstack.config.fields import Count, Positive, spec
from mjstack.managers.view import EnvView
from mjstack.mdp.observation import grasp_point_to_object
from mjstack.tasks.check import EpisodeCheck, Rule
from mjstack.tasks.parts import HeldSuccess, InWindow
from mjstack.tasks.view import Step


class ReachCheck(EpisodeCheck):
    """The grasp point has stayed near the point to the end."""

    @dataclass(kw_only=True, slots=True)
    class Thresholds:
        """When an episode of the reach task succeeded."""

        object: str = spec()
        """The cube."""
        height: float = spec(unit="m")
        """Height of the point above its centre."""
        distance: float = spec(unit="m", gt=0.0)
        """Largest distance that counts as near."""
        window: int = spec(unit="steps", ge=1)
        """Last steps, in which the grasp point is near."""

    t: Thresholds
    summaries = {"distance_max_m": ("distance_m", "max")}  # noqa: RUF012

    def build(self) -> list[Rule]:
        """See `EpisodeCheck`."""
        self.objects = [self.t.object]
        text = f"grasp point not above {self.t.object}"
        return [InWindow("REACHED", text, self.placed, self.t.window, measure=self.trace)]

    def placed(self, step: Step) -> Tensor:
        """Whether the grasp point is near, shape ``(nworld, 1)``."""
        return (self.trace(step)["distance_m"] <= self.t.distance)[:, None]

    def trace(self, step: Step) -> dict[str, Tensor]:
        """See `EpisodeCheck`."""
        t = self.t
        offset = grasp_point_to_object(step.view.env, object=t.object, height=t.height)
        return {"distance_m": torch.linalg.vector_norm(offset, dim=1)}

    def headline(self, values: Mapping[str, float]) -> str:
        """How near it is."""
        return f"{1e3 * values['distance_m']:.1f} mm from the point"


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
