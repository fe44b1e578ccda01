"""Cases of the fuzz: odd command lines, and command lines on damaged folders."""

import io
import json
import os
import random
import re
import shutil
import sys
import warnings
import zipfile
from collections.abc import Callable
from contextlib import chdir, suppress
from dataclasses import asdict
from hashlib import sha256
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
import torch
import yaml
from environments import configure, one_second_episode
from policies import write_policy
from safetensors.torch import load_file, save

from mjstack import load_config
from mjstack.cli import run

Make = Callable[[int, Path], list[str]]
"""Puts a case's files into its folder and returns its arguments."""


def _words(text: str) -> list[str]:
    return text.split()


QUICK = ["nworld=2", "sim=native", "gates=[baseline]"]
SHORT = [*QUICK[:2], *one_second_episode()]
JOBS = _words("gates collect export replay train")
CHOSEN = [*_words("task=stack task=box task=reach"), *(f"job={job}" for job in JOBS)]
GROUPS = _words("""
robot model scene timing solver batch sim action observation reset termination reward
controller phases gate job task experiment
""")
CHOICES = _words("""
so101 rebot builtin menagerie stack box reach fine default auto mjwarp native asset benchmark
joint_delta ee_delta joint_absolute nominal jitter randomized starts_file open_loop
closed_loop state_based baseline batch parity capacity success throughput asset_solver so100 Stack
null [] [stack,box] '' stack.yaml ../stack /etc/passwd nope
""")
_PLAIN = _words("""
-1 0 1 2 3 7 0.5 -0.001 1e-30 1e30 1e308 -1e308 1e999 10000000000000000000000 007 0x10 1_000
nan .nan inf -inf true false null None '' '' '' x red [] {} [1] [1,2] [1,2,3] [nan,0] [red]
[[1]] {a:1} {a:{b:[1]}} {func:x} {func:math.sqrt} ??? ${nope} ${seed} ${oc.env:HOME}
${oc.env:NOPE_} ${now:%Y} ${.} ${..name} ${a:b} 1,2 , = == a=b [/] [bold]x[/bold] %s {0} \\
../x /proc/x /dev/null / . .. ~ * ; | $HOME `id` é☃ 🤖 \u202e x=${y}
""")
ODD = [*_PLAIN, "a b", "'a b'", '"a b"', "a\tb", "a\nb", "\x1b[31m", "\x07", "x" * 3000, "[" * 200]
FUNCS = _words("""
mjstack.mdp.reward.reach mjstack.mdp.reward.nope mjstack.mdp.reward mjstack.mdp
mjstack.mdp.observation.joint_pos mjstack.mdp.reset.home mjstack.mdp.reset.RandomizeObjects
mjstack.mdp.termination.time_out mjstack.mdp.action.JointPosition mjstack.tasks.stack
mjstack.tasks.stack.StackCheck mjstack.tasks.box.BoxCheck mjstack.tasks.check.EpisodeCheck
mjstack.tasks.stack.StackSuccess mjstack.tasks.progress.Progress
mjstack.cli.run mjstack.cli.os.getcwd mjstack.cli.Path
mjstack.jobs.gates.JOB mjstack.jobs.collect.JOB mjstack.gates.episodes.judge_episodes
mjstack.rng.uniform mjstack.errors.ConfigError mjstack.__main__.main mjstack.envs.Env
builtins.max builtins.dict builtins.type builtins.print builtins.None builtins.object sys.exit
os.getpid os.nope math.sqrt json.loads torch.zeros torch.nn.Linear numpy.zeros
antigravity.geohash this nope nope.nope nope..nope .nope nope. mjstack..cli é.☃ '' 3 null [x]
""")
FLAGS = _words("""
--help -h --cfg=job --cfg=hydra --cfg=all --cfg=nope -c=job --version --version=1 --info
--info=config --info=defaults --info=nope --hydra-help --shell-completion --resolve
--package=gate -p=gate.nope --multirun -m --config-dir=nope --config-dir=. --config-dir
--config-name=x -cn=x --config-path=x --run -r -x --helpp --nworld=3 -- - ---
--experimental-rerun=x
""")
SWEEPS = _words("""
1,2 2,x range(1,3) range(3,1) range(1,2,0) choice(1,2) choice() glob(*) interval(0,1)
shuffle(1,2) sort(2,1) tag(t,choice(1,2)) int(2.5) str(1) bool(x) json_str(1) 1,1 1, ,1
[1,2],[3] {a:1},{b:2} extend_list(1)
""")
HYDRA = _words("""
hydra.run.dir=x hydra.run.dir=. hydra.run.dir=/proc/x hydra.run.dir= hydra.run.dir=null
hydra.run.dir=${nope} hydra.run.dir=${oc.env:NOPE_} hydra.sweep.dir=x hydra.sweep.subdir=
hydra.job.chdir=true hydra.job.chdir=3 hydra/job_logging=none hydra/job_logging=nope
hydra/hydra_logging=disabled hydra/launcher=nope hydra/sweeper=nope hydra.verbose=true
hydra.verbose=[x] hydra.output_subdir=null hydra.output_subdir=/proc/x hydra.output_subdir=x/y
hydra.searchpath=[x] hydra.searchpath=[pkg://nope] hydra.mode=MULTIRUN hydra.mode=x hydra=x
hydra.job.name=x hydra.job.num=3 hydra.job.config.override_dirname.x=1
+hydra.callbacks.x={_target_:nope.nope} hydra.callbacks=3 hydra.help.template=x
hydra.job_logging.handlers.file.filename=/proc/x ~hydra.run ~hydra hydra.runtime.cwd=x
hydra.overrides.task=[x]
""")
TEXTS = (
    b"", b"\0", b"null", b"[]", b"{}", b"3", b'"x"', b"true", b"nan", b"a: [", b"- x\n- y",
    b"\xff\xfe\x00", b"\xef\xbb\xbf{}", b"%YAML 9", b"!!python/object:os.system {}", b"&a [*a]",
    b"PK\x03\x04", b"PAR1PAR1", b"[" * 100_000, b'{"a":' * 100_000, b"a: &a [x]\nb: *c",
    b"\x1b[31m", b"a: b:",
    b"a0: &a0 [x,x,x,x,x,x,x,x,x,x]\n"
    + b"".join(b"a%d: &a%d [%s]\n" % (n, n, b"*a%d," % (n - 1) * 10) for n in range(1, 8)),
)  # fmt: skip


