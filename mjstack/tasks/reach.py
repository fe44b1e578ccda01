"""Task *reach*: the grasp point to a point above a cube."""

from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor
from typing_extensions import override

from mjstack.config.fields import spec
from mjstack.math import norm
from mjstack.mdp.observation import grasp_point_to_object
from mjstack.report.figure import Figure
from mjstack.tasks.check import EpisodeCheck, Rule
from mjstack.tasks.parts import InWindow
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
        window: int = spec(unit="steps", ge=1, le=10_000)
        """Last steps, in which the grasp point is near."""

    t: Thresholds
    summaries = {"distance_max": ("distance_m", "max")}  # noqa: RUF012

    @override
    def build(self) -> list[Rule]:
        self.objects = [self.t.object]
        text = f"grasp point not above {self.t.object}"
        measured = [Figure("distance", unit="m", high=self.t.distance)]
        rule = (self.placed, self.t.window)
        return [InWindow("REACHED", text, *rule, measure=self.trace, measured=measured)]

    def placed(self, step: Step) -> Tensor:
        """Whether the grasp point is near, shape ``(nworld, 1)``."""
        return (self.trace(step)["distance_m"] <= self.t.distance)[:, None]

    @override
    def trace(self, step: Step) -> dict[str, Tensor]:
        t = self.t
        offset = grasp_point_to_object(step.env, object=t.object, height=t.height)
        return {"distance_m": norm(offset)}

    def headline(self, values: Mapping[str, float]) -> str:
        """How near it is."""
        return f"{1e3 * values['distance_m']:.1f} mm from the point"
