"""What the terms of a manager offer, as far as other values depend on it."""

from __future__ import annotations

import importlib
from collections.abc import Mapping

from mjstack.config.schema import TermCfg


def reads_starts_file(reset: Mapping[str, TermCfg]) -> bool:
    """Whether worlds start as a file says."""
    return any("path" in term.params and _offers(term, "reads_file") for term in reset.values())


def places_objects(term: TermCfg) -> bool:
    """Whether a reset term puts objects anywhere in a region, its parameter ``xy``."""
    return "xy" in term.params and _offers(term, "places_objects")


def _offers(term: TermCfg, name: str) -> bool:
    """Whether a term's function has an attribute; see `mjstack.managers.offers`. One that cannot be
    imported has none: its manager says why.
    """
    module, _, attribute = term.func.rpartition(".")
    try:
        func = getattr(importlib.import_module(module), attribute, None)
    except Exception:
        return False
    return bool(getattr(func, name, False))
