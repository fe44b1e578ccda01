"""Managers: on any object of an environment's shape, their tables, and what overrides change."""

import functools
import itertools
import re
import sys
from collections.abc import Callable
from contextlib import closing
from types import FrameType
from typing import Any

import pytest
import torch
from environments import actions, configure, mask_of, new_sim, on_shared_sim, returned
from torch.utils._python_dispatch import TorchDispatchMode

from mjstack import make_env
from mjstack.config.schema import Config, TermCfg
from mjstack.managers import (
    ActionManager,
    ObservationManager,
    ResetManager,
    RewardManager,
    TerminationManager,
)
from mjstack.managers.state import branches, in_one_pass, shared
from mjstack.managers.term import Term
from mjstack.mdp import reward as reward_terms
from mjstack.scene import SceneIndex
from mjstack.sim.simulation import Columns
from mjstack.tasks.progress import Progress


class Bench:
    """The smallest thing that managers work on: see mjstack.managers.EnvView."""

    def __init__(self, cfg: Config, backend: str, nworld: int) -> None:
        self.cfg = cfg
        self.nworld = nworld
        self.seed = cfg.seed
        self.sim = new_sim(backend, nworld, cfg.robot.name)
        self.index = SceneIndex(self.sim.model, cfg.robot, cfg.scene)
        self.device = self.sim.device
        self.world = torch.arange(nworld, device=self.device)
        self.episode, self.episode_step = torch.zeros_like(self.world), torch.zeros_like(self.world)
        self.success = torch.zeros(nworld, dtype=torch.bool, device=self.device)
        self.given_places: dict[str, torch.Tensor] = {}
        self.actions: ActionManager | None = None

    @property
    def action(self) -> torch.Tensor:
        assert self.actions is not None
        return self.actions.action

    @property
    def previous_action(self) -> torch.Tensor:
        assert self.actions is not None
        return self.actions.previous_action


@pytest.mark.full
@pytest.mark.parametrize("kind", ["native", "mjwarp"])
def test_managers_work_on_any_object_of_that_shape(kind: str) -> None:
    """And do there what they do in an environment: the same numbers from the same seed."""
    cfg = configure("task=reach", "reset=randomized", "action=joint_delta")
    cfg.task.success = None
    cfg.reward.pop("success"), cfg.termination.pop("success")
    env = on_shared_sim(kind, 3, cfg)
    moves = actions(env, 5)
    start = returned(env.reset())
    expected = [returned(env.step(move)) for move in moves]

    bench = Bench(cfg, kind, 3)
    resets = ResetManager(bench, cfg.reset)
    everyone = torch.ones(3, dtype=torch.bool)
    resets.reset(everyone)
    bench.sim.kinematics()
    bench.actions = ActionManager(bench, cfg.action)
    ends = TerminationManager(bench, cfg.termination)
    rewards = RewardManager(bench, cfg.reward)
    observations = ObservationManager(bench, cfg.observation)
    for group, value in observations.refresh(everyone).items():
        assert torch.equal(value, start[f"obs.{group}"])
    for move, row in zip(moves, expected, strict=True):
        bench.actions.process(move)
        bench.actions.apply()
        bench.sim.step(cfg.timing.decimation, kinematics=True)
        bench.episode_step += 1
        ends.compute()
        assert torch.equal(rewards.compute(), row["reward"])
        assert torch.equal(ends.terminated, row["terminated"])
        for group, value in observations.compute().items():
            assert torch.equal(value, row[f"final.{group}"])
    torch.testing.assert_close(
        rewards.episode_sums.sum(1), torch.stack([row["reward"] for row in expected]).sum(0)
    )
    before = {name: getattr(bench.sim, name).clone() for name in ("qpos", "qvel", "ctrl")}
    bench.episode += mask_of(env, 1)
    resets.reset(mask_of(env, 1))
    for name, value in before.items():
        now = getattr(bench.sim, name)
        assert torch.equal(now[[0, 2]], value[[0, 2]])
        assert not torch.equal(now[1], value[1])


