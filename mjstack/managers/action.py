"""The action manager: slices of the policy's action, each turned into joint targets
by a term.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping

import torch
from torch import Tensor

from mjstack.config.schema import TermCfg
from mjstack.errors import ArgumentError, TermError
from mjstack.managers.term import Term, current_term, render_table
from mjstack.managers.view import EnvView, zero_rows
from mjstack.math import all_finite, describe_tensor


class ActionTerm(ABC):
    """Turns a slice of the action into joint targets. A subclass takes the environment and keyword
    parameters.

    Attributes:
        dim: Width of the slice.
        low: Smallest meaningful action, shape ``(dim,)``.
        high: Largest, shape ``(dim,)``.
        unit: Unit of the action, for tables; empty for numbers without one.
        actuators: Columns of ctrl that it writes; no two terms may share one.
    """

    dim: int
    low: Tensor
    high: Tensor
    unit: str = ""
    term_kind = "action term"  # as of `offers`
    actuators: tuple[int, ...] = ()

    @abstractmethod
    def write_commands(self, action: Tensor) -> None:
        """Write ``sim.ctrl`` for an action of shape ``(nworld, dim)``."""


class ActionManager:
    """Processes the policy's action, keeps the last two, and applies it.

    Attributes:
        action_dim: Width of the whole action.
        action: The last action, shape ``(nworld, action_dim)``, in the type of the simulation's
            floats.
        previous_action: The one before. Both are zero after a reset.
        low: Smallest meaningful action, shape ``(action_dim,)``.
        high: Largest, shape ``(action_dim,)``.
    """

    def __init__(self, env: EnvView, cfg: Mapping[str, TermCfg]) -> None:
        """Build the terms.

        Raises:
            TermError: A term cannot be found, built, or is no `ActionTerm`.
        """
        self._cfg = dict(cfg)
        self.terms: dict[str, ActionTerm] = {}
        driven: dict[int, str] = {}
        for name, term_cfg in cfg.items():
            label = f"action.{name}"
            term: ActionTerm = Term(label, term_cfg, env, base=ActionTerm).call
            for actuator in term.actuators:
                if driven.setdefault(actuator, label) != label:
                    problem = f"drives actuator {actuator}, which {driven[actuator]} drives too"
                    raise TermError(label, f"{problem}: leave one of them out")
            self.terms[name] = term
        terms = self.terms.values()
        dims = [term.dim for term in terms]
        self.action_dim = sum(dims)
        self._last_two = env.sim.qpos.new_zeros((2, env.nworld, self.action_dim))
        self.action, self.previous_action = self._last_two
        self._processed = self.action.clone()
        self._whole = not self.action.is_cuda  # as far as it is known
        self._parts = self.action.split(dims, dim=1) if terms else ()
        self.low = torch.cat([term.low for term in terms]) if terms else self.action[0]
        self.high = torch.cat([term.high for term in terms]) if terms else self.action[0]

    def process(self, action: Tensor) -> None:
        """Check an action and keep it for `apply`.

        A value that is not finite is an error at once on the CPU. On CUDA, where looking would stop
        the device, it counts as 0; see `not_finite`.

        Args:
            action: Shape ``(nworld, action_dim)``, float32 or float64.

        Raises:
            ArgumentError: Wrong shape, dtype or device, or values that are not finite.
        """
        self.check(action)
        action = action.detach()  # physics has no gradient, and a buffer must not acquire one
        self._processed.copy_(action)
        self._whole = all_finite(self._processed)
        copy = self._processed  # a float64 may be more than it holds
        if not action.is_cuda and not self._whole and not bool(copy.isfinite().all()):
            world = int((~copy.isfinite()).any(1).nonzero()[0, 0])
            value = f"{action[world].tolist()} in world {world}"
            fix = "Check the policy, and the starts that reset terms make"
            raise ArgumentError("action", value, "finite numbers", fix)

    def apply(self) -> None:
        """Make the processed action the current one and the current one the previous one, and write
        ``sim.ctrl`` in all worlds, term by term.
        """
        self.previous_action.copy_(self.action)
        if self._whole:
            self.action.copy_(self._processed)
        else:
            torch.nan_to_num(self._processed, 0.0, 0.0, 0.0, out=self.action)
        for (name, term), part in zip(self.terms.items(), self._parts, strict=True):
            current_term.label = f"action.{name}"
            term.write_commands(part)

    def not_finite(self) -> Tensor:
        """Worlds whose action, as it was applied last, was not finite, shape ``(nworld,)``, bool;
        before their reset.
        """
        return (self.action != self._processed).any(1)

    def check(self, action: Tensor) -> None:
        """Raise an `ArgumentError` for an action of wrong type, shape, dtype or device."""
        if (
            not isinstance(action, Tensor)
            or action.shape != self.action.shape
            or action.dtype not in (torch.float32, torch.float64)
            or action.device != self.action.device
        ):
            shape = tuple(self.action.shape)
            expected = f"a float32 or float64 tensor of shape {shape} on {self.action.device}"
            raise ArgumentError("action", describe_tensor(action), expected)

    def reset(self, mask: Tensor) -> None:
        """Zero the actions of the masked worlds."""
        zero_rows(mask, self._last_two)

    def __str__(self) -> str:
        rows = []
        for name, term in self.terms.items():
            bounds = zip(term.low.tolist(), term.high.tolist(), strict=True)
            ranges = ", ".join(dict.fromkeys(f"{low:.4g} to {high:.4g}" for low, high in bounds))
            rows.append((name, term.dim, ranges, term.unit, self._cfg[name].params))
        columns = ("term", "dim", "range", "unit")
        return render_table(f"action: {self.action_dim} numbers", columns, rows)
