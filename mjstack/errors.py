"""Errors built from facts: what is wrong with its value, what was expected, what to do.

Every error that a user can cause derives from `MjstackError`.
"""

import difflib
import json
import re
import sysconfig
import traceback
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

# As Python, C++, NumPy, torch, Warp and CUDA put it, each with another exception.
_OUT_OF_MEMORY = re.compile(
    r"out of memory|OutOfMemory|MemoryError|bad_alloc|failed to allocate|unable to allocate"
    r"|can't allocate memory|not enough memory",
    re.IGNORECASE,
)
_MOST_LETTERS = 290  # of a line, before which the command puts its name
_MOST_NAMED = 7  # names of a list in it
_LIBRARIES = (  # whose frames tell a user nothing
    *(sysconfig.get_path(name) for name in ("stdlib", "purelib", "platlib")),
    str(Path(__file__).parent),
    "<",
)


def is_out_of_memory(text: str) -> bool:
    """Whether an exception's type and text, or a process's output, say that memory ran out."""
    return _OUT_OF_MEMORY.search(text) is not None


class MjstackError(Exception):
    """Base class. Its message is one line that a user can act on."""

    exit_code = 2  # of a command line that could not begin

    def __init__(self, problem: str, fix: str = "") -> None:
        """Build the message from the problem, a value or an event and what was expected, with or
        without its full stop, and the fix: what to do about it, a sentence without one.
        """
        stop = "" if problem.endswith((".", "?")) else "."
        super().__init__(shorten(f"{problem}{stop}{f' {fix}.' if fix else ''}"))


class KeyedError(MjstackError):
    """An error of a dotted configuration key, with which its message begins."""

    def __init__(self, key: str, problem: str, fix: str = "") -> None:
        super().__init__(f"{key}{problem}", fix)
        self.key = key
        self._rest = (problem, fix)

    def move(self, key: str) -> None:
        """Name the key that the user has set instead."""
        KeyedError.__init__(self, key, *self._rest)


@contextmanager
def renamed_keys(keys: Mapping[str, str]) -> Iterator[None]:
    """Let errors of what runs inside name the keys that the user has set, by the beginnings of the
    keys that they name.
    """
    try:
        yield
    except KeyedError as error:
        for inner, outer in keys.items():
            if f"{error.key}.".startswith(f"{inner}."):
                error.move(outer + error.key.removeprefix(inner))
                break
        raise


class ConfigError(KeyedError):
    """A value in the configuration cannot be used."""

    def __init__(self, key: str, value: object, expected: str, fix: str = "") -> None:
        text = json.dumps(value) if value is None or isinstance(value, bool) else value
        super().__init__(key, f"={text}: expected {expected}", fix)


class UnknownName(MjstackError):
    """A name that does not exist, listed with the ones that do."""

    def __init__(self, what: str, name: str, available: Iterable[str]) -> None:
        super().__init__(f"{what} '{name}' does not exist. {suggest(name, available)}")


def require_names(what: str, names: Iterable[str | None], available: Collection[str]) -> None:
    """Raise an `UnknownName` for the first name, None aside, that is not available."""
    for name in names:
        if name is not None and name not in available:
            raise UnknownName(what, name, available)


class DeviceError(MjstackError):
    """A compute device that was asked for and is not there."""


class RankError(MjstackError):
    """Another process of the job has failed or gone.

    Attributes:
        printed: Whether another rank prints it.
        gone: Whether it cannot be waited for any more.
    """

    def __init__(self, problem: str, *, printed: bool = False, gone: bool = False) -> None:
        super().__init__(problem)
        self.printed = printed
        self.gone = gone


class FolderError(MjstackError):
    """The folder of a run, a policy or a dataset that cannot be read, written or gone on with."""


class TermError(KeyedError):
    """A term of a manager that cannot be found, built or used."""

    def __init__(self, key: str, problem: str) -> None:
        super().__init__(key, f": {problem}")


class ParameterError(ConfigError):
    """A value that a term cannot use, by the parameter's name; its manager names the whole key."""


