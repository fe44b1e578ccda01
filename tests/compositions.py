"""Configurations for tests, each composed once in a process: a composition takes half a second."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from functools import cache

import mjstack
from mjstack.config.schema import Config
from mjstack.envs import Env, build_env


@cache
def _composed(overrides: tuple[str, ...]) -> Config:
    return mjstack.load_config(overrides)


def load_config(overrides: Sequence[str] = ()) -> Config:
    """What `mjstack.load_config` returns, as a copy of the caller's own."""
    return copy.deepcopy(_composed(tuple(o for o in overrides if o != "robot=so101")))


def make_env(
    overrides: Sequence[str] = (),
    *,
    nworld: int | None = None,
    seed: int | None = None,
    device: str | None = None,
) -> Env:
    """What `mjstack.make_env` returns."""
    given = {"nworld": nworld, "seed": seed, "sim.device": device}
    return build_env(
        load_config([*overrides, *(f"{k}={v}" for k, v in given.items() if v is not None)])
    )
