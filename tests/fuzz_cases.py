"""Cases of the fuzz: odd command lines, and command lines on damaged folders."""

import json
import random
import re
import shutil
import sys
from collections.abc import Callable
from contextlib import chdir, suppress
from dataclasses import asdict
from hashlib import sha256
from pathlib import Path
from typing import Any

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
closed_loop baseline batch parity capacity success throughput asset_solver so100 Stack
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
    b"\x1b[31m", b"a: b:", b"x: 1" + b":00" * 30_000, b"x: 0x" + b"f" * 300_000,
    b"x: !!binary " + b"QUFB" * 30_000, b"? " * 30_000, b"- " * 30_000, b"{a: " * 30_000,
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


def damaged_folders(fixture: Path) -> Make:
    """Policies that gate *batch* is to play, and runs of which worlds are to be played again. One
    or two files of each are damaged.
    """
    with chdir(fixture):
        write_policy(Path("policy"), load_config(["sim=native"]))
        assert run(["gates=[batch]", *SHORT, "hydra.run.dir=run"]) == 1
    for picture in fixture.rglob("*.png"):
        picture.unlink()

    def make(case: int, cwd: Path) -> list[str]:
        draw = random.Random(f"folder {case}")
        name = ("policy", "run")[case % 2]
        shutil.copytree(fixture / name, cwd / name)
        for _ in range(draw.choice((1, 1, 1, 2))):
            files = [path for path in sorted((cwd / name).rglob("*")) if _counts(path)]
            _damage(draw, draw.choice(files))
        worlds = draw.choice(("1", "0:0", "failing"))
        return PLAY if name == "policy" else ["job=replay", "run=run", f"world={worlds}"]

    return make


def _counts(path: Path) -> bool:
    """Whether something reads it; what is behind a link is not the case's own."""
    if path.is_symlink():
        return False
    return path.suffix in {".json", ".yaml", ".npz", ".safetensors"} or path.name == ".hydra"


def _damage(draw: random.Random, path: Path) -> None:
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
        10**6, 2**63, [1] * 4000, ["red"] * 4000, "x" * 10**6, "/x" * 500, "\n" * 2000,
        {f"k{n}": [] for n in range(30_000)}, {"func": "mjstack.mdp.action.Gripper"},
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


def is_short(args: list[str]) -> bool:
    """Whether a command line that passed its check can be run to its end."""
    text = " ".join(args)
    long = (
        r"seconds|seeds|repetitions|steps|iterations|physics_dt|decimation|scaling|solver|timing"
        r"|video|view|minutes|launcher|range|/proc|nworld=(?![12]\b)"
    )
    return set(QUICK) <= set(args) and not re.search(long, text)