def command_lines(fixture: Path) -> Make:
    """Mutated command lines; an experiment in the fixture makes episodes of a second."""
    (fixture / "conf" / "experiment").mkdir(parents=True)
    phases = [o.split("=") for o in one_second_episode() if o.startswith("controller")]
    short = {"phases": {key.split(".")[2]: {"seconds": float(value)} for key, value in phases}}
    tiny = {"controller": short, "task": {"check": {"window": 5}}}
    path = fixture / "conf" / "experiment" / "tiny.yaml"
    path.write_text("# @package _global_\n" + yaml.dump(tiny))
    load_config(["experiment=tiny"], config_dir=fixture / "conf")  # composed before the children
    sys.path.remove(str(fixture))
    keys = {chosen: dict(_flat(asdict(configure(chosen)))) for chosen in CHOSEN}

    def make(case: int, cwd: Path) -> list[str]:
        draw = random.Random(f"command {case}")
        base = [f"--config-dir={fixture}/conf", *QUICK, "experiment=tiny"]
        chosen = draw.choice(["task=stack"] * 6 + list(keys))
        if chosen == "task=stack":
            args = base if draw.random() < 0.7 else QUICK.copy()
        else:
            args = [*QUICK[: draw.randrange(4)], chosen]
        for _ in range(draw.choice((1, 1, 1, 1, 2, 3))):
            mutation = draw.choice(_MUTATIONS)
            args = mutation(draw, args, keys[chosen])
        return [arg.replace("\0", "") for arg in args]

    return make


