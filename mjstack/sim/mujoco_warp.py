"""MuJoCo Warp, which takes seconds to load: only its simulation does, after Warp is set up. And
Warp, for those who use both.
"""

from mjstack.sim.warp_setup import torch_stream_scope, wp  # before the first use of Warp

import mujoco_warp as mjw  # isort: skip

__all__ = ["mjw", "torch_stream_scope", "wp"]
