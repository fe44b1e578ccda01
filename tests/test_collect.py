"""Demonstrations of the expert: what a step holds, which episodes count, and that nothing
is lost or there twice.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from compositions import load_config, put
from dataset_checker import check_dataset
from environments import at_double_speed, one_second_episode
from stubs import episodes_of, fake_demonstrations, pairs

from mjstack.cli import run
from mjstack.config.check import validate
from mjstack.config.fingerprint import config_hash, differences
from mjstack.config.schema import Backend, Config
from mjstack.datasets import DatasetWriter, Feature
from mjstack.datasets.part import PartWriter
from mjstack.envs import build_env, demonstration_config
from mjstack.episodes.context import RunContext
from mjstack.episodes.rollout import CommandRecorder
from mjstack.errors import ConfigError
from mjstack.jobs import CheckedJob, check_job, collection
from mjstack.jobs.collect import LOADING, collect_folder, plan_collection, run_collect
from mjstack.jobs.collected import FILE, CollectPlan
from mjstack.jobs.demonstration import (
    Played,
    StepRecorder,
    episode_config,
    make_spec,
)
from mjstack.managers.episode import required_fields
from mjstack.sim import make_simulation

COMMAND = ["job=collect", "sim=native", "job.folder=outputs/demos"]
JOINTS = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper"]
STEPS = 300  # of a demonstration at double speed


def steps_of(dataset: Path, number: int) -> dict[str, np.ndarray]:
    table = pq.read_table(dataset / "data", filters=[("episode_index", "==", number)])
    return {name: np.array(table[name].to_pylist()) for name in table.column_names}


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def report_of(folder: Path) -> dict:
    return json.loads((folder / "report.json").read_text())


def gate_episode(cfg: Config) -> SimpleNamespace:
    """The same worlds as a gate plays them: result and commands."""
    context = RunContext(cfg=cfg)
    sim = make_simulation(
        context.model, cfg, cfg.nworld, backend=Backend.native, fields=required_fields(cfg.reset)
    )
    try:
        commands = CommandRecorder()
        episode = context.play(sim, cfg.reset, [commands])
        return SimpleNamespace(result=episode.result, commands=commands.recorded)
    finally:
        sim.close()


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """Four real episodes. The stacks' offsets are 0.4, 0.7, 1.2 and 1.0 mm: by the threshold two of
    them fail, and are kept.
    """
    folder = tmp_path_factory.mktemp("collect")
    args = [
        *COMMAND,
        "nworld=4",
        "job.episodes=4",
        "job.keep_failures=true",
        "task.check.xy_err=0.0009",
        *at_double_speed(),
    ]
    before = os.getcwd()
    os.chdir(folder)
    try:
        code = run(args)
    finally:
        os.chdir(before)
    home = folder / "outputs" / "demos"
    cfg = load_config(args)
    return SimpleNamespace(
        code=code,
        args=args,
        cfg=cfg,
        cwd=folder,
        home=home,
        dataset=home / "dataset",
        judged=gate_episode(cfg),
    )


def test_the_dataset_keeps_its_promises(demos: SimpleNamespace) -> None:
    assert demos.code == 0
    stored = check_dataset(demos.dataset)
    assert len(stored.episodes) == 4
    assert report_of(demos.home)["status"] == "pass"


def test_names_and_units(demos: SimpleNamespace) -> None:
    info = json.loads((demos.dataset / "meta/info.json").read_text())
    features = info["features"]
    units = info["mjstack"]["units"]
    assert info["fps"] == 50
    assert (
        features["observation.state"]["names"]
        == features["action"]["names"]
        == [f"{name}.pos" for name in JOINTS]
    )
    assert units["observation.state"] == units["action"] == ["rad"] * 6
    policy = dict(
        zip(features["observation.policy"]["names"], units["observation.policy"], strict=True)
    )
    assert len(policy) == 24
    assert policy["joint_pos.0"] == policy["last_action.5"] == "rad"
    assert policy["joint_vel.3"] == "10 rad/s"
    assert policy["grasp_point_to_red.2"] == "m"
    privileged = dict(
        zip(
            features["observation.privileged"]["names"],
            units["observation.privileged"],
            strict=True,
        )
    )
    assert (privileged["red_pose.2"], privileged["red_pose.3"], privileged["jaw_force.1"]) == (
        "m",
        "1",
        "10 N",
    )
    assert (privileged["red_velocity.0"], privileged["red_velocity.5"]) == ("m/s", "rad/s")
    assert {"next.reward", "next.done", "next.success", "timestamp"} <= set(features)
    config = info["mjstack"]["provenance"][0]["config"]
    assert (
        config_hash(config)
        == info["mjstack"]["config_sha256"]
        == config_hash(episode_config(demos.cfg))
    )


@pytest.mark.full
@pytest.mark.parametrize(("robot", "task"), [("so101", "box"), ("rebot", "stack")])
def test_every_number_has_a_name_and_a_unit(robot: str, task: str) -> None:
    cfg = load_config([*COMMAND, f"robot={robot}", f"task={task}"])
    env = build_env(demonstration_config(cfg), nworld=1, backend=Backend.native, device="cpu")
    spec = make_spec(env, cfg, {})
    for group, dim in env.observation_manager.group_dims.items():
        assert spec.features[f"observation.{group}"].dim == dim
        assert "unknown" not in spec.features[f"observation.{group}"].units
    fingers = {"so101": ["rad"], "rebot": ["m", "m"]}[robot]
    assert list(spec.features["action"].units) == ["rad"] * len(cfg.robot.arm_joints) + fingers
    env.close()


@pytest.mark.full
def test_names_of_a_history_and_of_a_strange_term() -> None:
    history = "+observation.policy.terms.grasp_point_to_red.history=2"
    strange = "+observation.policy.terms.count={func: mjstack.mdp.reward.success}"
    cfg = load_config([*COMMAND, history, strange])
    env = build_env(demonstration_config(cfg), nworld=1, backend=Backend.native, device="cpu")
    feature: Feature = make_spec(env, cfg, {}).features["observation.policy"]
    first = feature.names.index("grasp_point_to_red.0.t-1")
    assert feature.names[first : first + 4] == (
        "grasp_point_to_red.0.t-1",
        "grasp_point_to_red.1.t-1",
        "grasp_point_to_red.2.t-1",
        "grasp_point_to_red.0",
    )
    assert feature.units[feature.names.index("count")] == "unknown"
    env.close()


def test_actions_are_what_the_gates_command(demos: SimpleNamespace) -> None:
    """And they are what went to the actuators: the same episode in the gates' own loop."""
    given = demos.judged.commands
    given.rewind()
    commands = torch.stack([given.command() for _ in range(STEPS)], dim=1).numpy()
    for number, row in enumerate(episodes_of(demos.dataset)):
        assert np.array_equal(
            steps_of(demos.dataset, number)["action"].astype(np.float32), commands[row["world"]]
        )


