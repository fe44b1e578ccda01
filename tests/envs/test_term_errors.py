"""Mistakes that a user can make with an environment: one line each, that names the term or argument
and says what to do.
"""

from collections.abc import Iterable
from functools import partial
from pathlib import Path

import pytest
import torch
from compositions import put
from env_cases import fails
from environments import Patch, configure, on_shared_sim, zeros

from mjstack.config.schema import (
    Backend,
    Config,
    ObservationTermCfg,
    RewardTermCfg,
    TermCfg,
    TerminationTermCfg,
)
from mjstack.envs import Env, build_env
from mjstack.errors import ConfigError, FaultError, MjstackError, TermError

HERE = __name__  # terms below are found by dotted name, as a user's own are


# Actions


# Resets


# Configuration


# Terms


def wrong_shape(env: Env) -> torch.Tensor:
    return torch.zeros(env.nworld + 1)


def wide(env: Env) -> torch.Tensor:
    return torch.zeros(env.nworld, 1)


def deep(env: Env) -> torch.Tensor:
    return torch.zeros(env.nworld, 2, 2)


def whole_number(env: Env) -> torch.Tensor:
    return torch.zeros(env.nworld, dtype=torch.int64)


def number(env: Env) -> torch.Tensor:
    return torch.zeros(env.nworld)


def elsewhere(env: Env) -> torch.Tensor:
    return torch.zeros(env.nworld, device="meta")


def nothing(env: Env) -> None:
    return None


def raises(env: Env, mask: torch.Tensor | None = None) -> torch.Tensor:
    raise ValueError("first line\nsecond line")


def nan_after_start(env: Env) -> torch.Tensor:
    return torch.where((env.episode_step > 1) & (env.world == 2), float("nan"), 1.0)


class NeedsScale:
    """A term with a parameter."""

    def __init__(self, env: Env, *, scale: float) -> None:
        self._scale = scale

    def __call__(self, env: Env) -> torch.Tensor:
        return torch.full((env.nworld,), self._scale)


KINDS = {
    "reward.mine": partial(RewardTermCfg, weight=1.0),
    "termination.mine": TerminationTermCfg,
    "observation.policy.terms.mine": ObservationTermCfg,
    "task.success": TermCfg,
    "reset.mine": TermCfg,
}
VALUES = [kind for kind in KINDS if kind != "reset.mine"]


def put_term(cfg: Config, kind: str, func: str, params: dict | None = None) -> None:
    """Puts a term into a configuration; a function without a module is one of those above."""
    term = KINDS[kind](func=func if "." in func else f"{HERE}.{func}", params=params or {})
    if kind == "task.success":
        cfg.task.success = term
    elif kind.startswith("observation"):
        cfg.observation["policy"].terms["mine"] = term
    else:
        getattr(cfg, kind.partition(".")[0])["mine"] = term


def build(cfg: Config) -> Env:
    return on_shared_sim("native", 3, cfg)


def refused(cfg: Config, *words: str, kind: type[MjstackError] = TermError) -> str:
    """No environment can be built."""
    return fails(kind, lambda: build(cfg), *words)


@pytest.mark.parametrize("kind", KINDS)
def test_misspelt_function_module_and_parameters(cfg: Config, kind: str) -> None:
    put_term(cfg, kind, "mjstack.mdp.reward.lfit")
    missing = [f"{kind}: func=mjstack.mdp.reward.lfit", "'lfit' does not exist"]
    refused(cfg, *missing, "Did you mean 'lift'?")
    for module in ("mjstack.mdp.rewards", "no_such_package"):
        put_term(cfg, kind, f"{module}.lift")
        refused(cfg, f"{kind}: func={module}.lift", f"'{module}' cannot be imported")
    put_term(cfg, kind, "NeedsScale")
    refused(cfg, f"{kind}: parameter 'scale' is missing", f"{kind}.params.scale")
    put_term(cfg, kind, "NeedsScale", {"scael": 1.0})
    refused(cfg, f"{kind}: parameter 'scael' does not exist", "Did you mean 'scale'?")


def test_function_without_a_module(cfg: Config) -> None:
    put_term(cfg, "reward.mine", "nothing")
    cfg.reward["mine"].func = "lift"
    refused(cfg, "reward.mine: func=lift", "dotted name")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("import torhc\n", ["torhc"]),
        ("raise RuntimeError('broken\\nin two lines')\n", ["broken"]),
        ("def one(env:\n", ["SyntaxError"]),
        ("import torch\ndef one(env):\n    return torch.ones(env.nworld)\n", []),
    ],
    ids=["terms_with_a_typo", "terms_that_raise", "terms_of_bad_syntax", "terms_that_work"],
)
def test_module_of_a_user(
    cfg: Config,
    text: str,
    words: list[str],
    tmp_path: Path,
    monkeypatch: Patch,
    request: pytest.FixtureRequest,
) -> None:
    """By name: what is wrong in it is said, in a line."""
    module = request.node.callspec.id
    (tmp_path / f"{module}.py").write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    put_term(cfg, "reward.mine", f"{module}.one")
    if words:
        refused(cfg, "reward.mine", module, *words)
    else:
        assert "mine" in build(cfg).reward_manager.names


def test_parameters_of_functions_and_actions(cfg: Config) -> None:
    for params, *words in (
        ({"object": "red"}, "parameter 'height' is missing"),
        (
            {"object": "red", "hieght": 0.05},
            "parameter 'hieght' does not exist",
            "Did you mean 'height'?",
        ),
        ({"object": "red_cub", "height": 0.05}, "'red_cub' does not exist", "Did you mean 'red'?"),
    ):
        put_term(cfg, "reward.mine", "mjstack.mdp.reward.lift", params)
        refused(cfg, "reward.mine: ", *words)
    cfg.reward.pop("mine")
    cfg.action["arm"].params["sacle"] = 1.0
    refused(cfg, "action.arm: parameter 'sacle' does not exist", "Did you mean 'scale'?")


