"""Demonstrations of the expert: what a step holds, which episodes count, and that nothing
is lost or there twice.
"""

import contextlib
import hashlib
import json
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from compositions import load_config, put
from dataset_checker import check_dataset, contents
from environments import Capture, Patch, Refused, at_double_speed, on_cuda, report_of, two_starts
from stubs import episodes_of, fake_batches, pairs

from mjstack.cli import run
from mjstack.config.fingerprint import config_hash, differences
from mjstack.config.schema import Backend, Config
from mjstack.datasets.spec import INDICES, DatasetSpec, Feature
from mjstack.datasets.writer import DatasetWriter
from mjstack.envs import Env, build_env, demonstration_config
from mjstack.episodes.batches import Batch, BatchPlan
from mjstack.episodes.recorder import Channels, Recorder, read_commands
from mjstack.episodes.rollout import Episode
from mjstack.episodes.stage import Stage
from mjstack.errors import ConfigError
from mjstack.jobs import CheckedJob
from mjstack.jobs import collect as job
from mjstack.jobs.collect import run_collect
from mjstack.jobs.collect_episodes import EpisodeSource
from mjstack.jobs.collect_plan import (
    BATCHES,
    CollectPlan,
    collect_folder,
    episode_config,
    make_spec,
    plan_collection,
)
from mjstack.managers.episode import required_fields
from mjstack.robots.units import LerobotUnits
from mjstack.sim import make_simulation

COMMAND = ["job=collect", "sim=native", "job.folder=outputs/demos"]
JOINTS = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper"]
STEPS = 300  # of a demonstration at double speed


def steps_of(dataset: Path, number: int) -> dict[str, np.ndarray]:
    table = pq.read_table(dataset / "data", filters=[("episode_index", "==", number)])
    return {name: np.array(table[name].to_pylist()) for name in table.column_names}


def gate_episode(cfg: Config) -> SimpleNamespace:
    """The same worlds as a gate plays them: result and commands."""
    stage = Stage(cfg)
    sim = make_simulation(
        stage.model, cfg, cfg.nworld, backend=Backend.native, fields=required_fields(cfg.reset)
    )
    try:
        recorder = Recorder(Channels(read_commands))
        episode = stage.play(sim, cfg.reset, [recorder])
        return SimpleNamespace(result=episode.result, commands=recorder.rows["ctrl"])
    finally:
        sim.close()


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """Four real episodes. The stacks' offsets are 0.4, 0.7, 1.2 and 1.0 mm: by the threshold two of
    them fail, and are kept.
    """
    folder = tmp_path_factory.mktemp("collect")
    args = [*COMMAND, "nworld=4", "job.episodes=4", "job.keep_failures=true", *at_double_speed()]
    args.append("task.check.xy_err=0.0009")
    with contextlib.chdir(folder):
        code = run(args)
    home = folder / "outputs" / "demos"
    cfg = load_config(args)
    paths = {"cwd": folder, "home": home, "dataset": home / "dataset"}
    return SimpleNamespace(code=code, args=args, cfg=cfg, judged=gate_episode(cfg), **paths)


def native_env(cfg: Config, nworld: int = 1) -> contextlib.closing[Env]:
    """The environment in which demonstrations are recorded, until the end of a block."""
    cfg = demonstration_config(cfg)
    return contextlib.closing(build_env(cfg, nworld=nworld, backend=Backend.native, device="cpu"))


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
    joints = [f"{name}.pos" for name in JOINTS]
    assert features["observation.state"]["names"] == features["action"]["names"] == joints
    assert units["observation.state"] == units["action"] == ["rad"] * 6
    policy, privileged = (
        dict(zip(features[key]["names"], units[key], strict=True))
        for key in ("observation.policy", "observation.privileged")
    )
    assert len(policy) == 24
    expected = {"joint_pos.0": "rad", "last_action.5": "rad", "joint_vel.3": "10 rad/s"}
    assert policy.items() >= (expected | {"grasp_point_to_red.2": "m"}).items()
    expected = {"red_pose.2": "m", "red_pose.3": "1", "jaw_force.1": "10 N"}
    expected |= {"red_velocity.0": "m/s", "red_velocity.5": "rad/s"}
    assert privileged.items() >= expected.items()
    assert {"next.reward", "next.done", "next.success", "timestamp"} <= set(features)
    stored = config_hash(info["mjstack"]["provenance"][0]["config"])
    assert stored == info["mjstack"]["config_sha256"] == config_hash(episode_config(demos.cfg))


