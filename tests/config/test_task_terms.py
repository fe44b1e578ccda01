"""Terms that a task writes act wherever it is played, and one that does not act is named."""

import sys
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import torch
from compositions import refusal
from environments import Capture, Patch, few, record_of, report_of

import mjstack
from mjstack.cli import run
from mjstack.config import load_config
from mjstack.config.load import load_saved
from mjstack.config.schema import EPISODES, Config
from mjstack.config.session import search_path
from mjstack.envs import build_env
from mjstack.episodes.run import Run
from mjstack.episodes.stage import Stage
from mjstack.gates.parity import run_parity
from mjstack.jobs.train import judged_stage
from mjstack.mdp.geometry import pose_w
from mjstack.report.record import Status
from mjstack.train.clone_network import input_noise
from mjstack.train.trainer import with_observation

TURN = 0.2  # rad, of the shoulder at the start
FRICTION = 0.3  # of the first geom
TASK = """# @package _global_
# Reach, from a turned shoulder and on slippery ground.
defaults:
  - override /scene: stack
  - override /phases: reach
  - override /observation: null
  - override /reward: null
task:
  name: turned
  episode_seconds: 3.0
  params: {goal_height: 0.06}
  check:
    {func: mjstack.tasks.reach.ReachCheck, object: red, height: 0.06, distance: 0.02, window: 50}
reset:
  turn: {func: turned.turn}
  slide: {func: turned.slide}
observation:
  policy:
    terms:
      joint_pos: {func: mjstack.mdp.observation.joint_pos_relative, noise: 0.01}
      shoulder: {func: turned.shoulder}
action:
  gripper: null
  tip: {func: mjstack.mdp.action.JointPosition, params: {joints: gripper, mode: absolute}}
termination:
  far: {func: turned.far}
reward:
  still: {func: turned.still, weight: 1.0}
"""
MODULE = f"""
import torch

from mjstack.managers import uses_fields


def turn(env, mask):
    for view in (env.sim.qpos, env.sim.ctrl):
        view[:, 0] = torch.where(mask, {TURN}, view[:, 0])


@uses_fields("geom_friction")
def slide(env, mask):
    friction = env.sim.fields["geom_friction"]
    friction[:, 0, 0] = torch.where(mask, {FRICTION}, friction[:, 0, 0])


def shoulder(env):
    return env.sim.qpos[:, :1]


def far(env):
    return env.sim.qpos[:, 0] > 9.0


def still(env):
    return -env.sim.qvel[:, 0].abs()
"""
SHIPPED = ["home", "joints", "cubes", "mass", "friction", "gains"]