def test_success_is_the_evidence(demos: SimpleNamespace) -> None:
    failed = demos.judged.result.failed.numpy()
    assert 0 < (failed == 0).sum() < 4  # some of each, or nothing is shown
    rows = episodes_of(demos.dataset)
    assert [row["world"] for row in rows] == [0, 1, 2, 3]
    for number, row in enumerate(rows):
        good = failed[row["world"]] == 0
        steps = steps_of(demos.dataset, number)
        assert row["success"] == good
        assert (row["failed_rules"] == "") == good
        assert steps["next.success"].tolist() == [False] * (STEPS - 1) + [bool(good)]
        assert steps["next.done"].tolist() == [False] * (STEPS - 1) + [True]
        assert steps["timestamp"] == pytest.approx(np.arange(STEPS) / 50.0)
        assert (row["seed"], row["length"]) == (0, STEPS)
        assert row["config_sha256"] == config_hash(episode_config(demos.cfg))


@pytest.mark.full
def test_a_step_is_the_state_before_its_action(demos: SimpleNamespace) -> None:
    """The actions, played in the environment, bring the same observations before and the same
    rewards after each of them.
    """
    env = build_env(demonstration_config(demos.cfg), nworld=4, backend=Backend.native, device="cpu")
    episodes = [steps_of(demos.dataset, number) for number in range(4)]

    def stored(name: str, step: int) -> np.ndarray:
        return np.stack([episode[name][step] for episode in episodes]).astype(np.float32)

    obs, _ = env.reset(seed=0)
    env.sim.forward()
    robot = env.index.on(env.device, env.sim.qpos.dtype)
    for step in range(STEPS):
        assert np.array_equal(
            stored("observation.state", step), robot.qpos.read(env.sim.qpos).float().numpy()
        ), step
        for group in ("policy", "privileged"):
            assert np.array_equal(stored(f"observation.{group}", step), obs[group].numpy()), (
                group,
                step,
            )
        obs, reward, terminated, truncated, _ = env.step(torch.from_numpy(stored("action", step)))
        assert not (terminated | truncated).any()
        assert np.array_equal(stored("next.reward", step), reward.numpy()), step
    assert np.ptp([episode["next.reward"].sum() for episode in episodes]) > 0.0
    env.close()


