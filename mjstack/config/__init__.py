"""Typed configuration: dataclasses in `schema`, composed by `load`, checked by `check`."""

import mjstack.report.gl  # noqa: F401  (before mujoco)
from mjstack.config.fields import spec
from mjstack.config.load import load_config
from mjstack.config.schema import Config

__all__ = ["Config", "load_config", "spec"]
