"""Random numbers keyed by (seed, world, episode, step, stream), without state; on CUDA,
`mjstack.sim.draws` draws the same.

Philox4x32-10 (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011) in numpy,
whose operations on a few hundred numbers cost less than torch's. World 5 of 16 draws what world 5
of 2048 draws, and no draw depends on which other worlds reset.
"""

import operator

import numpy as np
import torch

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
    keys = np.array(key, dtype=np.uint64) + np.arange(10, dtype=np.uint64)[:, None] * _WEYL & mask
    # Words 0 and 2 are multiplied, words 1 and 3 are mixed in: both pairs go through each round
    # together.
    multiplied = counter[::2]
    mixed = counter[1::2]
    for round_key in keys:
        product = multiplied * _MULTIPLIERS[:, None]
        multiplied = (product >> np.uint64(32))[::-1] ^ mixed
        multiplied ^= round_key[:, None]
        mixed = (product & mask)[::-1]
    return np.stack((multiplied, mixed), axis=1).reshape(4, -1)


def uniform(
    *,
    seed: int,
    world: torch.Tensor,
    episode: torch.Tensor,
    step: torch.Tensor,
    stream: int,
    size: int,
) -> torch.Tensor:
    """Uniform numbers in [-1, 1).

    Args:
        seed: The run's seed, a non-negative integer; its low 32 bits are used.
        world: World indices, shape ``(n,)``, int64.
        episode: Episode of each world, shape ``(n,)``, int64.
        step: Step within the episode, shape ``(n,)``, int64.
        stream: Number of the consumer, so that two consumers never share a draw.
        size: How many numbers each world gets.

    Returns:
        Shape ``(n, size)``, float32.
    """
    blocks = -(-size // 4)
    rows = torch.stack((world, episode, step)).cpu().numpy() & _MASK
    counter = np.empty((4, world.shape[0], blocks), dtype=np.uint64)
    counter[:3] = rows[:, :, None]
    counter[3] = np.arange(blocks)
    words = philox(counter.reshape(4, -1), (seed & _MASK, stream & _MASK))
    # 24 bits fill a float32 mantissa exactly, so that no rounding can reach 1.
    drawn = (words >> np.uint64(8)).astype(np.float32) * np.float32(2.0 / (1 << 24))
    numbers = np.moveaxis(drawn.reshape(counter.shape), 0, -1).reshape(-1, 4 * blocks)[:, :size]
    return torch.from_numpy(numbers - np.float32(1.0)).to(world.device)


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