def test_an_actions_table_has_ranges_and_units() -> None:
    """Of joint targets the limits of each joint; of a share of a step no unit."""
    env = on_shared_sim("native", 3, configure("action=joint_absolute"))
    manager = env.action_manager
    columns, arm = (
        [cell.strip() for cell in re.split("[│┃]", line)[1:-1]]
        for line in str(manager).splitlines()
        if re.match("[│┃] (term|arm) ", line)
    )
    assert columns == ["term", "dim", "range", "unit", "parameters"]
    assert arm[1] == "5"
    assert arm[2].split(",")[0] == f"{manager.low[0]:.4g} to {manager.high[0]:.4g}"
    assert arm[3] == "rad, m"
    env = on_shared_sim("native", 3, configure("action=joint_delta"))
    assert re.search(r"│ arm +│ 5 +│ -1 to 1 +│ +│ joints=arm", str(env.action_manager))


def test_tables_show_settings_and_the_environment_shows_all_tables() -> None:
    env = on_shared_sim("native", 3, configure("task=stack"))
    shown = str(env)
    assert "stack with SO-101: 3 worlds, MuJoCo" in shown
    scale = env.cfg.action["arm"].params["scale"]
    for text in (
        "action: 6 numbers",
        f"joints=arm, mode=relative, pose=start, scale={scale}",
        "privileged",
        "weight per s",
        "truncated",
    ):
        assert text in shown
    for manager, names in (
        (env.action_manager, env.cfg.action),
        (env.reset_manager, env.cfg.reset),
        (env.termination_manager, env.cfg.termination),
        (env.reward_manager, env.cfg.reward),
        (env.observation_manager, env.cfg.observation),
        *((env.observation_manager, group.terms) for group in env.cfg.observation.values()),
    ):
        assert str(manager) in shown
        assert all(name in str(manager) for name in names)
    (row,) = [line for line in str(env.reward_manager).splitlines() if "│ progress " in line]
    assert "5.0" in row
    assert "height=0.04" in row


def test_a_control_step_makes_few_torch_calls() -> None:
    """Each costs microseconds of one thread while the physics waits, on CUDA a kernel. There were
    289 without views before terms shared the state of a step.
    """

    class Calls(TorchDispatchMode):
        count = 0

        def __torch_dispatch__(self, func: Any, _: Any, args: Any = (), kwargs: Any = None) -> Any:
            self.count += not func.is_view
            return func(*args, **(kwargs or {}))

    env = on_shared_sim("native", 3, configure("task=stack"))
    env.reset()
    env.step(torch.zeros(3, 6))
    with Calls() as calls:
        env.step(torch.zeros(3, 6))
    assert calls.count <= 170


def test_a_part_of_a_view_is_its_memory_where_columns_lie_side_by_side() -> None:
    sim = on_shared_sim("native", 3, configure()).sim
    together = Columns(range(2, 8), sim.device)
    apart = Columns([4, 0], sim.device)
    for columns, shape, sliced in ((together, (2, 3), True), (apart, (2,), False)):
        for value in (1.0, 2.0):
            sim.qpos[:, list(columns.indices)] = value
            part = sim.part("qpos", columns, *shape)
            assert part.shape == (3, *shape)
            assert (part == value).all()
        assert (sim.part("qpos", columns, *shape) is part) is sliced
    assert sim.part("site_xpos", 1).shape == (3, 3)


def test_a_branch_knows_what_came_before_it_and_hands_on_the_rest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def side_by_side(device: torch.device, *works: Callable[[], None]) -> None:
        for work in works:
            work()

    monkeypatch.setattr("mjstack.managers.state.side_by_side", side_by_side)

    @shared
    def value(env: object, name: str) -> torch.Tensor:
        return torch.zeros(1)

    env = object()

    def look() -> tuple[torch.Tensor, torch.Tensor]:
        return value(env, "before"), value(env, "within")

    def work() -> torch.Tensor:
        before = value(env, "before")
        assert value(object(), "before") is not before
        (first, one), (second, other) = branches(torch.device("cuda"), look, look)
        assert first is second is before
        assert one is not other  # a branch may not read another's
        assert value(env, "within") is other
        return before

    assert value(env, "before") is not in_one_pass(work)