@pytest.mark.full
@pytest.mark.parametrize(("robot", "task"), [("so101", "box"), ("rebot", "stack")])
def test_every_number_has_a_name_and_a_unit(robot: str, task: str) -> None:
    cfg = load_config([*COMMAND, f"robot={robot}", f"task={task}"])
    with native_env(cfg) as env:
        spec = make_spec(env, cfg, {})
    for group, dim in env.observation_manager.group_dims.items():
        assert spec.features[f"observation.{group}"].dim == dim
        assert "unknown" not in spec.features[f"observation.{group}"].units
    fingers = {"so101": ["rad"], "rebot": ["m", "m"]}[robot]
    assert list(spec.features["action"].units) == ["rad"] * len(cfg.robot.arm_joints) + fingers


@pytest.mark.full
def test_names_of_a_history_and_of_a_strange_term() -> None:
    history = "+observation.policy.terms.grasp_point_to_red.history=2"
    strange = "+observation.policy.terms.count={func: mjstack.mdp.reward.success}"
    cfg = load_config([*COMMAND, history, strange])
    with native_env(cfg) as env:
        feature: Feature = make_spec(env, cfg, {}).features["observation.policy"]
    first = feature.names.index("grasp_point_to_red.0.t-1")
    names = [f"grasp_point_to_red.{end}" for end in ("0.t-1", "1.t-1", "2.t-1", "0")]
    assert list(feature.names[first : first + 4]) == names
    assert feature.units[feature.names.index("count")] == "unknown"


@pytest.mark.full
def test_lerobot_units_are_those_of_the_real_arm(demos: SimpleNamespace) -> None:
    """The same episodes in degrees and 0 to 100, in the columns of a follower's recordings."""
    with contextlib.chdir(demos.cwd):
        args = [*demos.args, "job.units=lerobot", "job.folder=outputs/degrees"]
        assert run([arg for arg in args if arg != COMMAND[2]]) == 0
    dataset = demos.cwd / "outputs" / "degrees" / "dataset"
    info = json.loads((dataset / "meta" / "info.json").read_text())
    names = [f"{joint}.pos" for joint in JOINTS]
    assert info["robot_type"] == "so_follower"
    assert set(info["features"]) == {"observation.state", "action", *INDICES}
    assert info["features"]["action"]["names"] == names
    assert info["mjstack"]["units"]["action"] == ["deg"] * 5 + ["%"]
    low, high = np.array(Stage(demos.cfg).index.servo_range).T
    units = LerobotUnits(5, np.stack([low, high], 1))
    for number in range(4):
        si, degrees = steps_of(demos.dataset, number), steps_of(dataset, number)
        for name in ("observation.state", "action"):
            wanted = np.rad2deg(si[name] - 0.5 * (low + high))
            wanted[:, 5] = 100.0 * (si[name][:, 5] - low[5]) / (high[5] - low[5])
            assert np.allclose(degrees[name], wanted, rtol=0, atol=1e-4)
            assert np.allclose(units.to_si(degrees[name]), si[name], rtol=0, atol=3e-7)


def test_ends_and_middles_of_lerobots_units() -> None:
    cfg = load_config([])
    ranges = np.array(Stage(cfg).index.servo_range)
    units = LerobotUnits(len(cfg.robot.arm_joints), ranges)
    half = np.rad2deg(0.5 * (ranges[:5, 1] - ranges[:5, 0]))
    for values, arm, gripper in (
        (ranges[:, 0], -half, 0.0),
        (ranges.mean(1), 0.0 * half, 50.0),
        (ranges[:, 1], half, 100.0),
    ):
        given = units.from_si(values)
        assert np.allclose(given, [*arm, gripper], atol=1e-5)
        assert given.dtype == np.float32
    draws = np.random.default_rng(0).uniform(*ranges.T, (10_000, 6)).astype(np.float32)
    assert np.abs(units.to_si(units.from_si(draws)) - draws).max() <= 2.4e-7  # an ulp of 2 to 4


def test_actions_are_what_the_gates_command(demos: SimpleNamespace) -> None:
    """And they are what went to the actuators: the same episode in the gates' own loop."""
    commands = demos.judged.commands.transpose(0, 1).numpy()
    for number, row in enumerate(episodes_of(demos.dataset)):
        action = steps_of(demos.dataset, number)["action"].astype(np.float32)
        assert np.array_equal(action, commands[row["world"]])


