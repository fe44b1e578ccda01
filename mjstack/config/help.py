"""What ``--help`` says. Groups, choices, keys and the words for them are read from `conf/`, where
they are defined.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.resources import files

from mjstack.config.session import list_choices

_CONF = files("mjstack.conf")
_GROUP = re.compile(r"  - (?P<name>\w+): (?P<default>\[.*\]|\S+) # (?P<words>.+)")
_KEY = re.compile(r"(?P<name>\w+): (?P<default>\[.*\]|\S+) # (?P<words>.+)")
_EXAMPLES = (
    ("robot=rebot nworld=64", "all gates this machine can run"),
    ("'gates=[baseline,parity]' timing=fine", "two gates, 1 ms physics"),
    ("batch.njmax=200 'gates=[capacity]'", "are 200 constraint rows enough?"),
    ("-m robot=so101,rebot timing=default,fine", "a sweep with a summary table"),
    ("'gates=[batch]' gate.batch.seeds=10", "ten seeds: how rare are failures?"),
    ("'gates=[success]' nworld=64", "how often does it work from random starts?"),
    (
        "reset=starts_file starts=worlds.csv nworld=64",
        "worlds that start as the rows of a file say",
    ),
    (
        "job=replay run=outputs/DATE/TIME world=17",
        "one world of an earlier run again: why did it fail?",
    ),
    ("job=collect job.episodes=20", "demonstrations of the scripted expert, as a dataset; resumes"),
    ("job=scaling robot=so101", "throughput from 1 to 32,768 worlds; resumes"),
    ("job=study nworld=8", "what the solver's limits cost, and who is still succeeded"),
    (
        "job=reachability robot=rebot",
        "what the arm reaches, and how far cubes may stand from their places",
    ),
)
_FLAGS = (
    ("--cfg job", "print the whole configuration as the other arguments make it, and run nothing"),
    (
        "--cfg job -p gate.batch",
        "print a part of it; job=collect --cfg job -p job has the keys of a job",
    ),
    ("-m", "a sweep over comma-separated values"),
    ("--config-dir DIR", "a folder of your own with more choices, such as DIR/task/push.yaml"),
    ("--hydra-help", "Hydra's own flags"),
    ("--version", "mjstack's version"),
)
_STATUSES = "Exit status: 0 passed, 1 a gate failed, 2 bad configuration or input, 130 interrupted."


@dataclass(frozen=True, slots=True)
class Group:
    """A configuration group.

    Attributes:
        name: Such as ``robot``.
        choices: Its files, the default first. Of ``gate``, whose files are all there at once: all.
        words: What it selects.
    """

    name: str
    choices: Sequence[str]
    words: str


@dataclass(frozen=True, slots=True)
class Key:
    """A top-level key: its name, its default as YAML has it, and what it is."""

    name: str
    default: str
    words: str


def list_groups() -> list[Group]:
    """The groups of the whole search path, mjstack's in the order of composition first."""
    choices = list_choices()
    known = {name: (default, words) for name, default, words in _entries(_GROUP)}
    groups = []
    for name in [*known, *(name for name in choices if name not in known)]:
        default, words = known.get(name, ("", "added by the search path"))
        first = [choice for choice in choices[name] if choice == default]
        rest = [choice for choice in choices[name] if choice != default]
        groups.append(Group(name, first + rest, words))
    return groups


def list_keys() -> list[Key]:
    """The top-level keys that are no groups."""
    return [Key(*entry) for entry in _entries(_KEY)]


def help_text(width: int) -> str:
    """The whole text, in lines that are not longer than ``width``."""
    groups = [(group.name, f"{group.words}: {', '.join(group.choices)}") for group in list_groups()]
    keys = [(key.name, f"{key.words} ({key.default.replace(', ', ',')})") for key in list_keys()]
    parts = [
        [
            "mjstack: two cubes and one simulated arm, from native MuJoCo to thousands of MuJoCo"
            " Warp worlds, verified in gates."
        ],
        [
            "Usage: mjstack [group=choice ...] [key=value ...] [flags]",
            "In a checkout: python scripts/run.py ...",
        ],
        [
            "Examples:",
            *_table([(f"mjstack {command}", words) for command, words in _EXAMPLES], width),
        ],
        [
            "Groups, to be set as group=choice, and their choices, the default first:",
            *_table(groups, width),
        ],
        ["Keys, to be set as key=value, and their defaults:", *_table(keys, width)],
        [
            "What groups hold can be set too: gate.batch.seeds=10. ~reward.grasp leaves a term out,"
            " +reward.mine=... adds one. --cfg job prints them all."
        ],
        ["Flags:", *_table(_FLAGS, width)],
        [_STATUSES],
    ]
    return "\n\n".join(
        "\n".join(line for text in part for line in textwrap.wrap(text, width)) for part in parts
    )


def _entries(pattern: re.Pattern[str]) -> Iterator[tuple[str, str, str]]:
    for line in _CONF.joinpath("config.yaml").read_text(encoding="utf-8").splitlines():
        if match := pattern.fullmatch(line):
            yield match["name"], match["default"], match["words"]


def _table(rows: Sequence[tuple[str, str]], width: int) -> list[str]:
    """Two columns as lines, of which the second is wrapped."""
    indent = max(len(name) for name, _ in rows) + 4
    lines = []
    for name, words in rows:
        lines += textwrap.wrap(
            words, width, initial_indent=f"  {name}".ljust(indent), subsequent_indent=" " * indent
        )
    return lines
