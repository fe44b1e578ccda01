"""job=export: onnxruntime gives torch's numbers, the metadata is all that a program needs, and a
program without mjstack drives native MuJoCo as PolicyDriver does.
"""

import ast
import json
import runpy
import sys
from collections.abc import Callable
from dataclasses import asdict, replace
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from compositions import load_config
from environments import NOMINAL, Patch, configure, few, has_gl
from policies import make_policy, write_policy

import mjstack
from mjstack.cli import run
from mjstack.config.schema import Config
from mjstack.config.session import search_path
from mjstack.drivers.policy import PolicyDriver
from mjstack.episodes.stage import Stage
from mjstack.errors import FolderError, MissingExtra, MjstackError
from mjstack.jobs import play as play_job
from mjstack.jobs.export import check_export, export_facts
from mjstack.jobs.export_lerobot import lerobot_files
from mjstack.policy import Vision, lerobot, load_policy, save_policy
from mjstack.policy.onnx import to_onnx

SEEN = ("observation=state", "+observation.policy.terms.joint_vel.history=2")
EXAMPLE = Path(__file__).parents[2] / "examples" / "policy_native.py"


def write_noiseless(folder: Path, cfg: Config) -> Path:
    """A policy whose observation has no noise, which a program without mjstack could not draw."""
    group = replace(cfg.observation["policy"], noise=False)
    save_policy(folder, make_policy(replace(cfg, observation={"policy": group}), execute=4))
    return folder


def export(policy: Path, out: Path, *overrides: str) -> int:
    return run(["job=export", "sim=native", f"policy={policy}", f"hydra.run.dir={out}", *overrides])


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy of task reach in ``policy``, and its export in ``out``."""
    folder = tmp_path_factory.mktemp("export")
    write_noiseless(folder / "policy", configure("task=reach", *SEEN))
    assert export(folder / "policy", folder / "out", "task=reach") == 0
    return folder


def session_of(folder: Path) -> onnxruntime.InferenceSession:
    return onnxruntime.InferenceSession(str(folder / "policy.onnx"))


@pytest.mark.parametrize("batch", [1, 64])
def test_onnxruntime_gives_torchs_numbers(exported: Path, batch: int) -> None:
    """Far observations are among them, which the network clamps, and answers beyond its range."""
    network = load_policy(exported / "policy").network
    width = network.observation_mean.shape[0]
    network.set_scale("observation", torch.randn(width), torch.rand(width) + 0.1)
    middle = network.action_mean
    network.set_range(middle - 0.01, middle + 0.02)
    seen = 4.0 * torch.randn(batch, width)
    session = onnxruntime.InferenceSession(to_onnx(network, {}))
    (found,) = session.run(["action"], {"observation": seen.numpy()})
    np.testing.assert_allclose(found, network(seen).numpy(), rtol=0.0, atol=2e-6)
    assert found.shape == (batch, network.chunk, network.width)
    if batch > 1:
        joints = torch.from_numpy(found).flatten(0, 1)
        torch.testing.assert_close(joints.amin(0), middle - 0.01)
        torch.testing.assert_close(joints.amax(0), middle + 0.02)


def test_the_metadata_is_what_a_program_needs(exported: Path) -> None:
    held = session_of(exported / "out").get_modelmeta().custom_metadata_map
    facts = {name: json.loads(text) for name, text in held.items()}
    cfg = configure("task=reach")
    assert facts["action"] == {
        "joints": cfg.robot.joints,
        "width": 6,
        "terms": {name: asdict(term) for name, term in cfg.controller.action.items()},
        "chunk": 6,
        "execute": 4,
        "step_dt": 0.02,
    }
    assert facts["observation"]["widths"] == {
        "joint_pos": 6,
        "joint_vel": 12,
        "offsets": 6,
        "positions": 6,
        "headings": 4,
        "tilts": 4,
        "grasped": 2,
        "goals": 0,
    }
    assert list(facts["observation"]["terms"]) == list(facts["observation"]["widths"])
    assert facts["columns"]["names"][5:8] == ["joint_pos.5", "joint_vel.0.t-1", "joint_vel.1.t-1"]
    assert facts["columns"]["units"][5:8] == ["rad", "10 rad/s", "10 rad/s"]
    assert facts["robot"]["units"] == ["rad"] * 6
    assert facts["normalization"]["action_mean"] == pytest.approx(cfg.robot.start)
    assert facts["training"] == {"seed": 0}
    assert facts["versions"].keys() == {"mjstack", "mujoco", "torch"}
    assert facts["exported_with"]["mjstack"] == mjstack.__version__
    assert facts["task"]["control_hz"] == 50.0


def test_the_example_imports_no_mjstack() -> None:
    tree = ast.parse(EXAMPLE.read_text())
    names = {a.name for node in ast.walk(tree) if isinstance(node, ast.Import) for a in node.names}
    assert names <= {"json", "sys", "mujoco", "numpy", "onnxruntime"}
    assert not any(isinstance(node, ast.ImportFrom) for node in ast.walk(tree))
    assert len(EXAMPLE.read_text().splitlines()) <= 84


def drivers_targets(policy: Path, cfg: Config, steps: int) -> np.ndarray:
    """Joint targets of PolicyDriver from the nominal start."""
    stage = Stage(cfg)
    sim = stage.batch_simulation(1)
    env = stage.start(sim, NOMINAL)
    driver = PolicyDriver(env, load_policy(policy))
    targets = []
    for _ in range(steps):
        command = driver.command()
        targets.append(command[0].numpy().copy())
        env.action_manager.process(command)
        env.advance()
    return np.array(targets)


@pytest.mark.parametrize("task", ["reach", pytest.param("stack", marks=pytest.mark.full)])
def test_the_example_drives_as_the_driver_does(task: str, exported: Path, tmp_path: Path) -> None:
    """Bit for bit but for onnxruntime's float32 where the driver has float64."""
    cfg = configure(f"task={task}", "sim=native", "nworld=1")
    policy = exported / "policy"
    out = exported / "out"
    if task == "stack":
        policy = write_noiseless(tmp_path / "policy", configure(*SEEN))
        out = tmp_path / "out"
        assert export(policy, out) == 0
    play = runpy.run_path(str(EXAMPLE))["play"]
    wanted = drivers_targets(policy, cfg, 40)
    np.testing.assert_allclose(play(str(out), 40), wanted, rtol=0.0, atol=2e-5)
    assert wanted.std(0).max() > 1e-3  # it moves