def test_what_is_left_beside_the_dataset(demos: SimpleNamespace) -> None:
    (gate,) = report_of(demos.home)["gates"]
    metrics = gate["metrics"]
    succeeded = int((demos.judged.result.failed == 0).sum())
    assert (
        metrics["episodes"],
        metrics["steps"],
        metrics["succeeded"],
        metrics["worlds_played"],
    ) == (4, 4 * STEPS, succeeded, 4)
    assert metrics["success_rate_low95"] < metrics["success_rate"] < metrics["success_rate_high95"]
    assert metrics["episodes_per_s"] > 0.0
    assert metrics["megabytes"] == pytest.approx(
        sum(map(len, contents(demos.dataset).values())) / 1e6
    )
    assert any(
        line.startswith(f"not stacked: {4 - succeeded} of 4 worlds") for line in gate["details"]
    )
    text = (demos.home / "dataset.md").read_text()
    state = steps_of(demos.dataset, 0)["observation.state"]
    (line,) = [
        line
        for line in text.splitlines()
        if line.startswith("| observation.state gripper.pos | rad |")
    ]
    low, _, high = (float(cell) for cell in line.split("|")[3:6])
    assert low - 1e-4 <= state[:, 5].min() < state[:, 5].max() <= high + 1e-4
    assert LOADING.format(folder="outputs/demos/dataset") in text


def test_reported_lines_load_it(demos: SimpleNamespace) -> None:
    program = LOADING.format(folder="outputs/demos/dataset")
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=demos.cwd, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    state, action = done.stdout.splitlines()
    assert state.startswith(f"observation.state ({STEPS}, 6) ['shoulder_pan.pos'")
    assert action.startswith(f"action ({STEPS}, 6) ['shoulder_pan.pos'")
    assert action.endswith("'rad']")