def test_success_is_the_evidence(demos: SimpleNamespace) -> None:
    failed = demos.judged.result.failed.numpy()
    assert 0 < (failed == 0).sum() < 4  # some of each, or nothing is shown
    rows = episodes_of(demos.dataset)
    assert [row["world"] for row in rows] == [0, 1, 2, 3]
    for number, row in enumerate(rows):
        success = bool(failed[row["world"]] == 0)
        steps = steps_of(demos.dataset, number)
        assert row["success"] == success
        assert (row["failed_rules"] == "") == success
        assert steps["next.success"].tolist() == [False] * (STEPS - 1) + [success]
        assert steps["next.done"].tolist() == [False] * (STEPS - 1) + [True]
        assert steps["timestamp"] == pytest.approx(np.arange(STEPS) / 50.0)
        assert (row["seed"], row["length"]) == (0, STEPS)
        assert row["config_sha256"] == config_hash(episode_config(demos.cfg))


@pytest.mark.full
def test_a_step_is_the_state_before_its_action(demos: SimpleNamespace) -> None:
    """The actions, played in the environment, bring the same observations before and the same
    rewards after each of them.
    """
    episodes = [steps_of(demos.dataset, number) for number in range(4)]

    def stored(name: str, step: int) -> torch.Tensor:
        rows = [episode[name][step] for episode in episodes]
        return torch.from_numpy(np.stack(rows).astype(np.float32))

    with native_env(demos.cfg, 4) as env:
        obs, _ = env.reset(seed=0)
        env.sim.forward()
        robot = env.index.on(env.device, env.sim.qpos.dtype)
        for step in range(STEPS):
            values = obs | {"state": robot.qpos.read(env.sim.qpos).float()}
            for name in ("state", "policy", "privileged"):
                assert torch.equal(stored(f"observation.{name}", step), values[name]), (name, step)
            obs, reward, terminated, truncated, _ = env.step(stored("action", step))
            assert not (terminated | truncated).any()
            assert torch.equal(stored("next.reward", step), reward), step
    assert np.ptp([episode["next.reward"].sum() for episode in episodes]) > 0.0


def test_what_is_left_beside_the_dataset(demos: SimpleNamespace) -> None:
    (gate,) = report_of(demos.home)["gates"]
    metrics = gate["metrics"]
    succeeded = int((demos.judged.result.failed == 0).sum())
    expected = {"episodes": 4, "steps": 4 * STEPS, "succeeded": succeeded, "worlds_played": 4}
    assert metrics.items() >= expected.items()
    assert metrics["success_rate_low95"] < metrics["success_rate"] < metrics["success_rate_high95"]
    assert metrics["episodes_per_s"] > 0.0
    size = sum(map(len, contents(demos.dataset).values()))
    assert metrics["megabytes"] == pytest.approx(size / 1e6)
    assert f"not stacked: {4 - succeeded} of 4 worlds" in "\n".join(gate["details"])


@pytest.mark.full
def test_the_same_command_again_does_nothing(demos: SimpleNamespace, monkeypatch: Patch) -> None:
    monkeypatch.chdir(demos.cwd)

    def none(stage: Stage, plans: Iterable[BatchPlan], *_: object, **__: object) -> Iterator[Batch]:
        assert not list(plans)
        yield from ()

    monkeypatch.setattr(job, "play_batches", none)
    before = contents(demos.dataset / "data")
    assert run(demos.args) == 0
    assert contents(demos.dataset / "data") == before
    reason = report_of(demos.home)["gates"][0]["reason"]
    assert "4 episodes, 4 asked for" in reason
    assert reason.endswith("; they were there already")


OTHER_EPISODES = "mjstack: outputs/demos/dataset has episodes of another configuration: "
SET_BACK = " Set job.folder to another folder, or these keys back."


@pytest.mark.full
@pytest.mark.parametrize(
    ("changes", "keys"),
    [
        (
            ["job.episodes=5", "reward.progress.weight=2.5"],
            "reward.progress.weight=5.0, expected 2.5.",
        ),
        (["reset=jitter"], r"reset\.[\w.]+=.*, expected .*, and \d+ more keys\."),
    ],
    ids=["one key", "many keys"],
)
def test_another_configuration_is_refused(
    demos: SimpleNamespace,
    changes: list[str],
    keys: str,
    monkeypatch: Patch,
    error_line: Callable[[], str],
) -> None:
    monkeypatch.chdir(demos.cwd)
    before = contents(demos.cwd)
    assert run([*demos.args, *changes]) == 2
    assert re.fullmatch(OTHER_EPISODES + keys + SET_BACK, error_line())
    assert contents(demos.cwd) == before