def _flat(node: Any, key: str = "") -> Any:
    """Dotted keys and their values."""
    if isinstance(node, dict) and node and key.count(".") < 5:
        for name, value in node.items():
            yield from _flat(value, f"{key}.{name}" if key else str(name))
        if key:
            yield key, node
    else:
        yield key, node


Keys = dict[str, Any]


def _value(draw: random.Random, args: list[str], keys: Keys) -> list[str]:
    """A key with a value near its own, or an odd one."""
    key, usual = draw.choice(list(keys.items()))
    value = draw.choice(ODD)
    if draw.random() < 0.7:
        if isinstance(usual, bool):
            value = str(not usual).lower()
        elif isinstance(usual, int | float):
            value = str(type(usual)(usual * draw.choice((0.5, 1, 1, 2, 10, -1))))
        elif isinstance(usual, list) and usual and isinstance(usual[0], float):
            value = str([x * draw.choice((0.9, 1.0, 1.1)) for x in usual]).replace(" ", "")
        elif isinstance(usual, str):
            value = usual
    return [*args, f"{draw.choice(('', '', '', '', '+', '++'))}{key}={value}"]


def _key(draw: random.Random, args: list[str], keys: Keys) -> list[str]:
    """A key that is misspelt, removed, or added."""
    key = draw.choice(list(keys))
    at = draw.randrange(len(key))
    wrong = draw.choice(
        (key[:at] + key[at + 1 :], key[:at] + "." + key[at:], f"{key[:at]}é{key[at:]}", f"{key}.x",
         f"{key}[0]", f"{key}@x", key.replace(".", "/", 1), key.upper(), "", ".", "a..b")
    )  # fmt: skip
    return [
        *args,
        draw.choice((f"~{key}", f"~{key}=1", f"{wrong}=1", f"+{wrong}=1", f"~{wrong}", wrong)),
    ]


def _func(draw: random.Random, args: list[str], keys: Keys) -> list[str]:
    """Another function for a term, or a term more."""
    func = draw.choice(FUNCS)
    named = [key for key in keys if key.endswith(".func")]
    params = draw.choice(("", ",params:{}", ",params:{x:1}", ",weight:1", ",weight:1,params:3"))
    section = draw.choice(
        ("reward.x", "termination.x", "reset.x", "action.x", "observation.policy.terms.x", "gate.x")
    )
    return [
        *args,
        draw.choice((f"{draw.choice(named)}={func}", f"+{section}={{func:{func}{params}}}")),
    ]


def _group(draw: random.Random, args: list[str], keys: Keys) -> list[str]:
    """A group's choice."""
    group = draw.choice(GROUPS)
    form = draw.choice(("{}={}",) * 6 + ("+{}={}", "++{}={}", "{}@x={}", "~{}", "{}:{}", "/{}={}"))
    choice = draw.choice(CHOICES)
    if draw.random() < 0.5:
        here = Path(__file__).parents[1] / "conf" / group
        choice = draw.choice(sorted(path.stem for path in here.iterdir()))
    return [*args, form.format(group, choice)]


def _flag(draw: random.Random, args: list[str], keys: Keys) -> list[str]:
    """A flag, anywhere."""
    flag = draw.choice(FLAGS).split("=")
    return _insert(draw, args, flag if draw.random() < 0.7 else ["=".join(flag)])


def _sweep(draw: random.Random, args: list[str], keys: Keys) -> list[str]:
    """A sweep, with its flag or without."""
    key = draw.choice(("nworld", "seed", "robot", "reset", "timing", draw.choice(list(keys))))
    swept = [*args, f"{key}={draw.choice(SWEEPS)}"]
    return _insert(draw, swept, ["-m"] if draw.random() < 0.8 else [])


def _hydra(draw: random.Random, args: list[str], keys: Keys) -> list[str]:
    """Hydra's own keys."""
    return [*args, draw.choice(HYDRA)]


def _text(draw: random.Random, args: list[str], keys: Keys) -> list[str]:
    """An argument that is none, or one with a character more."""
    letters = "=+~[]{}'\",:$ \\\t\n.@/-xé3"
    if draw.random() < 0.5:
        return _insert(draw, args, ["".join(draw.choices(letters, k=draw.randrange(12)))])
    number = draw.randrange(len(args))
    arg = args[number]
    at = draw.randrange(len(arg) + 1)
    return [*args[:number], arg[:at] + draw.choice(letters) + arg[at:], *args[number + 1 :]]


