"""The termination manager: which worlds' episodes end, and whether by the clock or by what
happened.
"""

from collections.abc import Mapping

import torch

from mjstack.config.schema import TerminationTermCfg
from mjstack.managers.term import Term, first_value, render_table, show_params
from mjstack.managers.view import EnvView


class TerminationManager:
    """Asks every term about every world.

    Attributes:
        names: The terms.
        terminated: Ended by a term that is no time-out, shape ``(nworld,)``, bool.
        truncated: Ended by a time-out alone, shape ``(nworld,)``, bool.
        values: What each term said last, shape ``(nworld, nterm)``, bool.
    """

    def __init__(self, env: EnvView, cfg: Mapping[str, TerminationTermCfg]) -> None:
        """Builds the terms and calls each once.

        Raises:
            TermError: A term cannot be found, or does not return ``(nworld,)`` bool.
        """
        self._env = env
        self._cfg = dict(cfg)
        self._terms = {name: Term(f"termination.{name}", term, env) for name, term in cfg.items()}
        for term in self._terms.values():
            first_value(term, env, dims=(1,), boolean=True)
        self.names = list(self._terms)

        def flags(*shape: int) -> torch.Tensor:
            return torch.zeros((env.nworld, *shape), dtype=torch.bool, device=env.device)

        self.terminated = flags()
        self.truncated = flags()
        self.values = flags(len(self.names))
        self._ends = torch.tensor(
            [not cfg[name].time_out for name in self.names], dtype=torch.bool, device=env.device
        )

    def compute(self) -> None:
        """Writes `terminated`, `truncated` and `values`."""
        if not self._terms:
            return
        torch.stack([term(self._env) for term in self._terms.values()], dim=1, out=self.values)
        torch.any(self.values & self._ends, dim=1, out=self.terminated)
        # Where both hold, the state itself ended the episode: there is nothing left to bootstrap
        # from.
        torch.any(self.values, dim=1, out=self.truncated)
        self.truncated ^= self.terminated

    def reset(self, mask: torch.Tensor) -> None:
        """Lets terms with a memory forget the masked worlds."""
        for term in self._terms.values():
            term.reset(mask)

    def __str__(self) -> str:
        rows = [
            (
                name,
                "truncated" if self._cfg[name].time_out else "terminated",
                show_params(term.params),
            )
            for name, term in self._terms.items()
        ]
        return render_table(
            f"termination: {len(rows)} terms", ("term", "episode counts as", "parameters"), rows
        )
