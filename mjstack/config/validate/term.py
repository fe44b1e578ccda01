"""What the terms of a manager do, as far as other values depend on it."""

from __future__ import annotations

from collections.abc import Mapping

from mjstack.config.schema import TermCfg


def reads_starts_file(reset: Mapping[str, TermCfg]) -> bool:
    """Whether worlds start as a file says."""
    return any(term.func.endswith(".FromStartsFile") for term in reset.values())


def places_objects(term: TermCfg) -> bool:
    """Whether a reset term puts objects anywhere in a region, its parameter ``xy``."""
    return term.func.endswith(".RandomizeObjects")
