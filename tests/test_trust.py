"""Nothing that a stranger's folder names is run or followed, and no damage in it is a traceback."""

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
from collections.abc import Callable, Iterator, Sequence
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
from mjstack.config.schema import Config, JobCfg
from mjstack.config.session import check_term, in_search_path, search_path
from mjstack.episodes.record import EpisodeRecord
from mjstack.errors import (
    ArgumentError,
    ConfigError,
    FolderError,
    KeyedError,
    MjstackError,
    TermError,
    UnknownName,
    describe_error,
)
from mjstack.files import read_inside
from mjstack.jobs import check_job
from mjstack.policy import load_policy, save_policy
from mjstack.policy.checkpoint import read_state, write_state
from mjstack.process import Child

ROOT = Path(__file__).parents[1]
SHELL = {"func": "pydoc.pipepager", "params": {"cmd": "id > PWNED"}}
PAYLOAD = "open('PWNED', 'w').close()\nfrom shutil import rmtree\ndef X(env): ...\n"


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


def edit(folder: Path, key: str, value: Any) -> None:
    """Set a key of the run's configuration, as text where it is."""
    path = folder / ".hydra" / "config.yaml"
    cfg = OmegaConf.load(path)
    OmegaConf.update(cfg, key, value, merge=False, force_add=True)
    path.write_text(OmegaConf.to_yaml(cfg))


def replay(folder: Path) -> None:
    """All of job=replay that comes before it writes."""
    cfg = load_config(["job=replay"])
    cfg.run = str(folder)
    cfg.world = "1"
    check_job(cfg)


def refused(call: Callable[[], object]) -> str:
    line = refusal(call)
    assert not Path("PWNED").exists()
    return line


@pytest.mark.full
def test_runs_have_values(own: Path, tmp_path: Path, monkeypatch: Patch) -> None:
    """Of a sweep too."""
    monkeypatch.chdir(tmp_path)
    args = ["gates=[batch]", "sim=native", "nworld=1", *one_second_episode()]
    assert run([*args, "-m", "seed=1,2", "hydra.sweep.dir=all"]) == 1
    for folder in (own, tmp_path / "all" / "1"):
        assert "${" not in (folder / ".hydra" / "config.yaml").read_text()


UNUSED = ("observation.policy.terms.evil", "reward.evil", "termination.evil", "task.success")
USED = ("reset.evil", "controller.action.arm", "gate.success.reset.evil", "task.check")


def others_full(values: Sequence[str], *essential: str) -> list[Any]:
    """Parameters of which some run with the essential tests."""
    return [v if v in essential else pytest.param(v, marks=pytest.mark.full) for v in values]


@pytest.mark.parametrize("key", others_full([*UNUSED, *USED], UNUSED[0], USED[0]))
def test_a_replay_runs_no_command_of_its_folder(key: str, stranger: Path) -> None:
    edit(stranger, key, SHELL | ({"weight": 1.0} if key.startswith("reward") else {}))
    if key in USED:
        found = refused(lambda: replay(stranger))
        assert f"{key}.func=pydoc.pipepager: expected one of the" in found
        assert found.endswith("add config_dir=DIR.")
    else:
        replay(stranger)
    assert not Path("PWNED").exists()


# Each takes env first: they write, play or call what their parameters say.
DOERS = {
    "mjstack.mdp.starts.starts_file.write_starts": {"path": "victim"},
    "mjstack.bench.env_step.measure_env_step": {"name": "victim"},
    "mjstack.episodes.rollout.rollout": {"driver": "victim"},
    "mjstack.mdp.starts.expert_states.ExpertStates": {"path": "victim"},
    "mjstack.adapters.rsl_rl_runner.Runner": {"train_cfg": {}},  # of earlier versions
    "mjstack.adapters.rsl_rl.RslRlVecEnv": {},
}


