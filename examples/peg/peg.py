"""Task peg: its terms, and how an episode is judged."""

from dataclasses import dataclass

import torch

from mjstack.config.fields import spec
from mjstack.managers import EnvView
from mjstack.mdp.geometry import pose_w
from mjstack.tasks.check import EpisodeCheck, Rule
from mjstack.tasks.parts import AtRest, InWindow, on_table, released
from mjstack.tasks.view import Step


def to_hole(env: EnvView) -> torch.Tensor:
    """From the peg to the hole [m], shape ``(nworld, 3)``."""
    return pose_w(env, "hole")[:, :3] - pose_w(env, "peg")[:, :3]


def near(env: EnvView, *, scale: float) -> torch.Tensor:
    """Reward for a peg near the hole: ``1 - tanh(distance / scale)``, scale in m."""
    return 1.0 - torch.tanh(torch.linalg.vector_norm(to_hole(env)[:, :2], dim=1) / scale)


class PegCheck(EpisodeCheck):
    """The peg stands in the hole, at rest and released."""

    @dataclass(kw_only=True, slots=True)
    class Thresholds:
        """When an episode succeeded."""

        within: float = spec(unit="m", gt=0.0)
        window: int = spec(unit="steps", ge=2)

    def build(self) -> list[Rule]:
        """The rules, in the order of their bits."""
        self.objects = ["peg"]
        w = self.t.window
        in_hole = InWindow("IN_HOLE", "peg not in the hole", self.placed, w, measure=self.trace)
        in_hole.limits[0]["off_m"] = (0.0, self.t.within)
        return [
            in_hole,
            InWindow("BOTTOM", "peg not at the bottom", on_table("peg", gap=0.002), w),
            InWindow("RELEASED", "peg not released", released("peg", open_fraction=0.8), w),
            AtRest(w, speed=0.05, position=0.005, rotation_deg=3.0),
        ]

    def placed(self, step: Step) -> torch.Tensor:
        """Whether the peg is over the hole or in it, shape ``(nworld, 1)``."""
        return (to_hole(step.view.env)[:, :2].abs() <= self.t.within).all(dim=1, keepdim=True)

    def trace(self, step: Step) -> dict[str, torch.Tensor]:
        """Values for a replay."""
        return {"off_m": to_hole(step.view.env)[:, :2].abs().amax(1)}
