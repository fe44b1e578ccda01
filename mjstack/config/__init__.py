"""Typed configuration: dataclasses in `schema`, composed by `load`, checked by `check`."""

from mjstack.config.fields import spec
from mjstack.config.load import load_config
from mjstack.config.schema import Config

__all__ = ["Config", "load_config", "spec"]
