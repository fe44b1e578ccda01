"""The managers of an episode's start, rewards and end: reset terms write the start into the masked
worlds, reward terms are summed, termination terms say which worlds end.
"""

from collections.abc import Mapping
from itertools import chain

import torch
from torch import Tensor

from mjstack.config.functions import offered
from mjstack.config.schema import RewardTermCfg, TermCfg, TerminationTermCfg
from mjstack.managers.state import lost_state
from mjstack.managers.term import Term, blamed, first_value, render_table
from mjstack.managers.view import EnvView, zero_rows


class ResetManager:
    """Puts the masked worlds back and runs every term over them, in their order."""

    def __init__(self, env: EnvView, cfg: Mapping[str, TermCfg]) -> None:
        """Build the terms.

        Raises:
            TermError: A term cannot be found, or a parameter is wrong.
        """
        self._env = env
        self._terms = {
            name: Term(f"reset.{name}", term, env, masked=True) for name, term in cfg.items()
        }

    def reset(self, mask: Tensor) -> None:
        """Reset the worlds of a ``(nworld,)`` bool mask: qpos0 first, then every term."""
        self._env.sim.reset(mask)
        for term in self._terms.values():
            with blamed(term.label):
                term(self._env, mask)

    def __str__(self) -> str:
        rows = [(n, ", ".join(term.model_fields), term.params) for n, term in self._terms.items()]
        return render_table(f"reset: {len(rows)} terms", ("term", "model fields"), rows)


def required_fields(*resets: Mapping[str, TermCfg]) -> tuple[str, ...]:
    """Per-world model fields that some reset terms write, for the simulation's constructor."""
    terms = chain.from_iterable(reset.values() for reset in resets)
    fields = [offered(term.func, "model_fields") or () for term in terms]
    return tuple(dict.fromkeys(chain.from_iterable(fields)))


class _ValueManager:
    """Terms that give every world a value at every step; ``early`` are those that read the state
    alone.
    """

    def __init__(
        self, kind: str, env: EnvView, cfg: Mapping[str, TermCfg], dtype: torch.dtype
    ) -> None:
        self._env = env
        self.terms = [Term(f"{kind}.{name}", term, env) for name, term in cfg.items()]
        for term in self.terms:
            first_value(term, env, boolean=dtype is torch.bool)
        self.early = [term for term in self.terms if term.reads_state]
        self.names = list(cfg)
        self.values = torch.zeros((env.nworld, len(cfg)), dtype=dtype, device=env.device)

    def _term_values(self) -> list[Tensor]:
        """The value of every term, in order."""
        return [term(self._env) for term in self.terms]

    def reset(self, mask: Tensor) -> None:
        """Clear what the terms keep of the masked worlds."""
        for term in self.terms:
            term.reset(mask)


class RewardManager(_ValueManager):
    """Adds up ``weight x value x step_dt`` over the terms.

    Attributes:
        names: The terms.
        weights: ``weight x step_dt`` of every term, shape ``(nterm,)``, float32. Write into it to
            change a weight later.
        reward: The sum of the last decision, shape ``(nworld,)``, float32.
        values: Its summands, shape ``(nworld, nterm)``, float32.
        episode_sums: The summands since each world's last reset, shape ``(nworld, nterm)``,
            float32.
    """

    def __init__(self, env: EnvView, cfg: Mapping[str, RewardTermCfg]) -> None:
        """Build the terms and call each once.

        Raises:
            TermError: A term cannot be found, does not return ``(nworld,)`` numbers, or has a
                weight that is not finite.
        """
        super().__init__("reward", env, cfg, torch.float32)
        self._cfg = dict(cfg)
        weights = [term.weight * env.cfg.timing.step_dt for term in cfg.values()]
        self.weights = torch.tensor(weights, dtype=torch.float32, device=env.device)
        self.reward = self.values.sum(1)
        self.episode_sums = torch.zeros_like(self.values)

    def compute(self, ended: Tensor | None = None) -> Tensor:
        """Write `values` and `reward`, and return `reward`. A world whose state is not finite gets
        none for this step.

        Args:
            ended: Within a decision that holds its action for several control steps: worlds whose
                episode ended in an earlier one, which get no reward, shape ``(nworld,)``, bool. The
                rewards of the others are added to those before.
        """
        before = None if ended is None else self.values.clone()
        if self.terms:
            torch.stack(self._term_values(), dim=1, out=self.values)
            self.values *= self.weights
        for worthless in (lost_state(self._env), ended):
            if worthless is not None and worthless is not self._env.sim.no_worlds:
                self.values.masked_fill_(worthless[:, None], 0.0)
        self.episode_sums += self.values
        if before is not None:
            self.values += before
        return torch.sum(self.values, dim=1, out=self.reward)

    def reset(self, mask: Tensor) -> None:
        """Start the sums of the masked worlds anew."""
        super().reset(mask)
        zero_rows(mask, self.episode_sums)

    def __str__(self) -> str:
        rows = [(name, term.weight, term.params) for name, term in self._cfg.items()]
        return render_table(f"reward: {len(rows)} terms", ("term", "weight per s"), rows)


class TerminationManager(_ValueManager):
    """Asks every term about every world.

    Attributes:
        names: The terms.
        done: Ended by any term, shape ``(nworld,)``, bool.
        terminated: Ended by a term that is no time-out, shape ``(nworld,)``, bool.
        truncated: Ended by a time-out alone, shape ``(nworld,)``, bool.
        values: What each term said last, shape ``(nworld, nterm)``, bool.
    """

    def __init__(self, env: EnvView, cfg: Mapping[str, TerminationTermCfg]) -> None:
        """Build the terms and call each once.

        Raises:
            TermError: A term cannot be found, or does not return ``(nworld,)`` bool.
        """
        super().__init__("termination", env, cfg, torch.bool)
        self._cfg = dict(cfg)
        self._ended = self.values.new_zeros((2, env.nworld))
        self.terminated, self.done = self._ended
        self.truncated = self.done.clone()
        counts = [[[not term.time_out for term in cfg.values()]], [[True for _ in cfg]]]
        self._counts = torch.tensor(counts, dtype=torch.bool, device=env.device)

    def compute(self, ended: Tensor | None = None) -> None:
        """Write `done`, `terminated`, `truncated` and `values`.

        Args:
            ended: Worlds whose episode ended in an earlier control step of the same decision, shape
                ``(nworld,)``, bool: they stay ended as they were.
        """
        if not self.terms:
            return
        values = self._term_values()
        if ended is not None:
            earlier = self.values.unbind(1)
            values = [torch.where(ended, *pair) for pair in zip(earlier, values, strict=True)]
        torch.stack(values, dim=1, out=self.values)
        # ``terminated`` by any term that counts as such, ``done`` by any term at all; in one call
        torch.any(self.values & self._counts, dim=2, out=self._ended)
        # A world that both ended is terminated: there is nothing left to bootstrap from.
        torch.gt(self.done, self.terminated, out=self.truncated)

    def __str__(self) -> str:
        rows = [
            (name, "truncated" if term.time_out else "terminated", term.params)
            for name, term in self._cfg.items()
        ]
        return render_table(f"termination: {len(rows)} terms", ("term", "episode counts as"), rows)
