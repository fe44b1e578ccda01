"""mjstack: a robot-arm task from one native MuJoCo world to thousands of MuJoCo Warp worlds, verified in gates."""

from pathlib import Path

from mjstack.report.gl import choose_gl

# The configuration lies at the top of a checkout and inside an installed package. This makes `mjstack.conf` mean the
# first one in a checkout that is on the path without being installed.
_CHECKOUT = Path(__file__).resolve().parent.parent
if (_CHECKOUT / "conf" / "config.yaml").is_file():
    __path__.append(str(_CHECKOUT))

choose_gl()

from mjstack.config import Config, load_config  # noqa: E402
from mjstack.envs import Env, make_env  # noqa: E402
from mjstack.errors import MjstackError  # noqa: E402

__all__ = ["Config", "Env", "MjstackError", "load_config", "make_env"]
__version__ = "0.1.0"
