"""Task tower: how an episode is judged."""

from dataclasses import dataclass

import torch

from mjstack.config.fields import spec
from mjstack.tasks.check import EpisodeCheck, Rule
from mjstack.tasks.parts import AtRest, InWindow, flat, on_table, on_top, on_top_of, released
from mjstack.tasks.view import Step

ONTO = {"red": "blue", "green": "red"}


class TowerCheck(EpisodeCheck):
    """Green stands on red, red on blue, blue on the table, all at rest and released."""

    @dataclass(kw_only=True, slots=True)
    class Thresholds:
        """When an episode succeeded."""

        xy_err: float = spec(unit="m", gt=0.0)
        tilt_deg: float = spec(unit="deg", gt=0.0)
        window: int = spec(unit="steps", ge=2)

    def build(self) -> list[Rule]:
        """The rules, in the order of their bits."""
        near = {"xy_err": self.t.xy_err, "dz_min": 0.035, "dz_max": 0.055}  # m
        self.stands = {"blue": on_table("blue", gap=0.005)}
        self.stands |= {each: on_top(each, onto, **near) for each, onto in ONTO.items()}
        self.stands = {n: c & flat(n, tilt_deg=self.t.tilt_deg) for n, c in self.stands.items()}
        self.objects = list(self.stands)
        w = self.t.window
        rules = [InWindow(n.upper(), f"{n} not in place", c, w) for n, c in self.stands.items()]
        let_go = InWindow("RELEASED", "not released", released(*self.objects, open_fraction=0.8), w)
        return [*rules, let_go, AtRest(w, speed=0.05, position=0.005, rotation_deg=3.0)]

    def placed(self, step: Step) -> torch.Tensor:
        """Whether each cube is where it belongs, shape ``(nworld, 3)``."""
        return torch.stack([stands(step) for stands in self.stands.values()], dim=1)

    def goals(self, step: Step) -> dict[str, torch.Tensor]:
        """Where red and green belong, for the reward."""
        return {each: on_top_of(step, onto, each) for each, onto in ONTO.items()}
