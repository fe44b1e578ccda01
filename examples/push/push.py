"""Task push: its reward, and how an episode is judged."""

from dataclasses import dataclass

import torch

from mjstack.config.fields import spec
from mjstack.managers import EnvView
from mjstack.mdp.observation import object_to_place
from mjstack.report.figure import Figure
from mjstack.tasks.check import EpisodeCheck, Rule
from mjstack.tasks.parts import AtRest, InWindow, at_place, away, flat, on_table, released
from mjstack.tasks.view import Step


def near_goal(env: EnvView, *, scale: float) -> torch.Tensor:
    """Reward for a puck near the goal: ``1 - tanh(distance / scale)``, scale in m."""
    off = object_to_place(env, object="puck", place="goal")[:, :2]
    return 1.0 - torch.tanh(torch.linalg.vector_norm(off, dim=1) / scale)


class PushCheck(EpisodeCheck):
    """The puck was pushed along the table, and rests flat at the goal, untouched."""

    @dataclass(kw_only=True, slots=True)
    class Thresholds:
        """When an episode succeeded."""

        within: float = spec(unit="m", gt=0.0)
        lift: float = spec(unit="m", gt=0.0)
        tip_deg: float = spec(unit="deg", gt=0.0)
        tilt_deg: float = spec(unit="deg", gt=0.0)
        window: int = spec(unit="steps", ge=2)

    def build(self) -> list[Rule]:
        """The rules, in the order of their bits."""
        self.objects = ["puck"]
        t = self.t
        down = on_table("puck", gap=t.lift)
        lies = down & flat("puck", tilt_deg=t.tilt_deg)
        slid = down & flat("puck", tilt_deg=t.tip_deg)
        there = at_place("puck", "goal", distance=t.within)
        self.there = there & lies
        at_goal = ("AT_GOAL", "puck not at goal", there, t.window)
        measured = [Figure("distance", unit="m", high=t.within), Figure("tilt", unit="deg")]
        return [
            InWindow("FLAT", "puck does not lie flat", lies, t.window),
            InWindow(*at_goal, measure=self.trace, measured=measured),
            InWindow("LEFT_ALONE", "puck touched", released("puck", open_fraction=0.0), t.window),
            AtRest(t.window, speed=0.05, position=0.005, rotation_deg=3.0),
            InWindow("SLID", "puck lifted or tipped over", slid, self.cfg.task.episode_steps),
        ]

    def placed(self, step: Step) -> torch.Tensor:
        """Whether the puck lies at the goal, shape ``(nworld, 1)``."""
        return self.there(step)[:, None]

    def trace(self, step: Step) -> dict[str, torch.Tensor]:
        """Values for a replay."""
        return {"distance_m": away(step, "puck", "goal"), "tilt_deg": step.tilt("puck")}
