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

ROOT = Path(__file__).parents[1]
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


def edit_json(path: Path, change: Callable[[Any], object]) -> None:
    facts = json.loads(path.read_text())
    change(facts)
    path.write_text(json.dumps(facts))


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


# Rules 2, 5 and 8: what a run's folder names. The last ones are not built for a replay.
USED = ("reset.evil", "controller.action.arm", "gate.success.reset.evil", "task.check")
UNUSED = ("observation.policy.terms.evil", "reward.evil", "termination.evil", "task.success")


@pytest.mark.parametrize("name", ["hard", "hard-2"])
def test_a_replay_runs_no_command_of_a_gate_of_its_folder(name: str, stranger: Path) -> None:
    """Rule 5: a gate of the run may have any name."""
    edit(stranger, f"gate.{name}", {"func": EPISODES, "reset": {"evil": SHELL}})
    edit(stranger, "gates", [name])
    says = f"gate.{name}.reset.evil.func={SHELL['func']}: expected one of the reset terms"
    assert says in refused_call(lambda: replay(stranger))


@pytest.mark.parametrize("key", [*USED, *UNUSED])
def test_a_replay_runs_no_command_of_its_folder(key: str, stranger: Path) -> None:
    edit(stranger, key, SHELL | ({"weight": 1.0} if key.startswith("reward") else {}))
    if key in UNUSED:
        replay(stranger)
        assert not Path("PWNED").exists()
        return
    line = refused_call(lambda: replay(stranger))
    assert f"{key}.func=pydoc.pipepager: expected one of the" in line
    assert line.endswith("add --config-dir DIR.")


def test_no_run_brings_a_policy_of_lerobots(stranger: Path) -> None:
    """Rule 3: its folder is trusted code, and the command line alone names it."""
    edit(stranger, "controller.func", "mjstack.drivers.lerobot.LerobotDriver")
    line = refused_call(lambda: replay(stranger))
    assert "LerobotDriver: expected one of the drivers of" in line


# Each takes env first: they write, play or call what their parameters say.
DOERS = {
    "mjstack.mdp.starts.starts_file.write_starts": {"path": "victim"},
    "mjstack.episodes.rollout.rollout": {"driver": "victim"},
    "mjstack.mdp.starts.expert_states.ExpertStates": {"path": "victim"},
}


@pytest.mark.parametrize("name", DOERS)
def test_folders_name_terms_alone(name: str, policy: Path, stranger: Path) -> None:
    """Rules 4 and 5; those of a run include reset terms."""
    victim = Path("victim")
    victim.write_text("precious")
    content = (policy / "policy.json").read_text()
    for part in ("observation", "action"):
        facts = json.loads(content)
        terms = facts[part]["terms"] or facts["config"]["controller"]["action"]
        terms[next(iter(terms))].update({"func": name, "params": DOERS[name]})
        (policy / "policy.json").write_text(json.dumps(facts))
        says = f"func={name}: expected one of the {part} terms"
        assert says in refused_call(lambda: load_policy(policy))
    if "Expert" not in name:
        edit(stranger, "reset.evil-2", {"func": name, "params": DOERS[name]})
        assert f"reset.evil-2.func={name}: expected" in refused_call(lambda: replay(stranger))
    assert victim.read_text() == "precious"


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


@pytest.mark.parametrize("name", ["pydoc.pipepager", "builtins.max", "torch.save"])
def test_only_what_declares_itself_is_called(name: str, refused: Refused) -> None:
    """Rule 7, also on the command line."""
    line = refused(f"+reward.evil={{func: {name}, params: {{cmd: 'id > PWNED'}}, weight: 1}}")
    assert f"func={name}: expected a function or class whose first parameter is named env" in line
    line = refused(f"gate.batch.func={name}", "gates=[batch]")
    assert "first parameter is named run" in line


@pytest.mark.full
@pytest.mark.parametrize("key", ["reset.evil", "controller", "task.check"])
@pytest.mark.parametrize("given", ["", "conf", "beside"])
def test_no_module_of_the_folder_is_imported(
    key: str, given: str, stranger: Path, monkeypatch: Patch
) -> None:
    """Rule 9: neither from the working folder, nor where a search path makes that importable."""
    (stranger / "payload.py").write_text(PAYLOAD)
    (Path("conf") / "task").mkdir(parents=True)
    Path("beside.py").write_text(PAYLOAD.replace("open", "# open"))
    sys.path.insert(0, str(Path.cwd()))
    monkeypatch.delitem(sys.modules, "beside", raising=False)
    # The second is the user's own module, whose import runs nothing, with another's function.
    func = "beside.rmtree" if given == "beside" else "stranger.payload.X"
    edit(stranger, *((f"{key}.func", func) if key == "controller" else (key, {"func": func})))
    with search_path(["conf"] if given else []):
        line = refused_call(lambda: replay(stranger))
        assert not given or in_search_path("beside.X", stranger)
    assert f"{key}.func=" in line
    assert "stranger.payload" not in sys.modules