@pytest.fixture(scope="module")
def sees(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """A policy of task reach with two cameras, and overrides with them."""
    folder = tmp_path_factory.mktemp("sees") / "policy"
    args = ["task=reach", "sim=native", "nworld=1", "cameras=[front,wrist]", "observation=pixels"]
    args += ["scene.cameras.front.size=[16,24]", "scene.cameras.wrist.size=[13,13]"]
    args += ["+observation.policy.noise=false"]
    sizes = {"front": (16, 24), "wrist": (13, 13)}
    vision = Vision(sizes=sizes, channels=[4, 8], features=8)
    policy = make_policy(load_config(args), vision=vision)
    for encoder in policy.network.encoders:  # so that the answer depends on the images
        encoder.layers[-2].weight.data *= 20.0
    save_policy(folder, policy)
    return folder, args


def test_onnxruntime_sees_as_torch_does(sees: tuple[Path, list[str]]) -> None:
    network = load_policy(sees[0]).network
    sizes = network.vision.sizes
    shown = [torch.randint(0, 256, (5, *size, 3), dtype=torch.uint8) for size in sizes.values()]
    joints = torch.randn(5, 6)
    session = onnxruntime.InferenceSession(to_onnx(network, {}))
    inputs = {f"images.{name}": image.numpy() for name, image in zip(sizes, shown, strict=True)}
    (found,) = session.run(["action"], {"observation": joints.numpy(), **inputs})
    wanted = network(joints, [image.float() for image in shown]).numpy()
    np.testing.assert_allclose(found, wanted, rtol=0.0, atol=2e-6)
    assert wanted.std(0).max() > 1e-3


@pytest.mark.skipif(not has_gl(), reason="MuJoCo does not draw offscreen here")
@pytest.mark.full
def test_the_example_sees_as_the_driver_does(sees: tuple[Path, list[str]], tmp_path: Path) -> None:
    policy, args = sees
    assert export(policy, tmp_path / "out", *args) == 0
    play = runpy.run_path(str(EXAMPLE))["play"]
    wanted = drivers_targets(policy, load_config(args), 30)
    np.testing.assert_allclose(play(str(tmp_path / "out"), 30), wanted, rtol=0.0, atol=2e-5)
    assert wanted.std(0).max() > 1e-3


def test_actions_of_a_policys_own_are_described(tmp_path: Path) -> None:
    """Of other numbers than joint targets, repeated below the control rate."""
    own = ("action=ee_delta", "timing.policy_decimation=5")
    cfg = configure("task=reach", *own)
    policy = make_policy(cfg, chunk=1, execute=5)
    save_policy(tmp_path / "policy", policy)
    facts = export_facts(Stage(replace(configure("task=reach"), policy=str(tmp_path / "policy"))))
    assert list(facts["action"]["terms"]) == list(cfg.action)
    assert facts["action"]["width"] == policy.network.width == policy.widths["last_action"]
    assert facts["columns"]["units"][-1] == "1"
    assert len(facts["columns"]["names"]) == sum(policy.widths.values())


@pytest.mark.parametrize("job", few(["export", "play"], 2))
def test_a_task_that_brings_a_controller_takes_a_policy(
    job: str, tmp_path: Path, monkeypatch: Patch
) -> None:
    conf = EXAMPLE.parent / "push" / "conf"
    write_policy(tmp_path / "policy", load_config(["task=push"], config_dir=conf))
    args = [f"job={job}", "task=push", "sim=native", f"policy={tmp_path / 'policy'}"]
    args += ["controller=policy"] if job == "play" else []
    cfg = load_config(args, config_dir=conf)
    monkeypatch.setattr(play_job, "require_offscreen", lambda model: None)
    with search_path([conf]):
        checked = {"export": check_export, "play": play_job.check_play}[job](cfg)
    assert checked.stage.cfg.controller.name == "policy"


def test_bad_input_is_one_line(
    exported: Path, tmp_path: Path, monkeypatch: Patch, error_line: Callable[[], str]
) -> None:
    policy = exported / "policy"
    assert export(policy, tmp_path / "out", "task=stack") == 2
    assert "was trained with task.name=reach, and here it is stack" in error_line()
    before = (exported / "out" / "policy.onnx").read_bytes()
    assert export(policy, exported / "out", "task=reach") == 2
    assert "expected a new or an empty folder" in error_line()
    assert (exported / "out" / "policy.onnx").read_bytes() == before
    monkeypatch.setitem(sys.modules, "onnx", None)
    assert export(policy, tmp_path / "out", "task=reach") == 2
    assert "job=export needs onnx, which is not installed" in error_line()
    assert not (tmp_path / "out").exists()


@pytest.mark.full
def test_a_full_disk_leaves_neither_file(
    exported: Path, tmp_path: Path, monkeypatch: Patch
) -> None:
    import mjstack.jobs.export as module

    real = module.write_atomic

    def full(path: Path, content: bytes) -> None:
        if path.suffix == ".onnx":
            raise OSError(28, "No space left on device")
        real(path, content)

    monkeypatch.setattr(module, "write_atomic", full)
    out = tmp_path / "out"
    assert export(exported / "policy", out, "task=reach") == 1
    assert not list(out.glob("*.onnx")) + list(out.glob("*.mjb"))
    (gate,) = json.loads((out / "report.json").read_text())["gates"]
    assert "cannot be written (No space left on device), and nothing was exported" in gate["reason"]


@pytest.mark.parametrize(
    ("observation", "key"),
    [("pixels", "state"), pytest.param("state", "environment_state", marks=pytest.mark.full)],
)
def test_lerobots_folder_has_its_own_files_and_the_weights(
    observation: str, key: str, tmp_path: Path
) -> None:
    """LeRobot itself loads it in test_lerobot.py. One that sees measured joints alone takes a real
    arm's.
    """
    policy = write_noiseless(tmp_path / observation, configure(f"observation={observation}"))
    out = tmp_path / f"{observation}_out"
    assert export(policy, out, "job.format=lerobot") == 0
    config = json.loads((out / "config.json").read_text())
    assert config["type"] == "mjstack"
    assert list(config["input_features"]) == [f"observation.{key}"]
    assert config["output_features"]["action"] == {"type": "ACTION", "shape": [6]}
    assert np.array(config["joint_range"]).shape == (6, 2)
    before, after = (load_policy(folder).network.state_dict() for folder in (policy, out))
    assert all(torch.equal(value, after[name]) for name, value in before.items())
    for kind in ("pre", "post"):
        chain = json.loads((out / f"policy_{kind}processor.json").read_text())["steps"]
        assert chain[-1]["registry_name"] == "device_processor"
    assert not (out / "policy.onnx").exists()


def test_lerobots_robots_take_joint_targets_alone(tmp_path: Path) -> None:
    cfg = configure("action=ee_delta", "timing.policy_decimation=5")
    save_policy(tmp_path / "policy", make_policy(cfg, chunk=1, execute=5))
    stage = Stage(replace(configure("job=export"), policy=str(tmp_path / "policy")))
    with pytest.raises(FolderError, match=r"its actions are arm, gripper, expected joint targets"):
        lerobot_files(stage)


def test_a_missing_lerobot_and_another_version_are_one_line(monkeypatch: Patch) -> None:
    monkeypatch.setattr(lerobot, "version", lambda name: "0.5.0")
    with pytest.raises(MjstackError, match=r"LeRobot 0.5.0 is installed, expected 0\.6\.x"):
        lerobot.require_lerobot("policy")

    def missing(name: str) -> str:
        raise PackageNotFoundError(name)

    monkeypatch.setattr(lerobot, "version", missing)
    with pytest.raises(MissingExtra, match=r"pip install 'mjstack\[lerobot\]'"):
        lerobot.require_lerobot("policy")
