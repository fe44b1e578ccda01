"""Configuration from a folder of one's own: on the command line, in a sweep, and in Python."""

import codecs
import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from environments import Capture, Patch, Refused
from policies import make_policy

import mjstack
from mjstack.cli import run
from mjstack.config import load_config
from mjstack.config.load import load_saved
from mjstack.config.session import check_term, in_search_path, search_path, search_path_args
from mjstack.drivers.policy import PolicyDriver
from mjstack.errors import MjstackError
from mjstack.policy import save_policy

TASK = """# @package _global_
defaults:
  - stack
  - _self_

task:
  name: lean
reward:
  height:
    func: lean.height
    weight: 2.0
"""
MODULE = """
from dataclasses import dataclass

from mjstack.config import spec
from mjstack.config.schema import GateFuncCfg
from mjstack.report.record import GateResult, Status


def height(env, *, scale=3.0):
    return scale * env.sim.qpos[:, 0]


def lean(env, mask):
    pass


@dataclass(kw_only=True)
class UprightCfg(GateFuncCfg):
    limit: float = spec(unit="m", gt=0.0)
    note: str = "none"


def run_upright(run):
    cfg = run.cfg.gate["upright"]
    status = Status.passed if cfg.limit < 2.0 else Status.failed
    return [GateResult(name="upright", status=status, reason=cfg.note)]


run_upright.config = UprightCfg
"""
SEEN = """

def rise(env):
    return env.sim.qpos[:, 0]
"""
GATE = """# A gate of one's own.
func: lean.run_upright
limit: 1.0
"""


