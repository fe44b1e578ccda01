"""Task push: its reward, and how an episode is judged."""

from dataclasses import dataclass

import torch

from mjstack.config.fields import spec
from mjstack.managers import EnvView
from mjstack.mdp.geometry import place_xy, pose_w
from mjstack.tasks.check import EpisodeCheck, Rule
from mjstack.tasks.parts import AtRest, InWindow, on_table
from mjstack.tasks.view import Step


def distance(env: EnvView) -> torch.Tensor:
    """Horizontal distance of the puck from the goal [m], shape ``(nworld,)``."""
    return torch.linalg.vector_norm(pose_w(env, "puck")[:, :2] - place_xy(env, "goal"), dim=1)


def near_goal(env: EnvView, *, scale: float) -> torch.Tensor:
    """Reward for a puck near the goal: ``1 - tanh(distance / scale)``, scale in m."""
    return 1.0 - torch.tanh(distance(env) / scale)


class PushCheck(EpisodeCheck):
    """The puck was pushed along the table, and rests at the goal, untouched."""

    @dataclass(kw_only=True, slots=True)
    class Thresholds:
        """When an episode succeeded."""

        within: float = spec(unit="m", gt=0.0)
        lift: float = spec(unit="m", gt=0.0)
        window: int = spec(unit="steps", ge=2)

    def build(self) -> list[Rule]:
        """The rules, in the order of their bits."""
        self.objects = ["puck"]
        flat = on_table("puck", gap=self.t.lift)
        at_goal = InWindow(
            "AT_GOAL", "puck not at goal", self.placed, self.t.window, measure=self.trace
        )
        at_goal.limits[0]["distance_m"] = (0.0, self.t.within)
        return [
            InWindow("FLAT", "puck left the table", flat, self.cfg.task.episode_steps),
            at_goal,
            InWindow("LEFT_ALONE", "puck touched", lambda step: step.untouched, self.t.window),
            AtRest(self.t.window, speed=0.05, position=0.005, rotation_deg=3.0),
        ]

    def placed(self, step: Step) -> torch.Tensor:
        """Whether the puck is at the goal, shape ``(nworld, 1)``."""
        return (distance(step.view.env) <= self.t.within)[:, None]

    def trace(self, step: Step) -> dict[str, torch.Tensor]:
        """Values for a replay."""
        return {"distance_m": distance(step.view.env)}
