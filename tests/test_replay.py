"""Job replay: a world of an earlier run does alone what it did among others, and every rule is
explained.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from check_cases import rules_of
from compositions import load_config, put
from environments import at_double_speed, has_gl, one_second_episode
from omegaconf import OmegaConf

from mjstack.cli import run
from mjstack.config.check import validate
from mjstack.config.load import load_saved
from mjstack.config.schema import Backend, TermCfg
from mjstack.episodes.context import RunContext
from mjstack.episodes.earlier_run import STEM, archive_starts, copy_names
from mjstack.episodes.record import EpisodeRecord
from mjstack.episodes.replay import _sizes_alone
from mjstack.episodes.rollout import snapshot
from mjstack.errors import MjstackError
from mjstack.jobs import check_job
from mjstack.jobs.replay import _compare
from mjstack.sim import BatchSizes

RULES = rules_of("stack")

FAILING = "0:2"
SUCCEEDED = "1:3"  # of the run below


@pytest.fixture(scope="module")
def earlier(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a native run of five worlds under two seeds, with a threshold so tight that
    some fail.
    """
    folder = tmp_path_factory.mktemp("earlier") / "run"
    args = [
        "gates=[batch]",
        "sim=native",
        "nworld=5",
        "gate.batch.seeds=2",
        "task.check.xy_err=0.00134",
        *at_double_speed(),
    ]
    assert run([*args, f"hydra.run.dir={folder}"]) == 1
    return folder


def replay_into(out: Path, folder: Path, *args: str) -> tuple[int, dict]:
    status = run(["job=replay", f"run={folder}", f"hydra.run.dir={out}", *args])
    return status, json.loads((out / "report.json").read_text())


@pytest.fixture(scope="module")
def failing(earlier: Path) -> tuple[Path, int, dict]:
    """The replay of a failing world: its folder, the exit status and the report."""
    out = earlier.parent / "failing"
    return out, *replay_into(out, earlier, f"world={FAILING}")


@pytest.fixture(scope="module")
def succeeded(earlier: Path) -> tuple[Path, int, dict]:
    """Likewise of an succeeded one, of the other seed."""
    out = earlier.parent / "succeeded"
    return out, *replay_into(out, earlier, f"world={SUCCEEDED}")


@pytest.fixture
def replay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[int, dict]]:
    """Replays with some arguments into ``out``; returns the exit status and the report."""
    monkeypatch.chdir(tmp_path)

    def do(folder: Path, *args: str) -> tuple[int, dict]:
        return replay_into(Path("out"), folder, *args)

    return do


def refusal(*values: str) -> str:
    """The line in which the job refuses a folder, before it writes anything."""
    cfg = put(load_config(["job=replay"]), *values)
    cfg.world = None if cfg.world is None else str(cfg.world)

    def check() -> None:
        validate(cfg)
        check_job(cfg, ["job=replay", *values])

    with pytest.raises(MjstackError) as caught:
        check()
    assert caught.value.exit_code == 2
    assert "\n" not in str(caught.value)
    return str(caught.value)


def record_of(folder: Path, seed: int) -> EpisodeRecord:
    record = EpisodeRecord.read(folder, seed)
    assert record is not None
    return record


def copy_of(folder: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(folder, tmp_path / "copy"))


def test_failing_world_fails_again_bit_for_bit(
    earlier: Path, failing: tuple[Path, int, dict]
) -> None:
    record = record_of(earlier, 0)
    assert record.failed[2] == RULES["STACKED"]
    out, status, report = failing
    assert status == 1
    assert report["status"] == "fail"
    (gate,) = report["gates"]
    assert (gate["name"], gate["status"]) == ("replay_native", "fail")
    assert (
        gate["reason"] == "failed: not stacked; as recorded, and it ends bit for bit where it did"
    )
    assert gate["metrics"]["xy_err_m"] == record.values["xy_err_m"][2]
    assert gate["thresholds"]["xy_err_m"] == 0.00134
    broken = [line for line in gate["details"] if "BROKEN" in line]
    assert len(broken) == 1
    assert broken[0].startswith("STACKED: BROKEN, not stacked: stacked_steps 0, xy_err_m ")
    assert f"xy_err_m {record.values['xy_err_m'][2]:.4g}, dz_m" in broken[0]
    assert broken[0].endswith("(wanted: at least 50)")
    assert len(gate["details"]) == len(RULES)
    with np.load(out / "trajectory.npz") as held:
        assert np.array_equal(held["qpos"][-1], record.qpos[2])
        assert (int(held["seed"]), int(held["world"]), int(held["failed"])) == (
            0,
            2,
            RULES["STACKED"],
        )
    assert sorted(path.name for path in (out).iterdir()) == [
        ".hydra",
        "episode.html",
        "replayed_config.yaml",
        "report.html",
        "report.json",
        "report.md",
        "run.log",
        *(["scene.png"] if has_gl() else []),
        "trajectories.png",
        "trajectory.npz",
    ]