@pytest.fixture
def lean(tmp_path: Path, monkeypatch: Patch) -> Iterator[Path]:
    """A folder with a task and, beside it, the module of its reward."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    conf = tmp_path / "lean" / "conf"
    (conf / "task").mkdir(parents=True)
    (conf / "task" / "lean.yaml").write_text(TASK)
    (conf / "gate").mkdir()
    (conf / "gate" / "upright.yaml").write_text(GATE)
    (tmp_path / "lean" / "lean.py").write_text(MODULE)
    yield conf
    sys.modules.pop("lean", None)


def test_an_environment_of_another_folder(lean: Path) -> None:
    env = mjstack.make_env(["task=lean"], config_dir=lean, nworld=2, device="cpu")
    try:
        assert env.cfg.task.name == "lean"
        assert "height" in env.reward_manager.names
    finally:
        env.close()
    with pytest.raises(MjstackError, match="'lean' does not exist"):
        load_config(["task=lean"])


@pytest.mark.full
def test_the_search_path_is_an_override_too(lean: Path) -> None:
    cfg = load_config([f"hydra.searchpath=[file://{lean}]", "task=lean"])
    assert cfg.reward["height"].func == "lean.height"
    second = lean.parent / "it's mine"
    (second / "task").mkdir(parents=True)
    with search_path([lean]):
        assert search_path_args() == ["--config-dir", str(lean)]
        with search_path([second]):
            assert search_path_args() == ["--config-dir", str(lean), "--config-dir", str(second)]
    both = f"hydra.searchpath=['{lean}',\"{second}\"]"
    assert load_config([both, "task=lean"]).task.name == "lean"


def test_several_folders_add_up(lean: Path, capsys: Capture) -> None:
    second = lean.parent / "second"
    (second / "reward").mkdir(parents=True)
    (second / "reward" / "none.yaml").write_text("{}\n")
    flags = ["--config-dir", str(lean), f"--config-dir={second}"]
    assert run([*flags, "task=lean", "reward=none", "--cfg", "job", "-p", "reward"]) == 0
    assert "height" in capsys.readouterr().out


@pytest.mark.full
def test_help_and_cfg_see_the_folder(lean: Path, capsys: Capture, refused: Refused) -> None:
    assert run(["--config-dir", str(lean), "--help"]) == 0
    assert "stack, box, lean, reach" in " ".join(capsys.readouterr().out.split())
    assert run([f"--config-dir={lean}", "task=lean", "--cfg", "job", "-p", "task.name"]) == 0
    assert capsys.readouterr().out == "lean\n"
    assert "Did you mean 'lean'?" in refused("-cd", str(lean), "task=lea")


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("task: {epsiode_steps: 3}", "Did you mean 'task.episode_steps'?"),
        ("scene: {objects: {puck: {szie: [1]}}}", "Did you mean 'scene.objects.puck.size'?"),
        ("reward: [", "while parsing"),
        *(
            pytest.param(*row, marks=pytest.mark.full)
            for row in (
                ("taks: {a: 1}", "Did you mean 'task'?"),
                ("controller: {phases: {go: {secnds: 2}}}", "mean 'controller.phases.go.seconds'?"),
                ("task: {episode_steps: many}", "task.episode_steps=many: expected an integer"),
            )
        ),
    ],
)
def test_a_file_that_does_not_fit_is_named(
    text: str, part: str, lean: Path, refused: Refused
) -> None:
    file = lean / "task" / "lean.yaml"
    file.write_text(f"{TASK.partition('task:')[0]}{text}\n")
    line = refused("--config-dir", str(lean), "task=lean")
    assert str(file) in line
    assert part in line


@pytest.mark.full
def test_a_sweep_and_a_replay(lean: Path, tmp_path: Path) -> None:
    flags = ["--config-dir", str(lean), "-m", "task=stack", "gates=[upright]"]
    reset = "+reset.lean={func: lean.lean}"
    assert run([*flags, reset, "seed=1,2"]) == 0
    first, _ = sorted(tmp_path.rglob("report.json"))
    assert json.loads(first.read_text())["status"] == "pass"
    saved = first.parent / ".hydra" / "config.yaml"
    with pytest.raises(MjstackError) as caught:
        load_saved(saved)
    assert "reset.lean.func=lean.lean: expected one of the reset terms" in str(caught.value)
    assert f"--config-dir {lean}" in str(caught.value)
    with search_path([lean]):
        assert load_saved(saved).reset["lean"].func == "lean.lean"
    saved.write_text(saved.read_text().replace("lean.lean", "shutil.rmtree"))
    with search_path([lean]), pytest.raises(MjstackError, match=r"shutil\.rmtree"):
        load_saved(saved)


@pytest.mark.full
def test_a_gate_of_one_s_own(lean: Path, tmp_path: Path, capsys: Capture, refused: Refused) -> None:
    flags = ["--config-dir", str(lean), "gates=[upright]"]
    assert run([*flags, "hydra.run.dir=a"]) == 0
    report = json.loads((tmp_path / "a" / "report.json").read_text())
    assert [gate["name"] for gate in report["gates"]] == ["upright"]
    assert "gate=" not in (tmp_path / "a" / ".hydra" / "overrides.yaml").read_text()
    assert run([*flags, "gate.upright.limit=3.0", "hydra.run.dir=b"]) == 1
    capsys.readouterr()
    assert run([*flags, "--help", "gate.upright", "task.check.window"]) == 0
    out = capsys.readouterr().out
    assert "gate.upright.limit=1.0\n  Accepts a number above 0 [m]." in out
    assert "task.check.window=50\n" in out
    said = refused(*flags, "gate.upright.limit=0.0")
    assert said == "mjstack: gate.upright.limit=0.0: expected a number above 0 [m]."
    assert "Did you mean 'limit'?" in refused(*flags, "+gate.upright.limits=1.0")
    assert "Did you mean 'upright'?" in refused(*flags, "gate.uprigt.limit=1.0")
    assert "Available: baseline" in refused("gates=[upright]")


def test_a_bad_folder_is_refused(lean: Path, refused: Refused) -> None:
    assert f"Name {lean}." in refused("--config-dir", str(lean.parent))
    missing = refused("task=lean")
    assert missing.startswith("mjstack: task=lean: 'lean' does not exist. Available: ")
    assert missing.endswith(" A choice of your own needs --config-dir DIR (Python: config_dir).")
    assert "no such folder" in refused("--config-dir", "nowhere")
    assert "no such folder" in refused("hydra.searchpath=3")
    shutil.copy(lean / "task" / "lean.yaml", lean / "task" / "box.yaml")
    assert "task/box.yaml is mjstack's own" in refused("--config-dir", str(lean))


@pytest.mark.full
def test_an_installed_package_registers_its_configuration(lean: Path) -> None:
    site = lean.parent.parent / "site"
    (site / "leaning-1.0.dist-info").mkdir(parents=True)
    (site / "leaning-1.0.dist-info" / "METADATA").write_text("Name: leaning\nVersion: 1.0\n")
    points = "[mjstack.configs]\nleaning = leaning.conf\n"
    (site / "leaning-1.0.dist-info" / "entry_points.txt").write_text(points)
    shutil.copytree(lean, site / "leaning" / "conf")
    mark = "from mjstack.managers import offers\noffers('observation term')(height)\n"
    (site / "leaning" / "__init__.py").write_text(MODULE + mark)
    task = site / "leaning" / "conf" / "task" / "lean.yaml"
    task.write_text(TASK.replace("lean.height", "leaning.height"))
    program = (
        f"import sys; sys.path.insert(0, {str(site)!r}); from mjstack.config import load_config;"
        "from mjstack.config.session import check_term; from pathlib import Path;"
        "print(load_config(['task=lean']).reward['height'].func);"
        "check_term('', 'leaning.height', 'observation term', Path('config.yaml'));"
        "check_term('', 'leaning.height', 'reset term', Path('config.yaml'))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout.split() == ["leaning.height"], done.stderr
    assert "leaning.height: expected one of the reset terms" in done.stderr.splitlines()[-1]
    with pytest.raises(MjstackError, match="expected one of the observation terms"):
        check_term("", "leaning.height", "observation term", Path("config.yaml"))


def test_only_modules_beside_the_folder_are_trusted(lean: Path, monkeypatch: Patch) -> None:
    monkeypatch.chdir(lean.parent)  # a built-in module has no file: it is not beside the folder
    with search_path([lean]):
        assert in_search_path("lean.height", Path("config.yaml"))
        for name in ("os.system", "sys.exit", "shutil.rmtree", "nowhere.at_all"):
            assert not in_search_path(name, Path("config.yaml")), name


def test_a_byte_order_mark_is_refused(lean: Path) -> None:
    """It would hide a file's header from Hydra."""
    path = lean / "task" / "lean.yaml"
    path.write_bytes(codecs.BOM_UTF8 + path.read_bytes())
    with pytest.raises(MjstackError, match=r"lean\.yaml: begins with a byte order mark"):
        load_config(["task=lean"], config_dir=lean)