def _job(draw: random.Random, args: list[str], keys: Keys) -> list[str]:
    """A job, and what some of them read."""
    value = draw.choice(
        (".", "nope", "/", "/dev/null", "", "[x]", "3", "0:1", "success:1", "-1", "x")
    )
    return [*args, f"job={draw.choice(JOBS)}", f"{draw.choice(('run', 'world', 'starts'))}={value}"]


def _insert(draw: random.Random, args: list[str], more: list[str]) -> list[str]:
    at = draw.randrange(len(args) + 1)
    return [*args[:at], *more, *args[at:]]


_MUTATIONS = (
    *[_value] * 8, *[_key] * 2, *[_func] * 3, *[_group] * 3, *[_flag] * 3, *[_sweep] * 2,
    *[_text] * 9, _hydra, _job,
)  # fmt: skip


PLAY = ["controller=policy", "policy=policy", "gates=[batch]", *SHORT]


def _write_folders(fixture: Path) -> None:
    """A policy and a run."""
    with chdir(fixture):
        write_policy(Path("policy"), load_config(["sim=native"]))
        assert run(["gates=[batch]", *SHORT, "hydra.run.dir=run"]) == 1


def damaged_folders(fixture: Path) -> Make:
    """Policies that gate *batch* is to play (three of five cases), datasets that *collect* goes on
    with or a clone learns from (one of five), and runs of which a world is to be played again. One
    or two files of each are damaged.
    """
    seen = ["observation=state", "+observation.policy.noise=false"]
    collect = ["job=collect", *SHORT, *seen, "job.keep_failures=true", "job.folder=set"]
    train = ["job=train", "trainer=clone", "job.dataset=set/dataset", *SHORT, "job.folder=trained"]
    train += ["job.batches=2", "job.batch_size=16", "job.hidden=[8]"]
    _write_folders(fixture)
    with chdir(fixture):
        assert run([*collect, "job.episodes=2"]) == 0
    for picture in fixture.rglob("*.png"):
        picture.unlink()

    def make(case: int, cwd: Path) -> list[str]:
        draw = random.Random(f"folder {case}")
        name = ("policy", "set", "policy", "run", "policy")[case % 5]
        shutil.copytree(fixture / name, cwd / name)
        for _ in range(draw.choice((1, 1, 1, 2))):
            files = [path for path in sorted((cwd / name).rglob("*")) if _counts(path)]
            _damage(draw, draw.choice(files), cwd)
        if name == "policy":
            return PLAY
        if name == "set":
            return draw.choice(([*collect, "job.episodes=3"], train))
        return ["job=replay", "run=run", f"world={draw.choice(('1', '0:0'))}"]

    return make


def _counts(path: Path) -> bool:
    """Whether something reads it; what is behind a link is not the case's own."""
    if path.is_symlink():
        return False
    kinds = {".json", ".yaml", ".npz", ".parquet", ".safetensors"}
    return path.suffix in kinds or path.name in (".hydra", "meta")


def _damage(draw: random.Random, path: Path, cwd: Path) -> None:
    """Cut, replace, remove or redirect a file, or change a value in it."""
    kind = draw.choice(("cut", "text", "text", "gone", "link", "kind", *["value"] * 6))
    is_data = path.suffix in {".json", ".yaml", ".npz", ".safetensors"}
    if path.is_dir() or (kind == "value" and not is_data):
        kind = draw.choice(("gone", "link", "kind"))
    if kind == "cut":
        content = path.read_bytes()
        path.write_bytes(content[: draw.randrange(len(content) + 1)])
    elif kind == "text":
        path.write_bytes(draw.choice(TEXTS))
    elif kind == "value":
        with suppress(Exception):  # it may be damaged already
            _change_value(draw, path)
    else:
        shutil.rmtree(path) if path.is_dir() else path.unlink()
        if kind == "link":
            elsewhere = draw.choice(
                ("/dev/null", "/dev/zero", path.name, "..", "nope", "../report.md")
            )
            path.symlink_to(elsewhere)
        elif kind == "kind":
            path.write_text("x") if not path.suffix else path.mkdir()