@pytest.mark.full
def test_accepted_world_of_another_seed(earlier: Path, succeeded: tuple[Path, int, dict]) -> None:
    record = record_of(earlier, 1)
    assert record.failed[3] == 0
    out, status, report = succeeded
    assert status == 0
    (gate,) = report["gates"]
    assert gate["status"] == "pass"
    assert gate["reason"].endswith("; as recorded, and it ends bit for bit where it did")
    assert not [line for line in gate["details"] if "BROKEN" in line]
    with np.load(out / "trajectory.npz") as held:
        assert np.array_equal(held["qpos"][-1], record.qpos[3])


def test_trajectory_holds_the_episode(
    failing: tuple[Path, int, dict], new_context: Callable[..., RunContext]
) -> None:
    context = new_context("sim=native", "task.check.xy_err=0.00134", *at_double_speed())
    sim = context.batch_simulation(5)
    controller = context.driver(context.start(sim, context.cfg.reset))
    with np.load(failing[0] / "trajectory.npz") as held:
        assert np.array_equal(held["start_qpos"], snapshot(sim).qpos[2])
        assert not np.array_equal(held["start_qpos"], snapshot(sim).qpos[0])
        assert (held["start_qvel"] == 0.0).all()
        commands = np.stack([controller.command()[2].numpy() for _ in range(controller.steps)])
        assert np.allclose(held["ctrl"][:, context.index.ctrl], commands)
        assert held["time_s"][[0, -1]] == pytest.approx([0.02, 6.0])
        assert [str(held["phase"][i]) for i in (0, 29, 30, -1)] == [
            "above_red",
            "above_red",
            "descend_red",
            "done",
        ]
        red, blue = (held["qpos"][:, a : a + 3] for a in context.index.object_qpos)
        assert held["xy_err_m"] == pytest.approx(np.hypot(*(red - blue)[:, :2].T), abs=1e-6)
        assert held["dz_m"] == pytest.approx((red - blue)[:, 2], abs=1e-6)
        v = context.index.object_qvel[0]
        speed = np.linalg.norm(held["qvel"][:, v : v + 3], axis=1)
        speed += np.sqrt(3.0) * 0.022 * np.linalg.norm(held["qvel"][:, v + 3 : v + 6], axis=1)
        assert held["object_speed_m_per_s"][:, 0] == pytest.approx(speed, rel=1e-5, abs=1e-6)
        low = held["object_height_m"]
        assert abs(low[-1, 1]) < 0.001  # blue on the table,
        assert low[-1, 0] == pytest.approx(0.044, abs=0.001)  # red one cube above it
    sim.close()


@pytest.mark.full
def test_saved_configuration_is_the_runs_own(
    earlier: Path, succeeded: tuple[Path, int, dict]
) -> None:
    out, _, report = succeeded
    then = json.loads((earlier / "report.json").read_text())["provenance"]
    assert report["provenance"]["model_sha256"] == then["model_sha256"]
    loaded = load_saved(earlier / ".hydra" / "config.yaml")
    assert loaded == load_config(
        [
            "gates=[batch]",
            "sim=native",
            "nworld=5",
            "gate.batch.seeds=2",
            "task.check.xy_err=0.00134",
            *at_double_speed(),
        ]
    )
    played = OmegaConf.load(out / "replayed_config.yaml")
    assert (played.seed, played.task.check.xy_err) == (1, 0.00134)


