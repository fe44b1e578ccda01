"""MuJoCo Warp, imported in one place, when Warp has been configured."""

import mjstack.sim.warp_setup  # noqa: F401, I001
import mujoco_warp as mjw

__all__ = ["mjw"]