def test_an_interrupt_at_any_moment_leaves_no_values_behind() -> None:
    """KeyboardInterrupt at every call, line and return of a pass in a pass: what is computed after
    it is new.
    """

    @shared
    def zero(env: object) -> torch.Tensor:
        return torch.zeros(1)

    value = functools.partial(zero, None)

    def work() -> torch.Tensor:
        value()
        return in_one_pass(value)

    def interrupt(frame: FrameType, event: str, argument: object) -> object:
        nonlocal left
        left -= 1
        if left == 0:
            raise KeyboardInterrupt
        return interrupt

    for moment in itertools.count(1):
        left = moment
        before = sys.gettrace()
        sys.settrace(interrupt)
        try:
            in_one_pass(work)
        except KeyboardInterrupt as error:
            kept = error  # its traceback keeps what was cut short, as a notebook does
        else:
            break
        finally:
            sys.settrace(before)
        assert value() is not value()
        del kept
        assert value() is not value()
    assert moment > 20


def test_terms_with_parameters_are_built_once() -> None:
    """A class is built with its parameters, a function is called with them."""
    env = on_shared_sim("native", 3, configure())
    cfg = env.cfg.termination
    limit = Term("a", cfg["joint_limit"], env)
    clock = Term("b", cfg["time_out"], env)
    env.episode_step.copy_(torch.tensor([599, 600, 601]))
    assert clock(env).tolist() == [False, True, True]
    assert limit(env).tolist() == [False] * 3
    limit.reset(mask_of(env, 1))  # no memory, nothing to forget


def test_a_term_marked_so_reads_the_state_alone() -> None:
    lift = "{func: mjstack.mdp.reward.lift, params: {object: red, height: 0.04}, weight: 1.0}"
    reach = "{func: mjstack.mdp.reward.reach, params: {object: red, scale: 0.2}, weight: 1.0}"
    rewards = (f"+reward.lift={lift}", f"+reward.reach={reach}")
    with closing(make_env(["task=stack", "sim=native", *rewards], nworld=4)) as env:
        env.reset(seed=0)
        for action in actions(env, 3):
            env.step(action)
        managers = (env.reward_manager, env.termination_manager)
        marked = [t for m in managers for t in m.terms if t.reads_state]
        assert {term.label.partition(".")[2] for term in marked} == {
            *("progress", "lift", "reach", "action_rate", "joint_vel"),
            *("time_out", "object_off_table", "joint_limit", "non_finite", "overflow"),
        }
        assert env.observation_manager.reads_state
        for term in [*marked, *(part.term for part in env.observation_manager._parts)]:
            values = []
            for success in (False, True):
                env.success.fill_(success)
                values.append(term(env).clone())
            assert torch.equal(*values), term.label


def every_other_step(env: Any) -> torch.Tensor:
    return env.episode_step % 2 == 0


def succeeded(env: Any) -> torch.Tensor:
    return env.success.float()


def test_an_observation_may_read_the_success_of_its_step() -> None:
    success = f"task.success={{func: {__name__}.every_other_step}}"
    term = f"+observation.policy.terms.succeeded={{func: {__name__}.succeeded}}"
    with closing(make_env(["task=stack", "sim=native", success, term], nworld=4)) as env:
        assert not env.observation_manager.reads_state
        env.reset(seed=0)
        for number, action in enumerate(actions(env, 4)):
            _, _, terminated, _, extras = env.step(action)
            assert extras["success"].tolist() == terminated.tolist() == [number % 2 == 1] * 4
            assert extras["final_obs"]["policy"][:, -1].tolist() == extras["success"].tolist()


class PaysOnce(Progress):
    """Progress as long as the task is not achieved."""

    def __call__(self, env: Any) -> torch.Tensor:
        return super().__call__(env) * ~env.success


@functools.wraps(reward_terms.lift)
def bonus(env: Any, **params: Any) -> torch.Tensor:
    """Lifting, and the success of the same step."""
    return reward_terms.lift(env, **params) + env.success.float()


def test_what_is_made_of_a_marked_term_is_not_marked() -> None:
    with closing(make_env(["task=stack", "sim=native"], nworld=2)) as env:
        for name, params in (("PaysOnce", {}), ("bonus", {"object": "red", "height": 0.04})):
            cfg = TermCfg(func=f"{__name__}.{name}", params=params)
            assert not Term("reward.mine", cfg, env).reads_state