@pytest.fixture
def turned(tmp_path: Path, monkeypatch: Patch) -> Iterator[Path]:
    """A folder with the task."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    conf = tmp_path / "turned" / "conf"
    (conf / "task").mkdir(parents=True)
    (conf / "task" / "turned.yaml").write_text(TASK)
    (conf.parent / "turned.py").write_text(MODULE)
    yield conf
    sys.modules.pop("turned", None)


def composed(conf: Path, *overrides: str) -> Config:
    return load_config(["task=turned", "sim=native", *overrides], config_dir=conf)


def test_a_reset_of_the_task_acts_in_every_gate(turned: Path, tmp_path: Path) -> None:
    gates = "gates=[baseline,parity,batch,success]"
    folder = tmp_path / "run"
    args = ["task=turned", "sim=native", "nworld=3", gates, f"hydra.run.dir={folder}"]
    assert run(["--config-dir", str(turned), *args, "web.episode=false"]) == 0
    gate = {gate["name"]: gate for gate in report_of(folder)["gates"]}
    assert {name: result["status"] for name, result in gate.items()} == dict.fromkeys(
        ("baseline", "parity", "batch", "success"), "pass"
    )
    for name in ("batch", "success"):
        starts = record_of(folder, gate=name).worlds["start_qpos"]
        np.testing.assert_allclose(starts[:, 0], TURN, atol=1e-6)
    # Its other worlds still differ as gate success has it
    cubes = record_of(folder, gate="success").worlds["start_qpos"][:, 6:8]
    assert np.ptp(cubes[:, 0]) > 0.005
    saved = load_config(["task=turned"], config_dir=turned)
    assert list(saved.gate.success.reset) == [*SHIPPED, "turn", "slide"]
    assert list(saved.gate.baseline.reset) == ["home", "turn", "slide"]


def test_the_world_of_baseline_and_parity_is_that_of_the_task(turned: Path) -> None:
    cfg = composed(turned, "gates=[baseline,parity]")
    play = Run(Stage(cfg))
    nominal = play.nominal
    assert abs(float(nominal.world.qpos[0, 0]) - TURN) < 0.05  # after one step
    assert float(nominal.sim.fields["geom_friction"][0, 0, 0]) == FRICTION
    (result,) = run_parity(play)
    assert result.status is Status.passed, result.reason
    # A world of MJWarp with other friction, or none of the term, is another world
    cfg.gate.baseline.reset.pop("slide")
    assert "geom_friction" not in Run(Stage(cfg)).nominal.sim.fields


@pytest.mark.parametrize("job", few(["collect", "play", "gates"], 2))
def test_it_acts_in_other_jobs(turned: Path, job: str) -> None:
    cfg = composed(turned, f"job={job}", "nworld=2", "reset=jitter")
    assert list(cfg.reset) == ["home", "cubes", "turn", "slide"]
    with closing(build_env(Stage(cfg).driven(cfg.reset))) as env:
        env.reset()
        torch.testing.assert_close(env.sim.qpos[:, 0].float(), torch.full((2,), TURN))


def test_training_is_judged_from_the_starts_of_the_task(turned: Path, tmp_path: Path) -> None:
    cfg = composed(turned, "job=train", "reset=jitter")
    judged = judged_stage(Stage(cfg), tmp_path).cfg
    assert list(judged.gate.success.reset) == ["home", "cubes", "turn", "slide"]
    assert judged.gate.success.reset["cubes"] == cfg.reset["cubes"]
    # One that the task gives gate success alone acts there too, and a choice on the command line
    extra = "+gate.success.reset.more={func: turned.turn}"
    assert list(composed(turned, "job=train", "reset=jitter", extra).gate.success.reset)[-1] == (
        "more"
    )
    chosen = composed(turned, "job=train", "reset=jitter", "reset@gate.success.reset=randomized")
    assert list(chosen.gate.success.reset) == [*SHIPPED, "turn", "slide"]
    # An experiment's choice counts as one of the command line
    (turned / "experiment").mkdir()
    text = "# @package _global_\ndefaults:\n  - override /reset@gate.success.reset: jitter\n"
    (turned / "experiment" / "near.yaml").write_text(text)
    near = composed(turned, "job=train", "reset=randomized", "experiment=near")
    assert list(near.reset) == [*SHIPPED, "turn", "slide"]
    assert list(near.gate.success.reset) == ["home", "cubes", "turn", "slide"]


@pytest.mark.parametrize(
    ("overrides", "names", "line"),
    few(
        [
            # Added by a command line, or by an own function under a name that the gate has too
            (["+reset.more={func: turned.turn}"], [*SHIPPED, "turn", "slide", "more"], ""),
            (["reset.cubes={func: turned.turn}"], [*SHIPPED, "turn", "slide"], ""),
            # Removed from the task
            (
                ["~reset.cubes"],
                ["home", "joints", "mass", "friction", "gains", "turn", "slide"],
                "",
            ),
            (["reset.turn=null"], [*SHIPPED, "slide"], ""),
            # The gate's choice has another function of mjstack under this name
            (
                ["reset.cubes.params.xy=0.01"],
                [*SHIPPED, "turn", "slide"],
                "reset.cubes does not act",
            ),
            # Replaced in the gate by name, on purpose
            (
                ["+gate.success.reset.turn={func: turned.slide}"],
                [*SHIPPED, "turn", "slide"],
                "reset.turn does not act in gate success: gate.success.reset.turn takes its place",
            ),
            # A chosen file that the gate does not have
            (
                ["looks=randomized", "reset.light.params.tint=0.2"],
                [*SHIPPED, "turn", "slide"],
                "reset.light does not act in gate success: gate.success.reset has no light",
            ),
        ],
        2,
    ),
)
def test_a_reset_that_does_not_act_is_named(
    turned: Path, overrides: Sequence[str], names: list[str], line: str
) -> None:
    cfg = composed(turned, "gates=[batch,success]", "job=gates", *overrides)
    assert list(cfg.gate.success.reset) == names
    lines = [text for text in cfg.unused_terms if text.startswith("reset.")]
    assert len(lines) == bool(line)
    assert line in "".join(lines)


GATES = {"site": "defaults: [/reset@reset: randomized, _self_]\nfunc: {}", "plain": "func: {}"}


def own_gates(conf: Path) -> Path:
    (conf / "gate").mkdir()
    for name, text in GATES.items():
        (conf / "gate" / f"{name}.yaml").write_text(text.format(EPISODES))
    return conf


@pytest.mark.parametrize(
    ("overrides", "lines"),
    [
        (["gates=[site,plain,batch]", "reset=jitter"], ["site: reset@gate.site.reset=jitter"]),
        (
            ["gates=[site,success]", "reset=jitter", "reset@gate.site.reset=jitter"],
            ["success: reset@gate.success.reset=jitter"],
        ),
        (["gates=[site]", "looks=randomized"], ["site: +looks@gate.site.reset=randomized"]),
    ],
)
def test_a_choice_that_does_not_act_in_a_gate_is_named(
    overrides: list[str], lines: list[str], turned: Path
) -> None:
    cfg = load_config(["sim=native", *overrides], config_dir=own_gates(turned))
    said = [line.partition(" does not act in gate ")[2] for line in cfg.unused_terms]
    assert said == [f"{line} chooses it there" for line in lines]


@pytest.mark.full
def test_starts_of_a_gate_are_terms(turned: Path) -> None:
    words = "gate.plain.reset=randomized: expected keys and values"
    args = ["gates=[plain]", "gate.plain.reset=randomized"]
    refusal(lambda: load_config(args, config_dir=own_gates(turned)), words)


def test_the_same_function_takes_the_task_s_parameters(turned: Path) -> None:
    region = ["reset=randomized", "reset.cubes.params.xy=[0.01,0.02]"]
    cfg = composed(turned, *region, "gates=[success]")
    assert cfg.gate.success.reset["cubes"].params["xy"] == [0.01, 0.02]
    shipped = composed(turned, "gates=[success]").gate.success.reset["cubes"]
    assert shipped.params["xy"] != [0.01, 0.02]


def test_terms_that_a_job_leaves_out_are_printed(
    turned: Path, tmp_path: Path, capsys: Capture
) -> None:
    folder = tmp_path / "run"
    args = ["task=turned", "sim=native", "nworld=2", "gates=[baseline]", f"hydra.run.dir={folder}"]
    assert run(["--config-dir", str(turned), *args, "web.episode=false"]) == 0
    text = capsys.readouterr().out
    lines = (
        "job=gates but gate throughput leaves out action.tip: drivers command",
        "job=gates but gate throughput leaves out termination.far: task.check judges",
    )
    for line in lines:
        assert line in text
        assert line in (folder / "run.log").read_text()
        assert any(line in note for note in report_of(folder)["provenance"]["unused_terms"])
    assert "reward.still" not in text
    with search_path([turned]):
        assert load_saved(folder / ".hydra" / "config.yaml").unused_terms
    for stock in (["gates=[batch,success]"], ["job=train", "trainer=ppo", "reset=expert_states"]):
        assert not load_config(stock).unused_terms


def test_a_policy_sees_what_a_task_writes(turned: Path) -> None:
    for trainer in ("dagger", "ppo"):
        cfg = composed(turned, "job=train", f"trainer={trainer}", "reset=jitter")
        assert {"shoulder", "offsets"} <= cfg.job.observation["policy"].terms.keys()
        lines = " ".join(cfg.unused_terms)
        assert "does not see" not in lines
        assert ("reward.still" in lines) == (trainer != "ppo")
    noisy = composed(turned, "job=train", "job.observation.policy.terms.joint_pos.noise=0.02")
    assert noisy.job.observation["policy"].terms["joint_pos"].noise == 0.02
    assert "shoulder" in noisy.job.observation["policy"].terms
    cfg = composed(turned, "job=train", "observation@job.observation=state")
    assert "offsets" in cfg.job.observation["policy"].terms
    (line,) = [line for line in cfg.unused_terms if "see" in line]
    assert line.endswith(
        "goals; the task's own shoulder it does not see (observation@job.observation=task has them)"
    )
    # A task with a file of mjstack's, and a term of its own beside it
    more = ["+observation.policy.terms.seen={func: mjstack.mdp.observation.goals}", "job=train"]
    assert "seen" not in load_config(more).job.observation["policy"].terms  # it has it as goals
    more[0] = more[0].replace("goals", "gripper_opening")
    cfg = load_config(more)
    assert "seen" in cfg.job.observation["policy"].terms
    assert not cfg.unused_terms
    chosen = load_config([*more, "observation@job.observation=task"])
    assert chosen.job.observation == chosen.observation
    assert not chosen.unused_terms


def test_terms_that_are_null(turned: Path) -> None:
    """A task's own one, or one that the policy is not to see."""
    cfg = composed(turned, "job=train", "observation.policy.terms.shoulder=null")
    assert "shoulder" not in cfg.job.observation["policy"].terms
    assert not [line for line in cfg.unused_terms if "does not see" in line]
    cfg = composed(turned, "job=train", "++job.observation.policy.terms.shoulder=null")
    assert "shoulder" not in cfg.job.observation["policy"].terms
    (line,) = [line for line in cfg.unused_terms if "does not see" in line]
    assert "the task's own shoulder it does not see" in line


