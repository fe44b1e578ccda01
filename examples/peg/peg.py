"""Task peg: its terms, and how an episode is judged."""

from dataclasses import dataclass

import torch

from mjstack.config.fields import spec
from mjstack.managers import EnvView
from mjstack.mdp.observation import object_to_object
from mjstack.report.figure import Figure
from mjstack.tasks.check import EpisodeCheck, Rule
from mjstack.tasks.parts import AtRest, InWindow, in_zone, on_table, released, upright
from mjstack.tasks.view import Step


def near(env: EnvView, *, scale: float) -> torch.Tensor:
    """Reward for a peg near the hole: ``1 - tanh(distance / scale)``, scale in m."""
    away = object_to_object(env, a="peg", b="hole")
    return 1.0 - torch.tanh(away[:, :2].norm(dim=1) / scale)


class PegCheck(EpisodeCheck):
    """The peg stands in the hole, at rest and released."""

    @dataclass(kw_only=True, slots=True)
    class Thresholds:
        """When an episode succeeded."""

        within: float = spec(unit="m", gt=0.0)
        gap: float = spec(unit="m", gt=0.0)
        tilt_deg: float = spec(unit="deg", gt=0.0)
        window: int = spec(unit="steps", ge=2)

    def build(self) -> list[Rule]:
        """The rules, in the order of their bits."""
        self.objects = ["peg"]
        t = self.t
        self.over = in_zone("peg", "hole", low=[-t.within] * 2, high=[t.within] * 2)
        self.stands = on_table("peg", gap=t.gap) & upright("peg", tilt_deg=t.tilt_deg)
        measured = [Figure("off", unit="m", high=t.within), Figure("tilt", unit="deg")]
        hole = ("IN_HOLE", "peg not in the hole", self.over, t.window)
        return [
            InWindow(*hole, measure=self.trace, measured=measured),
            InWindow("BOTTOM", "peg does not stand at the bottom", self.stands, t.window),
            InWindow("RELEASED", "peg not released", released("peg", open_fraction=0.8), t.window),
            AtRest(t.window, speed=0.05, position=0.005, rotation_deg=3.0),
        ]

    def placed(self, step: Step) -> torch.Tensor:
        """Whether the peg stands in the hole, shape ``(nworld, 1)``."""
        return (self.over & self.stands)(step)[:, None]

    def trace(self, step: Step) -> dict[str, torch.Tensor]:
        """Values for a replay."""
        away = object_to_object(step.env, a="peg", b="hole")
        return {"off_m": away[:, :2].abs().amax(1), "tilt_deg": step.tilt("peg")}
