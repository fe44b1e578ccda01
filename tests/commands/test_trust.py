"""A stranger's folder: a test for each rule of docs/design.md, "What may run code", and one damage
for each file that is read. `test_fuzz.py` tries others.
"""

import importlib
import io
import json
import os
import pkgutil
import shutil
import signal
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

import numpy as np
import pytest
import torch
from compositions import load_config, refusal
from environments import Capture, Patch, Refused, one_second_episode
from omegaconf import OmegaConf
from policies import write_policy

import mjstack
from mjstack import files, make_env
from mjstack.cli import run
from mjstack.config.fields import Range, field_range
from mjstack.config.fingerprint import config_content
from mjstack.config.functions import find_object
from mjstack.config.schema import EPISODES, Config, JobCfg
from mjstack.config.session import check_term, in_search_path, search_path
from mjstack.errors import (
    ArgumentError,
    ConfigError,
    FolderError,
    KeyedError,
    MjstackError,
    UnknownName,
    describe_error,
)
from mjstack.files import read_inside
from mjstack.jobs import check_job
from mjstack.policy import load_policy, save_policy
from mjstack.policy.checkpoint import read_state, write_state
from mjstack.process import Child

ROOT = Path(__file__).parents[2]
NAMEABLE = (ROOT / "tests" / "data" / "may_be_named.txt").read_text().splitlines()
SHELL = {"func": "pydoc.pipepager", "params": {"cmd": "id > PWNED"}}
PAYLOAD = "open('PWNED', 'w').close()\nfrom shutil import rmtree\ndef X(env): ...\n"
CONFIG = ".hydra/config.yaml"


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run."""
    folder = tmp_path_factory.mktemp("own") / "run"
    args = ["gates=[batch]", "sim=native", "nworld=2", "web.episode=false", *one_second_episode()]
    assert run([*args, f"hydra.run.dir={folder}"]) == 1
    return folder


@pytest.fixture
def stranger(own: Path, tmp_path: Path, monkeypatch: Patch) -> Path:
    """A copy of it below the working folder, which a payload would write to."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    return Path(shutil.copytree(own, tmp_path / "stranger"))


@pytest.fixture
def policy(tmp_path: Path) -> Path:
    """A policy's folder."""
    return write_policy(tmp_path / "policy", load_config(["sim=native"]))


@pytest.fixture
def soon() -> Iterator[None]:
    """Waiting for a pipe or a device without end is an error."""

    def stop(*_: object) -> None:
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(20)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def edit(folder: Path, key: str, value: Any) -> None:
    """Set a key of the run's configuration, as text where it is."""
    path = folder / CONFIG
    cfg = OmegaConf.load(path)
    OmegaConf.update(cfg, key, value, merge=False, force_add=True)
    path.write_text(OmegaConf.to_yaml(cfg))


def replay(folder: Path) -> None:
    """All of job=replay that comes before it writes."""
    cfg = load_config(["job=replay"])
    cfg.run = str(folder)
    cfg.world = "1"
    check_job(cfg)


def refused_call(call: Callable[[], object]) -> str:
    line = refusal(call)
    assert not Path("PWNED").exists()
    return line


SHELLS = {  # the key that names a shell's command, and what it has to name
    "reset.evil": "reset terms",
    "controller.action.arm": "action terms",
    "task.check": "checks",
    "gate.hard-2.reset.evil": "reset terms",
    "observation.policy.terms.evil": "",  # a replay builds none of these
    "reward.evil": "",
    "task.success": "",
}


@pytest.mark.parametrize(("key", "kind"), SHELLS.items())
def test_a_replay_runs_no_command_of_its_folder(key: str, kind: str, stranger: Path) -> None:
    """Rules 2, 5 and 8; a gate of the run may have any name."""
    if "hard" in key:
        edit(stranger, "gate.hard-2", {"func": EPISODES, "reset": {}})
        edit(stranger, "gates", ["hard-2"])
    edit(stranger, key, SHELL | ({"weight": 1.0} if key.startswith("reward") else {}))
    if kind:
        line = refused_call(lambda: replay(stranger))
        assert f"{key}.func=pydoc.pipepager: expected one of the {kind}" in line
        assert line.endswith("add --config-dir DIR.")
    else:
        replay(stranger)
        assert not Path("PWNED").exists()


