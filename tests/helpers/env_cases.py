"""Configurations and errors that several tests of environments share."""

import re
from collections.abc import Callable

import pytest
import torch
from compositions import make_env
from environments import configure

from mjstack.config.schema import Config
from mjstack.envs import Env
from mjstack.errors import MjstackError, ParameterError

N = 4
SCENES = [("stack", "so101"), ("reach", "rebot")]
scenes = pytest.mark.parametrize(("task", "robot"), SCENES)


def randomized(task: str, robot: str, *, steps: int | None = None) -> Config:
    """Everything differs from world to world; episodes end after some steps, if given."""
    cfg = configure(f"task={task}", "reset=randomized", robot=robot)
    cfg.action["arm"].params["scale"] = 0.5  # rad: the clock alone ends an episode in these tests
    if steps is not None:
        cfg.termination["time_out"].params["steps"] = steps
    return cfg


def without_ends(cfg: Config) -> Config:
    cfg.termination.clear()
    return cfg


def split(env: Env, group: str, obs: torch.Tensor) -> dict[str, torch.Tensor]:
    """A group's terms by name, from the widths that the configuration implies."""
    n = len(env.cfg.robot.home)
    width = dict.fromkeys(("joint_pos", "joint_pos_relative", "joint_vel"), n)
    width |= dict.fromkeys(("grasp_point_pos", "grasp_point_to_object", "object_to_object"), 3)
    width |= {"object_pose": 7, "object_velocity": 6, "jaw_force": 2}
    width["last_action"] = env.action_manager.action_dim
    terms = env.cfg.observation[group].terms
    parts = obs.split([t.history * width[t.func.rpartition(".")[2]] for t in terms.values()], dim=1)
    return dict(zip(terms, parts, strict=True))


def fails(kind: type[MjstackError], call: Callable[[], object], *words: str) -> str:
    """The one sentence of the error that a call has to raise."""
    with pytest.raises(kind) as caught:
        call()
    message = str(caught.value)
    assert "\n" not in message
    assert type(caught.value) in (kind, ParameterError)  # a ConfigError of a parameter
    assert re.search(r"[^.]\.$", message)
    for word in words:
        assert word in message, message
    return message


def native(*overrides: str, nworld: int = 2) -> Env:
    return make_env(["sim=native", *overrides], nworld=nworld)
