"""Random numbers keyed by (seed, world, episode, step, stream), on any device, without state.

Philox4x32-10 (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011) written with int64 tensors. World 5
of 16 draws what world 5 of 2048 draws, and no draw depends on which other worlds reset.
"""

from __future__ import annotations

import torch

_MASK = 0xFFFFFFFF
_M0, _M1 = 0xD2511F53, 0xCD9E8D57
_W0, _W1 = 0x9E3779B9, 0xBB67AE85


def _mul_hi_lo(a: int, b: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """High and low 32 bits of a 32 x 32 bit product. int64 wraps, and masking after the shift drops the sign."""
    product = a * b
    return (product >> 32) & _MASK, product & _MASK


def philox(counter: torch.Tensor, key: tuple[int, int]) -> torch.Tensor:
    """Philox4x32-10.

    Args:
        counter: Four 32-bit words held in int64, shape ``(..., 4)``.
        key: Two 32-bit words.

    Returns:
        Four random 32-bit words held in int64, shape ``(..., 4)``.
    """
    c0, c1, c2, c3 = counter.unbind(-1)
    k0, k1 = key
    for _ in range(10):
        hi0, lo0 = _mul_hi_lo(_M0, c0)
        hi1, lo1 = _mul_hi_lo(_M1, c2)
        c0, c1, c2, c3 = hi1 ^ c1 ^ k0, lo1, hi0 ^ c3 ^ k1, lo0
        k0, k1 = (k0 + _W0) & _MASK, (k1 + _W1) & _MASK
    return torch.stack((c0, c1, c2, c3), dim=-1)


def uniform(
    *, seed: int, world: torch.Tensor, episode: torch.Tensor, step: torch.Tensor, stream: int, size: int
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
