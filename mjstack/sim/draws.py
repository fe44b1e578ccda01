"""`mjstack.rng.uniform` as one Warp kernel: in a captured step, five dozen small launches would
cost more than the numbers.
"""

# No `from __future__ import annotations` here: Warp reads the annotations as objects.
import torch
import warp as wp
from torch import Tensor

from mjstack.sim.warp_setup import torch_stream_scope

# Without this the compiler may fuse a product and a sum, and the last digit would differ from
# torch's.
wp.set_module_options({"fuse_fp": False, "enable_backward": False})


@wp.func
def _multiply_high(a: wp.uint32, b: wp.uint32) -> wp.uint32:
    return wp.uint32((wp.uint64(a) * wp.uint64(b)) >> wp.uint64(32))


@wp.kernel
def _philox_uniform(
    key: wp.array[wp.int64],
    stream: wp.uint32,
    world: wp.array[wp.int64],
    episode: wp.array[wp.int64],
    step: wp.array[wp.int64],
    use_step: bool,
    low: float,
    half_width: float,
    out: wp.array2d[float],
) -> None:
    """Philox4x32-10 with counter (world, episode, step, block) and key (seed, stream); four numbers
    per thread.
    """
    w, block = wp.tid()  # type: ignore[misc]
    c0 = wp.uint32(world[w])
    c1 = wp.uint32(episode[w])
    c2 = wp.uint32(0)
    if use_step:
        c2 = wp.uint32(step[w])
    c3 = wp.uint32(block)
    k0 = wp.uint32(key[0])
    k1 = stream
    for _ in range(10):
        low0 = wp.uint32(0xD2511F53) * c0
        low1 = wp.uint32(0xCD9E8D57) * c2
        high0 = _multiply_high(wp.uint32(0xD2511F53), c0)
        high1 = _multiply_high(wp.uint32(0xCD9E8D57), c2)
        c0 = high1 ^ c1 ^ k0
        c1 = low1
        c2 = high0 ^ c3 ^ k1
        c3 = low0
        k0 = k0 + wp.uint32(0x9E3779B9)
        k1 = k1 + wp.uint32(0xBB67AE85)
    words = wp.vec4ui(c0, c1, c2, c3)
    for i in range(4):
        column = 4 * block + i
        if column < out.shape[1]:
            draw = float(words[i] >> wp.uint32(8)) * (2.0 / 16777216.0) - 1.0  # type: ignore[index]
            out[w, column] = low + half_width * (draw + 1.0)


def draw_uniform(
    key: Tensor,
    stream: int,
    world: Tensor,
    episode: Tensor,
    step: Tensor | None,
    size: int,
    low: float = -1.0,
    high: float = 1.0,
) -> Tensor:
    """The numbers of `mjstack.rng.uniform`, from low to high: one launch, nothing read by the host.

    ``key`` is the seed, shape ``(1,)``, int64, on the device of everything else; ``step`` is 0 if
    None.
    """
    n = world.shape[0]
    out = torch.empty((n, size), dtype=torch.float32, device=world.device)
    device = wp.device_from_torch(world.device)
    with torch_stream_scope(device):
        wp.launch(
            _philox_uniform,
            dim=(n, -(-size // 4)),
            inputs=[
                wp.from_torch(key),
                stream & 0xFFFFFFFF,
                wp.from_torch(world),
                wp.from_torch(episode),
                wp.from_torch(world if step is None else step),
                step is not None,
                low,
                0.5 * (high - low),
                wp.from_torch(out),
            ],
            device=device,
        )
    return out
