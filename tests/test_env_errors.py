"""Mistakes that a user can make with an environment: one line each, that names the term or argument
and says what to do.
"""

from __future__ import annotations

import re
from collections.abc import Callable
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
from mjstack.errors import ArgumentError, ConfigError, FaultError, MjstackError, TermError

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


def fails(kind: type[MjstackError], call: Callable[[], object], *words: str) -> str:
    """The one-line message of the error that a call has to raise."""
    with pytest.raises(kind) as caught:
        call()
    assert type(caught.value) is kind
    message = str(caught.value)
    assert "\n" not in message
    assert message.endswith(".")
    assert not message.endswith("..")
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
    words = (
        "reward is not finite in 1 of 3 worlds (1)",
        f"after an action of {huge:.3g}",
        "policy",
    )
    fails(FaultError, lambda: env.step(action), *words)
    assert torch.equal(env.sim.qpos[[0, 2]], clean[[0, 2]])


def test_argument_errors_leave_the_environment_as_it_was(env: Env) -> None:
    action = 0.3 * torch.ones_like(zeros(env))
    expected = [returned(env.step(action)), returned(env.step(-action))]
    env.reset(seed=0)
    nan = action.clone()
    meta = action.to("meta")
    nan[0, 0] = float("nan")
    attempts: list[Callable[[], object]] = [
        lambda: env.step(nan),
        lambda: env.step(meta),
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
    fails(
        ArgumentError,
        lambda: env.reset(mask=mask),
        "mask: found",
        "bool tensor of shape (3,) on cpu",
        *words,
    )  # type: ignore[arg-type]


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


@pytest.mark.full
@pytest.mark.parametrize("seed", [-1, 1 << 32])
def test_configured_seed_out_of_range(seed: int) -> None:
    fails(ConfigError, lambda: make_env(["sim=native"], nworld=1, seed=seed), f"seed={seed}")


# Configuration


def test_overrides_as_a_string() -> None:
    fails(
        ArgumentError,
        lambda: make_env("task=reach"),
        "overrides",
        "'task=reach'",
        "['task=reach', 'robot=rebot']",
    )


def test_overrides_as_a_configuration() -> None:
    fails(
        ArgumentError,
        lambda: make_env(load_config([])),
        "overrides",
        "Config(",
        "['task=reach', 'robot=rebot']",
    )  # type: ignore[arg-type]


@pytest.mark.full
@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("task=reech", ["reech", "reach", "stack"]),
        ("action=ee_detla", ["ee_detla", "ee_delta"]),
        ("reset=randomised", ["randomised", "randomized"]),
        ("observation=none", ["none", "reach", "stack"]),
        ("rewards=stack", ["rewards", "reward"]),
        ("~reward.progres", ["progres", "progress"]),
        ("reward.progress.wait=3", ["wait", "weight"]),
        ("reward.porgress.weight=3", ["porgress", "progress"]),
        ("termination.time_out.params.step=3", ["step", "steps"]),
    ],
)
def test_unknown_group_or_key(override: str, words: list[str]) -> None:
    with pytest.raises(MjstackError) as caught:
        make_env([override, "sim=native"], nworld=1)
    assert "\n" not in str(caught.value)
    for word in words:
        assert word in str(caught.value)


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


KINDS: dict[str, Callable[[Config, str, dict], None]] = {
    "reward.mine": lambda cfg, func, p: cfg.reward.update(
        mine=RewardTermCfg(func=func, params=p, weight=1.0)
    ),
    "termination.mine": lambda cfg, func, p: cfg.termination.update(
        mine=TerminationTermCfg(func=func, params=p)
    ),
    "observation.policy.terms.mine": (
        lambda cfg, func, p: cfg.observation["policy"].terms.update(
            mine=ObservationTermCfg(func=func, params=p)
        )
    ),
    "task.success": lambda cfg, func, p: setattr(cfg.task, "success", TermCfg(func=func, params=p)),
    "reset.mine": lambda cfg, func, p: cfg.reset.update(mine=TermCfg(func=func, params=p)),
}
VALUES = [kind for kind in KINDS if kind != "reset.mine"]


def build(cfg: Config) -> Env:
    return on_shared_sim("native", 3, cfg)


