"""Checks of single values."""

from __future__ import annotations

import math

from mjstack.errors import ConfigError


def positive_int(key: str, value: int) -> None:
    """Raises a `ConfigError` unless a value is an integer of at least 1."""
    if value < 1:
        raise ConfigError(key, value, "an integer of at least 1")


def positive(key: str, value: float, unit: str = "") -> None:
    """Raises a `ConfigError` unless a value is finite and above 0."""
    if not (math.isfinite(value) and value > 0.0):
        raise ConfigError(key, value, f"a positive number{f' [{unit}]' if unit else ''}")


def not_negative(key: str, value: float, unit: str = "") -> None:
    """Raises a `ConfigError` unless a value is finite and at least 0."""
    if not (math.isfinite(value) and value >= 0.0):
        raise ConfigError(
            key, value, f"a number that is not negative{f' [{unit}]' if unit else ''}"
        )


def length(key: str, value: list, size: int) -> None:
    """Raises a `ConfigError` unless a list has so many items, none of them an infinite or undefined
    number.
    """
    if len(value) != size:
        raise ConfigError(key, value, f"{size} numbers or names")
    if any(isinstance(item, float) and not math.isfinite(item) for item in value):
        raise ConfigError(key, value, "finite numbers")
