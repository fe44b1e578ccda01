"""Task slot: its terms, and how an episode is judged."""

from dataclasses import dataclass

import torch

from mjstack.config.fields import spec
from mjstack.managers import EnvView
from mjstack.mdp.geometry import pose_w
from mjstack.tasks.check import EpisodeCheck, Rule
from mjstack.tasks.parts import AtRest, InWindow, on_table, released
from mjstack.tasks.view import Step


def to_slot(env: EnvView) -> torch.Tensor:
    """From the peg to the slot's mouth [m], shape ``(nworld, 3)``."""
    return pose_w(env, "slot")[:, :3] - pose_w(env, "peg")[:, :3]


def near(env: EnvView, *, scale: float) -> torch.Tensor:
    """Reward for a peg near the slot's mouth: ``1 - tanh(distance / scale)``, scale in m."""
    return 1.0 - torch.tanh(torch.linalg.vector_norm(to_slot(env)[:, :2], dim=1) / scale)


class SlotCheck(EpisodeCheck):
    """The peg stands deep in the slot, at rest and released."""

    @dataclass(kw_only=True, slots=True)
    class Thresholds:
        """When an episode succeeded."""

        depth: float = spec(unit="m", gt=0.0)
        window: int = spec(unit="steps", ge=2)

    def build(self) -> list[Rule]:
        """The rules, in the order of their bits."""
        self.objects = ["peg"]
        w = self.t.window
        return [
            InWindow("DEPTH", "peg not in the slot", self.placed, w),
            InWindow("STANDS", "peg does not stand", on_table("peg", gap=0.002), w),
            InWindow("RELEASED", "peg not released", released("peg", open_fraction=0.8), w),
            AtRest(w, speed=0.05, position=0.005, rotation_deg=3.0),
        ]

    def placed(self, step: Step) -> torch.Tensor:
        """Whether the peg is between the walls and deep enough, shape ``(nworld, 1)``."""
        away = to_slot(step.view.env)
        return (-away[:, :1] >= self.t.depth) & (away[:, 1:2].abs() <= 0.002)