SEEN = "observation.policy.terms.joint_pos"
CROWDED = "reset=randomized reset.cubes.params.gap=0.12 reset.cubes.params.candidates=2"
FREE = "free position"
# What is set last, the error, and words of the line, which also has the key, or the term's
OUT_OF_RANGE: list[tuple[str, type[MjstackError], str]] = [
    (
        "action.arm.params.joints=[elbow]",
        TermError,
        "'elbow' does not exist. Did you mean 'elbow_f",
    ),
    ("action.arm.params.joints=[shoulder_pan,shoulder_pan]", ConfigError, ""),
    ("action.arm.params.mode=absolut", ConfigError, "=absolut: expected one of relative, absolute"),
    ("action.arm.params.scale=0.0", ConfigError, "=0.0: expected a number above 0"),
    (
        "action=ee_delta action.arm.params.iterations=0",
        ConfigError,
        "=0: expected an integer from 1 to",
    ),
    ("termination.joint_limit.params.margin=-0.1", ConfigError, "=-0.1: expected a number of at"),
    ("reward.progress.params.scale=abc", ConfigError, "=abc: expected a number"),
    ("reward.progress.params.open_fraction=2", ConfigError, "=2: expected a number from 0 to 1"),
    ("reward.progress.weight=nan", ConfigError, "=nan: expected a finite number"),
    ("reset.cubes.params.xy=0.2", ConfigError, FREE),
    ("reset=randomized reset.cubes.params.xy=0.05", ConfigError, "=0.05: expected a list"),
    (f"{CROWDED} reset.cubes.params.xy=[0.5,0.5]", ConfigError, FREE),
    (f"{CROWDED} reset.cubes.params.xy=[0.14,0.3]", ConfigError, FREE),
    ("reset=randomized reset.mass.params.scale=2", ConfigError, "=2: expected a list"),
    ("reset=randomized reset.mass.params.scale=[1.3,0.7]", ConfigError, "smaller one first"),
    (f"{SEEN}.history=0", ConfigError, "=0: expected an integer from 1 to 1000"),
    (f"{SEEN}.noise=-1.0", ConfigError, "=-1.0: expected a number of at least 0"),
    (f"{SEEN}.scale=inf", ConfigError, "=inf: expected a finite number"),
    (
        f"{SEEN}.clip=[1.0,-1.0]",
        TermError,
        "clip=[1.0, -1.0]: expected two numbers, the smaller one",
    ),
]


@pytest.mark.parametrize(
    ("overrides", "kind", "words"), OUT_OF_RANGE, ids=[row[0] for row in OUT_OF_RANGE]
)
def test_parameters_and_settings_out_of_range(
    overrides: str, kind: type[MjstackError], words: str
) -> None:
    values = overrides.split()
    choice = "reset=jitter" if "." in values[0] else values.pop(0)
    key = values[-1].partition("=")[0]
    term = key.rpartition(".")[0].removesuffix(".params")
    message = refused(
        put(configure(choice), *values), term if kind is TermError else key, words, kind=kind
    )
    if words == FREE and CROWDED in overrides:
        assert "20000 trials" in message
        assert "smaller" in message


SINGLE = ("reward.mine", "termination.mine", "task.success")


@pytest.mark.parametrize(
    ("kinds", "func", "words"),
    [
        (VALUES, "wrong_shape", ["returned a torch.float32 tensor of shape (4,)", "(3,)"]),
        (VALUES, "deep", ["tensor of shape (3, 2, 2)", "(3,)"]),
        (VALUES, "whole_number", ["returned a torch.int64 tensor"]),
        (VALUES, "nothing", ["returned a NoneType"]),
        (KINDS, "raises", ["raised ValueError: first line"]),
        (SINGLE, "wide", ["returned", "(3, 1)", "(3,)"]),
        (SINGLE[1:], "number", ["returned a torch.float32", "expected a bool tensor"]),
        (SINGLE[:1], "elsewhere", ["returned", "(3,) on meta", "cpu"]),
    ],
)
def test_term_that_returns_what_its_manager_cannot_use(
    kinds: Iterable[str], func: str, words: list[str]
) -> None:
    for kind in kinds:
        cfg = configure("task=stack", "reset=jitter")
        put_term(cfg, kind, func)
        refused(cfg, f"{kind}: ", *words)


# Faults while stepping


@pytest.mark.parametrize(
    ("kind", "fault"),
    [
        ("reward.mine", "reward is not finite"),
        ("observation.policy.terms.mine", "observation is not finite"),
    ],
)
def test_value_that_becomes_nan_is_named(cfg: Config, kind: str, fault: str) -> None:
    put_term(cfg, kind, "nan_after_start")
    env = build(cfg)
    env.reset()
    env.step(zeros(env))
    step = partial(env.step, zeros(env))
    message = fails(FaultError, step, fault, kind, "1 of 3 worlds (2)")
    assert "reward.progress" not in message
    env.reset(seed=0)  # a full reset clears what has been reported
    env.step(zeros(env))


def warp_env(cfg: Config, **batch: int) -> Env:
    """Two worlds that have started."""
    for name, value in batch.items():
        setattr(cfg.batch, name, value)
    env = build_env(cfg, nworld=2, backend=Backend.mjwarp, device="cpu")
    env.reset()
    return env
