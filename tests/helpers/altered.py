"""Episodes of the examples whose states are written by hand near the end, each with the rules that
it breaks, by geometry that is worked out here.

The object of a task is held in a pose: every state is the written one.
"""

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from math import cos, radians, sin
from pathlib import Path

import numpy as np
import torch
from compositions import load_config

from mjstack.episodes.stage import Stage
from mjstack.managers.view import EnvView
from mjstack.tasks.check import make_check
from mjstack.tasks.placed import Placed

EXAMPLES = Path(__file__).parents[2] / "examples"
STEPS = 110  # of an altered episode; the window is 50
LATE = 30  # the step from which on a pose is written that is not there from the start

Quat = tuple[float, float, float, float]


def turned(degrees: float, *axis: float) -> Quat:
    """A rotation about an axis of length 1."""
    half = 0.5 * radians(degrees)
    x, y, z = (sin(half) * part for part in axis)
    return (cos(half), x, y, z)


def raised(radius: float, half: float, degrees: float) -> float:
    """Height of the centre of a cylinder that leans on the table [m]."""
    return radius * abs(sin(radians(degrees))) + half * abs(cos(radians(degrees)))


@dataclass
class Altered:
    """An episode in which an object is somewhere.

    Attributes:
        kind: Which sort of alteration.
        at: Where its centre is in the last steps, from the anchor and the table top [m].
        breaks: The rules that the episode breaks.
        quat: How it is turned.
        velocity: Its velocity, linear [m/s], then angular [rad/s].
        drift: How far it gets along x in each step [m].
        earlier: Where it was before step `LATE`; by default in the same place.
        earlier_quat: How it was turned then.
        touched: Whether a jaw presses on it.
        closed: Whether the gripper is closed.
        leaves: The step at which it is gone, if any.
    """

    kind: str
    at: tuple[float, float, float]
    breaks: set[str]
    quat: Quat = (1.0, 0.0, 0.0, 0.0)
    velocity: Sequence[float] = (0.0,) * 6
    drift: float = 0.0
    earlier: tuple[float, float, float] | None = None
    earlier_quat: Quat | None = None
    touched: bool = False
    closed: bool = False
    leaves: int | None = None

    def pose(self, step: int) -> tuple[tuple[float, float, float], Quat]:
        """Position and orientation at a step."""
        x, y, z = self.at
        if self.leaves is not None and step >= self.leaves:
            return (x, y + 0.1, z), self.quat
        if step < LATE and (self.earlier or self.earlier_quat):
            return self.earlier or self.at, self.earlier_quat or self.quat
        return (x + self.drift * step, y, z), self.quat


def altered_stage(task: str, robot: str, nworld: int) -> Stage:
    """The stage of an example; its arm stays where it starts, the gripper open."""
    folder = EXAMPLES / task / "conf"
    start = [f"task={task}", f"robot={robot}", "sim=native", f"nworld={nworld}"]
    phases = load_config(start, config_dir=folder).controller.phases
    seconds = [f"controller.phases.{name}.seconds=0.2" for name in phases]
    cfg = load_config([*start, *seconds, f"task.episode_steps={STEPS}"], config_dir=folder)
    return Stage(cfg)


def write_poses(
    env: EnvView, name: str, worlds: Sequence[Altered], step: int, anchor: torch.Tensor
) -> None:
    """Put the object of each world where it is at a step; the anchor's shape is ``(nworld, 3)``."""
    at, velocity = env.index.objects[name]
    sim = env.sim
    poses = [world.pose(step) for world in worlds]
    places = torch.tensor([pos for pos, _ in poses], dtype=torch.float64)
    sim.qpos[:, at : at + 3] = (anchor.double() + places).to(sim.qpos)
    sim.qpos[:, at + 3 : at + 7] = torch.tensor([quat for _, quat in poses]).to(sim.qpos)
    velocities = torch.tensor([list(world.velocity) for world in worlds])
    sim.qvel[:, velocity : velocity + 6] = velocities.to(sim.qvel)


def judge_held(
    task: str,
    robot: str,
    name: str,
    anchor: Callable[[EnvView], torch.Tensor],
    worlds: list[Altered],
) -> list[tuple[set[str], bool]]:
    """The broken rules of each world, without physics: every state is the written one. And whether
    the last step is a success, as rewards see it.
    """
    stage = altered_stage(task, robot, len(worlds))
    cfg = stage.cfg
    with closing(stage.simulation(len(worlds), "native", "cpu")) as sim:
        env = stage.start(sim, cfg.reset)
        gripper = env.index.robot_qpos[env.index.n_arm :]
        shut = [world for world, altered in enumerate(worlds) if altered.closed]
        sim.qpos[:, gripper] = torch.tensor(cfg.robot.gripper_open).to(sim.qpos)
        closed = torch.tensor(cfg.robot.gripper_closed).to(sim.qpos)
        sim.qpos[np.ix_(shut, gripper)] = closed.expand(len(shut), -1)
        sim.sensordata.zero_()
        touched = [world for world, altered in enumerate(worlds) if altered.touched]
        sim.sensordata[touched, env.index.jaw_force[name][0]] = 1.0
        check = make_check(cfg)
        check.start(env, STEPS)
        assert cfg.task.success is not None
        success = Placed(env, **cfg.task.success.params)
        base = anchor(env)
        for step in range(STEPS):
            write_poses(env, name, worlds, step, base)
            check.update()
            succeeded = success(env)
        sim.step_count.fill_(STEPS * cfg.timing.decimation)
        broken = [set(check.rules.broken(int(bits))) for bits in check.result().failed]
        return list(zip(broken, succeeded.tolist(), strict=True))