@pytest.mark.full
def test_a_dataset_that_is_being_written_is_refused(
    demos: SimpleNamespace, monkeypatch: Patch, error_line: Callable[[], str]
) -> None:
    monkeypatch.chdir(demos.cwd)
    with native_env(demos.cfg) as env:
        spec = make_spec(env, demos.cfg, {"config": episode_config(demos.cfg)})
    with DatasetWriter(demos.dataset, spec):
        assert run([*demos.args, "job.episodes=5"]) == 2
    assert "is open in another writer" in error_line()


JOINT_POS = "{func: mjstack.mdp.observation.joint_pos}"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: Patch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path / "outputs" / "demos"


@pytest.mark.full
@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["reset=nominal"], "reset=[home]: expected starts that differ"),
        (["task=reach", "task.check=null"], "task=reach"),
        ([f"+observation.state={{terms: {{q: {JOINT_POS}}}}}"], "observation.state=a group"),
        (["job.folder=taken"], "taken cannot be written"),
        (
            ["cameras=[front]", "scene.cameras.front.size=[33,32]"],
            "scene.cameras.front.size=[33, 32]: expected even numbers",
        ),
    ],
)
def test_bad_input_is_one_line(args: list[str], words: str, folder: Path, refused: Refused) -> None:
    Path("taken").write_text("")
    assert words in refused(*COMMAND, *args)


@pytest.mark.full
def test_what_the_hash_is_of() -> None:
    def home(*values: str, choices: Sequence[str] = ()) -> Path:
        return collect_folder(put(load_config(["job=collect", "sim=native", *choices]), *values))

    base = home()
    assert base.parent == Path("outputs/collect")
    same = "job.episodes=7 nworld=3 gates=[batch] batch.njmax=300 job.buffer_gib=1"
    assert home(*same.split(), "gate.throughput.steps=3", "gate.success.seeds=2") == base
    assert home(choices=["~termination.success", "graph=off"]) == base
    values = """seed=1 observation.policy.noise=false reward.progress.weight=3
        task.check.xy_err=0.01 job.keep_failures=true controller.phases.done.seconds=2.0"""
    folders = {home(choices=[group]) for group in ("robot=rebot", "reset=jitter")}
    folders |= {home(value) for value in values.split()}
    assert len({base, *folders}) == 1 + 2 + 6
    on_cpu = collect_folder(load_config(["job=collect", "sim=mjwarp", "sim.device=cpu"]))
    assert on_cpu != base  # backends change episodes in their last digits; the device is no matter


@pytest.mark.parametrize(
    ("stored", "current", "expected"),
    [
        ({"b": 1, "c": [1]}, {"b": 1, "c": [2]}, "a.c=[1], expected [2]"),
        ({"b": True, "c": 2}, {"b": None, "c": 3}, "a.b=True, expected None; a.c=2, expected 3"),
        ({"c": {"e": 2}}, {"d": 3}, "a.c.e=2, expected none; a.d=missing, expected 3"),
    ],
)
def test_differences(stored: dict, current: dict, expected: str) -> None:
    assert differences({"a": current}, {"a": current}) == ""
    assert differences({"a": stored}, {"a": current}) == expected


Fails = Callable[[int, int], bool]
PlayNothing = Callable[..., None]


@pytest.fixture
def play_nothing(monkeypatch: Patch) -> PlayNothing:
    """Batches that nobody plays: every world succeeds, unless it *fails*."""

    def use(fails: Fails = lambda seed, world: False, *args: Any, **options: bool) -> None:
        monkeypatch.setattr(job, "play_batches", fake_batches(fails, *args, **options))

    return use


def batches_of(folder: Path) -> list[tuple[int, int, int]]:
    """Worlds, successes and episodes of every batch."""
    batches = json.loads((folder / BATCHES).read_text())
    return [(batch["worlds"], batch["succeeded"], batch["episodes"]) for batch in batches]


def collect(*overrides: str) -> int:
    """Runs the job as the command line does once it has checked everything, and returns its exit
    status.
    """
    cfg = load_config([*COMMAND, *overrides])
    home = collect_folder(cfg)
    home.mkdir(parents=True, exist_ok=True)
    stage = Stage(cfg)
    work = partial(run_collect, plan_collection(stage))
    return CheckedJob(stage=stage, title="collect", work=work).run(home).exit_code