def test_no_run_brings_a_policy_of_lerobots(stranger: Path) -> None:
    """Rule 3: its folder is trusted code, and the command line alone names it."""
    edit(stranger, "controller.func", "mjstack.drivers.lerobot.LerobotDriver")
    line = refused_call(lambda: replay(stranger))
    assert "LerobotDriver: expected one of the drivers of" in line


# Both take env first: they write or play what their parameters say.
DOERS = ("mjstack.mdp.starts.starts_file.write_starts", "mjstack.episodes.rollout.rollout")


@pytest.mark.parametrize("name", DOERS)
def test_folders_name_terms_alone(name: str, policy: Path, stranger: Path) -> None:
    """Rules 4 and 5."""
    content = (policy / "policy.json").read_text()
    for part in ("observation", "action"):
        facts = json.loads(content)
        terms = facts[part]["terms"] or facts["config"]["controller"]["action"]
        terms[next(iter(terms))].update({"func": name, "params": {"path": "PWNED"}})
        (policy / "policy.json").write_text(json.dumps(facts))
        says = f"func={name}: expected one of the {part} terms"
        assert says in refused_call(lambda: load_policy(policy))
    edit(stranger, "reset.evil", {"func": name, "params": {"path": "PWNED"}})
    assert f"reset.evil.func={name}: expected" in refused_call(lambda: replay(stranger))


def test_each_kind_of_term_is_listed(tmp_path: Path) -> None:
    """Rules 7 and 11: those of the list may be named, and nothing else of mjstack."""
    named = set()
    for module in pkgutil.walk_packages(mjstack.__path__, "mjstack.", onerror=lambda name: None):
        if module.name.endswith(("__main__", "rsl_rl", "adapters.lerobot")):
            continue
        for name, value in vars(importlib.import_module(module.name)).items():
            if getattr(value, "__module__", "") != module.name:
                continue
            for kind in ("observation term", "action term", "reset term", "check", "driver"):
                with suppress(MjstackError):
                    check_term("", f"{module.name}.{name}", kind, tmp_path / "policy.json")
                    named.add(f"{kind}: {module.name}.{name}")
    assert named == {*NAMEABLE}


@pytest.mark.parametrize("name", ["pydoc.pipepager", "builtins.max"])
def test_only_what_declares_itself_is_called(name: str, refused: Refused) -> None:
    """Rule 7, also on the command line."""
    line = refused(f"+reward.evil={{func: {name}, params: {{cmd: 'id > PWNED'}}, weight: 1}}")
    assert f"func={name}: expected a function or class whose first parameter is named env" in line
    line = refused(f"gate.batch.func={name}", "gates=[batch]")
    assert "first parameter is named run" in line


@pytest.mark.parametrize("given", ["", "conf", "beside"])
def test_no_module_of_the_folder_is_imported(
    given: str, stranger: Path, monkeypatch: Patch
) -> None:
    """Rule 9: neither from the working folder, nor where a search path makes that importable."""
    (stranger / "payload.py").write_text(PAYLOAD)
    (Path("conf") / "task").mkdir(parents=True)
    Path("beside.py").write_text(PAYLOAD.replace("open", "# open"))
    sys.path.insert(0, str(Path.cwd()))
    monkeypatch.delitem(sys.modules, "beside", raising=False)
    # The second is the user's own module, whose import runs nothing, with another's function.
    edit(
        stranger, "task.check.func", "beside.rmtree" if given == "beside" else "stranger.payload.X"
    )
    with search_path(["conf"] if given else []):
        assert "task.check.func=" in refused_call(lambda: replay(stranger))
        assert not given or in_search_path("beside.X", stranger)
    assert "stranger.payload" not in sys.modules


@pytest.mark.parametrize("is_link", [True, False])
def test_a_package_that_the_folder_lies_in_is_not_trusted(is_link: bool, stranger: Path) -> None:
    """Rule 9: nor where its configuration is a link that leads elsewhere, or where the package has
    a second place beside the search path.
    """
    (Path("home") / "conf" / "task").mkdir(parents=True)
    (Path("home") / "outputs").mkdir()
    saved = Path("home" if is_link else ".") / "outputs" / "run" / "config.yaml"
    saved.parent.mkdir(parents=True)
    if is_link:
        saved.symlink_to((stranger / CONFIG).resolve())
    else:
        saved.touch()
        sys.path.insert(0, str(Path.cwd()))
    sys.path.insert(0, str(Path("home").resolve()))
    with search_path(["home/conf"]):
        assert not in_search_path("outputs.run.payload.f", saved)


