"""Typed configuration: `schema` has the dataclasses, `load` composes them, `check` checks their
values.
"""

from mjstack.config.fields import spec
from mjstack.config.load import load_config
from mjstack.config.schema import Config

__all__ = ["Config", "load_config", "spec"]