@pytest.mark.full
def test_seeds_go_on_until_the_episodes_are_there(folder: Path, play_nothing: PlayNothing) -> None:
    play_nothing(lambda seed, world: world == 1)
    assert collect("nworld=4", "job.episodes=7", "seed=5") == 0
    first = [(5, 0), (5, 2), (5, 3), (6, 0), (6, 2), (6, 3), (7, 0)]
    # The missing episodes decide how many worlds play: 7, then 4, then 1 and one to spare.
    assert pairs(folder / "dataset") == first
    assert batches_of(folder) == [(4, 3, 3), (4, 3, 3), (2, 1, 1)]
    steps = steps_of(folder / "dataset", 5)
    assert steps["action"] == pytest.approx(1e-3 * 6 + 1e-6 * 3)
    # More are wanted: seed 8 is next, whatever nworld is.
    assert collect("nworld=16", "job.episodes=9", "seed=5") == 0
    assert pairs(folder / "dataset") == [*first, (8, 0), (8, 2)]
    assert not any(row["failed_rules"] for row in episodes_of(folder / "dataset"))
    expected = {"worlds_played": 13, "succeeded": 9, "episodes_of_this_call": 2}
    assert report_of(folder)["gates"][0]["metrics"].items() >= expected.items()
    check_dataset(folder / "dataset")


def write_two_starts(path: Path, red_x: float = 0.31) -> str:
    """A starts file of two worlds; returns its SHA-256."""
    np.savez(path, **two_starts(red_x))
    return hashlib.sha256(path.read_bytes()).hexdigest()


FROM_LAYOUT = [
    "reset=starts_file",
    "+reset.noise={func: mjstack.mdp.reset.JointNoise, params: {arm: 0.01}}",
    "nworld=2",
]


@pytest.mark.full
def test_a_layout_counts_by_its_content(
    folder: Path, play_nothing: PlayNothing, capsys: Capture
) -> None:
    play_nothing()
    first = Path("worlds.npz")
    moved = Path("elsewhere.npz")
    was = write_two_starts(first)
    assert collect(*FROM_LAYOUT, "starts=worlds.npz", "job.episodes=2") == 0
    first.rename(moved)
    assert collect(*FROM_LAYOUT, "starts=elsewhere.npz", "job.episodes=4") == 0
    assert pairs(folder / "dataset") == [(0, 0), (0, 1), (1, 0), (1, 1)]
    info = json.loads((folder / "dataset/meta/info.json").read_text())
    assert len(info["mjstack"]["provenance"]) == 1
    now = write_two_starts(moved, red_x=0.32)
    before = contents(Path.cwd())
    capsys.readouterr()
    assert run([*COMMAND, *FROM_LAYOUT, "starts=elsewhere.npz", "job.episodes=6"]) == 2
    keys = f"starts=sha256:{was}, expected sha256:{now}."
    assert capsys.readouterr().err.strip() == OTHER_EPISODES + keys + SET_BACK
    assert contents(Path.cwd()) == before


@pytest.mark.full
def test_failures_are_kept_and_marked(folder: Path, play_nothing: PlayNothing) -> None:
    def break_two(seed: int, values: torch.Tensor) -> None:
        values[3, 2:3] = torch.nan  # a world that diverged: of no use

    play_nothing(lambda seed, world: world in (1, 2), break_two)
    assert collect("nworld=4", "job.episodes=5", "job.keep_failures=true") == 0
    rows = episodes_of(folder / "dataset")
    assert pairs(folder / "dataset") == [(0, 0), (0, 1), (0, 3), (1, 0), (1, 1)]
    assert [row["success"] for row in rows] == [True, False, True, True, False]
    assert [row["failed_rules"] for row in rows] == ["", "red not lifted", "", "", "red not lifted"]
    details = report_of(folder)["gates"][0]["details"]
    assert any(line.startswith("a number that is not finite: 1 of") for line in details)