def test_terms_without_noise_get_some_in_a_training(turned: Path) -> None:
    stage = Stage(composed(turned, "job=train", "trainer=clone", "job.input_noise=2.0"))
    cfg = with_observation(stage.cfg)
    spread = torch.full((7,), 0.5)
    noise = input_noise(cfg, stage.model, {"joint_pos": 6, "shoulder": 1}, spread)
    torch.testing.assert_close(noise, torch.tensor([0.01] * 6 + [0.02]))  # joint_pos has 0.005
    stage.cfg.job.input_noise = 0.0
    assert not input_noise(cfg, stage.model, {"joint_pos": 6, "shoulder": 1}, spread).any()


@pytest.mark.parametrize("backend", ["native", "mjwarp"])
def test_a_fixed_object_is_where_a_reset_term_has_moved_it(turned: Path, backend: str) -> None:
    (turned.parent / "turned.py").write_text(
        MODULE
        + """
@uses_fields("body_pos")
def shift(env, mask):
    body = env.index.bodies["blue"]
    moved = env.sim.fields["body_pos"]
    moved[:, body, 1] = torch.where(mask, 0.1 + 0.01 * env.world, moved[:, body, 1])
"""
    )
    fixed = ["scene.objects.blue.fixed=true", "+reset.shift={func: turned.shift}"]
    overrides = [*fixed, f"sim={backend}", "sim.device=cpu", "reset=nominal"]
    env = mjstack.make_env(["task=turned", *overrides], config_dir=turned, nworld=2)
    with closing(env):
        env.reset()
        pose = pose_w(env, "blue")
        torch.testing.assert_close(pose[:, 1].float(), torch.tensor([0.1, 0.11]))
        torch.testing.assert_close(pose[:, 3:].float().abs().amax(1), torch.ones(2))
        assert float(pose[0, 0]) == pytest.approx(env.index.fixed["blue"][0])