@pytest.mark.full
@pytest.mark.parametrize("sweep", [False, True])
def test_the_working_folder_is_not_imported_from(
    sweep: bool, tmp_path: Path, monkeypatch: Patch
) -> None:
    """Rule 9, also by a job of a sweep."""
    monkeypatch.chdir(tmp_path)
    for name in ("hydra", "omegaconf", "rich", "json", "difflib", "pathlib", "platform"):
        Path(f"{name}.py").write_text(PAYLOAD)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    args = ["--cfg", "job", "-p", "nworld"]
    with Path("output.log").open("wb") as output:
        if sweep:
            Child(args, output).wait()
        else:
            subprocess.run([sys.executable, "-m", "mjstack", *args], stdout=output)
    assert not Path("PWNED").exists()
    assert Path("output.log").read_text().split()[-1] == "256"


FOLLOWED = {
    "environment": ("task.instruction", "${oc.env:HOME}", "it has ${...}"),
    "robot's name": ("robot.name", "../../x", "robot.name=../../x: expected a name that"),
    "absolute name": ("robot.menagerie_file", "/etc/passwd", "robot.menagerie_file=/etc/passwd"),
    "robot's file": ("robot.file", "stranger/arm.xml", "add --config-dir {stranger}."),
    "object's file": ("scene.objects.red.file", "/none.xml", "expected a file beside a folder of"),
}


@pytest.mark.parametrize("name", FOLLOWED)
def test_nothing_outside_is_read(name: str, stranger: Path, monkeypatch: Patch) -> None:
    """Rule 2: no file is followed, and no MJCF compiled, before the user has added its folder."""
    shutil.copy(ROOT / "mjstack" / "robots" / "so101.xml", stranger / "arm.xml")
    key, value, says = (part.replace("{stranger}", str(stranger)) for part in FOLLOWED[name])
    edit(stranger, key, value)
    with monkeypatch.context() as patch:
        patch.setattr("mjstack.config.mjcf.read_mjcf", lambda *_, **__: pytest.fail("compiled"))
        assert says in refused_call(lambda: replay(stranger))
    if key == "robot.file":  # the line tells how to allow it
        with search_path([stranger]):
            replay(stranger)


# Rule 10: what it takes to read a file
@pytest.mark.usefixtures("soon")
@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_only_regular_files_are_read(kind: str, policy: Path, stranger: Path) -> None:
    def swap(path: Path) -> Path:
        path.unlink(missing_ok=True)
        os.mkfifo(path) if kind == "pipe" else path.symlink_to("/dev/zero")
        return path

    says = "it is no regular file"
    swap(next(policy.glob("weights-*")))
    assert says in refused_call(lambda: load_policy(policy))
    swap(stranger / "batch_seed0.npz")
    assert says in refused_call(lambda: replay(stranger))
    swap(stranger / ".hydra/hydra.yaml")
    edit(stranger, "task.check.func", "os.system")
    assert "add --config-dir DIR" in refused_call(lambda: replay(stranger))
    state = swap(stranger / "training.safetensors")
    assert says in refused_call(lambda: read_state(state))
    starts = ["reset=starts_file", f"starts={swap(stranger / 'starts.npz')}", "sim=native"]
    assert f"{starts[1]}" in refused_call(lambda: make_env(starts, nworld=1))
    assert says in refused_call(lambda: config_content(load_config(starts)))


def put_array(folder: Path, name: str, rows: int, times: int = 1) -> None:
    """Arrays in the run's record, with as many rows as their header claims."""
    header = io.BytesIO()
    claim = {"descr": "<U0", "fortran_order": False, "shape": (rows,)}
    np.lib.format.write_array_header_1_0(header, claim)
    with zipfile.ZipFile(folder / "batch_seed0.npz", "a", zipfile.ZIP_DEFLATED) as file:
        for number in range(times):
            file.writestr(f"{name}{number if times > 1 else ''}.npy", header.getvalue())


