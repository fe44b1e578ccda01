"""Mistakes that a user can make with an environment: one line each, that names the term or argument
and says what to do.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

import pytest
import torch
from compositions import load_config
from environments import assert_rows, configure, mask_of, on_shared_sim, returned

from mjstack import make_env
from mjstack.config.schema import (
    Backend,
    Config,
    ObservationGroupCfg,
    ObservationTermCfg,
    RewardTermCfg,
    TermCfg,
    TerminationTermCfg,
)
from mjstack.envs import Env, build_env
from mjstack.errors import (
    ArgumentError,
    ConfigError,
    FaultError,
    MjstackError,
    ParameterError,
    TermError,
)
from mjstack.sim import make_simulation

HERE = __name__  # terms below are found by dotted name, as a user's own are


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


def zeros(env: Env, **kwargs: object) -> torch.Tensor:
    return torch.zeros((env.nworld, env.action_manager.action_dim), **kwargs)  # type: ignore[arg-type]


def fails(kind: type[MjstackError] | None, call: Callable[[], object], *words: str) -> str:
    """The one-line message of the error that a call has to raise: a sentence, or of any kind."""
    with pytest.raises(kind or MjstackError) as caught:
        call()
    message = str(caught.value)
    assert "\n" not in message
    if kind is not None:
        assert type(caught.value) in (kind, ParameterError)  # a ConfigError of a parameter
        assert re.search(r"[^.]\.$", message)
    for word in words:
        assert word in message, message
    return message


# Actions


@pytest.mark.parametrize(
    ("action", "words"),
    [
        (lambda env: zeros(env)[:2], ["shape (2, 6)", "(3, 6)"]),
        (lambda env: zeros(env)[:, :5], ["shape (3, 5)", "(3, 6)"]),
        (lambda env: zeros(env)[0], ["shape (6,)", "(3, 6)"]),
        (lambda env: zeros(env).int(), ["a torch.int32 tensor", "float32"]),
        (lambda env: zeros(env).half(), ["a torch.float16 tensor", "float32"]),
        (lambda env: zeros(env, device="meta"), ["on meta", "cpu"]),
        (lambda env: zeros(env).numpy(), ["ndarray", "float32 tensor"]),
        (lambda env: None, ["NoneType", "float32 tensor"]),
    ],
)
def test_action_of_the_wrong_kind(
    env: Env, action: Callable[[Env], object], words: list[str]
) -> None:
    fails(ArgumentError, lambda: env.step(action(env)), "action: found", "expected", *words)  # type: ignore[arg-type]


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_action_that_is_not_finite_names_its_world(env: Env, bad: float) -> None:
    action = zeros(env)
    action[1, 4] = bad
    fails(ArgumentError, lambda: env.step(action), "action: found", "in world 1", "finite")


@pytest.mark.full
def test_action_that_the_simulation_cannot_hold_names_its_world(cfg: Config) -> None:
    env = on_shared_sim("mjwarp", 3, cfg)  # float32
    env.reset(seed=0)
    action = zeros(env).double()
    action[1, 4] = 1e300
    fails(ArgumentError, lambda: env.step(action), "1e+300", "in world 1", "finite")


@pytest.mark.parametrize("huge", [1e20, 1e38])
def test_a_reward_that_a_huge_action_breaks_names_the_action(env: Env, huge: float) -> None:
    env.step(zeros(env))
    clean = env.sim.qpos.clone()
    env.reset(seed=0)
    action = zeros(env)
    action[1, 4] = huge
    words = [
        "reward is not finite in 1 of 3 worlds (1)",
        f"after an action of {huge:.3g}",
        "policy",
    ]
    fails(FaultError, lambda: env.step(action), *words)
    assert torch.equal(env.sim.qpos[[0, 2]], clean[[0, 2]])


def test_argument_errors_leave_the_environment_as_it_was(env: Env) -> None:
    action = 0.3 * torch.ones_like(zeros(env))
    expected = [returned(env.step(action)), returned(env.step(-action))]
    env.reset(seed=0)
    attempts: list[Callable[[], object]] = [
        lambda: env.step(action * float("nan")),
        lambda: env.step(action.to("meta")),
        lambda: env.step(action[:1]),
        lambda: env.reset(seed=-1),
        lambda: env.reset(seed=1, mask=mask_of(env, 0)),
        lambda: env.reset(mask=torch.ones(2, dtype=torch.bool)),
    ]
    for move, result in zip((action, -action), expected, strict=True):
        for attempt in attempts:
            fails(ArgumentError, attempt)
        assert_rows(returned(env.step(move)), result, slice(None), slice(None), "native")


# Resets


@pytest.mark.parametrize(
    ("mask", "words"),
    [
        (torch.ones(2, dtype=torch.bool), ["shape (2,)"]),
        (torch.ones((3, 1), dtype=torch.bool), ["shape (3, 1)"]),
        (torch.ones(3), ["torch.float32"]),
        (torch.tensor([0, 1, 2]), ["torch.int64"]),
        (torch.ones(3, dtype=torch.bool, device="meta"), ["on meta"]),
        ([True, False, True], ["list"]),
    ],
)
def test_reset_mask_of_the_wrong_kind(env: Env, mask: object, words: list[str]) -> None:
    expected = "bool tensor of shape (3,) on cpu"
    fails(ArgumentError, lambda: env.reset(mask=mask), "mask: found", expected, *words)  # type: ignore[arg-type]


@pytest.mark.parametrize("seed", [-1, 1 << 32, 1.5, "7", True])
def test_seed_out_of_range(env: Env, seed: object) -> None:
    fails(ArgumentError, lambda: env.reset(seed=seed), "seed: found", repr(seed), "0 to 4294967295")  # type: ignore[arg-type]


def test_seed_of_some_worlds(env: Env) -> None:
    fails(ArgumentError, lambda: env.reset(seed=1, mask=mask_of(env, 1)), "seed", "mask")


def test_step_before_reset(cfg: Config) -> None:
    env = on_shared_sim("native", 3, cfg)
    fails(ArgumentError, lambda: env.step(zeros(env)), "before reset()", "env.reset()")
    fails(ArgumentError, lambda: env.reset(mask=mask_of(env, 1)), "mask", "env.reset()")
    env.reset()
    env.step(zeros(env))


# Configuration


@pytest.mark.parametrize(
    ("overrides", "words"),
    [(lambda: "task=reach", "'task=reach'"), (lambda: load_config([]), "Config(")],
    ids=["a string", "a configuration"],
)
def test_overrides_that_are_no_list(overrides: Callable[[], object], words: str) -> None:
    call = lambda: make_env(overrides())  # type: ignore[arg-type]  # noqa: E731
    fails(ArgumentError, call, "overrides", words, "['task=reach', 'robot=rebot']")


@pytest.mark.full
@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("seed=-1", ["seed=-1"]),
        (f"seed={1 << 32}", [f"seed={1 << 32}"]),
        ("task=reech", ["reech", "reach", "stack"]),
        ("action=ee_detla", ["ee_detla", "ee_delta"]),
        ("reset=randomised", ["randomised", "randomized"]),
        ("observation=none", ["none", "reach", "stack"]),
        ("rewards=stack", ["rewards", "reward"]),
        ("~reward.progres", ["progres", "progress"]),
        ("reward.progress.wait=3", ["wait", "weight"]),
        ("reward.progress.params.force=1", ["To add it, write +reward.progress.params.force=..."]),
        ("reward.porgress.weight=3", ["porgress", "progress"]),
        ("termination.time_out.params.step=3", ["step", "steps"]),
    ],
)
def test_override_that_cannot_be_used(override: str, words: list[str]) -> None:
    fails(None, lambda: make_env([override, "sim=native"], nworld=1), *words)


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


def put(cfg: Config, kind: str, func: str, params: dict | None = None) -> None:
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


def refused(cfg: Config, *words: str, kind: type[MjstackError] | None = TermError) -> None:
    """No environment can be built."""
    fails(kind, lambda: build(cfg), *words)


@pytest.mark.parametrize("kind", KINDS)
def test_misspelt_function_module_and_parameters(cfg: Config, kind: str) -> None:
    put(cfg, kind, "mjstack.mdp.reward.lfit")
    missing = [f"{kind}: func=mjstack.mdp.reward.lfit", "'lfit' does not exist"]
    refused(cfg, *missing, "Did you mean 'lift'?")
    for module in ("mjstack.mdp.rewards", "no_such_package"):
        put(cfg, kind, f"{module}.lift")
        refused(cfg, f"{kind}: func={module}.lift", f"'{module}' cannot be imported")
    put(cfg, kind, "NeedsScale")
    refused(cfg, f"{kind}: parameter 'scale' is missing", f"{kind}.params.scale")
    put(cfg, kind, "NeedsScale", {"scael": 1.0})
    refused(cfg, f"{kind}: parameter 'scael' does not exist", "Did you mean 'scale'?")


def test_function_without_a_module(cfg: Config) -> None:
    put(cfg, "reward.mine", "nothing")
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
    monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest,
) -> None:
    """By name: what is wrong in it is said, in a line."""
    module = request.node.callspec.id
    (tmp_path / f"{module}.py").write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    put(cfg, "reward.mine", f"{module}.one")
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
        put(cfg, "reward.mine", "mjstack.mdp.reward.lift", params)
        refused(cfg, "reward.mine: ", *words)
    cfg.reward.pop("mine")
    cfg.action["arm"].params["sacle"] = 1.0
    refused(cfg, "action.arm: parameter 'sacle' does not exist", "Did you mean 'scale'?")


@pytest.mark.parametrize(
    ("choice", "name", "params", "kind", "words"),
    [
        ("action", "arm", {"joints": "arms"}, TermError, ["'arms' does not exist", "arm"]),
        ("action", "arm", {"joints": ["elbow"]}, TermError, ["'elbow' does not", "elbow_flex"]),
        (
            *("action", "arm", {"joints": "arm", "mode": "absolut"}, ConfigError),
            ["arm.params.mode=absolut", "one of relative, absolute, delta"],
        ),
        (
            *("action", "arm", {"joints": "arm", "scale": 0.0}, ConfigError),
            ["arm.params.scale=0.0", "a number above 0"],
        ),
        (
            *("action=ee_delta", "arm", {"scale": 0.01, "iterations": 0}, ConfigError),
            ["arm.params.iterations=0", "an integer of at least 1"],
        ),
        (
            *("termination", "joint_limit", {"margin": -0.1}, ConfigError),
            ["joint_limit.params.margin=-0.1", "a number of at least 0"],
        ),
        (
            *("reset", "cubes", {"xy": -0.1, "yaw": 0.0}, ConfigError),
            ["cubes.params.xy=-0.1", "a number of at least 0"],
        ),
        ("reset", "cubes", {"xy": 0.2, "yaw": 0.0}, ConfigError, ["xy=0.2", "free position"]),
        *(
            ("reset=randomized", "cubes", {key: value}, ConfigError, [f"cubes.params.{key}="])
            for key, value in (("xy", [0.05]), ("gap", -0.01), ("candidates", 0), ("yaw", math.nan))
        ),
        *(
            (
                *("reset=randomized", "cubes", {"xy": xy, "gap": 0.12, "candidates": 2}),
                *(ConfigError, ["cubes.params.xy", "free position", "20000 trials", "smaller"]),
            )
            for xy in ([0.5, 0.5], [0.14, 0.3])
        ),
    ],
)
def test_parameters_out_of_range(
    choice: str, name: str, params: dict, kind: type[MjstackError], words: list[str]
) -> None:
    cfg = configure(choice) if "=" in choice else configure("task=stack", "reset=jitter")
    group = choice.partition("=")[0]
    term = getattr(cfg, group)[name]
    term.params = term.params | params if choice == "reset=randomized" else params
    refused(cfg, f"{group}.{name}", *words, kind=kind)


@pytest.mark.full
@pytest.mark.parametrize(
    ("name", "params"),
    [
        ("mass", {"scale": [1.3, 0.7]}),
        ("friction", {"sliding": [0.0, 1.0]}),
        ("gains", {"scale": [1.0]}),
    ],
)
def test_randomisation_bounds(name: str, params: dict) -> None:
    cfg = configure("reset=randomized")
    cfg.reset["cubes"] = configure("reset=jitter").reset["cubes"]  # builds faster
    cfg.reset[name].params = params
    words = [f"reset.{name}.params.{next(iter(params))}=", "smaller one first"]
    refused(cfg, *words, kind=ConfigError)


def test_action_that_is_no_action_term(cfg: Config) -> None:
    cfg.action["arm"].func = "mjstack.mdp.reward.lift"
    refused(cfg, "action.arm", "mjstack.mdp.reward.lift", "ActionTerm")


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
        put(cfg, kind, func)
        refused(cfg, f"{kind}: ", *words)


def test_reset_term_without_its_fields(cfg: Config) -> None:
    env = on_shared_sim("native", 3, cfg)
    bare = make_simulation(env.sim.model, cfg, 3, backend=Backend.native)
    cfg.reset["mass"] = TermCfg(func="mjstack.mdp.reset.ObjectMass", params={"scale": [0.9, 1.1]})
    fails(TermError, lambda: Env(bare, env.index, cfg), "reset.mass", "body_mass", "fields=")


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("history", 0, ["history=0", "from 1 to 1000"]),
        ("noise", -1.0, ["noise=-1.0", "at least 0"]),
        ("noise", float("nan"), ["noise=nan"]),
        ("scale", float("inf"), ["scale=inf", "finite"]),
        ("clip", [1.0, -1.0], ["clip=[1.0, -1.0]", "smaller one first"]),
        ("clip", [1.0], ["clip=[1.0]", "two numbers"]),
    ],
)
def test_observation_settings_out_of_range(
    cfg: Config, key: str, value: object, words: list[str]
) -> None:
    setattr(cfg.observation["policy"].terms["joint_pos"], key, value)
    kind = TermError if key == "clip" else ConfigError
    refused(cfg, "observation.policy.terms.joint_pos", *words, kind=kind)


def test_reward_weight_and_an_empty_group(cfg: Config) -> None:
    cfg.reward["progress"].weight = float("nan")
    refused(cfg, "reward.progress", "weight=nan", "finite", kind=ConfigError)
    cfg.reward["progress"].weight = 1.0
    cfg.observation["empty"] = ObservationGroupCfg(terms={})
    refused(cfg, "observation.empty", "no terms")


# Faults while stepping


@pytest.mark.parametrize(
    ("kind", "fault"),
    [
        ("reward.mine", "reward is not finite"),
        ("observation.policy.terms.mine", "observation is not finite"),
    ],
)
def test_value_that_becomes_nan_is_named(cfg: Config, kind: str, fault: str) -> None:
    put(cfg, kind, "nan_after_start")
    env = build(cfg)
    env.reset()
    env.step(zeros(env))
    step = partial(env.step, zeros(env))
    message = fails(FaultError, step, fault, kind, "1 of 3 worlds (2)")
    assert "reward.progress" not in message
    env.reset(seed=0)  # a full reset clears what has been reported
    env.step(zeros(env))


def test_state_that_becomes_nan_is_named_without_its_termination(cfg: Config) -> None:
    cfg.termination.pop("non_finite")
    env = build(cfg)
    env.reset()
    env.sim.qvel[1, 0] = float("nan")
    words = ["state is not finite", "1 of 3 worlds (1)", "non_finite"]
    fails(FaultError, lambda: env.step(zeros(env)), *words)


def warp_env(cfg: Config, **batch: int) -> Env:
    """Two worlds that have started."""
    for name, value in batch.items():
        setattr(cfg.batch, name, value)
    env = build_env(cfg, nworld=2, backend=Backend.mjwarp, device="cpu")
    env.reset()
    return env


@pytest.mark.full
def test_contact_pool_too_small() -> None:
    env = warp_env(configure("reset=randomized"), nconmax=1)
    words = ["PHASE overflow in ", "Raise batch.nconmax (nconmax=1;", "per world"]
    fails(FaultError, lambda: env.step(zeros(env)), *words)


@pytest.mark.full
def test_constraint_rows_too_few(cfg: Config) -> None:
    """Each step of a resting start needs some 100 rows; the environment says so at the first step,
    or ends the episodes if it has the termination.
    """
    env = warp_env(cfg, njmax=40)
    _, _, terminated, _, _ = env.step(zeros(env))
    assert terminated.all()
    column = env.termination_manager.names.index("overflow")
    assert env.termination_manager.values[:, column].all()
    cfg.termination.pop("overflow")
    env = warp_env(cfg, njmax=40)
    words = ["NEFC overflow in 2 of 2 worlds (0, 1)", "Raise batch.njmax", "njmax=40"]
    message = fails(FaultError, lambda: env.step(zeros(env)), *words)
    rows = re.search(r"up to (\d+) rows", message)
    assert rows is not None
    assert int(rows[1]) > 40
