"""Every reward against the expert, and letting go against holding on. The expert's accepted
episodes pass without phases, too.

The exact statement: the stage of `Progress` never falls along an accepted episode in which no grasp
was tried again, in any step of any world, so the reward of a step is at least that with which its
stage began. Within a stage the measured part may waver, with contacts or with a detour of the arm,
by `WAVER` of the stage, in the stage reach by `REACH_WAVER`. A reward without stages (task reach,
examples/push) is one stage. Costs (`action_rate`, `joint_vel`) are left out: they price effort.
With them the weighted sum of all rewards rises from the end of each stage to that of the next.
"""

from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from compositions import load_config
from environments import REBOT_LATER, at_double_speed

from mjstack.config.schema import Backend, Config
from mjstack.drivers.driver import Driver
from mjstack.envs import Env, build_env
from mjstack.episodes.rollout import Observer, rollout
from mjstack.episodes.stage import Stage
from mjstack.errors import ConfigError
from mjstack.managers.term import Term
from mjstack.tasks.check import make_check
from mjstack.tasks.progress import STAGES

EXAMPLES = Path(__file__).parents[2] / "examples"
REACH_WAVER = 0.4  # of the stage reach: the arm goes up, and around to the point above the object
WAVER = 0.05  # of any later one
NWORLD = 2


class Terms(Observer):
    """Values of the first reward term, which is the task's, of success, and of the weighted sum of
    all terms at every step end.
    """

    def __init__(self, cfg: Config) -> None:
        self.cfg = cfg
        self.rows: list[torch.Tensor] = []

    def start(self, env: Env, driver: Driver) -> None:
        super().start(env, driver)
        self.terms = [Term(f"reward.{name}", term, env) for name, term in self.cfg.reward.items()]
        self.success = Term("task.success", self.cfg.task.success, env)

    def update(self) -> None:
        values = [term(self.env).float().cpu() for term in self.terms]
        weights = [term.weight for term in self.cfg.reward.values()]
        total = sum(weight * value for weight, value in zip(weights, values, strict=True))
        self.rows.append(torch.stack((values[0], self.success(self.env).float().cpu(), total)))


class JudgeWithoutPhases(Observer):
    """Judges every world as if the driver had no phases, and asks what is placed."""

    def start(self, env: Env, driver: Driver) -> None:
        super().start(env, driver)
        self.check = make_check(env.cfg)
        self.check.start(env, driver.steps)
        self.carried = env.state.columns([*self.check.goals(env.state)])
        self.placed: list[torch.Tensor] = []

    def update(self) -> None:
        self.check.update()
        if self.carried.indices:
            self.placed.append(self.carried.read(self.check.placed(self.env.state)))

    def finish(self) -> None:
        self.failed = self.check.result().failed
        if self.carried.indices:
            assert torch.stack(self.placed).unique().tolist() == [False, True]


def configure(task: str, robot: str) -> Config:
    chosen = [f"task={task}", f"robot={robot}", "sim=native"]
    if task in ("push", "tower"):
        return load_config(chosen, config_dir=EXAMPLES / task / "conf")
    faster = at_double_speed(robot, task) if task == "box" else ()
    return load_config([*chosen, *(v for v in faster if "settle" not in v)])


@cache
def expert(task: str, robot: str) -> SimpleNamespace:
    """Rewards and success along accepted native episodes, shape ``(steps, NWORLD)``."""
    cfg = configure(task, robot)
    stage = Stage(cfg)
    terms = Terms(cfg)
    sim = stage.simulation(NWORLD, Backend.native, "cpu")
    if cfg.task.check is None:
        env = stage.start(sim, cfg.reset)
        rollout(env, stage.driver(env), [terms])
    else:
        freely = JudgeWithoutPhases()
        episode = stage.play(sim, cfg.reset, [terms, freely])
        assert not episode.failed.any()
        assert not freely.failed.any(), "accepted with phases, not without"
        assert not episode.retries.any()
    sim.close()
    value, success, total = torch.stack(terms.rows).unbind(1)
    phases = stage.planner.phases
    return SimpleNamespace(cfg=cfg, phases=phases, value=value, success=success, total=total)


