"""Task tower: how an episode is judged."""

from dataclasses import dataclass

import torch

from mjstack.config.fields import spec
from mjstack.tasks.check import EpisodeCheck, Rule
from mjstack.tasks.parts import AtRest, InWindow, on_table, on_top
from mjstack.tasks.view import Step


class TowerCheck(EpisodeCheck):
    """Green stands on red, red on blue, blue on the table, all at rest and untouched."""

    @dataclass(kw_only=True, slots=True)
    class Thresholds:
        """When an episode succeeded."""

        xy_err: float = spec(unit="m", gt=0.0)
        window: int = spec(unit="steps", ge=2)

    def build(self) -> list[Rule]:
        """The rules, in the order of their bits."""
        self.objects = ["blue", "red", "green"]
        near = {"xy_err": self.t.xy_err, "dz_min": 0.035, "dz_max": 0.055}  # m
        blue = on_table("blue", gap=0.005)
        red = on_top("red", "blue", **near)
        green = on_top("green", "red", **near)
        self.stands = [blue, red, green]
        return [
            InWindow("BLUE", "blue not on the table", blue, self.t.window),
            InWindow("RED", "red not on blue", red, self.t.window),
            InWindow("GREEN", "green not on red", green, self.t.window),
            InWindow("LET_GO", "touched", lambda step: step.untouched, self.t.window),
            AtRest(self.t.window, speed=0.05, position=0.005, rotation_deg=3.0),
        ]

    def placed(self, step: Step) -> torch.Tensor:
        """Whether each cube is where it belongs, shape ``(nworld, 3)``."""
        return torch.stack([stands(step) for stands in self.stands], dim=1)