def _change_value(draw: random.Random, path: Path) -> None:
    """Another value, or none, for a key of JSON or YAML or an array of an npz file."""
    odd: tuple[Any, ...] = (
        None, True, -1, 0, 3, 1e308, float("nan"), "", "x", "\x1b[31mx", "[/]", "é", "../x", [], {},
        [1], {"a": 1}, [[]], "${oc.env:HOME}", "${nope}", "os.getpid", 10**30, "/etc/passwd",
    )  # fmt: skip
    if path.suffix == ".npz":
        with np.load(path) as file:
            data = dict(file)
        name = draw.choice(sorted(data))
        arrays = (data[name].ravel()[:1], np.array(3.0), np.array("evil"), np.zeros((0, 3)), np.nan)
        data[name] = np.array(draw.choice(arrays))
        np.savez(path, **data)
        return
    if path.suffix == ".safetensors":
        _change_weights(draw, path)
        return
    text = path.read_text()
    data = json.loads(text) if path.suffix == ".json" else yaml.safe_load(text)
    node = data
    while True:
        names = list(node) if isinstance(node, dict) else list(range(len(node)))
        if not names:
            return
        name = draw.choice(names)
        if not isinstance(node[name], dict | list) or not node[name] or draw.random() < 0.2:
            break
        node = node[name]
    if draw.random() < 0.3 and isinstance(node, dict):
        del node[name]
    else:
        node[name] = draw.choice(odd)
    path.write_text(json.dumps(data) if path.suffix == ".json" else yaml.safe_dump(data))


def _change_weights(draw: random.Random, path: Path) -> None:
    """Another tensor in a policy, whose policy.json knows the new file."""
    tensors = load_file(path)
    name = draw.choice(sorted(tensors))
    value = tensors.pop(name)
    others = (value * np.nan, value.double(), value.flatten()[:1], torch.zeros(3), None)
    if (other := draw.choice(others)) is not None:
        tensors[name] = other.contiguous()
    content = save(tensors)
    digest = sha256(content).hexdigest()
    path.unlink()
    (path.parent / f"weights-{digest[:12]}.safetensors").write_bytes(content)
    facts = json.loads((path.parent / "policy.json").read_text())
    facts["weights_sha256"] = digest
    (path.parent / "policy.json").write_text(json.dumps(facts))


def small_files(fixture: Path) -> Make:
    """Files of a stranger of which a little stands for much, or a name for something else; a kind
    of them after the other.
    """
    _write_folders(fixture)
    kinds = (_escaped_digest, _dense_text, _dense_record, _high_value, _long_name, _odd_robot)

    def make(case: int, cwd: Path) -> list[str]:
        for name in ("policy", "run"):
            shutil.copytree(fixture / name, cwd / name)
        return kinds[case % len(kinds)](random.Random(f"small file {case}"), cwd)

    return make


def _replay_args(draw: random.Random) -> list[str]:
    return ["job=replay", "run=run", f"world={draw.choice(('1', '0:0', 'failing'))}"]


def _escaped_digest(draw: random.Random, cwd: Path) -> list[str]:
    """A policy that names its weights with escapes, which are damaged."""
    path = cwd / "policy" / "policy.json"
    facts = json.loads(path.read_text())
    digest = facts["weights_sha256"]
    weights = next((cwd / "policy").glob("weights-*"))
    kind = draw.choice(("hole", "cut", "gone", "whole", "other"))
    if kind == "hole":
        facts["network"]["hidden"] = [draw.choice((2000, 6000, 12_000))] * 2
        with weights.open("wb") as file:
            file.truncate(4 * facts["network"]["hidden"][0] ** 2)
    elif kind == "other":
        digest = "".join(draw.choices("0123456789abcdef", k=64))
    elif kind == "gone":
        weights.unlink()
    elif kind == "cut":
        weights.write_bytes(weights.read_bytes()[: draw.randrange(6000)])
    text = json.dumps(facts)
    for at in draw.sample(range(64), draw.choice((1, 3, 64))):
        text = text.replace(digest, _escaped(digest, at), 1)
    path.write_text(text.replace(facts["weights_sha256"], _escaped(digest, draw.randrange(64))))
    return PLAY