def fall(value: torch.Tensor) -> torch.Tensor:
    """How far each step is below the highest one so far."""
    return value.cummax(0).values - value


@pytest.mark.parametrize(
    ("task", "objects", "robot"),
    [
        ("stack", 1, "so101"),
        *(
            pytest.param(*row, marks=pytest.mark.full)
            for row in (
                *(("stack", 1, "rebot"), ("box", 2, "rebot")),
                *(("box", 2, "so101"), ("tower", 2, "so101")),
            )
        ),
    ],
)
def test_the_stage_never_falls_along_an_accepted_episode(
    task: str, objects: int, robot: str
) -> None:
    """The statement of this module, for a reward in stages."""
    rec = expert(task, robot)
    progress = rec.value * len(STAGES) * objects
    stage = (progress + 1e-4).floor()
    assert (stage.diff(dim=0) >= 0.0).all()
    assert (stage[0] == 0.0).all()
    assert (stage[-1] == len(STAGES) * objects).all()
    # Every stage is gone through but one: a cube that falls into the box is at once in its place.
    assert len(stage.unique()) >= len(STAGES) * objects
    limit = torch.where(stage % len(STAGES) == 0, REACH_WAVER, WAVER)
    assert (fall(progress) <= limit).all()
    assert rec.success[-1].all()
    # The sum with costs at the last step of each stage
    for world, stages in enumerate(stage.T):
        last = torch.cat((stages.diff() > 0.0, torch.tensor([True])))
        assert (rec.total[last, world].diff() > 0.0).all()


@pytest.mark.parametrize("task", ["reach", pytest.param("push", marks=pytest.mark.full)])
@REBOT_LATER
def test_a_reward_without_stages_rises_along_the_experts_way(task: str, robot: str) -> None:
    rec = expert(task, robot)
    assert rec.success.any(0).all()
    limit = REACH_WAVER if task == "reach" else WAVER
    assert (fall(rec.value) <= limit).all()
    assert (rec.value[-1] > rec.value[0] + 0.5).all()


@pytest.mark.parametrize("gamma", [0.99, 0.995])
@pytest.mark.parametrize(
    ("task", "opens"),
    [("stack", "release"), pytest.param("box", "open_blue", marks=pytest.mark.full)],
)
@REBOT_LATER
def test_a_release_is_worth_more_than_holding_for_ever(
    task: str, opens: str, gamma: float, robot: str
) -> None:
    """From the last step in the hand: even if every other release fails, and is then worth nothing.
    Any dwelling is worth less than success, too.
    """
    rec = expert(task, robot)
    reward = rec.cfg.reward
    dt = rec.cfg.timing.step_dt
    last = next(phase.start for phase in rec.phases if phase.name == opens)
    most = reward["progress"].weight * dt / (1.0 - gamma)
    bonus = reward["success"].weight * dt
    for world in range(NWORLD):
        value = rec.value[:, world].double()
        end = int(rec.success[:, world].argmax()) + 1
        earned = reward["progress"].weight * dt * value[last:end]
        earned[-1] += bonus
        release = float((earned * gamma ** torch.arange(end - last)).sum())
        assert 0.5 * release > most * float(value[:last].max())
    assert bonus > 2.0 * most


@pytest.mark.full
def test_success_needs_a_release() -> None:
    """The tower's success: none while green is held, or the gripper is not open."""
    rec = expert("tower", "so101")
    opens = next(phase.start for phase in rec.phases if phase.name == "release_green")
    assert rec.success.argmax(0).min() > opens + 50


def test_a_check_without_goals_is_named() -> None:
    cfg = load_config(["task=push", "reward=stack"], config_dir=EXAMPLES / "push" / "conf")
    with pytest.raises(ConfigError, match="PushCheck: expected a check with goals"):
        build_env(replace(cfg, nworld=1), backend=Backend.native)