@pytest.mark.full
def test_a_policy_with_terms_of_ones_own_plays_in_python(lean: Path, tmp_path: Path) -> None:
    """By an absolute and a relative folder; without one the advice is that for Python."""
    module = lean.parent / "lean.py"
    module.write_text(module.read_text() + SEEN)
    overrides = ["task=reach", "sim=native", "action=joint_absolute"]
    seen = "+observation.policy.terms.rise={func: lean.rise}"
    cfg = load_config([*overrides, seen], config_dir=lean)
    folder = tmp_path / "policy"
    save_policy(folder, make_policy(cfg))
    sys.modules.pop("lean")
    chosen = ["controller=policy", f"policy='{folder}'", "sim=native", "nworld=1"]
    gate = [*chosen, "gates=[baseline]", "task.check.distance=10.0"]
    found = mjstack.verify(gate, config_dir=lean)
    assert found.status == "pass", found.messages
    relative = str(lean.relative_to(Path.cwd()))
    assert "rise" in mjstack.load_policy(str(folder), config_dir=relative).widths
    env = mjstack.make_env(overrides, nworld=2, config_dir=lean)
    env.reset(seed=0)
    driver = PolicyDriver(env, mjstack.load_policy(folder, config_dir=lean))
    assert driver.command().shape == (2, 6)
    env.close()
    for call in (lambda: mjstack.verify(gate), lambda: mjstack.load_policy(folder)):
        with pytest.raises(MjstackError) as caught:
            call()
        assert "expected one of the observation terms of mjstack" in str(caught.value)
        assert "add --config-dir DIR." in str(caught.value)


def test_the_package_lists_its_public_names() -> None:
    assert set(mjstack.__all__) <= set(dir(mjstack))
    assert all(hasattr(mjstack, name) for name in mjstack.__all__)
