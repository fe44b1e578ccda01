"""MuJoCo Warp, which takes seconds to load: only its simulation does, after Warp is set up."""

from mjstack.sim.warp_setup import wp  # noqa: F401  (the set-up, before the first use of Warp)

import mujoco_warp as mjw  # isort: skip

__all__ = ["mjw"]