def put_zeros(folder: Path) -> None:
    np.savez_compressed(folder / "batch_seed0.npz", zeros=np.zeros(2**20))


def add_yaml(text: str) -> Callable[[Path], object]:
    return lambda folder: (folder / CONFIG).open("a").write(f"{text}\n")


def change_device(folder: Path) -> None:
    with np.load(folder / "batch_seed0.npz") as held:
        np.savez(folder / "batch_seed0.npz", **dict(held) | {"device": "cuda:x"})


VALUES = "it has more than 5000 values, or 3000 letters in one"
BOMB = "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 9))
RUNS: dict[str, tuple[Callable[[Path], object], str]] = {
    # A little that stands for much
    "aliases": (add_yaml(f"a0: &a0 [x]\n{BOMB}"), "(YAMLError: an alias)"),
    "long value": (add_yaml("x: 0x" + "f" * 500_000), VALUES),
    "many values": (add_yaml("".join(f"k{n}: 1\n" for n in range(50_000))), VALUES),
    "long text": (add_yaml("#" * 2**20), "more than 1048576"),
    "arrays": (lambda run: put_array(run, "value.x", 1, times=1000), "more than 1000 arrays"),
    "rows": (lambda run: put_array(run, "object_names", 30_000_000), "more than 1048576 rows"),
    "zeros": (put_zeros, "its arrays have 8388736 bytes, more than 4194304"),
    # Damage
    "report": (lambda run: (run / "report.json").write_text("[" * 10_000), "cannot be read (Recur"),
    "bytes": (lambda run: (run / CONFIG).write_bytes(bytes(range(256))), "yaml: cannot be read"),
    "device": (change_device, "batch_seed0.npz: cannot be read"),
}


@pytest.mark.usefixtures("soon")
@pytest.mark.parametrize("name", RUNS)
def test_a_damaged_run_is_one_line(name: str, stranger: Path, monkeypatch: Patch) -> None:
    monkeypatch.setitem(files._MOST, ".npz", 2**22)
    damage, says = RUNS[name]
    damage(stranger)
    assert says in refused_call(lambda: replay(stranger))


@pytest.mark.usefixtures("soon")
@pytest.mark.parametrize(
    ("params", "says"),
    [
        ({"scale": 0.1, "iterations": 10**9}, "=1000000000: expected an integer from 1"),
        ({"scale": 0.1, "x": ["shoulder_pan"] * 100_000}, VALUES),
    ],
)
def test_a_policy_cannot_claim_more_than_it_is(
    params: dict[str, Any], says: str, policy: Path
) -> None:
    """Weights that are a hole of gigabytes are in test_policy.py."""
    facts = json.loads((policy / "policy.json").read_text())
    term = {"func": "mjstack.mdp.action.EndEffectorDelta", "params": params}
    facts["action"]["terms"]["evil"] = term
    (policy / "policy.json").write_text(json.dumps(facts))
    overrides = ["controller=policy", f"policy={policy}", "gates=[success]", "sim=native"]
    assert says in refused_call(lambda: check_job(load_config([*overrides, "nworld=1"])))


@pytest.mark.usefixtures("soon")
def test_damaged_weights_and_states_are_one_line(policy: Path, tmp_path: Path) -> None:
    weights = next(policy.glob("weights-*"))
    weights.write_bytes(weights.read_bytes()[:-1] + b"x")
    assert "its content is not that of policy.json" in refused_call(lambda: load_policy(policy))
    state = tmp_path / "training.safetensors"
    write_state(state, {"bias": torch.tensor([1.0, torch.nan])}, {})
    assert "bias has numbers that are not finite" in refused_call(lambda: read_state(state))
    state.write_bytes((2**22 + 8).to_bytes(8, "little") + b"{" + b" " * (2**22 + 8))
    assert "its header has more than 4194304 bytes" in refused_call(lambda: read_state(state))


def test_a_policy_that_a_training_saves_meanwhile_is_read_again(
    policy: Path, monkeypatch: Patch
) -> None:
    """The weights that policy.json has just named may be gone before they are read."""
    newer = load_policy(policy)
    with torch.no_grad():
        newer.network.layers[0].bias.add_(1.0)

    def save_before(path: Path, *most: int) -> bytes:
        if path.suffix == ".safetensors":
            monkeypatch.undo()
            save_policy(policy, newer)
        return read_inside(path, *most)

    monkeypatch.setattr("mjstack.policy.checkpoint.read_inside", save_before)
    assert torch.equal(load_policy(policy).network.layers[0].bias, newer.network.layers[0].bias)


