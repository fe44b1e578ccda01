"""Domain randomisation: quantities and model fields that differ between worlds."""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from functools import partial
from typing import ClassVar

import torch
from torch import Tensor

from mjstack.errors import ParameterError
from mjstack.managers.view import EnvView, random_uniform
from mjstack.sim.simulation import Columns


class Randomized(ABC):
    """A quantity of the model, drawn anew for each episode, or given by a file of starts.

    All that follows from a value is computed in float64 from the value that the field holds, so
    that writing what was read changes nothing.
    """

    label = "reset.model"
    model_fields: ClassVar[tuple[str, ...]]  # that it needs
    ends: tuple[float, float]  # smallest and largest value, over the nominal one
    columns: list[str]  # names of its numbers in a file of starts
    nominal: Tensor  # numbers that the ends are relative to, shape ``(n,)``, float64

    def __call__(self, env: EnvView, mask: Tensor) -> None:
        """Write the model fields."""
        factors = random_uniform(env, self.label, len(self.nominal), *self.ends)
        self.write(mask, self.nominal.to(factors) * factors)

    @abstractmethod
    def read(self) -> Tensor:
        """The numbers of every world, shape ``(nworld, n)``."""

    @abstractmethod
    def write(self, mask: Tensor, values: Tensor) -> None:
        """Write numbers ``(nworld, n)``, and what follows from them, into the masked worlds."""


def bounds(name: str, values: Sequence[float]) -> tuple[float, float]:
    """The smallest and largest value of a parameter that has both.

    Raises:
        ParameterError: They are no two numbers, not positive, or not in order.
    """
    try:
        low, high = map(float, () if isinstance(values, str | Mapping) else values)
    except (TypeError, ValueError):
        low = high = math.nan
    if not 0.0 < low <= high < math.inf:
        raise ParameterError(name, values, "two positive numbers, the smaller one first")
    return low, high


class Elements:
    """Some elements of a per-world model field, of its ``dtype``; ``nominal`` are the model's own
    values of them.
    """

    def __init__(
        self, env: EnvView, name: str, elements: Sequence[int], *, exact: bool = True
    ) -> None:
        """Find them; nominal values are ``exact`` in float64, or of the field's type."""
        view = env.sim.fields[name]
        columns = Columns(elements, env.device)
        self.read = partial(columns.read, view)  # the values of every world
        self.write = partial(columns.write_masked, view)  # (mask, value), into the masked worlds
        self.dtype = view.dtype
        nominal = torch.from_numpy(getattr(env.sim.model, name)[list(elements)].copy())
        self.nominal = nominal.to(env.device, torch.float64 if exact else self.dtype)

    def scale(self, mask: Tensor, factor: Tensor) -> None:
        """Write nominal times factor, ``(nworld, elements)``, into the masked worlds."""
        factor = factor.view(*factor.shape, *[1] * (self.nominal.dim() - 1))
        self.write(mask, self.nominal * factor)
