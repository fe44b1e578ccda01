"""Random numbers keyed by (seed, world, episode, step, stream), on any device, without state.

Philox4x32-10 (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011) written with
int64 tensors. World 5 of 16 draws what world 5 of 2048 draws, and no draw depends on which other
worlds reset.
"""

import operator
from functools import lru_cache

import torch

from mjstack.errors import ArgumentError

_MASK = 0xFFFFFFFF
_M0 = 0xD2511F53
_M1 = 0xCD9E8D57
_W0 = 0x9E3779B9
_W1 = 0xBB67AE85


def philox(counter: torch.Tensor, key: tuple[int, int]) -> torch.Tensor:
    """Philox4x32-10.

    Args:
        counter: Four 32-bit words held in int64, shape ``(..., 4)``.
        key: Two 32-bit words.

    Returns:
        Four random 32-bit words held in int64, shape ``(..., 4)``.
    """
    multipliers, keys = _constants(key, counter.device)
    # Words 0 and 2 are multiplied, words 1 and 3 are mixed in: both pairs go through each round
    # together.
    multiplied = counter[..., ::2]
    mixed = counter[..., 1::2]
    for round_ in range(10):
        # int64 wraps, and the mask after the shift drops the sign.
        product = multiplied * multipliers
        high = (product >> 32).bitwise_and_(_MASK)
        multiplied = high.flip(-1).bitwise_xor_(mixed).bitwise_xor_(keys[round_])
        mixed = product.bitwise_and_(_MASK).flip(-1)
    return torch.stack((multiplied, mixed), dim=-1).flatten(-2)


@lru_cache(maxsize=1024)
def _constants(key: tuple[int, int], device: torch.device) -> tuple[torch.Tensor, torch.Tensor]:
    """Multipliers ``(2,)`` and the key of each round ``(10, 2)``; made once, because a captured
    step cannot copy them.
    """
    rounds = [[(key[0] + i * _W0) & _MASK, (key[1] + i * _W1) & _MASK] for i in range(10)]
    return torch.tensor([_M0, _M1], device=device), torch.tensor(rounds, device=device)


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
    block = torch.arange(blocks, device=world.device)
    rows = torch.stack((world, episode, step), dim=-1)[:, None, :].expand(-1, blocks, -1)
    counter = torch.cat((rows, block[None, :, None].expand(world.shape[0], -1, -1)), dim=-1)
    words = philox(counter & _MASK, (seed & _MASK, stream & _MASK)).flatten(1)[:, :size]
    # 24 bits fill a float32 mantissa exactly, so that no rounding can reach 1.
    return (words >> 8).to(torch.float32) * (2.0 / (1 << 24)) - 1.0


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
