"""Functions and classes by dotted name: the only place that imports what a configuration names.

A name may be anything that Python can import. Only objects that declare themselves are called: by
the name of their first parameter, or by their base class.
"""

import importlib
import inspect
from collections.abc import Callable
from contextlib import suppress
from typing import Any, TypeVar

from mjstack.errors import ConfigError, MissingExtra, TermError, first_line, suggest

T = TypeVar("T")


def resolve_func(
    label: str, path: str, *, first: str = "env", base: type | None = None
) -> Callable[..., Any]:
    """Find a function or class by its dotted name, and check that it declares itself: by the name
    of its first parameter, or instead by its base class. The label is its configuration key. A
    TermError if there is no such module, or nothing of that name in it that is meant to be called.
    """
    func = find_object(label, path)
    declared = False
    expected = f"a function or class whose first parameter is named {first}"
    if base is None:
        with suppress(TypeError, ValueError):  # functions in C have no names
            declared = next(iter(inspect.signature(func).parameters), "") == first
    else:
        expected = f"a subclass of {base.__module__}.{base.__name__}"
        declared = isinstance(func, type) and issubclass(func, base)
    if not declared:
        raise TermError(label, f"func={path}: expected {expected}")
    return func


def find_object(label: str, path: str) -> Any:
    """Find anything in a module by its dotted name; a TermError if there is no such module or
    nothing of that name in it, a MissingExtra if it needs a package that is not installed.
    """
    module_name, _, attribute = path.rpartition(".")
    if not module_name:
        expected = "expected a dotted name, such as mjstack.mdp.reward.reach"
        raise TermError(label, f"func={path}: {expected}")
    try:
        module = importlib.import_module(module_name)
    except MissingExtra:
        raise
    except Exception as error:  # the module is the user's, and may raise anything
        kind = "" if isinstance(error, ImportError) else f"{type(error).__name__}: "
        problem = f"module '{module_name}' cannot be imported ({kind}{first_line(error)})"
        raise TermError(label, f"func={path}: {problem}") from error
    if hasattr(module, attribute):
        return getattr(module, attribute)
    names = [
        name
        for name, value in vars(module).items()
        if callable(value) and getattr(value, "__module__", "") == module_name
    ]
    hint = suggest(attribute, names)
    raise TermError(label, f"func={path}: '{attribute}' does not exist. {hint}")


def find_instance(key: str, path: str, kind: type[T]) -> T:
    """Find an object of a class by its dotted name, the value of a key; a ConfigError if it is of
    another class, or a TermError as of `find_object`.
    """
    instance = find_object(key, path)
    if not isinstance(instance, kind):
        raise ConfigError(key, path, f"a {kind.__module__}.{kind.__name__}")
    return instance


def offered(path: str, name: str) -> Any:
    """An attribute of a function or class by its dotted name, see `mjstack.managers.offers`. None
    if it has none, or cannot be found: the code that calls it says why.
    """
    try:
        return getattr(find_object("", path), name, None)
    except TermError:
        return None
