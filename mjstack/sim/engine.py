"""MuJoCo Warp, imported in one place, when Warp has been configured."""

import mjstack.sim.start  # noqa: F401, I001
import mujoco_warp as mjw

__all__ = ["mjw"]
