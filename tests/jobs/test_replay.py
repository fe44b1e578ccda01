"""Job replay: a world of an earlier run does alone what it did among others, and every rule is
explained.
"""

import io
import json
import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from check_cases import rules_of
from compositions import load_config, put, refusal
from environments import (
    NewRun,
    Patch,
    at_double_speed,
    has_gl,
    on_cuda,
    one_second_episode,
    record_of,
    two_starts,
)
from omegaconf import OmegaConf

from mjstack.cli import run
from mjstack.config.check import validate
from mjstack.config.load import load_saved
from mjstack.config.schema import Backend, TermCfg
from mjstack.episodes.earlier_run import archive_starts
from mjstack.episodes.record import EpisodeRecord, record_name
from mjstack.episodes.rollout import snapshot
from mjstack.files import write_npz
from mjstack.jobs import check_job
from mjstack.jobs.replay import _compare
from mjstack.sim import BatchSizes

RULES = rules_of("stack")

EARLIER = ["gates=[batch]", "sim=native", "nworld=5", "gate.batch.seeds=2"]
EARLIER += ["task.check.xy_err=0.00134", *at_double_speed()]
FAILING = "0:2"
SUCCEEDED = "1:3"  # of the run below


@pytest.fixture(scope="module")
def earlier(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a native run of five worlds under two seeds, with a threshold so tight that
    some fail.
    """
    folder = tmp_path_factory.mktemp("earlier") / "run"
    assert run([*EARLIER, f"hydra.run.dir={folder}"]) == 1
    return folder


NO_PAGE = "web.episode=false"


def replay_into(out: Path, folder: Path, *args: str) -> tuple[int, dict]:
    status = run(["job=replay", f"run={folder}", f"hydra.run.dir={out}", *args])
    return status, json.loads((out / "report.json").read_text())


@pytest.fixture(scope="module")
def failing(earlier: Path) -> tuple[Path, int, dict]:
    """The replay of a failing world: its folder, the exit status and the report."""
    out = earlier.parent / "failing"
    return out, *replay_into(out, earlier, f"world={FAILING}")


def refusal_of(*values: str) -> str:
    """The line in which the job refuses a folder."""
    cfg = put(load_config(["job=replay"]), *values)
    cfg.world = None if cfg.world is None else str(cfg.world)
    return refusal(lambda: (validate(cfg), check_job(cfg, ["job=replay", *values])))


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
    as_recorded = "as recorded, and it ends bit for bit where it did"
    assert gate["reason"] == f"failed: not stacked (xy_err 0 of 50); {as_recorded}"
    assert gate["metrics"]["xy_err_m"] == record.values["xy_err_m"][2]
    assert gate["thresholds"]["xy_err_m"] == 0.00134
    broken = [line for line in gate["details"] if "BROKEN" in line]
    assert len(broken) == 1
    assert broken[0].startswith("STACKED: BROKEN, not stacked: stacked_steps 0, xy_err_m ")
    assert gate["beyond"] == ["stacked_steps.xy_err"]
    assert f"xy_err_m {record.values['xy_err_m'][2]:.4g}, dz_m" in broken[0]
    assert broken[0].endswith("(wanted: at least 50)")
    assert len(gate["details"]) == len(RULES)
    with np.load(out / "trajectory.npz") as held:
        assert np.array_equal(held["qpos"][-1], record.qpos[2])
        facts = [int(held[name]) for name in ("seed", "world", "failed")]
        assert facts == [0, 2, RULES["STACKED"]]
    names = ".hydra episode.html replayed_config.yaml report.html report.json report.md run.log"
    names += f"{' scene.png' if has_gl() else ''} trajectory.npz"
    assert sorted(path.name for path in out.iterdir()) == names.split()


@pytest.mark.full
def test_an_accepted_world_of_another_seed(earlier: Path, tmp_path: Path) -> None:
    """Its saved configuration is the run's, with that seed."""
    record = record_of(earlier, 1)
    assert record.failed[3] == 0
    status, report = replay_into(tmp_path / "out", earlier, f"world={SUCCEEDED}", NO_PAGE)
    assert status == 0
    (gate,) = report["gates"]
    assert gate["status"] == "pass"
    assert gate["reason"].endswith("; as recorded, and it ends bit for bit where it did")
    assert not [line for line in gate["details"] if "BROKEN" in line]
    with np.load(tmp_path / "out" / "trajectory.npz") as held:
        assert np.array_equal(held["qpos"][-1], record.qpos[3])
    recorded = json.loads((earlier / "report.json").read_text())["provenance"]
    assert report["provenance"]["model_sha256"] == recorded["model_sha256"]
    assert load_saved(earlier / ".hydra" / "config.yaml") == load_config(EARLIER)
    played = OmegaConf.load(tmp_path / "out" / "replayed_config.yaml")
    assert (played.seed, played.task.check.xy_err) == (1, 0.00134)


def test_trajectory_holds_the_episode(failing: tuple[Path, int, dict], new_run: NewRun) -> None:
    run = new_run("sim=native", "task.check.xy_err=0.00134", *at_double_speed())
    sim = run.stage.batch_simulation(5)
    controller = run.stage.driver(run.stage.start(sim, run.cfg.reset))
    with np.load(failing[0] / "trajectory.npz") as held:
        assert np.array_equal(held["start_qpos"], snapshot(sim).qpos[2])
        assert not np.array_equal(held["start_qpos"], snapshot(sim).qpos[0])
        assert (held["start_qvel"] == 0.0).all()
        commands = np.stack([controller.command()[2].numpy() for _ in range(controller.steps)])
        assert np.allclose(held["ctrl"][:, run.stage.index.ctrl], commands)
        assert held["time_s"][[0, -1]] == pytest.approx([0.02, 6.0])
        phases = held["phase"][[0, 29, 30, -1]].tolist()
        assert phases == ["above_red", "above_red", "descend_red", "done"]
        red, blue = (held["qpos"][:, a : a + 3] for a in run.stage.index.object_qpos)
        assert held["xy_err_m"] == pytest.approx(np.hypot(*(red - blue)[:, :2].T), abs=1e-6)
        assert held["dz_m"] == pytest.approx((red - blue)[:, 2], abs=1e-6)
        v = run.stage.index.object_qvel[0]
        speed = np.linalg.norm(held["qvel"][:, v : v + 3], axis=1)
        speed += np.sqrt(3.0) * 0.022 * np.linalg.norm(held["qvel"][:, v + 3 : v + 6], axis=1)
        assert held["object_speed_m_per_s"][:, 0] == pytest.approx(speed, rel=1e-5, abs=1e-6)
        low = held["object_height_m"]
        assert abs(low[-1, 1]) < 0.001  # blue on the table,
        assert low[-1, 0] == pytest.approx(0.044, abs=0.001)  # red one cube above it
    sim.close()


@pytest.mark.full
def test_another_verdict_is_said(earlier: Path, tmp_path: Path) -> None:
    folder = copy_of(earlier, tmp_path)
    record = record_of(folder, 0)
    record.failed[0] = RULES["CARRY"]
    record.qpos[0, 14] += 0.002  # somewhere in blue's position
    write_npz(folder / record_name("batch", record.seed), record.arrays())
    status, report = replay_into(tmp_path / "out", folder, "world=0", NO_PAGE)
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
    status, report = replay_into(tmp_path / "other", folder, "world=0", NO_PAGE)
    (gate,) = report["gates"]
    assert gate["reason"].endswith(f"{differs}and not all is as it was in that run")
    assert any("mujoco was 3.9.9 in that run" in line for line in gate["details"])
    assert any("the compiled model was 000" in line for line in gate["details"])
    assert (status, gate["status"]) == (0, "pass")


APART = "its objects end 1e-06 mm from where they did, "
EXACT = "as recorded, and it ends bit for bit where it did"
CARRY_BIT = RULES["CARRY"]


@pytest.mark.parametrize(
    ("bits", "moved", "device", "changes", "kept", "says"),
    [
        (0, 0.0, "cpu", [], True, EXACT),
        (0, 0.0, "cpu", ["mujoco"], True, EXACT),
        (0, 1e-9, "cpu", [], False, f"NOT as recorded (the same result): {APART}expected"),
        (0, 1e-9, "cpu", ["mujoco"], True, f"as recorded, but {APART}and not all is as"),
        (0, 1e-9, "cuda:0", [], True, f"as recorded, but {APART}and runs on CUDA agree"),
        (CARRY_BIT, 0.0, "cpu", [], False, "(red not carried): it ends bit for bit where it did"),
        (CARRY_BIT, 0.002, "cpu", [], False, "NOT as recorded (red not carried): its objects"),
        (CARRY_BIT, 0.002, "cuda:0", [], True, "NOT as recorded (red not carried): its objects"),
        (RULES["OVERFLOW"], 0.002, "cpu", [], True, "and a world alone shares no contact pool"),
    ],
)
def test_what_is_promised_of_another_end(
    bits: int, moved: float, device: str, changes: list[str], kept: bool, says: str, new_run: NewRun
) -> None:
    """Bit for bit, but on CUDA, with other versions, and where the contact pool was too small."""
    run = new_run("sim=native")
    end = np.zeros(run.stage.model.nq)
    recorded = end.copy()
    recorded[run.stage.index.object_qpos[1]] = moved
    record = EpisodeRecord(
        seed=0,
        backend="mjwarp",
        device=device,
        worlds={
            "failed": np.array([0, bits], np.int32),
            "start_qpos": np.stack((end, end)),
            "qpos": np.stack((end, recorded)),
        },
    )
    plan = SimpleNamespace(record=record, world=1, where=[(Backend.mjwarp, device)])
    episode = SimpleNamespace(failed=np.zeros(1, dtype=np.int32))
    agrees, text = _compare(plan, 0, episode, end, changes, run)
    assert agrees is kept
    assert says in text


@pytest.mark.full
def test_a_start_that_is_not_the_recorded_one_is_refused(
    earlier: Path, tmp_path: Path, monkeypatch: Patch, error_line: Callable[[], str]
) -> None:
    """Such as after random numbers have changed."""
    folder = copy_of(earlier, tmp_path)
    record = record_of(folder, 1)
    record.worlds["start_qpos"][3, 14] += 0.002
    write_npz(folder / record_name("batch", record.seed), record.arrays())
    monkeypatch.chdir(tmp_path)
    assert run(["job=replay", f"run={folder}", f"world={SUCCEEDED}"]) == 2
    says = "world 3 of seed 1 would start up to 0.002 (m, rad) from where it did, expected its own"
    says += " start. Use mjstack at"
    assert says in error_line()
    assert [path.name for path in tmp_path.iterdir()] == ["copy"]


def carry(red_x: float = 0.31, red_mass: float = 0.09) -> bytes:
    """A starts file of two worlds, the second one's cube at a place and with a mass."""
    file = io.BytesIO()
    np.savez(file, **two_starts(red_x, red_mass_kg=[0.08, red_mass]))
    return file.getvalue()


@pytest.fixture(scope="module")
def from_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of both gates from a file and, beside it, random joints. The file is
    gone.
    """
    home = tmp_path_factory.mktemp("from_file")
    noise = ["+reset.noise.func=mjstack.mdp.reset.JointNoise", "+reset.noise.params.arm=0.01"]
    start = ["reset=starts_file", "starts=carry.npz", "nworld=2", "sim=native", *noise]
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(home)
        Path("carry.npz").write_bytes(carry())
        args = ["gates=[batch,success]", *start, *one_second_episode(), "hydra.run.dir=run"]
        assert run(args) == 1
        Path("carry.npz").unlink()
    return home / "run"


@pytest.mark.full
@pytest.mark.parametrize("gate", ["batch", "success"])
def test_a_run_from_a_file_replays_from_its_own_copy(
    gate: str, from_file: Path, tmp_path: Path, monkeypatch: Patch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert (from_file / "starts_played.npz").read_bytes() == carry()
    # A file of that name where the replay is called
    (tmp_path / "carry.npz").write_bytes(carry(red_x=0.32))
    _, report = replay_into(tmp_path / "out", from_file, f"world={gate}:1", NO_PAGE)
    (found,) = report["gates"]
    assert found["reason"].endswith("as recorded, and it ends bit for bit where it did")
    with np.load(tmp_path / "out" / "trajectory.npz") as held:
        assert 0.31 in held["start_qpos"]
        assert held["field.body_mass"][-2:].tolist() == [0.09, 0.08]


@pytest.mark.full
@pytest.mark.parametrize(
    ("edit", "says"),
    [
        (lambda copy: copy.unlink(), "has no starts_played.npz, expected a copy of the starts"),
        (
            lambda copy: copy.write_bytes(carry(red_x=0.315)),
            "would start up to 0.005 (m, rad) from where it did",
        ),
        (
            lambda copy: copy.write_bytes(carry(red_x=math.nan)),
            "starts_played.npz, world 1, red_xy: expected 0.19 to 0.51, it is nan",
        ),
    ],
    ids=["lost", "edited", "damaged"],
)
def test_another_layout_is_refused(
    edit: Callable[[Path], None], says: str, from_file: Path, tmp_path: Path
) -> None:
    folder = copy_of(from_file, tmp_path)
    edit(folder / "starts_played.npz")
    assert says in refusal_of(f"run={folder}", "world=batch:1")


@pytest.mark.full
def test_what_the_start_does_not_show_is_found_at_the_end(from_file: Path, tmp_path: Path) -> None:
    """Another mass."""
    folder = copy_of(from_file, tmp_path)
    (folder / "starts_played.npz").write_bytes(carry(red_mass=0.1))
    status, report = replay_into(tmp_path / "out", folder, "world=batch:1", NO_PAGE)
    assert "; NOT as recorded (the same result): its objects end " in report["gates"][0]["reason"]
    assert status == 1


@pytest.mark.full
def test_the_copy_of_a_starts_file(tmp_path: Path) -> None:
    """Byte for byte, for all terms that read it."""
    folder = tmp_path / "run"
    folder.mkdir()
    own = tmp_path / "a.npz"
    own.write_bytes(b"any")
    cfg = load_config(["reset=starts_file", f"starts={own}"])
    func = "mjstack.mdp.starts.starts_file.FromStartsFile"
    cfg.reset["again"] = TermCfg(func=func, params={"path": str(own), "pose": "home"})
    found = archive_starts(cfg, folder)
    assert [path.read_bytes() for path in folder.iterdir()] == [b"any"]
    read = [term.params["path"] for term in found.reset.values()]
    assert read == [str(folder / "starts_played.npz")] * 2
    assert found.reset["again"].params["pose"] == "home"
    assert cfg.reset["starts"].params["path"] == str(own)  # as saved and shown

    plain = load_config(["gates=[batch]"])
    assert archive_starts(plain, folder) == plain
    plain.gate.success.reset = dict(cfg.reset)
    (folder / "starts_played.npz").unlink()
    archive_starts(plain, folder)
    assert not list(folder.iterdir())  # of a gate that does not run
    plain.gates = ["success"]
    plain.reset = {"other": replace(cfg.reset["starts"], params={"path": str(tmp_path / "b.npz")})}
    (tmp_path / "b.npz").write_bytes(b"other")
    plain.gate.success.reset = dict(cfg.reset)
    both = archive_starts(plain, folder)
    for reset, content in ((both.reset, b"other"), (both.gate.success.reset, b"any")):
        assert {Path(term.params["path"]).read_bytes() for term in reset.values()} == {content}


@pytest.mark.full
def test_sim_native_plays_native_alone_and_randomized_fields_are_kept(tmp_path: Path) -> None:
    folder = tmp_path / "random"
    args = ["gates=[batch]", "sim=native", "nworld=3", "reset=randomized"]
    run([*args, *one_second_episode(), f"hydra.run.dir={folder}"])
    _, report = replay_into(tmp_path / "out", folder, "world=2", "sim=native")
    assert report["gates"][0]["reason"].endswith(
        "as recorded, and it ends bit for bit where it did"
    )
    with np.load(tmp_path / "out" / "trajectory.npz") as held:
        assert {"field.body_mass", "field.geom_friction"} <= set(held.files)
        assert not np.isclose(held["field.body_mass"][-2:], 0.08).any()  # scaled


@pytest.mark.full
def test_mjwarp_world_is_played_on_both_engines(tmp_path: Path) -> None:
    folder = tmp_path / "warp"
    args = ["gates=[batch]", "sim=mjwarp", "sim.device=cpu", "nworld=2"]
    assert run([*args, *one_second_episode(), f"hydra.run.dir={folder}"]) == 1
    status, report = replay_into(tmp_path / "out", folder, "world=1")
    assert status == 1
    warp, native = report["gates"]
    assert (warp["name"], native["name"]) == ("replay_mjwarp", "replay_native")
    assert warp["reason"].startswith("failed: red not carried (carry_m 0 of 0.05")
    assert warp["reason"].endswith("; as recorded, and it ends bit for bit where it did")
    assert native["reason"].startswith("failed: red not carried (carry_m 0 of 0.05")
    assert native["reason"].endswith("; that run's mjwarp world had the same result")
    with (
        np.load(tmp_path / "out" / "trajectory.npz") as ours,
        np.load(tmp_path / "out" / "trajectory_native.npz") as theirs,
    ):
        assert "Warp" in str(ours["backend"])
        assert np.abs(ours["start_qpos"] - theirs["start_qpos"]).max() < 1e-6
        assert np.abs(ours["object_pos_m"][-1] - theirs["object_pos_m"][-1]).max() < 0.002


@on_cuda
def test_cuda_world_ends_near_where_it_did(tmp_path: Path) -> None:
    folder = tmp_path / "cuda"
    args = ["gates=[batch]", "sim=mjwarp", "sim.device=cuda:0", "nworld=64"]
    assert run([*args, f"hydra.run.dir={folder}"]) == 0
    record = record_of(folder, 0)
    status, report = replay_into(tmp_path / "out", folder, "world=41")
    assert status == 0
    warp, _ = report["gates"]
    assert "as recorded" in warp["reason"]
    assert "NOT" not in warp["reason"]
    with np.load(tmp_path / "out" / "trajectory.npz") as held:
        assert np.abs(held["qpos"][-1] - record.qpos[41]).max() < 0.01


@pytest.mark.parametrize(("nworld", "nconmax"), [(64, 80), (2, 40)])
def test_a_world_alone_has_its_room(
    nworld: int, nconmax: int, new_run: NewRun, monkeypatch: Patch
) -> None:
    """A world may have taken more than its share of the pool, but never more than the pool."""
    sizes = ["batch.nconmax=20", "batch.njmax=100"]
    stage = new_run("sim=mjwarp", "sim.device=cpu", f"nworld={nworld}", *sizes).stage
    made = []
    monkeypatch.setattr(stage, "simulation", lambda *args, sizes: made.append(sizes))
    stage.simulate_alone(*stage.backend)
    assert made == [BatchSizes(nconmax=nconmax, njmax=100)]


WRONG = [
    ([], "run=null"),
    (["run={run}"], "world=null"),
    (["run=nowhere", "world=1"], "run=nowhere: has no .hydra/config.yaml"),
    (["run={run}", "world=7"], "a world from 0 to 4"),
    (["run={run}", "world=2:1"], "a seed from 0 to 1"),
    (["run={run}", "world=success:1"], "a world of a gate that run had, batch"),
    (["run={run}", "world=failing"], "world=failing: expected a world such as 17"),
    (["run={run}", "world=-1"], "world=-1"),
    (["run={run}", "world=1.5"], "world=1.5"),
    (["run={run}", "world=1", "nworld=3"], "nworld=3: expected only run, world, sim, view, video"),
    (["run={run}", "world=1", "sim.device=cuda:77"], "cuda:77"),
]


@pytest.mark.full
@pytest.mark.parametrize(("values", "says"), WRONG, ids=[" ".join(v) for v, _ in WRONG])
def test_values_that_name_no_world(values: list[str], says: str, earlier: Path) -> None:
    assert says in refusal_of(*(value.format(run=earlier) for value in values))


REPORT = "report.json"
CONFIG = ".hydra/config.yaml"
# By name: the file, its new content or a part of it and what takes its place, and the line.
# None removes the file.
DAMAGE: dict[str, tuple[str, str | tuple[str, str] | None, str]] = {
    "no report": (REPORT, None, "has no report.json"),
    "another tool's": (CONFIG, "model: resnet\n", "config.yaml: cannot be read"),
    "a key too many": (CONFIG, ("nworld: 5\n", "nworld: 5\ncolour: red\n"), "colour"),
    "another version": (
        CONFIG,
        ("    rate: 1.0\n", "    failed_worlds: 0\n"),
        "run of another version",
    ),
    "a value out of range": (CONFIG, ("nworld: 5", "nworld: 0"), "nworld=0"),
    "a key too few": (CONFIG, ("nworld: 5\n", ""), "nworld is missing"),
    "another nworld": (
        CONFIG,
        ("nworld: 5", "nworld: 4"),
        "a record of 5 worlds of seed 0, expected one of 4 worlds",
    ),
    "another job": (CONFIG, ("name: gates", "name: replay"), "job=replay"),
    "a training": (  # has keys that no other job has
        CONFIG,
        ("name: gates", "name: train\n  trainer: null"),
        "is a run of job=train, expected one of job=gates",
    ),
    "no record": ("batch_seed0.npz", None, "gate batch has left no record of seed 0"),
    "record": ("batch_seed0.npz", "PK", "batch_seed0.npz: cannot be read"),
}


@pytest.mark.full
@pytest.mark.parametrize("name", DAMAGE)
def test_damaged_folder_is_one_line(name: str, earlier: Path, tmp_path: Path) -> None:
    folder = copy_of(earlier, tmp_path)
    file, content, says = DAMAGE[name]
    path = folder / file
    if isinstance(content, tuple):
        text = path.read_text()
        assert text.count(content[0]) == 1
        path.write_text(text.replace(*content))
    elif content is not None:
        path.write_text(content)
    else:
        path.unlink()
    assert says in refusal_of(f"run={folder}", "world=1")
