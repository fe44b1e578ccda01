"""The state-based expert: accepted without phases, and a function of the state alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from compositions import load_config

from mjstack.drivers.roles import Role, find_roles
from mjstack.drivers.state_based import StateBasedDriver
from mjstack.envs import Env
from mjstack.episodes.stage import Stage
from mjstack.errors import ConfigError
from mjstack.scene.phases import build_phases

GetStage = Callable[..., Stage]
EXPERT = "controller=state_based"


def started(get_stage: GetStage, robot: str, *overrides: str, nworld: int) -> tuple[Stage, Env]:
    """Worlds that have started, and their stage."""
    stage = get_stage(robot, EXPERT, "sim=native", "reset=jitter", *overrides)
    return stage, stage.start(stage.batch_simulation(nworld), stage.cfg.reset)


@pytest.mark.parametrize(
    ("robot", "task", "steps"),
    [
        ("so101", "stack", 200),
        pytest.param("rebot", "stack", 260, marks=pytest.mark.full),
        pytest.param("so101", "box", 320, marks=pytest.mark.full),
        pytest.param("rebot", "box", 400, marks=pytest.mark.full),
    ],
)
def test_episodes_are_accepted(get_stage: GetStage, robot: str, task: str, steps: int) -> None:
    """The episode is as long as the expert needs, and the window of rest."""
    own = get_stage(robot, f"task={task}", EXPERT, "sim=native", "reset=randomized")
    cfg = replace(own.cfg, task=replace(own.cfg.task, episode_steps=steps))
    stage = own.with_config(cfg)
    episode = stage.play(stage.batch_simulation(4), cfg.reset)
    assert not episode.failed.any(), stage.check.rules.failing(episode.failed)


def test_a_command_is_a_function_of_the_state(get_stage: GetStage) -> None:
    """A driver that has never been asked gives the same command, in whatever step it is asked."""
    stage, env = started(get_stage, "so101", nworld=2)
    driver = stage.driver(env)
    other = stage.start(stage.batch_simulation(2), stage.cfg.reset, seed=7)
    fresh = stage.driver(other)
    assert isinstance(driver, StateBasedDriver)
    seen = set()
    for step in range(84):
        command = driver.command()
        if step % 4 == 0:
            for name in ("qpos", "qvel", "sensordata"):
                getattr(other.sim, name).copy_(getattr(env.sim, name))
            torch.testing.assert_close(fresh.command(), command, rtol=0.0, atol=0.0)
            seen |= set(driver.due.tolist())
        env.step(command)
    assert len(seen) >= 4  # over red, close, over blue and more
    env.close()
    other.close()


def test_roles_are_found_in_the_phases() -> None:
    cfg = load_config(["task=box"])
    phases = build_phases(cfg)
    names, rows = find_roles(cfg, phases, ["red", "blue"])
    assert names == ["red", "blue"]
    roles = [f"{phases[k].name}" for k in rows[1]]
    assert roles == [
        f"{each}_blue"
        for each in ("approach", "descend", "close", "carry", "hold", "open", "retreat")
    ]
    assert len(roles) == len(Role)
    _, ((over, *others),) = find_roles(
        reach := load_config(["task=reach"]), build_phases(reach), []
    )
    assert (over, set(others)) == (0, {1})
    with pytest.raises(ConfigError, match="another controller, because task stack has no goals"):
        find_roles(stack := load_config(), build_phases(stack), [])