@pytest.mark.full
def test_the_same_command_again_does_nothing(
    demos: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(demos.cwd)
    monkeypatch.setattr(collection, "play_demonstrations", None)
    before = contents(demos.dataset / "data")
    assert run(demos.args) == 0
    assert contents(demos.dataset / "data") == before
    reason = report_of(demos.home)["gates"][0]["reason"]
    assert "4 episodes, 4 asked for" in reason
    assert reason.endswith("; they were there already")


@pytest.mark.full
def test_another_configuration_is_refused(
    demos: SimpleNamespace, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(demos.cwd)
    before = contents(demos.cwd)
    assert run([*demos.args, "job.episodes=5", "reward.progress.weight=2.5"]) == 2
    err = capsys.readouterr().err.strip()
    assert (
        err == "mjstack: outputs/demos/dataset has episodes of another configuration:"
        " reward.progress.weight=5.0, expected 2.5. Set job.folder to another folder, or these keys"
        " back."
    )
    assert contents(demos.cwd) == before


@pytest.mark.full
def test_a_dataset_that_is_being_written_is_refused(
    demos: SimpleNamespace, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(demos.cwd)
    env = build_env(demonstration_config(demos.cfg), nworld=1, backend=Backend.native, device="cpu")
    with DatasetWriter(
        demos.dataset, make_spec(env, demos.cfg, {"config": episode_config(demos.cfg)})
    ):
        assert run([*demos.args, "job.episodes=5"]) == 2
    assert "is open in another writer" in capsys.readouterr().err
    env.close()


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path / "outputs" / "demos"


@pytest.mark.full
@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["reset=nominal"], "reset=[home]: expected starts that differ"),
        (["task=reach", "task.check=null"], "task=reach"),
        (
            ["+observation.state={terms: {q: {func: mjstack.mdp.observation.joint_pos}}}"],
            "observation.state=a group",
        ),
        (["job.folder=taken"], "taken cannot be written"),
    ],
)
def test_bad_input_is_one_line(
    args: list[str], words: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cwd = Path.cwd()
    (cwd / "taken").write_text("")
    before = contents(cwd)
    assert run([*COMMAND, *args]) == 2
    err = capsys.readouterr().err.strip()
    assert words in err
    assert len(err.splitlines()) == 1
    assert contents(cwd) == before


def test_a_value_that_the_job_does_not_take() -> None:
    with pytest.raises(ConfigError, match=r"job\.episodes=0"):
        validate(put(load_config(COMMAND), "job.episodes=0"))
    with pytest.raises(ConfigError, match="video=true: expected false with job=collect"):
        check_job(put(load_config(COMMAND), "video=true"))


@pytest.mark.full
def test_what_the_hash_is_of() -> None:
    def home(*values: str, choices: Sequence[str] = ()) -> Path:
        return collect_folder(put(load_config(["job=collect", "sim=native", *choices]), *values))

    base = home()
    assert base.parent == Path("outputs/collect")
    assert (
        home(
            "job.episodes=7",
            "nworld=3",
            "gates=[batch]",
            "batch.njmax=300",
            "job.buffer_gib=1",
        )
        == base
    )
    assert home("gate.throughput.steps=3", "gate.success.seeds=2") == base
    assert home(choices=["~termination.success", "graph=off"]) == base
    groups = ["robot=rebot", "reset=jitter"]
    values = [
        "seed=1",
        "observation.policy.noise=false",
        "reward.progress.weight=3",
        "task.check.xy_err=0.01",
    ]
    values += ["job.keep_failures=true", "controller.phases.done.seconds=2.0"]
    others = [*(home(choices=[group]) for group in groups), *(home(value) for value in values)]
    assert len({base, *others}) == 1 + len(others)
    on_cpu = collect_folder(load_config(["job=collect", "sim=mjwarp", "sim.device=cpu"]))
    assert (
        on_cpu != base
    )  # the backend changes episodes in their last digits, the device does not count


@pytest.mark.parametrize(
    ("theirs", "ours", "expected"),
    [
        ({"a": {"b": 1, "c": [1]}}, {"a": {"b": 1, "c": [2]}}, "a.c=[1], expected [2]"),
        (
            {"a": {"b": True, "c": 2}},
            {"a": {"b": None, "c": 3}},
            "a.b=True, expected None; a.c=2, expected 3",
        ),
        (
            {"a": {"b": 1, "c": {"e": 2}}},
            {"a": {"b": 1, "d": 3}},
            "a.c.e=2, expected none; a.d=missing, expected 3",
        ),
    ],
)
def test_differences(theirs: dict, ours: dict, expected: str) -> None:
    assert differences(ours, ours) == ""
    assert differences(theirs, ours) == expected


@pytest.mark.full
def test_many_differences_are_one_line(
    demos: SimpleNamespace, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(demos.cwd)
    assert run([*demos.args, "reset=jitter"]) == 2
    err = capsys.readouterr().err.strip()
    assert re.search(
        r"another configuration: reset\.[\w.]+=.*, expected .*, and \d+ more keys\.", err
    )
    assert len(err.splitlines()) == 1


def all_succeed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every world of every batch succeed, without playing it."""
    played = fake_demonstrations(lambda seed, world: False)
    monkeypatch.setattr(collection, "play_demonstrations", played)


def collect(*overrides: str) -> int:
    """Runs the job as the command line does once it has checked everything, and returns its exit
    status.
    """
    cfg = load_config([*COMMAND, *overrides])
    home = collect_folder(cfg)
    home.mkdir(parents=True, exist_ok=True)
    context = RunContext(cfg)
    work = partial(run_collect, plan_collection(context))
    return CheckedJob(context=context, title="collect", work=work).run(home).exit_code


@pytest.mark.full
def test_seeds_go_on_until_the_episodes_are_there(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        collection, "play_demonstrations", fake_demonstrations(lambda seed, world: world == 1)
    )
    assert collect("nworld=4", "job.episodes=7", "seed=5") == 0
    found = pairs(folder / "dataset")
    # The missing episodes decide how many worlds play: 7, then 4, then 1 and one to spare.
    assert found == [(5, 0), (5, 2), (5, 3), (6, 0), (6, 2), (6, 3), (7, 0)]
    batches = json.loads((folder / FILE).read_text())
    assert [(batch["worlds"], batch["succeeded"], batch["kept"]) for batch in batches] == [
        (4, 3, 3),
        (4, 3, 3),
        (2, 1, 1),
    ]
    steps = steps_of(folder / "dataset", 5)
    assert steps["action"] == pytest.approx(1e-3 * 6 + 1e-6 * 3)
    # More are wanted: seed 8 is next, whatever nworld is.
    assert collect("nworld=16", "job.episodes=9", "seed=5") == 0
    assert pairs(folder / "dataset") == [*found, (8, 0), (8, 2)]
    assert not any(row["failed_rules"] for row in episodes_of(folder / "dataset"))
    metrics = report_of(folder)["gates"][0]["metrics"]
    assert (metrics["worlds_played"], metrics["succeeded"], metrics["episodes_of_this_call"]) == (
        13,
        9,
        2,
    )
    check_dataset(folder / "dataset")


LAYOUT = """world,red_x_m,red_y_m,red_yaw_rad,blue_x_m,blue_y_m,blue_yaw_rad
0,0.33,-0.13,0,0.33,0.06,0
1,0.31,-0.10,0.3,0.34,0.08,-0.5
"""
FROM_LAYOUT = [
    "reset=starts_file",
    "+reset.noise={func: mjstack.mdp.reset.JointNoise, params: {arm: 0.01}}",
    "nworld=2",
]


@pytest.mark.full
def test_a_layout_counts_by_its_content(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    all_succeed(monkeypatch)
    first = Path("worlds.csv")
    moved = Path("elsewhere.csv")
    first.write_text(LAYOUT)
    args = [*COMMAND, *FROM_LAYOUT]
    assert collect(*FROM_LAYOUT, "starts=worlds.csv", "job.episodes=2") == 0
    first.rename(moved)
    assert collect(*FROM_LAYOUT, "starts=elsewhere.csv", "job.episodes=4") == 0
    assert pairs(folder / "dataset") == [(0, 0), (0, 1), (1, 0), (1, 1)]
    assert (
        len(json.loads((folder / "dataset/meta/info.json").read_text())["mjstack"]["provenance"])
        == 1
    )
    moved.write_text(LAYOUT.replace("0.31", "0.32"))
    before = contents(Path.cwd())
    capsys.readouterr()
    assert run([*args, "starts=elsewhere.csv", "job.episodes=6"]) == 2
    was, now = (hashlib.sha256(text.encode()).hexdigest() for text in (LAYOUT, moved.read_text()))
    assert (
        capsys.readouterr().err.strip()
        == "mjstack: outputs/demos/dataset has episodes of another configuration:"
        f" starts=sha256:{was}, expected sha256:{now}. Set job.folder to another folder, or these"
        " keys back."
    )
    assert contents(Path.cwd()) == before


@pytest.mark.full
def test_a_layout_that_only_the_term_names_counts_too(folder: Path) -> None:
    homes = set()
    for path, text in (("a.csv", LAYOUT), ("b.csv", LAYOUT), ("b.csv", LAYOUT + "\n")):
        Path(path).write_text(text)
        homes.add(
            collect_folder(
                load_config(
                    ["job=collect", "reset=starts_file", f"reset.starts.params.path={path}"]
                )
            )
        )
    assert len(homes) == 2


@pytest.mark.full
def test_failures_are_kept_and_marked(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def break_two(seed: int, values: torch.Tensor) -> None:
        values[3, 2:3] = torch.nan  # a world that diverged: of no use

    monkeypatch.setattr(
        collection,
        "play_demonstrations",
        fake_demonstrations(lambda seed, world: world in (1, 2), break_two),
    )
    assert collect("nworld=4", "job.episodes=5", "job.keep_failures=true") == 0
    rows = episodes_of(folder / "dataset")
    assert [(row["seed"], row["world"], row["success"]) for row in rows] == [
        (0, 0, True),
        (0, 1, False),
        (0, 3, True),
        (1, 0, True),
        (1, 1, False),
    ]
    assert [row["failed_rules"] for row in rows] == ["", "red not lifted", "", "", "red not lifted"]
    details = report_of(folder)["gates"][0]["details"]
    assert any(line.startswith("a number that is not finite: 1 of") for line in details)


@pytest.mark.full
def test_an_expert_that_never_succeeds_is_given_up(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        collection, "play_demonstrations", fake_demonstrations(lambda seed, world: True)
    )
    args = ["nworld=2", "job.episodes=3"]
    assert collect(*args) == 1
    (gate,) = report_of(folder)["gates"]
    assert gate["reason"].startswith(
        "3 seeds in a row brought no episode, the last because of: red not lifted in 2 of 2 worlds"
    )
    all_succeed(monkeypatch)
    assert collect(*args) == 0
    assert pairs(folder / "dataset") == [(3, 0), (3, 1), (4, 0)]
    assert report_of(folder)["gates"][0]["metrics"]["success_rate"] == pytest.approx(4 / 10)


@pytest.mark.full
@pytest.mark.parametrize("keep_failures", [False, True])
def test_worlds_of_which_none_is_finite_are_given_up(
    folder: Path, keep_failures: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def diverge(seed: int, values: torch.Tensor) -> None:
        values[3] = torch.nan

    monkeypatch.setattr(
        collection, "play_demonstrations", fake_demonstrations(lambda seed, world: False, diverge)
    )
    assert collect("nworld=2", "job.episodes=3", f"job.keep_failures={keep_failures}") == 1
    (gate,) = report_of(folder)["gates"]
    assert gate["reason"].startswith(
        "3 seeds in a row brought no episode, the last because of: a number that is not finite in 2"
        " of 2 worlds"
    )
    assert gate["metrics"]["episodes"] == 0


@pytest.mark.full
def test_ctrl_c_keeps_finished_batches(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stop(seed: int, values: torch.Tensor) -> None:
        if seed == 1:
            raise KeyboardInterrupt

    args = ["nworld=2", "job.episodes=5"]
    monkeypatch.setattr(
        collection, "play_demonstrations", fake_demonstrations(lambda seed, world: False, stop)
    )
    assert collect(*args) == 130
    assert pairs(folder / "dataset") == [(0, 0), (0, 1)]
    found = report_of(folder)
    assert found["status"] == "interrupted"
    assert found["gates"][0]["reason"].startswith("interrupted; 2 episodes, 5 asked for")
    all_succeed(monkeypatch)
    assert collect(*args) == 0
    assert pairs(folder / "dataset") == [(0, 0), (0, 1), (1, 0), (1, 1), (2, 0)]


@pytest.mark.full
def test_a_full_disk_is_one_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    add = PartWriter.write

    def full(self: PartWriter, *args: object) -> None:
        if "000001" in self.part.path.name and len(self.part.rows) == 1:
            raise OSError(28, "No space left on device")
        add(self, *args)  # type: ignore[arg-type]

    args = ["nworld=2", "job.episodes=5"]
    all_succeed(monkeypatch)
    monkeypatch.setattr(PartWriter, "write", full)
    assert collect(*args) == 1
    err = capsys.readouterr().err.strip()
    assert len(err.splitlines()) == 1
    assert "No space left on device" in err
    assert "2 committed episodes are kept" in err
    assert pairs(folder / "dataset") == [(0, 0), (0, 1)]
    assert report_of(folder)["status"] == "fail"
    monkeypatch.setattr(PartWriter, "write", add)
    assert collect(*args) == 0
    assert pairs(folder / "dataset") == [(0, 0), (0, 1), (1, 0), (1, 1), (2, 0)]


@pytest.mark.full
def test_a_full_device_is_one_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: object) -> None:
        raise RuntimeError("CUDA out of memory. Tried to allocate 9 GiB")

    monkeypatch.setattr(collection, "play_demonstrations", full)
    assert collect("nworld=2", "job.episodes=2") == 1
    err = capsys.readouterr().err.strip()
    assert err.startswith("mjstack: out of memory (")
    assert len(err.splitlines()) == 1
    assert report_of(folder)["status"] == "fail"


@pytest.mark.full
def test_brackets_in_names_are_printed(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    all_succeed(monkeypatch)
    own = ("robot.title='Arm [/b]'", "job.folder='outputs/[b]'")
    assert collect("nworld=2", "job.episodes=2", *own) == 0
    out = capsys.readouterr().out
    assert "Arm [/b], " in out
    assert "dataset: outputs/[b]/dataset, described in " in out


@pytest.mark.full
def test_a_kill_in_the_middle_of_a_batch(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Killed when the batch's first data file is committed and an episode of the second one is on
    the disk.
    """
    kill = """
import os, signal
from functools import partial
from mjstack.cli import run
from mjstack.datasets.part import PartWriter
from mjstack.jobs import collection
from stubs import fake_demonstrations

collection.play_demonstrations = fake_demonstrations(lambda seed, world: world == 1, noise=True)
collection.DatasetWriter = partial(collection.DatasetWriter, file_mb=1)
add = PartWriter.write

def killed(self, *args):
    add(self, *args)
    if "000001" in self.part.path.name:
        os.kill(os.getpid(), signal.SIGKILL)

PartWriter.write = killed
run(ARGS)
"""
    args = ["nworld=7", "job.episodes=8"]
    program = f"ARGS = {[*COMMAND, *args]!r}\n{kill}"
    found = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(
            [str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]
        ),
    }
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=120, env=found
    )
    assert done.returncode == -signal.SIGKILL, done.stderr
    left = contents(folder / "dataset" / "data")
    before = {name: data for name, data in left.items() if "/." not in name}
    assert len(before) == 1 < len(left)
    whole = [(0, 0), *((0, world) for world in range(2, 7)), (1, 0), (1, 2)]
    kept = len(pairs(folder / "dataset"))
    assert 2 <= kept < 6
    assert pairs(folder / "dataset") == whole[:kept]
    assert report_of(folder)["status"] == "interrupted"
    (folder / ".hydra" / "config.yaml").write_text(
        ""
    )  # and so would be left by a kill a little later, in a second call
    monkeypatch.setattr(
        collection,
        "play_demonstrations",
        fake_demonstrations(lambda seed, world: world == 1, noise=True),
    )
    assert run([*COMMAND, *args]) == 0
    assert pairs(folder / "dataset") == whole
    assert before.items() <= contents(folder / "dataset" / "data").items()
    check_dataset(folder / "dataset")
    batches = json.loads((folder / FILE).read_text())
    assert [(batch["worlds"], batch["succeeded"], batch["kept"]) for batch in batches] == [
        (7, 6, 6),
        (3, 2, 2),
    ]
    assert report_of(folder)["gates"][0]["metrics"]["succeeded"] == 8


