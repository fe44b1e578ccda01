"""Hydra's side of a composition: where the files are, and a Hydra of its own that leaves somebody
else's as it was.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from hydra import initialize_config_module
from hydra.core.global_hydra import GlobalHydra
from hydra.core.singleton import Singleton

CONFIG_MODULE = "mjstack.conf"
CONFIG_NAME = "config"


@contextmanager
def own_hydra() -> Iterator[None]:
    """Composes from mjstack's files, also inside somebody else's Hydra application, whose state
    comes back afterwards.
    """
    outer = Singleton.get_state()
    GlobalHydra.instance().clear()
    try:
        with initialize_config_module(config_module=CONFIG_MODULE, version_base="1.3"):
            yield
    finally:
        Singleton.set_state(outer)
