"""Random numbers keyed by (seed, world, episode, step, stream), without state; on CUDA,
`mjstack.sim.draws` draws the same.

Philox4x32-10 (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011) in numpy,
whose operations on a few hundred numbers cost less than torch's. World 5 of 16 draws what world 5
of 2048 draws, and no draw depends on which other worlds reset.
"""

import operator

import numpy as np
import torch
from torch import Tensor

from mjstack.errors import ArgumentError

_MASK = 0xFFFFFFFF
_MULTIPLIERS = np.array([0xD2511F53, 0xCD9E8D57], dtype=np.uint64)
_WEYL = np.array([0x9E3779B9, 0xBB67AE85], dtype=np.uint64)


def philox(counter: np.ndarray, key: tuple[int, int]) -> np.ndarray:
    """Philox4x32-10.

    Args:
        counter: Four 32-bit words held in uint64, shape ``(4, n)``.
        key: Two 32-bit words.

    Returns:
        Four random 32-bit words held in uint64, shape ``(4, n)``.
    """
    mask = np.uint64(_MASK)
    half = np.uint64(32)
    keys = np.array(key, dtype=np.uint64) + np.arange(10, dtype=np.uint64)[:, None] * _WEYL & mask
    # Words 0 and 2 are multiplied, words 1 and 3 are mixed in: both pairs go through each round
    # together, in the memory of the first one.
    words = counter.copy()
    multiplied = words[::2]
    mixed = words[1::2]
    product = np.empty_like(multiplied)
    swapped = product[::-1]
    for round_key in keys[:, :, None]:
        np.multiply(multiplied, _MULTIPLIERS[:, None], out=product)
        np.right_shift(swapped, half, out=multiplied)
        multiplied ^= mixed
        multiplied ^= round_key
        np.bitwise_and(swapped, mask, out=mixed)
    return words


def uniform(
    seed: int, stream: int, world: Tensor, episode: Tensor, step: Tensor | None, size: int
) -> Tensor:
    """Uniform numbers in [-1, 1).

    Args:
        seed: The run's seed, a non-negative integer; its low 32 bits are used.
        stream: Number of the consumer, so that two consumers never share a draw.
        world: World indices, shape ``(n,)``, int64.
        episode: Episode of each world, shape ``(n,)``, int64.
        step: Step within the episode, shape ``(n,)``, int64; 0 if None.
        size: How many numbers each world gets.

    Returns:
        Shape ``(n, size)``, float32.
    """
    blocks = -(-size // 4)
    counter = np.zeros((4, world.shape[0], blocks), dtype=np.uint64)
    for word, numbers in zip(counter, (world, episode, step), strict=False):
        if numbers is not None:
            word[:] = (numbers.cpu().numpy() & _MASK)[:, None]
    counter[3] = np.arange(blocks)
    words = philox(counter.reshape(4, -1), (seed & _MASK, stream & _MASK))
    # 24 bits fill a float32 mantissa exactly, so that no rounding can reach 1.
    words >>= np.uint64(8)
    out = np.moveaxis(words.reshape(counter.shape), 0, -1).astype(np.float32, order="C")
    out *= np.float32(2.0 / (1 << 24))
    out -= np.float32(1.0)
    return torch.from_numpy(out.reshape(-1, 4 * blocks)[:, :size]).to(world.device)


def check_seed(seed: int, *, masked: bool) -> int:
    """The seed as a Python integer.

    Raises:
        ArgumentError: It is no 32-bit integer, or a mask is given beside it.
    """
    if masked:
        expected = "no mask beside it, because a seed starts every world anew"
        raise ArgumentError("seed", str(seed), expected, "Leave one out")
    number = operator.index(seed) if hasattr(seed, "__index__") else -1
    if isinstance(seed, bool) or not 0 <= number < 1 << 32:
        raise ArgumentError("seed", repr(seed), "an integer from 0 to 4294967295")
    return number
