"""Checks of an argument of an environment's reset."""

import operator

from mjstack.errors import ArgumentError


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