@pytest.mark.full
def test_another_verdict_is_said(
    earlier: Path, replay: Callable[..., tuple[int, dict]], tmp_path: Path
) -> None:
    folder = copy_of(earlier, tmp_path)
    record = record_of(folder, 0)
    record.failed[0] = RULES["CARRY"]
    record.qpos[0, 14] += 0.002  # somewhere in blue's position
    record.write(folder)
    status, report = replay(folder, "world=0")
    (gate,) = report["gates"]
    differs = "NOT as recorded (red not carried): its objects end 2 mm from where they did, "
    assert gate["reason"].startswith("succeeded, ")
    assert gate["reason"].endswith(f"{differs}expected bit for bit there")
    assert gate["notes"]["recorded"] == "red not carried"
    assert (status, report["status"], gate["status"]) == (1, "fail", "fail")

    told = json.loads((folder / "report.json").read_text())
    told["provenance"]["versions"]["mujoco"] = "3.9.9"  # which promises nothing
    told["provenance"]["model_sha256"] = "0" * 64
    (folder / "report.json").write_text(json.dumps(told))
    status, report = replay_into(tmp_path / "other", folder, "world=0")
    (gate,) = report["gates"]
    assert gate["reason"].endswith(f"{differs}and not all is as it was in that run")
    assert any("mujoco was 3.9.9 in that run" in line for line in gate["details"])
    assert any("not the same as in that run" in line for line in gate["details"])
    assert (status, gate["status"]) == (0, "pass")


@pytest.mark.parametrize(
    ("bits", "moved", "device", "changes", "kept", "says"),
    [
        (0, 0.0, "cpu", [], True, "as recorded, and it ends bit for bit where it did"),
        (0, 0.0, "cpu", ["mujoco"], True, "as recorded, and it ends bit for bit where it did"),
        (
            0,
            1e-9,
            "cpu",
            [],
            False,
            (
                "NOT as recorded (the same result): its objects end 1e-06 mm from where they did,"
                " expected"
            ),
        ),
        (
            0,
            1e-9,
            "cpu",
            ["mujoco"],
            True,
            "as recorded, but its objects end 1e-06 mm from where they did, and not all is as",
        ),
        (
            0,
            1e-9,
            "cuda:0",
            [],
            True,
            "as recorded, but its objects end 1e-06 mm from where they did, and runs on CUDA agree",
        ),
        (
            RULES["CARRY"],
            0.0,
            "cpu",
            [],
            False,
            "NOT as recorded (red not carried): it ends bit for bit where it did",
        ),
        (
            RULES["CARRY"],
            0.002,
            "cpu",
            [],
            False,
            "NOT as recorded (red not carried): its objects end 2 mm from where they did",
        ),
        (
            RULES["CARRY"],
            0.002,
            "cuda:0",
            [],
            True,
            "NOT as recorded (red not carried): its objects end 2 mm",
        ),
        (
            RULES["OVERFLOW"],
            0.002,
            "cpu",
            [],
            True,
            "mm from where they did, and a world alone shares no contact pool",
        ),
    ],
)
def test_what_is_promised_of_another_end(
    bits: int,
    moved: float,
    device: str,
    changes: list[str],
    kept: bool,
    says: str,
    new_context: Callable[..., RunContext],
) -> None:
    """Bit for bit, but on CUDA, with other versions, and where the contact pool was too small."""
    context = new_context("sim=native")
    ours = np.zeros(context.model.nq)
    theirs = ours.copy()
    theirs[context.index.object_qpos[1]] = moved
    failed = np.array([0, int(bits)], np.int32)
    record = EpisodeRecord(
        seed=0,
        backend="mjwarp",
        device=device,
        failed=failed,
        values={},
        start=np.stack((ours, ours)),
        qpos=np.stack((ours, theirs)),
    )
    plan = SimpleNamespace(record=record, world=1, gate="batch")
    episode = SimpleNamespace(failed=np.zeros(1, dtype=np.int32))
    done = SimpleNamespace(episode=episode, recorder=SimpleNamespace(qpos=ours[None]))
    found = _compare(plan, done, Backend.mjwarp, device, changes, context)
    assert found[0] is kept
    assert says in found[1]