@pytest.mark.full
@pytest.mark.parametrize(
    ("finite", "keep_failures", "cause"),
    [
        (True, False, "red not lifted"),
        (False, False, "a number that is not finite"),
        (False, True, "a number that is not finite"),
    ],
)
def test_seeds_without_an_episode_are_given_up(
    folder: Path, finite: bool, keep_failures: bool, cause: str, play_nothing: PlayNothing
) -> None:
    def diverge(seed: int, values: torch.Tensor) -> None:
        values[3] = torch.nan

    play_nothing(lambda seed, world: finite, None if finite else diverge)
    args = ["nworld=2", "job.episodes=3", f"job.keep_failures={keep_failures}"]
    assert collect(*args) == 1
    (gate,) = report_of(folder)["gates"]
    reason = f"3 seeds in a row brought no episode, the last because of: {cause} in 2 of 2 worlds"
    assert gate["reason"].startswith(reason)
    assert gate["metrics"]["episodes"] == 0
    play_nothing()
    assert collect(*args) == 0
    assert pairs(folder / "dataset") == [(3, 0), (3, 1), (4, 0)]
    rate = 4 / 10 if finite else 1.0  # the check finds nothing wrong with the others
    assert report_of(folder)["gates"][0]["metrics"]["success_rate"] == pytest.approx(rate)


@pytest.mark.full
def test_a_full_device_is_one_line(
    folder: Path, monkeypatch: Patch, error_line: Callable[[], str]
) -> None:
    def full(*_: object, **__: object) -> None:
        raise RuntimeError("CUDA out of memory. Tried to allocate 9 GiB")

    monkeypatch.setattr(job, "play_batches", full)
    assert collect("nworld=2", "job.episodes=2") == 1
    assert error_line().startswith("mjstack: out of memory (")
    assert report_of(folder)["status"] == "fail"


@pytest.mark.full
def test_damaged_notes_are_one_line(
    folder: Path, play_nothing: PlayNothing, capsys: Capture
) -> None:
    play_nothing()
    assert collect("nworld=2", "job.episodes=1") == 0
    (folder / BATCHES).write_text("[{]")
    capsys.readouterr()
    assert run([*COMMAND, "nworld=2", "job.episodes=2"]) == 2
    assert f"{BATCHES}: cannot be read (JSONDecodeError: " in capsys.readouterr().err


@pytest.mark.full
def test_the_buffer_bounds_the_worlds() -> None:
    cfg = load_config([*COMMAND, "nworld=100"])
    stage = Stage(cfg)
    world = 4 * 600 * (6 + 24 + 46 + 6 + 1)  # bytes: state, both groups, action, reward
    with native_env(cfg) as env:
        for buffer, worlds in ((1.5, 1), (3.5, 3), (7.5, 7), (2**30 / world, 100)):
            cfg.job.buffer_gib = buffer * world / 2**30  # type: ignore[attr-defined]
            assert CollectPlan.from_stage(stage, Path(), env).most == worlds
        cfg.job.buffer_gib = 0.9 * world / 2**30  # type: ignore[attr-defined]
        with pytest.raises(ConfigError, match=r"job.buffer_gib"):
            CollectPlan.from_stage(stage, Path(), env)


def test_steps_come_to_the_host_in_chunks(monkeypatch: Patch) -> None:
    stage = Stage(load_config(COMMAND))
    rows = {"observation.state": torch.randn(6, 7, 3), "action": torch.randn(5, 7, 1)}
    spec = SimpleNamespace(config_sha256="", features=rows)
    source = EpisodeSource(stage, cast(DatasetSpec, spec), Path())
    plan = BatchPlan(0, range(7))
    results = SimpleNamespace(failed=np.zeros(7, np.int32), retries=np.zeros(7, np.int32))
    batch = Batch(plan, cast(Env, None), cast(Episode, results), rows)
    for size in (1, 2 * (6 * 3 + 5) * 4, 10**6):  # one world, two and all at once
        monkeypatch.setattr("mjstack.jobs.collect_episodes._CHUNK_BYTES", size)
        episodes = list(source.episodes(batch, [6, 0, 3]))
        assert [episode.row["world"] for episode in episodes] == [6, 0, 3]
        for episode in episodes:
            for name, values in rows.items():
                assert np.array_equal(
                    episode.arrays[name], values[:5, episode.row["world"]].numpy()
                )


@pytest.mark.full
@on_cuda
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
    shared_pairs = sorted(set(pairs(captured)) & set(pairs(eager)))
    assert len(shared_pairs) >= 6
    for pair in shared_pairs:
        a, b = (steps_of(dataset, pairs(dataset).index(pair)) for dataset in (captured, eager))
        for name in ("observation.state", "action", "observation.policy"):
            assert np.allclose(a[name][:100], b[name][:100], atol=2e-3), name
        assert a["next.success"][-1]
    check_dataset(captured)