@pytest.mark.full
def test_damaged_notes_are_one_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    all_succeed(monkeypatch)
    assert collect("nworld=2", "job.episodes=1") == 0
    (folder / FILE).write_text("[{]")
    capsys.readouterr()
    assert run([*COMMAND, "nworld=2", "job.episodes=2"]) == 2
    assert f"{FILE}: cannot be read (JSONDecodeError: " in capsys.readouterr().err


@pytest.mark.full
def test_the_buffer_bounds_the_worlds() -> None:
    cfg = load_config([*COMMAND, "nworld=100"])
    context = RunContext(cfg)
    env = build_env(demonstration_config(cfg), nworld=1, backend=Backend.native, device="cpu")
    world = 4 * 600 * (6 + 24 + 46 + 6 + 1)  # bytes: state, both groups, action, reward
    for worlds in (1, 3, 7):
        cfg.job.buffer_gib = (worlds + 0.5) * world / 2**30  # type: ignore[attr-defined]
        assert CollectPlan.of(context, Path(), env).most == worlds
    cfg.job.buffer_gib = 1.0  # type: ignore[attr-defined]
    assert CollectPlan.of(context, Path(), env).most == 100
    cfg.job.buffer_gib = 0.9 * world / 2**30  # type: ignore[attr-defined]
    with pytest.raises(ConfigError, match=r"job.buffer_gib"):
        CollectPlan.of(context, Path(), env)
    env.close()