@pytest.mark.full
@pytest.mark.parametrize("way", ["link", "two places"])
def test_a_package_that_the_folder_lies_in_is_not_trusted(way: str, stranger: Path) -> None:
    """Rule 9: nor where its configuration is a link that leads elsewhere, or where the package has
    a second place beside the search path.
    """
    home = Path("home")
    (home / "conf" / "task").mkdir(parents=True)
    (home / "outputs").mkdir()
    saved = stranger / CONFIG
    if way == "link":
        inside = home / "outputs" / "run" / ".hydra"
        inside.mkdir(parents=True)
        (inside / "config.yaml").symlink_to(saved.resolve())
        saved = inside / "config.yaml"
    else:
        saved = Path("outputs") / "run" / "config.yaml"
        saved.parent.mkdir(parents=True)
        saved.touch()
        sys.path.insert(0, str(Path.cwd()))
    sys.path.insert(0, str(home.resolve()))
    with search_path([str(home / "conf")]):
        assert not in_search_path("outputs.run.payload.f", saved)


@pytest.mark.full
@pytest.mark.parametrize("start", ["-m mjstack", "a job of a sweep"])
def test_the_working_folder_is_not_imported_from(
    start: str, tmp_path: Path, monkeypatch: Patch
) -> None:
    """Rule 9."""
    monkeypatch.chdir(tmp_path)
    for name in ("hydra", "omegaconf", "rich", "json", "difflib", "pathlib", "platform"):
        Path(f"{name}.py").write_text(PAYLOAD)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    args = ["--cfg", "job", "-p", "nworld"]
    if start == "a job of a sweep":
        with Path("output.log").open("wb") as output:
            Child(args, output).wait()
        text = Path("output.log").read_text()
    else:
        command = [sys.executable, *start.split(), *args]
        text = subprocess.run(command, capture_output=True, text=True).stdout
    assert not Path("PWNED").exists()
    assert text.split()[-1] == "256"


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