class FaultError(MjstackError):
    """Something went wrong while worlds were stepped."""


@dataclass(eq=False)
class Unreachable(MjstackError):
    """The arm cannot bring its grasp point to a target; lengths in m."""

    world: int
    phase: str
    anchor: str | None
    target: Sequence[float]
    distance: float
    tolerance: float

    def __str__(self) -> str:
        where = ", ".join(f"{x:.3f}" for x in self.target)
        return (
            f"world {self.world}, phase {self.phase}: target ({where}) m is"
            f" {1e3 * self.distance:.1f} mm out of reach of the grasp point, expected at most"
            f" {1e3 * self.tolerance:.1f} mm. Move {self.anchor} closer, or change"
            f" controller.phases.{self.phase}."
        )


class ArgumentError(MjstackError):
    """An argument of a function cannot be used."""

    def __init__(self, name: str, value: object, expected: str, fix: str = "") -> None:
        super().__init__(f"{name}: found {value}, expected {expected}", fix)


class MissingExtra(MjstackError):
    """A package that is not installed, because it comes with an extra."""

    def __init__(self, what: str, package: str, extra: str) -> None:
        super().__init__(
            f"{what} needs {package}, which is not installed: run pip install 'mjstack[{extra}]'."
        )


def describe_error(
    error: BaseException, traceback_at: str = "MJSTACK_DEBUG=1 shows the traceback"
) -> str:
    """An error in one line: kind, text, the line of the user's own code, where the traceback is."""
    if isinstance(error, MjstackError):
        return shorten(" ".join(str(error).splitlines()))  # a value in it may have several
    first = first_line(error)
    if is_out_of_memory(f"{type(error).__name__}: {error}"):
        smaller = "Run fewer worlds, or lower batch.nconmax, batch.njmax"
        return f"out of memory ({first}). {smaller} or, with images, job.vision.pool"
    frames = [
        f"{Path(frame.filename).name}:{frame.lineno}; "
        for frame in traceback.extract_tb(error.__traceback__)
        if not frame.filename.startswith(_LIBRARIES)
    ]
    return shorten(f"{type(error).__name__}: {first} ({''.join(frames[-1:])}{traceback_at})")


def first_line(error: BaseException) -> str:
    """The first line of an error's text without its full stop; its type where it has no text."""
    return shorten((str(error).splitlines() or [type(error).__name__])[0].rstrip("."))


def shorten(text: str, most: int = _MOST_LETTERS) -> str:
    """A text that fits a line: of a longer one, long paths and words and then the rest lose their
    middle. It begins with the key or the file, and ends with what to do.
    """
    if len(text) <= most:
        return text
    begin, end = text[: -(most // 2)], text[-(most // 2) :]
    begin = re.sub(r"/\S{50,}|\S{100,}", lambda long: f"{long[0][:20]}...{long[0][-20:]}", begin)
    return begin + end if len(begin + end) <= most else f"{begin[: most // 2 - 5]} ... {end}"


def suggest(name: str, available: Iterable[str]) -> str:
    """List the available names, or the first of many, the nearest match first if there is one."""
    names = sorted(available)
    nearest = difflib.get_close_matches(shorten(name), names[:1000], n=1, cutoff=0.5)
    hint = f"Did you mean '{nearest[0]}'? " if nearest else ""
    more = f" and {len(names) - _MOST_NAMED} more" * (len(names) > _MOST_NAMED)
    return f"{hint}Available: {', '.join(names[:_MOST_NAMED]) or 'none'}{more}."


def name_worlds(
    worlds: Sequence[int | str], nworld: int, limit: int = 8, what: str = "worlds"
) -> str:
    """Say how many worlds and name the first ones: ``17 of 4096 worlds (first: 3, 41, 96)``."""
    first = ", ".join(map(str, worlds[:limit]))
    label = "first: " if len(worlds) > limit else ""
    return f"{len(worlds)} of {nworld} {what} ({label}{first})"