def _escaped(text: str, at: int) -> str:
    return f"{text[:at]}\\u{ord(text[at]):04x}{text[at + 1 :]}"


def _dense_text(draw: random.Random, cwd: Path) -> list[str]:
    """YAML or JSON of a run that takes long to build."""
    many = draw.choice((3000, 30_000, 300_000))
    if draw.random() < 0.3:
        versions = draw.choice(
            (
                "[" * many,
                f"[{'[],' * many}1]",
                "9" * many,
                f'"{"x" * many}"',
                f"{'9' * 4000}e{many}",
            )
        )
        text = (cwd / "run" / "report.json").read_text()
        text = text.replace('"versions": {', f'"versions": {{"mujoco": {versions}, ', 1)
        (cwd / "run" / "report.json").write_text(text)
        return _replay_args(draw)
    value = draw.choice(
        (f"1{':00' * many}", f"0x{'f' * many}", f"0{'7' * many}", f"0b{'1' * many}", "9" * many,
         f"1e{many}", f"{'[' * many}{']' * many}", "{a: " * many, "- " * many, "? " * many,
         f"[{'1,' * many}]", f"{{{'a,' * many}}}", "&a [*a]", "x" * many, "'${a:" * many,
         f"!!set {{{'x,' * many}}}", f"!!omap [{'a: 1,' * many}]", f"!!binary {'QUFB' * many}")
    )  # fmt: skip
    path = cwd / "run" / ".hydra" / "config.yaml"
    lines = path.read_text().splitlines()
    at = draw.choice([n for n, line in enumerate(lines) if ": " in line])
    entries = [f"k{n}: {draw.choice(('1', '{}', '[]'))}" for n in range(many)]
    indent = " " * (len(lines[at]) - len(lines[at].lstrip()))
    if draw.random() < 0.3:
        lines[at:at] = [indent + entry for entry in entries]
    else:
        lines[at] = f"{lines[at].partition(': ')[0]}: {value}"
    path.write_text("\n".join(lines))
    return _replay_args(draw)


def _dense_record(draw: random.Random, cwd: Path) -> list[str]:
    """An array of a run's record that claims, or unpacks to, far more than it has."""
    path = cwd / "run" / "batch_seed0.npz"
    with np.load(path) as arrays:
        names = [*arrays, "value.x", "evil"]
    count = draw.choice((10**5, 3 * 10**7, 10**9, 10**18))
    dtype = draw.choice(("<f8", "|i1", "<U0", "<U4", "|V0", "|O", "<U100000000", "|b1"))
    shape = draw.choice(((count,), (count, 0), (0, count), (1, count, 1), (2, count)))
    data = bytes(draw.choice((0, 8, 3 * 10**6, 3 * 10**7)))
    with zipfile.ZipFile(path, "a", draw.choice((0, 8, 12, 14))) as file:
        for number in range(draw.choice((1, 1, 3, 2000))):
            header = io.BytesIO()
            claim = {"descr": dtype, "fortran_order": False, "shape": shape}
            np.lib.format.write_array_header_1_0(header, claim)
            name = draw.choice(names) + f"{number}" * draw.choice((0, 1, 1))
            with warnings.catch_warnings(action="ignore"):
                file.writestr(f"{name}.npy", header.getvalue() + data * (number < 1))
    return _replay_args(draw)