def put_array(name: str, shape: tuple[int, ...], times: int = 1) -> Callable[[Path], object]:
    """An array in the run's record, as its header claims it to be."""

    def put(folder: Path) -> None:
        header = io.BytesIO()
        claim = {"descr": "<U0" if shape[0] > 1 else "<f8", "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(header, claim)
        with zipfile.ZipFile(folder / "batch_seed0.npz", "a", zipfile.ZIP_DEFLATED) as file:
            for number in range(times):
                data = header.getvalue() + bytes(8 * (shape[0] == 1))
                file.writestr(f"{name}{number if times > 1 else ''}.npy", data)

    return put


def add_yaml(text: str) -> Callable[[Path], object]:
    """More keys in the run's configuration."""
    return lambda folder: (folder / CONFIG).open("a").write(f"{text}\n")


def write(name: str, content: bytes) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_bytes(content)


def put_zeros(folder: Path) -> None:
    np.savez_compressed(folder / "batch_seed0.npz", zeros=np.zeros(2**20))
    assert (folder / "batch_seed0.npz").stat().st_size < 2**14


def put_versions(folder: Path) -> None:
    many = {f"v{n}": [] for n in range(5000)}
    edit_json(folder / "report.json", lambda facts: facts["provenance"].update(versions=many))


def change_record(**changes: Any) -> Callable[[Path], object]:
    def apply(folder: Path) -> None:
        path = folder / "batch_seed0.npz"
        with np.load(path) as held:
            np.savez(path, **dict(held) | changes)

    return apply


VALUES = "it has more than 5000 values, or 3000 letters in one"
BOMB = "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 9))
RUNS: dict[str, tuple[Callable[[Path], object], str]] = {
    # A little that stands for much
    "aliases": (add_yaml(f"a0: &a0 [x]\n{BOMB}"), "(YAMLError: an alias)"),
    "long value": (add_yaml("x: 0x" + "f" * 500_000), VALUES),
    "many values": (add_yaml("".join(f"k{n}: 1\n" for n in range(50_000))), VALUES),
    "long text": (add_yaml("#" * 2**20), "more than 1048576"),
    "many versions": (put_versions, VALUES),
    "arrays": (put_array("value.x", (1,), times=1000), "more than 1000 arrays"),
    "rows": (put_array("object_names", (30_000_000,)), "more than 1048576 rows"),
    "zeros": (put_zeros, "its arrays have 8388736 bytes, more than 4194304"),
    # Damage
    "deep report": (write("report.json", b"[" * 10_000), "report.json: cannot be read (Recursion"),
    "no report": (write("report.json", b'{"provenance": []}'), "report.json: cannot be read"),
    "bytes": (write(CONFIG, bytes(range(256))), "config.yaml: cannot be read"),
    "a scalar": (change_record(failed=np.int32(0)), "batch_seed0.npz: cannot be read"),
    "a device": (change_record(device="cuda:x"), "batch_seed0.npz: cannot be read"),
}


@pytest.mark.usefixtures("soon")
@pytest.mark.parametrize("name", RUNS)
def test_a_damaged_run_is_one_line(name: str, stranger: Path, monkeypatch: Patch) -> None:
    monkeypatch.setitem(files._MOST, ".npz", 2**22)
    damage, says = RUNS[name]
    damage(stranger)
    assert says in refused_call(lambda: replay(stranger))


def set_action(**params: Any) -> Callable[[Any], None]:
    term = {"func": "mjstack.mdp.action.EndEffectorDelta", "params": params}
    return lambda facts: facts["action"]["terms"].update(evil=term)


POLICIES: dict[str, tuple[Callable[[Any], object], str]] = {
    "clip": (
        lambda facts: next(iter(facts["observation"]["terms"].values())).update(clip=[True, True]),
        ".clip=[True, True]: expected a list of 2 numbers",
    ),
    "an integer": (
        set_action(scale=0.1, iterations=10**9),
        "iterations=1000000000: expected an integer from 1",
    ),
    "a list": (set_action(scale=0.1, x=["shoulder_pan"] * 100_000), VALUES),
}


@pytest.mark.usefixtures("soon")
@pytest.mark.parametrize("name", POLICIES)
def test_a_policy_cannot_claim_more_than_it_is(name: str, policy: Path) -> None:
    """Weights that are a hole of gigabytes are in test_policy.py."""
    change, says = POLICIES[name]
    edit_json(policy / "policy.json", change)
    overrides = ["controller=policy", f"policy={policy}", "gates=[success]", "sim=native"]
    assert says in refused_call(lambda: check_job(load_config([*overrides, "nworld=1"])))


@pytest.mark.usefixtures("soon")
def test_damaged_weights_and_states_are_one_line(policy: Path, tmp_path: Path) -> None:
    """A digest with escapes is read as it is: policy.json need not have it letter by letter."""
    path = policy / "policy.json"
    digest = json.loads(path.read_text())["weights_sha256"]
    escaped = digest[:30] + f"\\u{ord(digest[30]):04x}" + digest[31:]
    path.write_text(path.read_text().replace(digest, escaped))
    load_policy(policy)
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
    """Of the parameters of terms, the thresholds of checks, and a run's configuration."""
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
LINES: dict[str, Callable[[], Exception]] = {
    "value": lambda: ConfigError("task.name", LONG, "a name", "Set another"),
    "key": lambda: ConfigError(LONG, 3, "a name", "Set another"),
    "argument": lambda: ArgumentError("name", [LONG], "a name", "Set another"),
    "names": lambda: UnknownName("object", "re", [f"red{n}" for n in range(200_000)]),
    "fix": lambda: FolderError("no", LONG),
    "library": lambda: KeyError(LONG),
}


@pytest.mark.usefixtures("soon")
@pytest.mark.parametrize("name", LINES)
def test_a_line_is_short(name: str) -> None:
    """It begins with the key and ends with what to do."""
    error = LINES[name]()
    line = describe_error(error)
    assert 2 < len(line) <= 290
    if name in ("value", "argument"):
        assert line.startswith(("task.name=", "name: found"))
        assert line.endswith("expected a name. Set another.")
    if isinstance(error, KeyedError):
        error.move("the.key")
        assert str(error).startswith("the.key")
        assert len(str(error)) <= 290
    assert name != "names" or line.endswith("and 199993 more.")


def test_a_line_of_some_length_is_whole() -> None:
    """Paths lose their middle before the words between them do."""
    path = "/home/somebody/with/a/very/long/path/of/folders/" * 2
    error = FolderError(f"run={path}: {path}: cannot be read, expected it as written", "Run again")
    assert "cannot be read, expected it as written. Run again." in str(error)


@pytest.mark.full
def test_no_control_character_reaches_the_terminal(stranger: Path, capsys: Capture) -> None:
    commit = "\x1b]0;PWNED\x07\x9b2J\u202e\u2066"
    edit_json(stranger / "report.json", lambda facts: facts["provenance"].update(git_commit=commit))
    edit(stranger, "robot.title", "\x1b[8m[/]")
    assert run(["job=replay", f"run={stranger}", "world=1", "hydra.run.dir=out"]) in (0, 1)
    text = "".join(capsys.readouterr())
    assert "commit was ]0;PWNED2J in that run" in " ".join(text.split())
    assert not {"\x1b", "\x07", "\x9b", "\u202e", "\u2066"} & set(text)
    edit(stranger, "controller.action.arm.func", "os.\x1b[8m")
    assert run(["job=replay", f"run={stranger}", "world=1"]) == 2
    assert "\x1b" not in capsys.readouterr().err
