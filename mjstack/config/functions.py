"""Functions and classes by dotted name: the only place that imports what a configuration names."""

import importlib
from collections.abc import Callable
from typing import Any

from mjstack.errors import TermError, first_line, suggest


def resolve_func(label: str, path: str, base: type | None = None) -> Callable[..., Any]:
    """Find a function or class by its dotted name.

    Args:
        label: Dotted configuration key, for errors.
        path: The dotted name.
        base: The class that it must be a subclass of.

    Raises:
        TermError: There is no such module, or nothing callable of that name in it.
    """
    func = find_object(label, path)
    if not callable(func):
        raise TermError(label, f"func={path}: expected a function or a class")
    if base is not None and not (isinstance(func, type) and issubclass(func, base)):
        expected = f"expected a subclass of {base.__module__}.{base.__name__}"
        raise TermError(label, f"func={path}: {expected}")
    return func


def find_object(label: str, path: str) -> Any:
    """Find anything in a module by its dotted name.

    Raises:
        TermError: There is no such module, or nothing of that name in it.
    """
    module_name, _, attribute = path.rpartition(".")
    if not module_name:
        raise TermError(
            label, f"func={path}: expected a dotted name, such as mjstack.mdp.reward.reach"
        )
    try:
        module = importlib.import_module(module_name)
    except Exception as error:  # the module is the user's, and may raise anything
        kind = "" if isinstance(error, ImportError) else f"{type(error).__name__}: "
        reason = f"{kind}{first_line(error)}"
        raise TermError(
            label, f"func={path}: module '{module_name}' cannot be imported ({reason})"
        ) from error
    if not hasattr(module, attribute):
        names = [
            name
            for name, value in vars(module).items()
            if callable(value) and getattr(value, "__module__", "") == module_name
        ]
        raise TermError(
            label, f"func={path}: '{attribute}' does not exist. {suggest(attribute, names)}"
        )
    return getattr(module, attribute)


def offered(path: str, name: str) -> Any:
    """An attribute of a function or class, see `mjstack.managers.offers`; None if it has none, or
    cannot be found: who uses it says why.

    Args:
        path: Dotted name of the function.
        name: The attribute.
    """
    try:
        return getattr(find_object("", path), name, None)
    except TermError:
        return None
