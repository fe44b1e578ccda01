"""Typed configuration: `schema` has the dataclasses, `store` composes them, `validate` checks their values."""

from mjstack.config.schema import Config
from mjstack.config.store import load_config

__all__ = ["Config", "load_config"]
