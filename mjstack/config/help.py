"""Text of ``--help`` and of the configuration reference.

Groups and choices are those of the search path; units, ranges and words are those of the fields.
"""

import inspect
import json
import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from importlib import import_module
from typing import Any, NamedTuple

from mjstack.config.complete import typed
from mjstack.config.fields import CHANGES, accepted, field_docs, field_range
from mjstack.config.fingerprint import shipped_policies
from mjstack.config.functions import find_object, offered
from mjstack.config.schema import Config
from mjstack.config.session import CONFIG_FOLDER, config_folders, list_choices
from mjstack.errors import UnknownName, require_names

_GROUP = re.compile(r"^  - (\w+): (\[.*\]|\S+) # (.+)$", re.MULTILINE)  # name, default, words
_LISTED = ("tasks", "robots", "terms", "conditions", "gates", "trainers", "policies")
_FUNCTIONS = ("terms", "conditions")  # the others are groups
_TERMS = ("action", "observation", "reward", "reset", "termination", "looks")
_RANGE = re.compile(r"(?:typing\.)?Annotated\[(\w+), Range\(.*?\)\]")
_PLAIN = re.compile(r"collections\.abc\.|mjstack\.\w+\.\w+\.|torch\.(?=Tensor)| = <.+>$")
_TEXT = """\
mjstack: a task of a robot arm, from native MuJoCo to thousands of MuJoCo Warp worlds,\
 verified in gates.

Usage: mjstack [group=choice ...] [key=value ...] [flags]
       mjstack list [tasks|robots|terms|conditions|gates|trainers|policies]
       mjstack experiment=demo    16 worlds stack by a shipped policy: see episode.html
       mjstack new task|driver|action|robot NAME [FILE.xml]    your own folder
In a checkout: python scripts/run.py ...  What this machine has: mjstack doctor

Examples:
  mjstack robot=rebot nworld=64
    all gates this machine can run
  mjstack -m robot=so101,rebot timing=default,fine
    a sweep with a summary table
  mjstack 'gates=[success]' nworld=64
    how often does it work from random starts?
  mjstack job=replay run=outputs/DATE/TIME world=17
    one world of an earlier run again: why did it fail?
  mjstack job=collect job.episodes=20
    demonstrations of the expert, as a dataset; resumes
  mjstack job=train job.folder=outputs/mine
    a policy that imitates the expert, judged by gate success; resumes
  mjstack controller=policy policy=outputs/mine/last 'gates=[success]'
    the policy in the expert's place, in any gate
  mjstack job=play controller=policy policy=outputs/mine/last
    four worlds of the policy as a video; view=web: in a browser

Groups, to be set as group=choice, and their choices, the default first:
{groups}

Keys, to be set as key=value, and their defaults:
{keys}

Keys below a group can be set too: gate.batch.seeds=10. ~reward.success leaves a term out,\
 +reward.mine=... adds one.

Flags:
  --help gate.batch        keys below one, with unit, range and meaning
  --cfg job                print the whole configuration as the other arguments make it,\
 and run nothing
  --cfg job -p gate.batch  print a part of it; job=collect --cfg job -p job has the keys of a job
  -m                       a sweep over comma-separated values
  --config-dir DIR         a folder of your own with more choices, such as DIR/task/push.yaml
  --hydra-help             Hydra's own flags
  --version                mjstack's version

Exit status: 0 passed, 1 a gate failed, 2 bad configuration or input, 130 interrupted.
"""


class Key(NamedTuple):
    """A dotted configuration key, its value, its type with range and unit, its meaning, and which
    results depend on it.
    """

    name: str
    value: str
    accepts: str
    meaning: str
    effect: str = ""


def list_groups() -> dict[str, tuple[list[str], str]]:
    """The groups of the whole search path, mjstack's in the order of composition first: the choices
    of each, the default first, and what it selects. Of ``gate``, all choices are in use at once.
    """
    choices = list_choices()
    text = (CONFIG_FOLDER / "config.yaml").read_text(encoding="utf-8")
    groups = dict.fromkeys(choices, ("", "added by the search path"))
    known = {name: (default, meaning) for name, default, meaning in _GROUP.findall(text)}
    return {
        name: (sorted(choices[name], key=default.__ne__), meaning)
        for name, (default, meaning) in (known | groups | known).items()
    }


def list_keys(
    value: Any, name: str = "", *, named: bool = True, inherited: Sequence[str] = ()
) -> Iterator[Key]:
    """Keys of a configuration at and below one of its parts, whose dotted key is ``name``.

    With ``named``, entries that users name, such as terms, are listed each. Otherwise the first one
    stands for all, as NAME and without values.
    """
    docs = field_docs(value.__class__)
    for item in fields(value) if is_dataclass(value) else ():
        child = getattr(value, item.name)
        key = f"{name}.{item.name}".lstrip(".")
        changes = field_range(item).changes or inherited
        if is_dataclass(child):
            yield from list_keys(child, key, named=named, inherited=changes)
        elif isinstance(child, dict) and any(map(is_dataclass, child.values())):
            for entry in child if named else list(child)[:1]:
                path = f"{key}.{entry if named else 'NAME'}"
                yield from list_keys(child[entry], path, named=named, inherited=changes)
        else:
            text = "" if ".NAME" in key else _yaml(child)
            effect = " ".join(filter(None, map(CHANGES.get, changes)))
            yield Key(key, text, accepted(type(value), item), docs.get(item.name, ""), effect)


