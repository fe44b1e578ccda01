"""mjstack: a robot-arm task from one native MuJoCo world to thousands of MuJoCo Warp worlds,
verified in gates.
"""

import os
import sys

# With -m, Python puts the working folder first, which may be a stranger's, where any module of
# Python's own may be another one. A checkout's own stays.
if (
    sys.argv[:1] == ["-m"]
    and not sys.flags.safe_path
    and os.path.realpath(sys.path[0]) != os.path.realpath(f"{os.path.dirname(__file__)}/..")
):
    del sys.path[0]

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from mjstack.version import __version__ as __version__

if TYPE_CHECKING:
    from mjstack.config import Config, load_config
    from mjstack.envs import Env, make_env
    from mjstack.errors import MjstackError
    from mjstack.jobs.runner import verify
    from mjstack.policy import load_policy

__all__ = ["Config", "Env", "MjstackError", "load_config", "load_policy", "make_env", "verify"]

_HOMES = {
    "Config": "mjstack.config",
    "load_config": "mjstack.config",
    "Env": "mjstack.envs",
    "make_env": "mjstack.envs",
    "MjstackError": "mjstack.errors",
    "load_policy": "mjstack.policy",
    "verify": "mjstack.jobs.runner",
}

if not TYPE_CHECKING:  # a type checker would take any name for one of these

    def __getattr__(name: str) -> Any:
        """Load torch and Warp, which take seconds, when they are asked for."""
        if name in _HOMES:
            return getattr(import_module(_HOMES[name]), name)
        if find_spec(f"mjstack.{name}"):
            return import_module(f"mjstack.{name}")
        raise AttributeError(f"module 'mjstack' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
