"""Errors built from facts: what is wrong with its value, what was expected, what to do.

Every error that a user can cause derives from `MjstackError`.
"""

import difflib
import json
import re
import sysconfig
import traceback
from collections.abc import Iterable, Sequence
from pathlib import Path

# As Python, C++, NumPy, torch, Warp and CUDA put it, each with another exception.
_OUT_OF_MEMORY = re.compile(
    r"out of memory|OutOfMemory|MemoryError|bad_alloc|failed to allocate|unable to allocate"
    r"|can't allocate memory|not enough memory",
    re.IGNORECASE,
)
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
        """Build the message.

        Args:
            problem: A value or an event, and what was expected; with or without its full stop.
            fix: What to do about it, a sentence without its full stop.
        """
        stop = "" if problem.endswith((".", "?")) else "."
        super().__init__(f"{problem}{stop}{f' {fix}.' if fix else ''}")


class ConfigError(MjstackError):
    """A value in the configuration cannot be used."""

    def __init__(self, key: str, value: object, expected: str, fix: str = "") -> None:
        """Build the message.

        Args:
            key: Dotted configuration key, such as ``timing.decimation``.
            value: The offending value.
            expected: What would have been accepted.
            fix: What to do about it, a sentence without its full stop.
        """
        shown = json.dumps(value) if value is None or isinstance(value, bool) else value
        super().__init__(f"{key}={shown}: expected {expected}", fix)
        self.key = key
        self._facts = (value, expected, fix)

    def at(self, key: str) -> "ConfigError":
        """The same error under the key that the user has set."""
        return ConfigError(key, *self._facts)


class CompositionError(MjstackError):
    """Overrides do not fit the configuration files."""


class UnknownName(MjstackError):
    """A name that does not exist, listed with the ones that do."""

    def __init__(self, what: str, name: str, available: Iterable[str]) -> None:
        super().__init__(f"{what} '{name}' does not exist. {suggest(name, available)}")


class SourceError(MjstackError):
    """A robot description that cannot be fetched, found or read."""


class DeviceError(MjstackError):
    """A compute device that was asked for and is not there."""


class RunError(MjstackError):
    """The folder of an earlier run that cannot be read, or has not what is asked for."""


class FolderError(MjstackError):
    """A folder that has another run, or that another process is writing."""


class UnsupportedModel(MjstackError):
    """MJWarp does not implement a feature of the model."""


class TermError(MjstackError):
    """A term of a manager that cannot be found, built or used."""

    def __init__(self, key: str, problem: str) -> None:
        """Build the message from the term's dotted configuration key and what is wrong with it."""
        super().__init__(f"{key}: {problem}")
        self.key = key
        self._problem = problem

    def at(self, key: str) -> "TermError":
        """The same error under the key that the user has set."""
        return TermError(key, self._problem)


class ParameterError(ConfigError):
    """A value that a term cannot use, by the parameter's name. The manager raises it `at` the
    term's key.
    """


class FaultError(MjstackError):
    """Something went wrong while worlds were stepped."""


class Unreachable(MjstackError):
    """The arm cannot bring its grasp point to a target."""

    def __init__(
        self,
        world: int,
        phase: str,
        anchor: str | None,
        target: Sequence[float],
        distance: float,
        tolerance: float,
    ) -> None:
        # `args` stays as Python has set it: a process hands them on.
        self.world = world
        self.phase = phase
        self.distance = distance

    def __str__(self) -> str:
        world, phase, anchor, target, distance, tolerance = self.args
        where = ", ".join(f"{x:.3f}" for x in target)
        return (
            f"world {world}, phase {phase}: target ({where}) m is {1e3 * distance:.1f} mm out of"
            f" reach of the grasp point, expected at most {1e3 * tolerance:.1f} mm. Move {anchor}"
            f" closer, or change controller.phases.{phase}."
        )


class RebindError(MjstackError):
    """A view of a simulation was assigned to instead of written into."""

    def __init__(self, view: str) -> None:
        """Build the message.

        Args:
            view: The view as the user writes it, such as ``sim.qpos``.
        """
        super().__init__(
            f"{view} is a view of the simulation's memory and cannot be rebound: write {view}[:] ="
            " ... instead."
        )


class ArgumentError(MjstackError):
    """An argument of a function cannot be used."""

    def __init__(self, name: str, found: object, expected: str, fix: str = "") -> None:
        """Build the message.

        Args:
            name: The argument.
            found: What was given.
            expected: What would have been accepted.
            fix: What to do about it, a sentence without its full stop.
        """
        super().__init__(f"{name}: found {found}, expected {expected}", fix)


class DatasetError(MjstackError):
    """A dataset of demonstrations that cannot be opened or read, or an episode that does not fit
    into it.
    """


class UnwrittenError(MjstackError):
    """A dataset that could not be written any further, such as on a full disk."""

    def __init__(self, folder: str, error: OSError, kept: int) -> None:
        """Build the message.

        Args:
            folder: The dataset.
            error: What the system says.
            kept: Episodes that were committed before.
        """
        super().__init__(
            f"{folder}: cannot be written ({error.strerror or error}): {kept} committed episodes"
            " are kept, those added since are not. Make room or correct it, and do the same again:"
            " it goes on after the last one kept."
        )


class MissingExtra(MjstackError):
    """A package that is not installed, because it comes with an extra."""

    def __init__(self, what: str, package: str, extra: str) -> None:
        super().__init__(
            f"{what} needs {package}, which is not installed: run pip install 'mjstack[{extra}]'."
        )


def describe_error(error: BaseException, traceback_at: str) -> str:
    """An error in one line: kind, text, the line of the user's own code, where the traceback is."""
    if isinstance(error, MjstackError):
        return " ".join(str(error).splitlines())  # a value in it may have several
    first = first_line(error)
    if is_out_of_memory(f"{type(error).__name__}: {error}"):
        smaller = "Run fewer worlds, or with smaller buffers (batch.nconmax, batch.njmax)"
        return f"out of memory ({first}). {smaller}"
    frames = [
        f"{Path(frame.filename).name}:{frame.lineno}; "
        for frame in traceback.extract_tb(error.__traceback__)
        if not frame.filename.startswith(_LIBRARIES)
    ]
    return f"{type(error).__name__}: {first} ({''.join(frames[-1:])}{traceback_at})"


def first_line(error: BaseException) -> str:
    """The first line of an error's text without its full stop; its type where it has no text."""
    return (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")


def suggest(name: str, available: Iterable[str]) -> str:
    """List the available names, the nearest match first if there is one."""
    names = sorted(available)
    nearest = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    hint = f"Did you mean '{nearest[0]}'? " if nearest else ""
    return f"{hint}Available: {', '.join(names) or 'none'}."


def name_worlds(
    worlds: Sequence[int | str], nworld: int, limit: int = 8, what: str = "worlds"
) -> str:
    """Say how many worlds and name the first ones: ``17 of 4096 worlds (first: 3, 41, 96)``."""
    shown = ", ".join(str(w) for w in worlds[:limit])
    label = "first: " if len(worlds) > limit else ""
    return f"{len(worlds)} of {nworld} {what} ({label}{shown})"