def key_help(cfg: Config, prefix: str, width: int) -> str:
    """Keys of a configuration at and below a dotted one, with unit, range and meaning; an
    UnknownName if there are none.
    """
    added = {f"gate.{name}": node for name, node in cfg.gate.added.items()}
    nodes = {key: (node, "config") for key, node in added.items() if isinstance(node, dict)}
    if cfg.task.check:
        nodes["task.check"] = (cfg.task.check, "Thresholds")
    keys = [key for key in list_keys(cfg) if key.name not in nodes]
    keys = [key for key in keys if not key.name.startswith("gate.added")]
    for name in added.keys() - nodes.keys():
        keys += list_keys(added[name], name)
    for name, (node, attribute) in nodes.items():
        keys += _declared_keys(name, node, attribute)
    matching = [key for key in keys if f"{key.name}.".startswith(f"{prefix}.")]
    if not matching:
        parent = prefix.rpartition(".")[0]
        depth = prefix.count(".") + 1
        siblings = [key.name.split(".") for key in keys if f".{key.name}".startswith(f".{parent}")]
        raise UnknownName("key", prefix, {".".join(names[:depth]) for names in siblings})
    lines = []
    for key in matching:
        text = f"{key.meaning} Accepts {key.accepts}. {key.effect}"
        meaning = textwrap.wrap(text.strip(), width - 2)
        lines += [f"{key.name}={key.value}", *(f"  {line}" for line in meaning)]
    return "\n".join(lines)


def _declared_keys(key: str, node: dict[str, Any], attribute: str) -> Iterator[Key]:
    """Keys that a function declares by a dataclass, its attribute."""
    kind = offered(str(node["func"]), attribute)
    names = [item.name for item in fields(kind)] if kind else []
    for name in [name for name in node if name not in names]:
        accepts = "a dotted name" if name == "func" else "the values of its function"
        yield Key(f"{key}.{name}", _yaml(node[name]), accepts, "")
    if kind:
        values = {name: value for name, value in node.items() if name in names}
        yield from list_keys(typed(key, values, kind), key)


def help_text(cfg: Config, width: int) -> str:
    """The whole text with a configuration's values, in lines of at most ``width``."""
    groups = {
        name: f"{meaning}: {', '.join(names)}" for name, (names, meaning) in list_groups().items()
    }
    keys = {
        key.name: f"{key.meaning} ({key.value})" for key in list_keys(cfg) if "." not in key.name
    }
    for name in (*groups, "unused_terms"):  # which mjstack fills in
        keys.pop(name, None)
    text = _TEXT.format(groups=_table(groups), keys=_table(keys))
    lines = []
    for row in text.splitlines():  # the second column of a table is wrapped
        column = re.match(r"  \S.*?  +", row)
        indent = " " * len(column[0] if column else "")
        lines += textwrap.wrap(row, width, subsequent_indent=indent) or [""]
    return "\n".join(lines)


def _yaml(value: object) -> str:
    """A value as a command line has it."""
    if isinstance(value, str):
        return value
    return json.dumps(value).replace(", ", ",").replace('"', "")


def _table(rows: Mapping[str, str]) -> str:
    """Two columns, a line for each row."""
    indent = max(map(len, rows)) + 4
    return "\n".join(f"  {name}".ljust(indent) + meaning for name, meaning in rows.items())


def list_text(kinds: Sequence[str]) -> str:
    """List the choices of mjstack and of the search path, a line each; terms alone with their
    parameters. Without kinds, list all of them; an unknown one is an UnknownName.
    """
    require_names("list", kinds, _LISTED)
    lines = []
    for kind in kinds or _LISTED:
        named: Iterable[tuple[str, str]] = shipped_policies().items()
        if kind != "policies":
            one_kind = len(kinds) == 1
            named = _functions(kind, one_kind) if kind in _FUNCTIONS else _files(kind[:-1])
        lines += [f"{kind}:", *(f"  {name:<12} {meaning}".rstrip() for name, meaning in named)]
    return "\n".join(lines)


def _files(group: str) -> Iterator[tuple[str, str]]:
    """Choices of a group, and the comments that their files begin with."""
    for folder in (CONFIG_FOLDER, *config_folders()):
        for path in sorted(folder.glob(f"{group}/*.yaml")):
            comment = re.search("(?m)^# (?!@)(.+)", path.read_text("utf-8"))
            yield path.stem, comment[1] if comment else ""


def _functions(kind: str, with_parameters: bool) -> Iterator[tuple[str, str]]:
    """Terms or conditions by their dotted names, and what their docstrings begin with."""
    modules = ["mjstack.tasks.parts"]
    text = ""
    if kind == "terms":  # also those that the search path's files name
        modules = [f"mjstack.mdp.{name}" for name in _TERMS]
        paths = [path for folder in config_folders() for path in sorted(folder.rglob("*.yaml"))]
        text = "".join(path.read_text("utf-8") for path in paths)
    names = [f"{m}.{name}" for m in modules for name in vars(import_module(m)) if name[0] != "_"]
    for name in dict.fromkeys([*names, *re.findall(r"func: ([\w.]+)", text)]):
        func: Any = find_object("list", name)
        if getattr(func, "__module__", "") != name.rpartition(".")[0] or not callable(func):
            continue
        options = inspect.signature(func).parameters
        if kind == "conditions" and next(iter(options), "") == "step":  # a helper of conditions
            continue
        doc = inspect.getdoc(func) or ""
        yield name, " ".join(doc.partition("\n\n")[0].split()).partition(". ")[0]
        called = func.__init__ if inspect.isclass(func) else func
        notes = dict(re.findall(r"(?m)^ +(\w+): (.+)$", inspect.getdoc(called) or ""))
        for option in options.values() if with_parameters else ():
            if option.kind is option.KEYWORD_ONLY:
                text = _PLAIN.sub("", _RANGE.sub(r"\1", str(option)))
                yield "", f"{text}. {notes.get(option.name, '')}"
