"""Fixtures of the tests of environments."""

import pytest
from environments import configure, on_shared_sim

from mjstack.config.schema import Config
from mjstack.envs import Env


@pytest.fixture
def cfg() -> Config:
    """A small configuration to be spoilt."""
    return configure("task=stack", "reset=jitter")


@pytest.fixture
def env(cfg: Config) -> Env:
    """Three native worlds that have started."""
    env = on_shared_sim("native", 3, cfg)
    env.reset(seed=0)
    return env
