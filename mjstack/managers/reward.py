"""The reward manager: a weighted sum of terms, per second of simulated time."""

from collections.abc import Mapping

import torch

from mjstack.config.schema import RewardTermCfg
from mjstack.managers.term import Term, first_value, render_table, show_params
from mjstack.managers.view import EnvView


class RewardManager:
    """Adds up ``weight x value x step_dt`` over the terms.

    Attributes:
        names: The terms.
        weights: ``weight x step_dt`` of every term, shape ``(nterm,)``, float32. Write into it to
            change a weight later.
        reward: The sum at the last step, shape ``(nworld,)``, float32.
        values: Its summands, shape ``(nworld, nterm)``, float32.
        episode_sums: The summands since each world's last reset, shape ``(nworld, nterm)``,
            float32.
    """

    def __init__(self, env: EnvView, cfg: Mapping[str, RewardTermCfg]) -> None:
        """Builds the terms and calls each once.

        Raises:
            TermError: A term cannot be found, does not return ``(nworld,)`` numbers, or has a
                weight that is not finite.
        """
        self._env = env
        self._cfg = dict(cfg)
        self._terms = {name: Term(f"reward.{name}", term, env) for name, term in cfg.items()}
        for term in self._terms.values():
            first_value(term, env, dims=(1,))
        self.names = list(self._terms)
        weights = [cfg[name].weight * env.cfg.timing.step_dt for name in self.names]
        self.weights = torch.tensor(weights, dtype=torch.float32, device=env.device)
        self.reward = torch.zeros(env.nworld, dtype=torch.float32, device=env.device)
        self.values = torch.zeros(
            (env.nworld, len(self.names)), dtype=torch.float32, device=env.device
        )
        self.episode_sums = torch.zeros_like(self.values)

    def compute(self, void: torch.Tensor | None = None) -> torch.Tensor:
        """Writes `values` and `reward`, and returns `reward`.

        Args:
            void: Worlds whose state is not finite, shape ``(nworld,)``, bool: they get no reward
                for this step.
        """
        if self._terms:
            torch.mul(
                torch.stack([term(self._env).float() for term in self._terms.values()], 1),
                self.weights,
                out=self.values,
            )
        if void is not None:
            self.values.masked_fill_(void[:, None], 0.0)
        self.episode_sums += self.values
        return torch.sum(self.values, dim=1, out=self.reward)

    def reset(self, mask: torch.Tensor) -> None:
        """Starts the sums of the masked worlds anew."""
        self.episode_sums.masked_fill_(mask[:, None], 0.0)
        for term in self._terms.values():
            term.reset(mask)

    def __str__(self) -> str:
        rows = [
            (name, self._cfg[name].weight, show_params(term.params))
            for name, term in self._terms.items()
        ]
        return render_table(
            f"reward: {len(rows)} terms", ("term", "weight per s", "parameters"), rows
        )
