"""Task slot: its terms, and how an episode is judged."""

from dataclasses import dataclass

import torch

from mjstack.config.fields import spec
from mjstack.managers import EnvView
from mjstack.mdp.observation import object_to_object
from mjstack.tasks.check import EpisodeCheck, Rule
from mjstack.tasks.parts import AtRest, InWindow, in_zone, on_table, released, upright
from mjstack.tasks.view import Step


def near(env: EnvView, *, scale: float) -> torch.Tensor:
    """Reward for a peg near the slot's mouth: ``1 - tanh(distance / scale)``, scale in m."""
    return 1.0 - torch.tanh(object_to_object(env, a="peg", b="slot")[:, :2].norm(dim=1) / scale)


class SlotCheck(EpisodeCheck):
    """The peg stands deep in the slot, at rest and released."""

    @dataclass(kw_only=True, slots=True)
    class Thresholds:
        """When an episode succeeded."""

        depth: float = spec(unit="m", gt=0.0)
        depth_max: float = spec(unit="m", gt=0.0)
        play: float = spec(unit="m", gt=0.0)
        tilt_deg: float = spec(unit="deg", gt=0.0)
        window: int = spec(unit="steps", ge=2)

    def build(self) -> list[Rule]:
        """The rules, in the order of their bits."""
        self.objects = ["peg"]
        t = self.t
        self.deep = in_zone("peg", "slot", low=(t.depth, -t.play), high=(t.depth_max, t.play))
        self.stands = on_table("peg", gap=t.play) & upright("peg", tilt_deg=t.tilt_deg)
        return [
            InWindow("DEPTH", "peg not in the slot", self.deep, t.window),
            InWindow("STANDS", "peg does not stand", self.stands, t.window),
            InWindow("RELEASED", "peg not released", released("peg", open_fraction=0.8), t.window),
            AtRest(t.window, speed=0.05, position=0.005, rotation_deg=3.0),
        ]

    def placed(self, step: Step) -> torch.Tensor:
        """Whether the peg stands in the slot, shape ``(nworld, 1)``."""
        return (self.deep & self.stands)(step)[:, None]
