"""Ids of the tasks in Gymnasium's registry, such as ``mjstack/stack-so101-v0``. mjstack imports
this with itself, so nothing here loads Gymnasium.
"""

import os
import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

_MAKER = "mjstack.adapters.gymnasium:make"


def register_env(
    id: str, overrides: Sequence[str] = (), *, config_dir: str | os.PathLike | None = None
) -> None:
    """Register a task of your own for ``gymnasium.make`` and ``make_vec``.

    Args:
        id: Such as ``mine/push-v0``.
        overrides: Of every environment of this id, such as ``["task=push", "robot=so101"]``.
        config_dir: A folder with more choices, as of `mjstack.make_env`.
    """
    from gymnasium.envs.registration import register

    kwargs: dict[str, Any] = {"choices": list(overrides)}
    if config_dir is not None:  # relative to the folder of this call
        kwargs["config_dir"] = os.path.abspath(config_dir)
    register(id, entry_point=_MAKER, vector_entry_point=_MAKER, kwargs=kwargs)


def register_tasks() -> None:
    """Register every task of mjstack with every robot."""
    from mjstack.files import CONFIG_FOLDER

    for task in sorted(path.stem for path in CONFIG_FOLDER.glob("task/*.yaml")):
        for robot in sorted(path.stem for path in CONFIG_FOLDER.glob("robot/*.yaml")):
            register_env(f"mjstack/{task}-{robot}-v0", [f"task={task}", f"robot={robot}"])


class Registrar(MetaPathFinder):
    """Registers the tasks when Gymnasium has been imported, now or later."""

    def install(self) -> None:
        """Register now if Gymnasium is there, else wait for its import."""
        if "gymnasium" in sys.modules:
            register_tasks()
        else:
            sys.meta_path.insert(0, self)

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Find Gymnasium as Python would, with the tasks registered at the end of its import."""
        if name != "gymnasium":
            return None
        finders = [finder for finder in sys.meta_path if finder is not self]
        specs = (finder.find_spec(name, path, target) for finder in finders)
        spec = next(filter(None, specs), None)
        if spec is None or spec.loader is None:
            return spec
        execute = spec.loader.exec_module

        def execute_and_register(module: ModuleType) -> None:
            execute(module)
            if self in sys.meta_path:
                sys.meta_path.remove(self)
                register_tasks()

        spec.loader.exec_module = execute_and_register  # type: ignore[method-assign]
        return spec