def test_steps_come_to_the_host_in_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    values = torch.randn(5, 7, 4)
    steps = cast(StepRecorder, SimpleNamespace(values=values, schema={"a": 3, "b": 1}))
    none = np.zeros(7, dtype=np.int32)
    played = Played(seed=0, steps=steps, failed=none, retries=none, worlds=range(len(none)))
    for size in (1, 2 * 5 * 4 * 4, 10**6):  # one world, two and all at once
        monkeypatch.setattr("mjstack.jobs.demonstration._CHUNK_BYTES", size)
        found = dict(played.episodes([6, 0, 3]))
        assert list(found) == [6, 0, 3]
        for world, arrays in found.items():
            assert np.array_equal(arrays["a"], values[:, world, :3].numpy())
            assert np.array_equal(arrays["b"], values[:, world, 3:].numpy())


@pytest.mark.full
def test_mjwarp_demonstrations(folder: Path) -> None:
    """Their steps are nearly those of the same worlds on native MuJoCo."""
    args = ["nworld=1", "job.episodes=1", "job.keep_failures=true", *one_second_episode()]
    assert collect(*args, "sim=mjwarp", "sim.device=cpu", "job.folder=warp") == 0
    assert collect(*args) == 0
    check_dataset(Path("warp/dataset"))
    found = steps_of(Path("warp/dataset"), 0)
    expected = steps_of(folder / "dataset", 0)
    for name in ("observation.state", "action"):
        assert np.ptp(expected[name], axis=0).max() > 0.5
        assert np.abs(found[name] - expected[name]).max() < 1e-2, name


@pytest.mark.full
@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")
def test_demonstrations_on_cuda(folder: Path) -> None:
    """Captured steps are the eager ones, as far as two runs on CUDA agree, and the last step is one
    of rest on the stack.
    """
    short = ["job.episodes=8", "nworld=16", "sim=mjwarp", "sim.device=cuda:0"]
    assert run([*COMMAND, *short, "graph=require"]) == 0
    assert run(["job=collect", "job.folder=outputs/eager", *short, "graph=off"]) == 0
    captured = folder / "dataset"
    eager = folder.parent / "eager" / "dataset"
    assert len(episodes_of(captured)) == 8
    both = sorted(set(pairs(captured)) & set(pairs(eager)))
    assert len(both) >= 6
    for pair in both:
        a, b = (steps_of(dataset, pairs(dataset).index(pair)) for dataset in (captured, eager))
        for name in ("observation.state", "action", "observation.policy"):
            assert np.allclose(a[name][:100], b[name][:100], atol=2e-3), name
        assert a["next.success"][-1]
    check_dataset(captured)