@pytest.mark.parametrize("name", others_full([*DOERS], *list(DOERS)[2:5]))
def test_a_policy_names_terms_alone(name: str, tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.write_text("precious")
    folder = write_policy(tmp_path / "policy", load_config(["sim=native"]))
    path = folder / "policy.json"
    content = path.read_text()
    params = DOERS[name] | ({"path": str(victim)} if "path" in DOERS[name] else {})
    term = {"func": name, "params": params}
    for part, kind in (("observation", "observation term"), ("action", "action term")):
        facts = json.loads(content)
        terms = facts[part]["terms"] or facts["config"]["controller"]["action"]
        terms[next(iter(terms))].update(term)
        path.write_text(json.dumps(facts))
        gone = "Runner" in name
        says = f"module '{name[:-7]}' cannot" if gone else f"expected one of the {kind}s"
        assert f"func={name}: {says}" in refused(lambda: load_policy(folder))
    assert run([f"policy={folder}", "controller=policy", "gates=[success]", "nworld=2"]) == 2
    assert victim.read_text() == "precious"


IN_RUNS = [name for name in DOERS if not name.endswith(("ExpertStates", "Runner"))]


@pytest.mark.parametrize("name", others_full(IN_RUNS, IN_RUNS[0]))
@pytest.mark.parametrize("term", ["evil", "evil-2"])
def test_a_run_names_terms_alone(name: str, term: str, stranger: Path) -> None:
    edit(stranger, f"reset.{term}", {"func": name, "params": DOERS[name]})
    assert f"reset.{term}.func={name}: expected" in refused(lambda: replay(stranger))


def test_each_kind_of_term_is_listed(tmp_path: Path) -> None:
    """A policy names observation and action terms, a run action and reset terms, checks and
    drivers: those of the list, and nothing else of mjstack.
    """
    listed = set((ROOT / "tests" / "data" / "may_be_named.txt").read_text().splitlines())
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
    assert named == listed


CALLABLE = ("pydoc.pipepager", "builtins.max", "builtins.dict", "sys.exit", "torch.save")


@pytest.mark.parametrize("name", others_full(CALLABLE, CALLABLE[0]))
def test_only_what_declares_itself_is_called(name: str, refused: Refused) -> None:
    line = refused(f"+reward.evil={{func: {name}, params: {{cmd: 'id > PWNED'}}, weight: 1}}")
    assert f"func={name}: expected a function or class whose first parameter is named env" in line


@pytest.mark.full
def test_a_gate_declares_itself(capsys: Capture) -> None:
    assert run(["gate.batch.func=os.system", "gates=[batch]"]) == 2
    assert "first parameter is named run" in capsys.readouterr().err


@pytest.mark.full
@pytest.mark.parametrize("key", ["reset.evil", "controller.action.arm", "controller", "task.check"])
@pytest.mark.parametrize("given", ["", "conf", "beside"])
def test_no_module_of_the_folder_is_imported(
    key: str, given: str, stranger: Path, monkeypatch: Patch
) -> None:
    """Neither from the working folder, nor where a search path makes that importable."""
    (stranger / "payload.py").write_text(PAYLOAD)
    (Path("conf") / "task").mkdir(parents=True)
    Path("beside.py").write_text(PAYLOAD.replace("open", "# open"))
    sys.path.insert(0, str(Path.cwd()))
    monkeypatch.delitem(sys.modules, "beside", raising=False)
    # The second is the user's own module, whose import runs nothing, with another's function.
    func = "beside.rmtree" if given == "beside" else "stranger.payload.X"
    edit(stranger, *((f"{key}.func", func) if key == "controller" else (key, {"func": func})))
    with search_path(["conf"] if given else []):
        found = refused(lambda: replay(stranger))
        assert not given or in_search_path("beside.X", stranger)
    assert f"{key}.func=" in found
    assert "stranger.payload" not in sys.modules


@pytest.mark.full
@pytest.mark.parametrize("way", ["link", "two places"])
def test_a_package_that_the_folder_lies_in_is_not_trusted(
    way: str, stranger: Path, monkeypatch: Patch
) -> None:
    """Nor where its configuration is a link that leads elsewhere, or where the package has a second
    place beside the search path.
    """
    home = Path("home")
    (home / "conf" / "task").mkdir(parents=True)
    (home / "outputs").mkdir()
    saved = stranger / ".hydra" / "config.yaml"
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
    monkeypatch.chdir(tmp_path)
    for name in ("hydra", "omegaconf", "rich", "json", "difflib", "pathlib", "platform"):
        Path(f"{name}.py").write_text(PAYLOAD)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    args = ["--cfg", "job", "-p", "nworld"]
    if start == "a job of a sweep":
        log = tmp_path / "output.log"
        with log.open("wb") as output:
            Child(args, output).wait()
        text = log.read_text()
    else:
        command = [sys.executable, *start.split(), *args]
        text = subprocess.run(command, capture_output=True, text=True).stdout
    assert not Path("PWNED").exists()
    assert text.split()[-1] == "256"


FOLLOWED = {
    "environment": ("task.instruction", "${oc.env:HOME}", "it has ${...}"),
    "robot's name": ("robot.name", "../../x", "robot.name=../../x: expected a name that"),
    "absolute name": ("robot.menagerie_file", "/etc/passwd", "robot.menagerie_file=/etc/passwd"),
    "robot's file": ("robot.file", "{stranger}/arm.xml", "stranger/arm.xml: expected a fil"),
    "relative file": ("robot.file", "stranger/arm.xml", "add config_dir='{stranger}'."),
}


@pytest.mark.full
@pytest.mark.parametrize("name", FOLLOWED)
def test_nothing_outside_is_read(name: str, stranger: Path) -> None:
    shutil.copy(ROOT / "mjstack" / "robots" / "so101.xml", stranger / "arm.xml")
    key, value, says = (part.replace("{stranger}", str(stranger)) for part in FOLLOWED[name])
    edit(stranger, key, value)
    assert says in refused(lambda: replay(stranger))
    if key == "robot.file":  # the line tells how to allow it
        with search_path([stranger]):
            replay(stranger)


@pytest.mark.parametrize("fixed", [False, True])
def test_no_file_outside_is_compiled(fixed: bool, stranger: Path, monkeypatch: Patch) -> None:
    def compiled(*args: Any, **options: Any) -> None:
        pytest.fail("compiled")

    monkeypatch.setattr("mjstack.config.mjcf.read_mjcf", compiled)
    Path(stranger / "thing.xml").write_text("<mujoco/>")
    edit(stranger, "scene.objects.red.fixed", fixed)
    for file in (f"{stranger}/thing.xml", "stranger/thing.xml", "/none.xml"):
        edit(stranger, "scene.objects.red.file", file)
        assert "expected a file beside a " in refused(lambda: replay(stranger))


@pytest.mark.full
def test_aliases_are_refused_at_once(stranger: Path) -> None:
    path = stranger / ".hydra" / "config.yaml"
    bomb = "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 9))
    path.write_text(f"{path.read_text()}a0: &a0 [x]\n{bomb}")
    assert "(YAMLError: an alias)" in refused(lambda: replay(stranger))


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


@pytest.mark.usefixtures("soon")
@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_only_regular_files_are_read(kind: str, stranger: Path) -> None:
    def swap(path: Path) -> Path:
        path.unlink(missing_ok=True)
        os.mkfifo(path) if kind == "pipe" else path.symlink_to("/dev/zero")
        return path

    folder = write_policy(stranger.parent / "policy", load_config(["sim=native"]))
    swap(next(folder.glob("weights-*")))
    assert "it is no regular file" in refused(lambda: load_policy(folder))
    for name in ("batch_seed0.npz", ".hydra/hydra.yaml"):
        swap(stranger / name)
        if name == "batch_seed0.npz":
            assert "it is no regular file" in refused(lambda: replay(stranger))
        else:
            edit(stranger, "task.check.func", "os.system")
            assert "add config_dir=DIR." in refused(lambda: replay(stranger))
    state = swap(stranger / "training.safetensors")
    assert "it is no regular file" in refused(lambda: read_state(state))
    starts = swap(stranger / "starts.npz")
    overrides = ["reset=starts_file", f"starts={starts}", "sim=native", "nworld=1"]
    assert f"starts={starts}" in refused(lambda: make_env(overrides))
    assert "it is no regular file" in refused(lambda: content(starts))


def content(starts: Path) -> object:
    """What a starts file counts as."""
    return config_content(load_config(["reset=starts_file", f"starts={starts}"]))


@pytest.mark.usefixtures("soon")
def test_a_policy_cannot_claim_more_than_it_is(tmp_path: Path) -> None:
    """Weights that are a hole of gigabytes are in test_policy.py."""
    folder = write_policy(tmp_path / "policy", load_config(["sim=native"]))
    path = folder / "policy.json"
    odd = json.loads(path.read_text())
    next(iter(odd["observation"]["terms"].values()))["clip"] = [True, True]
    path.write_text(json.dumps(odd))
    line = refused(lambda: load_policy(folder))
    assert line.startswith(f"{path}: observation.policy.terms.")
    assert ".clip=[True, True]: expected a list of 2 numbers" in line


def test_arrays_are_not_unpacked_without_end(stranger: Path, monkeypatch: Patch) -> None:
    """A few bytes of an npz file may stand for gigabytes."""
    monkeypatch.setitem(files._MOST, ".npz", 2**22)
    for name in ("batch_seed0.npz", "starts.npz"):
        np.savez_compressed(stranger / name, zeros=np.zeros(2**20))
        assert (stranger / name).stat().st_size < 2**14
    assert "its arrays have 8388736 bytes, more than 4194304" in refused(lambda: replay(stranger))
    starts = stranger / "starts.npz"
    overrides = ["reset=starts_file", f"starts={starts}", "sim=native", "nworld=1"]
    assert f"starts={starts}" in refused(lambda: make_env(overrides))


def put_array(
    name: str, dtype: str, shape: tuple[int, ...], data: bytes = b"", times: int = 1
) -> Any:
    """An array in the run's record, as its header claims it to be."""

    def put(folder: Path) -> None:
        header = io.BytesIO()
        claim = {"descr": dtype, "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(header, claim)
        with zipfile.ZipFile(folder / "batch_seed0.npz", "a", zipfile.ZIP_DEFLATED) as file:
            for number in range(times):
                again = f"{number}" * (times > 1)
                file.writestr(f"{name}{again}.npy", header.getvalue() + data)

    return put


def add_yaml(text: str) -> Callable[[Path], object]:
    """More keys in the run's configuration."""

    def add(folder: Path) -> None:
        path = folder / CONFIG
        path.write_text(f"{path.read_text()}{text}\n")

    return add


# A few kilobytes or megabytes that stand for minutes or gigabytes, and what is said of them
CONFIG = ".hydra/config.yaml"
VALUES = "it has more than 5000 values, or 3000 letters in one"
SMALL: dict[str, tuple[Callable[[Path], object], str]] = {
    "base 60": (add_yaml("x: 1" + ":00" * 300_000), VALUES),
    "hexadecimal": (add_yaml("x: 0x" + "f" * 500_000), VALUES),
    "a short number in base 60": (add_yaml("x: 1" + ":00" * 900), "Key 'x' not in 'Config'"),
    "brackets": (add_yaml(f"x: {'[' * 100_000}{']' * 100_000}"), VALUES),
    "dashes": (add_yaml(f"x:\n  {'- ' * 100_000}x"), VALUES),
    "keys": (add_yaml("".join(f"k{n}: 1\n" for n in range(50_000))), VALUES),
    "long text": (add_yaml("#" * 2**20), "more than 1048576"),
    "arrays": (put_array("value.x", "<f8", (1,), bytes(8), times=1000), "more than 1000 arrays"),
    "no bytes": (put_array("object_names", "<U0", (30_000_000,)), "more than 1048576 rows"),
    "empty lists": (put_array("object_names", "<U4", (30_000_000, 0)), "more than 1048576 rows"),
    "a lie": (put_array("value.x", "<f8", (10**18,)), "cannot be read (MemoryError"),
    "names": (put_array("phase_names", "|i1", (10**7,), bytes(10**7)), "more than 1048576 rows"),
    "wide names": (put_array("phase_names", "|i1", (10, 10**7), bytes(10**8)), "of size 1"),
    "worlds": (put_array("failed", "|i1", (10**7,), bytes(10**7)), "more than 1048576 rows"),
}


@pytest.mark.usefixtures("soon")
@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize("name", SMALL)
def test_a_small_file_does_not_stand_for_much(name: str, stranger: Path) -> None:
    damage, says = SMALL[name]
    damage(stranger)
    assert says in refused(lambda: replay(stranger))


@pytest.mark.usefixtures("soon")
def test_what_is_listed_of_a_report_is_bounded(stranger: Path) -> None:
    path = stranger / "report.json"
    report = json.loads(path.read_text())
    report["provenance"]["versions"] = {f"v{n}": [] for n in range(5000)}
    path.write_text(json.dumps(report))
    assert VALUES in refused(lambda: replay(stranger))


@pytest.mark.usefixtures("soon")
def test_tensors_have_few_names(tmp_path: Path) -> None:
    """A header of 20 MB would be 300,000 tensors, each of which takes a kilobyte."""
    path = tmp_path / "training.safetensors"
    path.write_bytes((2**22 + 8).to_bytes(8, "little") + b"{" + b" " * (2**22 + 8))
    assert "its header has more than 4194304 bytes" in refused(lambda: read_state(path))


@pytest.mark.usefixtures("soon")
def test_a_digest_with_escapes_is_read_as_it_is(tmp_path: Path) -> None:
    """The text of policy.json need not have it letter by letter. Damaged weights are read twice at
    most: the next ones may have been saved meanwhile.
    """
    folder = write_policy(tmp_path / "policy", load_config(["sim=native"]))
    path = folder / "policy.json"
    digest = json.loads(path.read_text())["weights_sha256"]
    escaped = digest[:30] + f"\\u{ord(digest[30]):04x}" + digest[31:]
    path.write_text(path.read_text().replace(digest, escaped))
    load_policy(folder)
    weights = next(folder.glob("weights-*"))
    content = bytearray(weights.read_bytes())
    content[-1] ^= 1
    weights.write_bytes(content)
    assert "its content is not that of policy.json" in refused(lambda: load_policy(folder))
    weights.unlink()
    assert "No such file" in refused(lambda: load_policy(folder))


PARAMETERS = {  # of allowed terms in a policy: value, and what is said of it
    "iterations": ("mjstack.mdp.action.EndEffectorDelta", {"scale": 0.1, "iterations": 10**9}),
    "joints": ("mjstack.mdp.action.JointPosition", {"joints": ["shoulder_pan"] * 100_000}),
}


@pytest.mark.usefixtures("soon")
def test_an_allowed_term_takes_no_value_without_end(tmp_path: Path) -> None:
    folder = write_policy(tmp_path / "policy", load_config(["sim=native"]))
    path = folder / "policy.json"
    content = path.read_text()
    overrides = ["controller=policy", f"policy={folder}", "gates=[success]", "sim=native"]

    def play() -> None:
        check_job(load_config([*overrides, "nworld=1"]))

    for name, (func, params) in PARAMETERS.items():
        facts = json.loads(content)
        facts["action"]["terms"]["evil"] = {"func": func, "params": params}
        path.write_text(json.dumps(facts))
        says = VALUES if name == "joints" else "iterations=1000000000: expected an integer from 1"
        assert says in refused(play)


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
    for line in (ROOT / "tests" / "data" / "may_be_named.txt").read_text().splitlines():
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
    assert len(ranges) > 40
    assert not [name for name, one in ranges.items() if one.le is None and not one.choices]


LONG = "x" * 10**6
LINES: dict[str, Callable[[], Exception]] = {
    "value": lambda: ConfigError("task.name", LONG, "a name", "Set another"),
    "key": lambda: ConfigError(LONG, 3, "a name", "Set another"),
    "words": lambda: ConfigError("task.name", "x " * 10**6, "a name", "Set another"),
    "argument": lambda: ArgumentError("name", [LONG], "a name", "Set another"),
    "unknown": lambda: UnknownName("object", LONG, ["red", "blue"]),
    "names": lambda: UnknownName("object", "re", [f"red{n}" for n in range(200_000)]),
    "long names": lambda: UnknownName("object", "re", [LONG, LONG[1:]]),
    "term": lambda: TermError("reset.x", LONG),
    "file": lambda: FolderError(LONG, "Name another"),
    "fix": lambda: FolderError("no", LONG),
    "library": lambda: KeyError(LONG),
    "lines": lambda: ValueError("x\n" * 10**6),
}


@pytest.mark.usefixtures("soon")
@pytest.mark.parametrize("name", LINES)
def test_a_line_is_short(name: str) -> None:
    """It begins with the key and ends with what to do."""
    error = LINES[name]()
    line = describe_error(error)
    assert 2 < len(line) <= 290
    if isinstance(error, ConfigError | ArgumentError) and name != "key":
        assert line.startswith(("task.name=", "name: found"))
        assert line.endswith("expected a name. Set another.")
    if isinstance(error, KeyedError):
        error.move("the.key")
        assert str(error).startswith("the.key")
        assert len(str(error)) <= 290
    if name == "names":
        assert "Did you mean" in line
        assert line.endswith("and 199993 more.")


def test_a_line_of_some_length_is_whole() -> None:
    """Paths lose their middle before the words between them do."""
    path = "/home/somebody/with/a/very/long/path/of/folders/" * 2
    error = FolderError(
        f"run={path}: {path}: cannot be read, expected it as written", "Run it again"
    )
    assert "cannot be read, expected it as written. Run it again." in str(error)
    text = "x" * 200 + " expected a name. Set another"
    assert str(FolderError(text)) == f"{text}."


def test_a_policy_that_a_training_saves_meanwhile_is_read_again(
    tmp_path: Path, monkeypatch: Patch
) -> None:
    """The weights that policy.json has just named may be gone before they are read."""
    folder = write_policy(tmp_path / "policy", load_config(["sim=native"]))
    newer = load_policy(folder)
    with torch.no_grad():
        newer.network.layers[0].bias.add_(1.0)

    def save_before(path: Path, *most: int) -> bytes:
        if path.suffix == ".safetensors":
            monkeypatch.undo()
            save_policy(folder, newer)
        return read_inside(path, *most)

    monkeypatch.setattr("mjstack.policy.checkpoint.read_inside", save_before)
    assert torch.equal(load_policy(folder).network.layers[0].bias, newer.network.layers[0].bias)


def test_no_training_goes_on_from_numbers_that_are_not_finite(tmp_path: Path) -> None:
    path = tmp_path / "training.safetensors"
    write_state(path, {"count": torch.tensor(3), "bias": torch.tensor([1.0, torch.nan])}, {})
    assert "bias has numbers that are not finite" in refused(lambda: read_state(path))


def damage_record(**changes: Any) -> Callable[[Path], object]:
    def apply(folder: Path) -> None:
        path = folder / "batch_seed0.npz"
        with np.load(path) as held:
            arrays = dict(held)
        arrays.update({k: f(arrays[k]) if callable(f) else f for k, f in changes.items()})
        np.savez(path, **arrays)

    return apply


RECORD = "batch_seed0.npz: cannot be read"


def write(name: str, content: bytes) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_bytes(content)


def damage_hydra(folder: Path) -> None:
    edit(folder, "task.check.func", "os.system")
    write(".hydra/hydra.yaml", b"hydra: [3]")(folder)


DEEP = b"[" * 10_000  # ten times as deep as Python recurses
DAMAGE = {
    "backend": (damage_record(backend="evil"), RECORD),
    "device": (damage_record(device="cuda:x"), RECORD),
    "scalar": (damage_record(failed=np.int32(0)), RECORD),
    "rows": (damage_record(start_qpos=lambda x: x[:1]), RECORD),
    "text": (damage_record(start_qpos=lambda x: x.astype(str)), RECORD),
    "flat": (damage_record(qpos=lambda x: x.ravel()), RECORD),
    "deep report": (write("report.json", DEEP), "report.json: cannot be read (RecursionError"),
    "list": (write("report.json", b'{"provenance": []}'), "report.json: cannot be read"),
    "versions": (write("report.json", b'{"provenance": {"versions": 3}}'), "json: cannot be read"),
    "deep configuration": (write(CONFIG, DEEP), "config.yaml: cannot be read (ValueError"),
    "bytes": (write(CONFIG, bytes(range(256))), "config.yaml: cannot be read"),
    "hydra": (damage_hydra, "add config_dir=DIR."),
}


@pytest.mark.full
@pytest.mark.parametrize("name", DAMAGE)
def test_damage_is_one_line(name: str, stranger: Path) -> None:
    damage, says = DAMAGE[name]
    damage(stranger)
    assert says in refused(lambda: replay(stranger))


@pytest.mark.full
def test_a_record_is_read_as_it_was_written(own: Path) -> None:
    record = EpisodeRecord.read(own, 0)
    assert record is not None
    assert record.qpos.shape == record.worlds["start_qpos"].shape == (2, 20)


@pytest.mark.full
def test_no_control_character_reaches_the_terminal(stranger: Path, capsys: Capture) -> None:
    report = json.loads((stranger / "report.json").read_text())
    report["provenance"]["git_commit"] = "\x1b]0;PWNED\x07\x9b2J\u202e\u2066"
    (stranger / "report.json").write_text(json.dumps(report))
    edit(stranger, "robot.title", "\x1b[8m[/]")
    assert run(["job=replay", f"run={stranger}", "world=1", "hydra.run.dir=out"]) in (0, 1)
    told = "".join(capsys.readouterr())
    assert "commit was ]0;PWNED2J in that run" in " ".join(told.split())
    assert not {"\x1b", "\x07", "\x9b", "\u202e", "\u2066"} & set(told)
    edit(stranger, "robot.title", 3)
    edit(stranger, "controller.action.arm.func", "os.\x1b[8m")
    assert run(["job=replay", f"run={stranger}", "world=1"]) == 2
    assert "\x1b" not in capsys.readouterr().err