@pytest.mark.parametrize("kind", KINDS)
def test_misspelt_function(cfg: Config, kind: str) -> None:
    KINDS[kind](cfg, "mjstack.mdp.reward.lfit", {})
    fails(
        TermError,
        lambda: build(cfg),
        f"{kind}: func=mjstack.mdp.reward.lfit",
        "'lfit' does not exist",
        "Did you mean 'lift'?",
    )


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("func", ["mjstack.mdp.rewards.lift", "no_such_package.term"])
def test_misspelt_module(cfg: Config, kind: str, func: str) -> None:
    KINDS[kind](cfg, func, {})
    fails(
        TermError,
        lambda: build(cfg),
        f"{kind}: func={func}",
        f"'{func.rpartition('.')[0]}' cannot be imported",
    )


def test_function_without_a_module(cfg: Config) -> None:
    KINDS["reward.mine"](cfg, "lift", {})
    fails(TermError, lambda: build(cfg), "reward.mine: func=lift", "dotted name")


def test_module_that_cannot_be_read(
    cfg: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A user's own module by name: what is wrong in it is said, in a line."""
    (tmp_path / "terms_with_a_typo.py").write_text("import torhc\n")
    (tmp_path / "terms_that_work.py").write_text(
        "import torch\ndef one(env):\n    return torch.ones(env.nworld)\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    KINDS["reward.mine"](cfg, "terms_with_a_typo.one", {})
    fails(TermError, lambda: build(cfg), "reward.mine", "terms_with_a_typo", "torhc")
    KINDS["reward.mine"](cfg, "terms_that_work.one", {})
    assert "mine" in build(cfg).reward_manager.names


def test_module_that_raises(cfg: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "terms_that_raise.py").write_text("raise RuntimeError('broken\\nin two lines')\n")
    (tmp_path / "terms_of_bad_syntax.py").write_text("def one(env:\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    for module, word in (("terms_that_raise", "broken"), ("terms_of_bad_syntax", "SyntaxError")):
        KINDS["reward.mine"](cfg, f"{module}.one", {})
        fails(TermError, lambda: build(cfg), "reward.mine", module, word)


@pytest.mark.parametrize("kind", KINDS)
def test_missing_and_misspelt_parameters(cfg: Config, kind: str) -> None:
    KINDS[kind](cfg, f"{HERE}.NeedsScale", {})
    fails(
        TermError,
        lambda: build(cfg),
        f"{kind}: parameter 'scale' is missing",
        f"{kind}.params.scale",
    )
    KINDS[kind](cfg, f"{HERE}.NeedsScale", {"scael": 1.0})
    fails(
        TermError,
        lambda: build(cfg),
        f"{kind}: parameter 'scael' does not exist",
        "Did you mean 'scale'?",
    )


def test_parameters_of_functions_and_actions(cfg: Config) -> None:
    lift = RewardTermCfg(func="mjstack.mdp.reward.lift", params={"object": "red"}, weight=1.0)
    cfg.reward["lift"] = lift
    fails(TermError, lambda: build(cfg), "reward.lift: parameter 'height' is missing")
    cfg.reward["lift"].params = {"object": "red", "hieght": 0.05}
    fails(
        TermError,
        lambda: build(cfg),
        "reward.lift: parameter 'hieght' does not exist",
        "Did you mean 'height'?",
    )
    cfg.reward["lift"].params = {"object": "red_cub", "height": 0.05}
    fails(
        TermError,
        lambda: build(cfg),
        "reward.lift",
        "'red_cub' does not exist",
        "Did you mean 'red'?",
    )
    cfg.reward.pop("lift")
    cfg.action["arm"].params["sacle"] = 1.0
    fails(
        TermError,
        lambda: build(cfg),
        "action.arm: parameter 'sacle' does not exist",
        "Did you mean 'scale'?",
    )


@pytest.mark.parametrize(
    ("group", "name", "params", "words"),
    [
        ("action", "arm", {"joints": "arms"}, ["action.arm", "'arms' does not exist", "arm"]),
        (
            "action",
            "arm",
            {"joints": ["elbow"]},
            ["action.arm", "'elbow' does not exist", "elbow_flex"],
        ),
        (
            "action",
            "arm",
            {"joints": "arm", "mode": "absolut"},
            ["action.arm.params.mode=absolut", "one of relative, absolute, delta"],
        ),
        (
            "action",
            "arm",
            {"joints": "arm", "scale": 0.0},
            ["action.arm.params.scale=0.0", "a number above 0"],
        ),
        (
            "termination",
            "joint_limit",
            {"margin": -0.1},
            ["termination.joint_limit.params.margin=-0.1", "a number of at least 0"],
        ),
        (
            "reset",
            "cubes",
            {"xy": -0.1, "yaw": 0.0},
            ["reset.cubes.params.xy=-0.1", "a number of at least 0"],
        ),
        ("reset", "cubes", {"xy": 0.2, "yaw": 0.0}, ["reset.cubes.params.xy=0.2", "free position"]),
    ],
)
def test_parameters_out_of_range(
    cfg: Config, group: str, name: str, params: dict, words: list[str]
) -> None:
    getattr(cfg, group)[name].params = params
    with pytest.raises(MjstackError) as caught:
        build(cfg)
    assert "\n" not in str(caught.value)
    for word in words:
        assert word in str(caught.value), str(caught.value)


def test_end_effector_action_out_of_range() -> None:
    cfg = configure("action=ee_delta")
    cfg.action["arm"].params = {"scale": 0.01, "iterations": 0}
    fails(
        ConfigError,
        lambda: build(cfg),
        "action.arm.params.iterations=0",
        "an integer of at least 1",
    )


def test_action_that_is_no_action_term(cfg: Config) -> None:
    cfg.action["arm"].func = "mjstack.mdp.reward.lift"
    fails(TermError, lambda: build(cfg), "action.arm", "mjstack.mdp.reward.lift", "ActionTerm")


@pytest.mark.parametrize("kind", VALUES)
@pytest.mark.parametrize(
    ("func", "words"),
    [
        ("wrong_shape", ["returned a torch.float32 tensor of shape (4,)", "(3,)"]),
        ("deep", ["tensor of shape (3, 2, 2)", "(3,)"]),
        ("whole_number", ["returned a torch.int64 tensor"]),
        ("nothing", ["returned a NoneType"]),
        ("raises", ["raised ValueError: first line"]),
    ],
)
def test_term_that_returns_what_its_manager_cannot_use(
    cfg: Config, kind: str, func: str, words: list[str]
) -> None:
    KINDS[kind](cfg, f"{HERE}.{func}", {})
    fails(TermError, lambda: build(cfg), f"{kind}: ", *words)


def test_term_of_the_wrong_type_or_width(cfg: Config) -> None:
    for kind in ("reward.mine", "termination.mine", "task.success"):
        spoilt = configure("task=stack", "reset=jitter")
        KINDS[kind](spoilt, f"{HERE}.wide", {})
        fails(TermError, lambda spoilt=spoilt: build(spoilt), f"{kind}: returned", "(3, 1)", "(3,)")
    for kind in ("termination.mine", "task.success"):
        spoilt = configure("task=stack", "reset=jitter")
        KINDS[kind](spoilt, f"{HERE}.number", {})
        fails(
            TermError,
            lambda spoilt=spoilt: build(spoilt),
            f"{kind}: returned a torch.float32",
            "expected a bool tensor",
        )
    KINDS["reward.mine"](cfg, f"{HERE}.elsewhere", {})
    fails(TermError, lambda: build(cfg), "reward.mine: returned", "(3,) on meta", "cpu")


def test_reset_term_that_raises(cfg: Config) -> None:
    KINDS["reset.mine"](cfg, f"{HERE}.raises", {})
    fails(TermError, lambda: build(cfg), "reset.mine: raised ValueError: first line")


def test_reset_term_without_its_fields(cfg: Config) -> None:
    from mjstack.sim import make_simulation

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
    fails(kind, lambda: build(cfg), "observation.policy.terms.joint_pos", *words)


def test_reward_weight_that_is_not_finite(cfg: Config) -> None:
    cfg.reward["progress"].weight = float("nan")
    fails(ConfigError, lambda: build(cfg), "reward.progress", "weight=nan", "finite")


def test_observation_group_without_terms(cfg: Config) -> None:
    cfg.observation["empty"] = ObservationGroupCfg(terms={})
    fails(TermError, lambda: build(cfg), "observation.empty", "no terms")


# Faults while stepping


def test_reward_that_becomes_nan_is_named(cfg: Config) -> None:
    KINDS["reward.mine"](cfg, f"{HERE}.nan_after_start", {})
    env = build(cfg)
    env.reset()
    env.step(zeros(env))
    message = fails(
        FaultError,
        lambda: env.step(zeros(env)),
        "reward is not finite",
        "reward.mine",
        "1 of 3 worlds (2)",
    )
    assert "reward.progress" not in message


def test_observation_that_becomes_nan_is_named(cfg: Config) -> None:
    KINDS["observation.policy.terms.mine"](cfg, f"{HERE}.nan_after_start", {})
    env = build(cfg)
    env.reset()
    env.step(zeros(env))
    fails(
        FaultError,
        lambda: env.step(zeros(env)),
        "observation",
        "observation.policy.terms.mine",
        "1 of 3 worlds (2)",
    )
    env.reset(seed=0)  # a full reset clears what has been reported
    env.step(zeros(env))


def test_state_that_becomes_nan_is_named_without_its_termination(cfg: Config) -> None:
    cfg.termination.pop("non_finite")
    env = build(cfg)
    env.reset()
    env.sim.qvel[1, 0] = float("nan")
    fails(
        FaultError,
        lambda: env.step(zeros(env)),
        "state is not finite",
        "1 of 3 worlds (1)",
        "non_finite",
    )


@pytest.mark.parametrize("xy", [[0.5, 0.5], [0.14, 0.3]])
def test_randomisation_that_leaves_no_free_place(xy: list[float]) -> None:
    cfg = configure("reset=randomized")
    cfg.reset["cubes"].params.update(xy=xy, gap=0.12, candidates=2)
    fails(
        ConfigError,
        lambda: build(cfg),
        "reset.cubes.params.xy",
        "free position",
        "20000 trials",
        "smaller",
    )


@pytest.mark.parametrize(
    ("key", "value"), [("xy", [0.05]), ("gap", -0.01), ("candidates", 0), ("yaw", float("nan"))]
)
def test_randomisation_out_of_range(key: str, value: object) -> None:
    cfg = configure("reset=randomized")
    cfg.reset["cubes"].params[key] = value
    fails(ConfigError, lambda: build(cfg), f"reset.cubes.params.{key}=")


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
    fails(
        ConfigError,
        lambda: build(cfg),
        f"reset.{name}.params.{next(iter(params))}=",
        "smaller one first",
    )


def warp_env(cfg: Config, **batch: int) -> Env:
    for name, value in batch.items():
        setattr(cfg.batch, name, value)
    return build_env(cfg, nworld=2, backend=Backend.mjwarp, device="cpu")


@pytest.mark.full
def test_contact_pool_too_small() -> None:
    env = warp_env(configure("reset=randomized"), nconmax=1)
    env.reset()
    fails(
        FaultError,
        lambda: env.step(zeros(env)),
        "PHASE overflow in ",
        "Raise batch.nconmax (nconmax=1;",
        "per world",
    )
    whole = warp_env(configure("reset=randomized"), naconmax=2)
    whole.reset()
    fails(FaultError, lambda: whole.step(zeros(whole)), "Raise batch.naconmax (naconmax=2;")


@pytest.mark.full
def test_constraint_rows_too_few_without_the_termination(cfg: Config) -> None:
    """Each step of a resting start needs some 100 rows; the environment says so at the
    first step.
    """
    cfg.termination.pop("overflow")
    env = warp_env(cfg, njmax=40)
    env.reset()
    message = fails(
        FaultError,
        lambda: env.step(zeros(env)),
        "NEFC overflow in 2 of 2 worlds (0, 1)",
        "Raise batch.njmax",
        "njmax=40",
    )
    rows = re.search(r"up to (\d+) rows", message)
    assert rows is not None
    assert int(rows[1]) > 40


@pytest.mark.full
def test_constraint_rows_too_few_end_episodes_with_the_termination(cfg: Config) -> None:
    env = warp_env(cfg, njmax=40)
    env.reset()
    _, _, terminated, _, _ = env.step(zeros(env))
    assert terminated.all()
    said = dict(
        zip(env.termination_manager.names, env.termination_manager.values.unbind(1), strict=True)
    )
    assert said["overflow"].all()