@pytest.mark.full
def test_a_start_that_is_not_the_recorded_one_is_refused(
    earlier: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Such as after random numbers have changed; a run of before schema 2 names none."""
    folder = copy_of(earlier, tmp_path)
    report = json.loads((folder / "report.json").read_text())
    assert report["provenance"].pop("starts_schema") == 2
    (folder / "report.json").write_text(json.dumps(report))
    record = record_of(folder, 1)
    assert record.start is not None
    record.start[3, 14] += 0.002
    record.write(folder)
    monkeypatch.chdir(tmp_path)
    assert run(["job=replay", f"run={folder}", f"world={SUCCEEDED}"]) == 2
    _refused(
        capsys,
        "world 3 of seed 1 would start up to 0.002 (m, rad) from where it did, expected its own"
        " start. Random starts are drawn otherwise now (schema 2, not 1). Use mjstack at",
    )
    assert [path.name for path in tmp_path.iterdir()] == ["copy"]


CARRY = """world,red_x_m,red_y_m,red_yaw_rad,blue_x_m,blue_y_m,blue_yaw_rad,red_mass_kg
0,0.33,-0.13,0,0.33,0.06,0,0.08
1,0.31,-0.1,0.3,0.34,0.08,-0.5,0.09
"""


@pytest.fixture(scope="module")
def from_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of both gates from a file and, beside it, random joints. The file is
    gone.
    """
    home = tmp_path_factory.mktemp("from_file")
    noise = ["+reset.noise.func=mjstack.mdp.reset.JointNoise", "+reset.noise.params.arm=0.01"]
    start = [
        "reset=starts_file",
        "starts=carry.csv",
        *noise,
        "nworld=2",
        "sim=native",
        "hydra.run.dir=run",
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(home)
        Path("carry.csv").write_text(CARRY)
        assert run(["gates=[batch,success]", *start, *one_second_episode()]) == 1
        Path("carry.csv").unlink()
    return home / "run"


@pytest.mark.full
@pytest.mark.parametrize("gate", ["batch", "success"])
def test_a_run_from_a_file_replays_from_its_own_copy(
    gate: str, from_file: Path, replay: Callable[..., tuple[int, dict]], tmp_path: Path
) -> None:
    assert (from_file / "starts_played.csv").read_text() == CARRY
    (tmp_path / "carry.csv").write_text(
        CARRY.replace("0.31", "0.32")
    )  # a file of that name where the replay is called
    _, report = replay(from_file, f"world={gate}:1")
    (found,) = report["gates"]
    assert found["reason"].endswith("as recorded, and it ends bit for bit where it did")
    with np.load(tmp_path / "out" / "trajectory.npz") as held:
        assert 0.31 in held["start_qpos"]
        assert held["field.body_mass"][-2:].tolist() == [0.09, 0.08]


@pytest.mark.full
@pytest.mark.parametrize(
    ("edit", "says"),
    [
        (
            lambda copy: copy.unlink(),
            (
                "has no starts_played.csv, expected a copy of the starts file that it started from,"
                " carry"
            ),
        ),
        (
            lambda copy: _replace(copy, "0.31", "0.315"),
            "would start up to 0.005 (m, rad) from where it did",
        ),
        (
            lambda copy: _replace(copy, "0.31", "left"),
            "starts_played.csv, line 3, column red_x_m: expected a finite number",
        ),
    ],
    ids=["lost", "edited", "damaged"],
)
def test_another_layout_is_refused(
    edit: Callable[[Path], None],
    says: str,
    from_file: Path,
    tmp_path: Path,
) -> None:
    folder = copy_of(from_file, tmp_path)
    edit(folder / "starts_played.csv")
    assert says in refusal(f"run={folder}", "world=batch:1")


@pytest.mark.full
def test_what_the_start_does_not_show_is_found_at_the_end(
    from_file: Path, replay: Callable[..., tuple[int, dict]], tmp_path: Path
) -> None:
    """Another mass."""
    folder = copy_of(from_file, tmp_path)
    _replace(folder / "starts_played.csv", "0.09", "0.1")
    status, report = replay(folder, "world=batch:1")
    assert "; NOT as recorded (the same result): its objects end " in report["gates"][0]["reason"]
    assert status == 1


@pytest.mark.full
def test_copies_of_layouts(tmp_path: Path) -> None:
    """Each file once, byte for byte."""
    folder = tmp_path / "run"
    folder.mkdir()
    own = tmp_path / "own.csv"
    own.write_bytes(b"own")
    (tmp_path / "a.csv").write_bytes(b"\xef\xbb\xbfworld\r\n")
    cfg = load_config(["reset=starts_file", f"starts={tmp_path}/a.csv"])
    cfg.reset["own"] = TermCfg(
        func="mjstack.mdp.starts.starts_file.FromStartsFile", params={"path": str(own)}
    )
    cfg.reset["again"] = TermCfg(
        func="mjstack.mdp.starts.starts_file.FromStartsFile",
        params={"path": str(own), "pose": "home"},
    )
    found = archive_starts(cfg, folder)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == {
        f"{STEM}.csv": b"\xef\xbb\xbfworld\r\n",
        f"{STEM}_2.csv": b"own",
    }
    read = [term.params["path"] for term in found.reset.values()]
    assert read == [str(folder / f"{STEM}{number}.csv") for number in ("", "_2", "_2")]
    assert found.reset["again"].params["pose"] == "home"
    assert (
        cfg.reset["starts"].params["path"] == f"{tmp_path}/a.csv"
    )  # what is saved and shown stays

    plain = load_config(["gates=[batch]"])
    assert archive_starts(plain, folder) == plain
    plain.gate.success.reset = dict(cfg.reset)
    assert not copy_names(plain)  # of a gate that does not run
    plain.gates = ["success"]
    assert list(copy_names(plain)) == [f"{tmp_path}/a.csv", str(own)]


@pytest.mark.full
def test_sim_native_plays_native_alone_and_randomized_fields_are_kept(
    replay: Callable[..., tuple[int, dict]], tmp_path: Path
) -> None:
    folder = tmp_path / "random"
    args = [
        "gates=[batch]",
        "sim=native",
        "nworld=3",
        "reset=randomized",
        *one_second_episode(),
    ]
    run([*args, f"hydra.run.dir={folder}"])
    _, report = replay(folder, "world=2", "sim=native")
    assert report["gates"][0]["reason"].endswith(
        "as recorded, and it ends bit for bit where it did"
    )
    with np.load(tmp_path / "out" / "trajectory.npz") as held:
        assert {"field.body_mass", "field.geom_friction"} <= set(held.files)
        assert not np.isclose(held["field.body_mass"][-2:], 0.08).any()  # scaled


@pytest.mark.full
def test_mjwarp_world_is_played_on_both_engines(
    replay: Callable[..., tuple[int, dict]], tmp_path: Path
) -> None:
    folder = tmp_path / "warp"
    args = [
        "gates=[batch]",
        "sim=mjwarp",
        "sim.device=cpu",
        "nworld=2",
        *one_second_episode(),
    ]
    assert run([*args, f"hydra.run.dir={folder}"]) == 1
    status, report = replay(folder, "world=1")
    assert status == 1
    warp, native = report["gates"]
    assert (warp["name"], native["name"]) == ("replay_mjwarp", "replay_native")
    assert warp["reason"].startswith("failed: red not carried; ")
    assert warp["reason"].endswith("; as recorded, and it ends bit for bit where it did")
    assert native["reason"].startswith("failed: red not carried; ")
    assert native["reason"].endswith("; that run's mjwarp world had the same result")
    with (
        np.load(tmp_path / "out" / "trajectory.npz") as ours,
        np.load(tmp_path / "out" / "trajectory_native.npz") as theirs,
    ):
        assert "Warp" in str(ours["backend"])
        assert np.abs(ours["start_qpos"] - theirs["start_qpos"]).max() < 1e-6
        assert np.abs(ours["object_pos_m"][-1] - theirs["object_pos_m"][-1]).max() < 0.002


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")
def test_cuda_world_ends_near_where_it_did(
    replay: Callable[..., tuple[int, dict]], tmp_path: Path
) -> None:
    folder = tmp_path / "cuda"
    assert (
        run(
            [
                "gates=[batch]",
                "sim=mjwarp",
                "sim.device=cuda:0",
                "nworld=64",
                f"hydra.run.dir={folder}",
            ]
        )
        == 0
    )
    record = record_of(folder, 0)
    status, report = replay(folder, "world=41")
    assert status == 0
    warp, _ = report["gates"]
    assert "as recorded" in warp["reason"]
    assert "NOT" not in warp["reason"]
    with np.load(tmp_path / "out" / "trajectory.npz") as held:
        assert np.abs(held["qpos"][-1] - record.qpos[41]).max() < 0.01


def test_a_world_alone_has_its_room() -> None:
    """A world may have taken more than its share of the pool, but never more than the pool."""
    small = BatchSizes(nconmax=20, njmax=100)
    assert _sizes_alone(small, 64) == BatchSizes(nconmax=80, njmax=100)
    assert _sizes_alone(small, 2) == BatchSizes(nconmax=40, njmax=100)
    pooled = BatchSizes(nconmax=20, njmax=100, naconmax=30, nccdmax=4)
    assert _sizes_alone(pooled, 64) == BatchSizes(nconmax=30, njmax=100)


WRONG = [
    ([], "run=null"),
    (["run={run}"], "world=null"),
    (["run=nowhere", "world=1"], "run=nowhere: has no .hydra/config.yaml"),
    (["run={run}", "world=7"], "a world from 0 to 4"),
    (["run={run}", "world=2:1"], "a seed from 0 to 1"),
    (["run={run}", "world=-1"], "world=-1"),
    (["run={run}", "world=1.5"], "world=1.5"),
    (
        ["run={run}", "world=1", "nworld=3"],
        "nworld=3: expected only run, world, sim, view, video, web",
    ),
    (["run={run}", "world=1", "sim.device=cuda:77"], "cuda:77"),
]


@pytest.mark.full
@pytest.mark.parametrize(("values", "says"), WRONG, ids=[" ".join(v) for v, _ in WRONG])
def test_values_that_name_no_world(values: list[str], says: str, earlier: Path) -> None:
    assert says in refusal(*(value.format(run=earlier) for value in values))


BAD = [
    (["run={run}", "world=7"], "a world from 0 to 4"),
    (
        ["run={run}", "world=1", "robot=rebot"],
        "robot=rebot: expected only run, world, sim, view, video, web",
    ),
    (["run={run}", "world=1", "~reset.cubes"], "reset.cubes"),
    (["run={run}", "world=1", "sim=native", "sim.device=cuda:0"], "cuda:0"),
]


@pytest.mark.full
@pytest.mark.parametrize(("args", "says"), BAD, ids=[" ".join(args) for args, _ in BAD])
def test_bad_input_is_one_line_and_writes_nothing(
    args: list[str],
    says: str,
    earlier: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(["job=replay", *(arg.format(run=earlier) for arg in args)]) == 2
    _refused(capsys, says)
    assert list(tmp_path.iterdir()) == []


def _refused(capsys: pytest.CaptureFixture[str], says: str) -> None:
    out, err = capsys.readouterr()
    assert err.startswith("mjstack: ")
    assert len(err.strip().splitlines()) == 1
    assert says in err
    assert "Traceback" not in out + err


DAMAGE = {
    "no report": (lambda f: (f / "report.json").unlink(), "has no report.json"),
    "no JSON": (lambda f: (f / "report.json").write_text("{"), "report.json: cannot be read"),
    "another report": (
        lambda f: (f / "report.json").write_text("[]"),
        "report.json: cannot be read",
    ),
    "no YAML": (
        lambda f: (f / ".hydra" / "config.yaml").write_text("a: [1"),
        "no configuration of this mjstack",
    ),
    "empty": (
        lambda f: (f / ".hydra" / "config.yaml").write_text(""),
        "no configuration of this mjstack",
    ),
    "another tool's": (
        lambda f: (f / ".hydra" / "config.yaml").write_text("model: resnet\n"),
        "no configuration of this mjstack",
    ),
    "a key too many": (lambda f: _append(f / ".hydra" / "config.yaml", "colour: red\n"), "colour"),
    "a value out of range": (
        lambda f: _replace(f / ".hydra" / "config.yaml", "nworld: 5", "nworld: 0"),
        "nworld=0",
    ),
    "a key too few": (
        lambda f: _replace(f / ".hydra" / "config.yaml", "nworld: 5\n", ""),
        "nworld is missing",
    ),
    "another nworld": (
        lambda f: _replace(f / ".hydra" / "config.yaml", "nworld: 5", "nworld: 4"),
        "a record of 5 worlds of seed 0, expected one of 4 worlds",
    ),
    "another job": (
        lambda f: _replace(f / ".hydra" / "config.yaml", "name: gates", "name: replay"),
        "job=replay",
    ),
    "a training": (  # has keys that no other job has
        lambda f: _replace(
            f / ".hydra" / "config.yaml", "name: gates", "name: train\n  trainer: null"
        ),
        "is a run of job=train, expected one of job=gates",
    ),
    "no record": (
        lambda f: (f / "worlds_seed0.npz").unlink(),
        "gate batch has left no record of seed 0",
    ),
    "record": (
        lambda f: (f / "worlds_seed0.npz").write_bytes(b"PK"),
        "worlds_seed0.npz: cannot be read",
    ),
}


def _append(path: Path, text: str) -> None:
    path.write_text(path.read_text() + text)


def _replace(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert text.count(old) == 1
    path.write_text(text.replace(old, new))


@pytest.mark.full
@pytest.mark.parametrize("name", DAMAGE)
def test_damaged_folder_is_one_line(name: str, earlier: Path, tmp_path: Path) -> None:
    folder = copy_of(earlier, tmp_path)
    damage, says = DAMAGE[name]
    damage(folder)
    assert says in refusal(f"run={folder}", "world=1")


@pytest.mark.full
@pytest.mark.parametrize("args", [["run=somewhere"], ["world=3"]])
def test_keys_of_replay_belong_to_replay(
    args: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(args) == 2
    _refused(capsys, "job=replay")