def _high_value(draw: random.Random, cwd: Path) -> list[str]:
    """A number, or a list, far beyond any use in a policy's terms or a run's configuration."""
    high = draw.choice((10**6, 10**9, 2**31, 2**63, 10**30, 1e308, [1] * 4000, ["red"] * 4000))
    if draw.random() < 0.5:
        path = cwd / "run" / ".hydra" / "config.yaml"
        data = yaml.safe_load(path.read_text())
        keys = [key for key, value in _flat(data) if isinstance(value, int | float | list)]
        *groups, last = draw.choice(keys).split(".")
        node = data
        for name in groups:
            node = node[name]
        node[last] = high
        path.write_text(yaml.safe_dump(data))
        return _replay_args(draw)
    path = cwd / "policy" / "policy.json"
    facts = json.loads(path.read_text())
    term = next(iter(facts["observation"]["terms"].values()))
    func, key = draw.choice(
        (("action.EndEffectorDelta", "iterations"), ("action.EndEffectorDelta", "scale"),
         ("action.Gripper", "step"), ("action.JointPosition", "joints"))
    )  # fmt: skip
    changes: list[tuple[dict[str, Any], str]] = [
        (facts["action"], "execute"), (facts["action"], "chunk"), (facts["action"], "width"),
        (facts["network"], "hidden"), (term, "history"), (term, "scale"), (term, "clip"),
        (facts["observation"]["widths"], "joint_pos"),
    ]  # fmt: skip
    node, name = draw.choice(changes)
    if draw.random() < 0.5:
        node, name = facts["action"]["terms"], "evil"
        high = {"func": f"mjstack.mdp.{func}", "params": {key: high}}
    node[name] = high
    path.write_text(json.dumps(facts))
    return PLAY


def _long_name(draw: random.Random, cwd: Path) -> list[str]:
    """A text of a stranger that fills pages, in a policy or in a run."""
    long = draw.choice(("x", "x ", "x.", "\n", "é", "/x")) * draw.choice((500, 2000, 10**6))
    if draw.random() < 0.5:
        path = cwd / "run" / ".hydra" / "config.yaml"
        data = yaml.safe_load(path.read_text())
        *groups, last = draw.choice([key for key, _ in _flat(data)]).split(".")
    else:
        path = cwd / "policy" / "policy.json"
        data = json.loads(path.read_text())
        *groups, last = draw.choice([key for key, _ in _flat(data)]).split(".")
    node = data
    for name in groups:
        node = node[name]
    if draw.random() < 0.5:
        node[long] = node.pop(last)
    else:
        node[last] = long
    path.write_text(json.dumps(data) if path.suffix == ".json" else yaml.safe_dump(data))
    return PLAY if path.suffix == ".json" else _replay_args(draw)


def _odd_robot(draw: random.Random, cwd: Path) -> list[str]:
    """A robot's file with odd names, or one that is none; `test_new.py` holds what comes back."""
    path = cwd / draw.choice(("arm.xml", "arm\nx: 1 #.xml", "${oc.env:HOME}.xml", "a'b.xml"))
    kind = draw.choice(("names", "names", "names", "pipe", "joints", "gone"))
    odd = ("".join(draw.choices("01:, #[]{}&*!|>'\"%@`$\\\n\t-?~é回🤖=<x", k=7)) for _ in range(3))
    names = [
        *odd,
        draw.choice(("null", "1", "01", "1e5", "${seed}", "???", "", "{a: 1}", "x")),
        "jaw",
    ]
    parts = [
        f"<body name={quoteattr(name + ' body')}><joint name={quoteattr(name)}/><geom size='1'/>"
        for name in names
    ]
    if kind == "joints":
        parts = ["<body><geom size='1'/>"]
    if kind == "pipe":
        os.mkfifo(path)
    elif kind != "gone":
        body = "".join(parts).replace("\n", "&#10;").replace("\t", "&#9;") + "</body>" * len(parts)
        path.write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    command = ["new", "robot", "arm", str(path.relative_to(cwd))]
    return command


def is_short(args: list[str]) -> bool:
    """Whether a command line that passed its check can be run to its end."""
    text = " ".join(args)
    long = (
        r"seconds|seeds|repetitions|steps|iterations|physics_dt|decimation|scaling|solver|timing"
        r"|video|view|minutes|launcher|range|/proc|nworld=(?![12]\b)"
    )
    return set(QUICK) <= set(args) and not re.search(long, text)