def integers(hint: Any) -> Iterator[Range]:
    """The ranges of the integers in an annotation."""
    inner = get_args(hint)
    if hint is int or (get_origin(hint) is Annotated and inner[0] is int):
        yield next((part for part in inner[1:] if isinstance(part, Range)), Range())
    elif get_origin(hint) is not Literal:
        for part in inner:
            yield from integers(part)


def test_each_integer_that_a_folder_may_set_has_an_upper_end() -> None:
    """Rule 10: of the parameters of terms, the thresholds of checks, and a run's configuration."""
    ranges: dict[str, Range] = {}
    models = [Config]
    for line in NAMEABLE:
        term = find_object("", line.split(": ")[1])
        called = term.__init__ if isinstance(term, type) else term
        hints = {} if line.startswith("check") else get_type_hints(called, include_extras=True)
        ranges |= {f"{line}.{k}": one for k, hint in hints.items() for one in integers(hint)}
        models += [term.Thresholds] if hasattr(term, "Thresholds") else []
    while models:
        model = models.pop()
        for item in fields(model):
            hint = get_type_hints(model)[item.name]
            for part in (hint, *get_args(hint), *(p for h in get_args(hint) for p in get_args(h))):
                if is_dataclass(part) and part is not JobCfg:
                    models.append(part)
            if any(True for _ in integers(hint)):
                ranges[f"{model.__name__}.{item.name}"] = field_range(item)
    assert len(ranges) > 30
    assert not [name for name, one in ranges.items() if one.le is None and not one.choices]


LONG = "x" * 10**6
LINES: dict[str, tuple[Exception, str]] = {
    "value": (
        ConfigError("task.name", LONG, "a name", "Set another"),
        "expected a name. Set another.",
    ),
    "key": (ConfigError(LONG, 3, "a name", "Set another"), ""),
    "argument": (ArgumentError("name", [LONG], "a name", "Set another"), "a name. Set another."),
    "names": (UnknownName("object", "re", [f"red{n}" for n in range(10**5)]), "and 99993 more."),
    "fix": (FolderError("no", LONG), ""),
    "library": (KeyError(LONG), ""),
}


@pytest.mark.parametrize("name", LINES)
def test_a_line_is_short(name: str) -> None:
    """Rule 10: it begins with the key and ends with what to do."""
    error, end = LINES[name]
    assert 2 < len(describe_error(error)) <= 290
    assert describe_error(error).endswith(end)
    if isinstance(error, KeyedError):
        error.move("the.key")
        assert str(error).startswith("the.key")
        assert len(str(error)) <= 290


def test_a_line_of_some_length_is_whole() -> None:
    """Paths lose their middle before the words between them do."""
    path = "/home/somebody/with/a/very/long/path/of/folders/" * 2
    error = FolderError(f"run={path}: {path}: cannot be read, expected it as written", "Run again")
    assert "cannot be read, expected it as written. Run again." in str(error)


@pytest.mark.full
def test_no_control_character_reaches_the_terminal(stranger: Path, capsys: Capture) -> None:
    facts = json.loads((stranger / "report.json").read_text())
    facts["provenance"]["git_commit"] = "\x1b]0;PWNED\x07\x9b2J\u202e\u2066"
    (stranger / "report.json").write_text(json.dumps(facts))
    edit(stranger, "robot.title", "\x1b[8m[/]")
    assert run(["job=replay", f"run={stranger}", "world=1", "hydra.run.dir=out"]) in (0, 1)
    text = "".join(capsys.readouterr())
    assert "commit was ]0;PWNED2J in that run" in " ".join(text.split())
    assert not {"\x1b", "\x07", "\x9b", "\u202e", "\u2066"} & set(text)
    edit(stranger, "controller.action.arm.func", "os.\x1b[8m")
    assert run(["job=replay", f"run={stranger}", "world=1"]) == 2
    assert "\x1b" not in capsys.readouterr().err
