"""Task drawer: how a cabinet is placed, the drawer's terms, and how an episode is judged."""

from dataclasses import dataclass

import torch

from mjstack.config.fields import spec
from mjstack.managers import EnvView, uses_fields
from mjstack.mdp.geometry import place_xy
from mjstack.mdp.observation import fixture_pos, fixture_vel, grasp_point_pos
from mjstack.report.figure import Figure
from mjstack.tasks.check import EpisodeCheck, Rule
from mjstack.tasks.parts import InWindow
from mjstack.tasks.view import Step

JOINT = "cabinet_drawer"


@uses_fields("body_pos")
def move_cabinet(env: EnvView, mask: torch.Tensor) -> None:
    """Put the cabinet where the episode's handle is, and move the cube in it along."""
    scene = env.cfg.scene
    handle = place_xy(env, "handle")
    top = torch.full_like(handle[:, :1], scene.table_top)
    pos = env.sim.fields["body_pos"][:, env.sim.model.body("cabinet").id]
    torch.where(mask[:, None], torch.cat((handle, top), dim=1).to(pos), pos, out=pos)
    cube = env.sim.qpos[:, env.index.objects["cube"][0] :][:, :2]
    moved = cube + handle - handle.new_tensor(scene.places["handle"].xy)
    torch.where(mask[:, None], moved.to(cube), cube, out=cube)


def to_handle(env: EnvView) -> torch.Tensor:
    """From the grasp point to the handle [m], shape ``(nworld, 3)``."""
    return env.sim.xpos[:, env.sim.model.body("cabinet_handle").id] - grasp_point_pos(env)


def near(env: EnvView, *, scale: float) -> torch.Tensor:
    """Reward for a grasp point near the handle: ``1 - tanh(distance / scale)``, scale in m."""
    return 1.0 - torch.tanh(torch.linalg.vector_norm(to_handle(env), dim=1) / scale)


def progress(env: EnvView, *, open: float, stop: float) -> torch.Tensor:
    """Reward for how far the drawer is open, as a fraction of ``open`` [m]; 0 from ``stop`` on."""
    at = fixture_pos(env, joint=JOINT)
    return (at / open).clamp(0.0, 1.0) * (at <= stop)


def force(env: EnvView, name: str) -> torch.Tensor:
    """Net force on the cabinet or the handle [N], shape ``(nworld,)``."""
    first = int(env.sim.model.sensor(f"cabinet_{name}").adr[0])
    return torch.linalg.vector_norm(env.sim.sensordata[:, first : first + 3], dim=1)


class DrawerCheck(EpisodeCheck):
    """The drawer is open, at rest and let go of, the cube in it; the cabinet was left alone."""

    @dataclass(kw_only=True, slots=True)
    class Thresholds:
        """When an episode succeeded."""

        open: float = spec(unit="m", gt=0.0)
        stop: float = spec(unit="m", gt=0.0)
        speed: float = spec(unit="m/s", gt=0.0)
        window: int = spec(unit="steps", ge=1)

    def build(self) -> list[Rule]:
        """The rules, in the order of their bits."""
        self.objects = ["cube"]
        t = self.t
        whole = self.cfg.task.episode_steps

        def still(step: Step) -> torch.Tensor:
            return fixture_vel(step.env, joint=JOINT)[:, None].abs() <= t.speed

        def on_rail(step: Step) -> torch.Tensor:
            return step.joint(JOINT) <= t.stop

        def alone(step: Step) -> torch.Tensor:
            return (force(step.env, "cabinet") == 0.0)[:, None]

        opening = [Figure("open", unit="m", low=t.open)]
        rule = ("OPEN", "drawer not open", self.is_open, t.window)
        return [
            InWindow(*rule, measure=self.trace, measured=opening),
            InWindow("STILL", "drawer moving", still, t.window),
            InWindow("LET_GO", "handle not let go of", self.let_go, t.window),
            InWindow("INSIDE", "cube not in the drawer", self.inside, t.window),
            InWindow("ON_RAIL", "drawer pulled to its stop", on_rail, whole),
            InWindow("ALONE", "cabinet touched", alone, whole),
        ]

    def is_open(self, step: Step) -> torch.Tensor:
        """Whether the drawer is open, shape ``(nworld, 1)``."""
        return step.joint(JOINT) >= self.t.open

    def let_go(self, step: Step) -> torch.Tensor:
        """Whether nothing touches the handle, shape ``(nworld, 1)``."""
        return (force(step.env, "handle") == 0.0)[:, None]

    def inside(self, step: Step) -> torch.Tensor:
        """Whether the cube is between the drawer's walls, shape ``(nworld, 3)``."""
        env = step.env
        middle = env.sim.site_xpos[:, env.sim.model.site("cabinet_inside").id]
        half = step.constant(*env.sim.model.site("cabinet_inside").size)
        return (step.center("cube") - middle).abs() <= half

    def placed(self, step: Step) -> torch.Tensor:
        """Whether the drawer is open and let go of, shape ``(nworld, 1)``."""
        return self.is_open(step) & self.let_go(step)

    def trace(self, step: Step) -> dict[str, torch.Tensor]:
        """Values for a replay."""
        return {"open_m": step.joint(JOINT)[:, 0]}
