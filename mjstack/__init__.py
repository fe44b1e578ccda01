"""mjstack: a robot-arm task from one native MuJoCo world to thousands of MuJoCo Warp worlds, verified in gates."""

from mjstack.config import Config, load_config

__all__ = ["Config", "load_config"]
__version__ = "0.1.0"
