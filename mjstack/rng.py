"""Random numbers keyed by (seed, world, episode, step, stream), without state; on CUDA,
`mjstack.sim.draws` draws the same.

Philox4x32-10 (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011) in numpy,
whose operations on a few hundred numbers cost less than torch's. World 5 of 16 draws what world 5
of 2048 draws, and no draw depends on which other worlds reset.
"""

import operator
from contextlib import suppress
from functools import lru_cache
from typing import SupportsIndex

import numpy as np
import torch
from torch import Tensor

from mjstack.errors import ArgumentError

_MASK = 0xFFFFFFFF
_MULTIPLIERS = np.array([[0xD2511F53], [0xCD9E8D57]], dtype=np.uint64)
_WEYL = np.array([0x9E3779B9, 0xBB67AE85], dtype=np.uint64)


@lru_cache(maxsize=64)
def _round_keys(key: tuple[int, int]) -> np.ndarray:
    """The keys of all rounds, shape ``(10, 2, 1)``."""
    rounds = np.arange(10, dtype=np.uint64)[:, None]
    return (np.array(key, dtype=np.uint64) + rounds * _WEYL).astype(np.uint32)[:, :, None]


def philox(counter: np.ndarray, key: tuple[int, int]) -> np.ndarray:
    """Philox4x32-10: four random words, shape ``(4, n)``, uint32, of a counter of the same shape
    and type and a key of two 32-bit words.
    """
    # Words 0 and 2 are multiplied, words 1 and 3 are mixed in: both pairs go through each round
    # together. Mixed in is the lower half of the other pair's product, read where it lies.
    bits = np.empty_like(counter)
    multiplied = counter[::2].copy()
    mixed = counter[1::2]
    products = np.empty((2, *mixed.shape), dtype=np.uint64)
    lower, upper = (products.view(np.uint32)[:, ::-1, half::2] for half in (0, 1))
    for number, round_key in enumerate(_round_keys(key)):
        parity = number % 2
        np.multiply(multiplied, _MULTIPLIERS, out=products[parity])
        np.bitwise_xor(upper[parity], mixed, out=multiplied)
        multiplied ^= round_key
        mixed = lower[parity]
    bits[::2] = multiplied
    bits[1::2] = mixed
    return bits


def uniform(
    seed: int, stream: int, world: Tensor, episode: Tensor, step: Tensor | None, size: int
) -> Tensor:
    """Uniform numbers in [-1, 1), shape ``(n, size)``, float32.

    Args:
        seed: The run's seed, a non-negative integer; its low 32 bits are used.
        stream: Number of the consumer, so that two consumers never share a draw.
        world: World indices, shape ``(n,)``, int64.
        episode: Episode of each world, shape ``(n,)``, int64.
        step: Step within the episode, shape ``(n,)``, int64; 0 if None.
        size: How many numbers each world gets.
    """
    blocks = -(-size // 4)
    counter = np.zeros((4, world.shape[0], blocks), dtype=np.uint32)
    for row, numbers in zip(counter, (world, episode, step), strict=False):
        if numbers is not None:
            row[:] = numbers.cpu().numpy()[:, None]  # modulo 2^32
    counter[3] = np.arange(blocks)
    bits = philox(counter.reshape(4, -1), (seed & _MASK, stream & _MASK))
    # 24 bits fill a float32 mantissa exactly, so that no rounding can reach 1.
    bits >>= np.uint32(8)
    samples = bits.reshape(counter.shape).transpose(1, 2, 0).astype(np.float32, order="C")
    samples *= np.float32(2.0 / (1 << 24))
    samples -= np.float32(1.0)
    return torch.from_numpy(samples.reshape(-1, 4 * blocks)[:, :size]).to(world.device)


def check_seed(seed: SupportsIndex, *, masked: bool = False) -> int:
    """The seed, which may be NumPy's or torch's, as a Python integer; an ArgumentError if it is no
    32-bit integer, or a mask is given beside it.
    """
    if masked:
        expected = "no mask beside it, because a seed starts every world anew"
        raise ArgumentError("seed", str(seed), expected, "Leave one out")
    kind = str(getattr(seed, "dtype", type(seed).__name__))
    with suppress(TypeError):  # no integer
        if "bool" not in kind and 0 <= (number := operator.index(seed)) < 1 << 32:
            return number
    raise ArgumentError("seed", repr(seed), "an integer from 0 to 4294967295")
