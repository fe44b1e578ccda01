"""The reset manager: terms that write the start of an episode into the masked worlds."""

from collections.abc import Mapping

import torch

from mjstack.config.schema import TermCfg
from mjstack.errors import MjstackError, TermError
from mjstack.managers.term import Term, raised, render_table, resolve_func, show_params
from mjstack.managers.view import EnvView


class ResetManager:
    """Puts the masked worlds back and runs every term over them, in their order."""

    def __init__(self, env: EnvView, cfg: Mapping[str, TermCfg]) -> None:
        """Builds the terms.

        Raises:
            TermError: A term cannot be found, or a parameter is wrong.
        """
        self._env = env
        for name, term in cfg.items():
            wanted = required_fields({name: term})
            lacking = [field for field in wanted if field not in env.sim.fields]
            if lacking:
                raise TermError(
                    f"reset.{name}",
                    f"writes {', '.join(lacking)}: build the simulation with fields={list(wanted)}",
                )
        self._terms = {
            name: Term(f"reset.{name}", term, env, masked=True) for name, term in cfg.items()
        }

    def reset(self, mask: torch.Tensor) -> None:
        """Resets the worlds of a ``(nworld,)`` bool mask: qpos0 first, then every term."""
        self._env.sim.reset(mask)
        for term in self._terms.values():
            try:
                term(self._env, mask)
            except MjstackError:
                raise
            except Exception as error:
                raise raised(term.label, error) from error

    def __str__(self) -> str:
        rows = [
            (name, show_params(term.params), ", ".join(term.model_fields))
            for name, term in self._terms.items()
        ]
        return render_table(
            f"reset: {len(rows)} terms", ("term", "parameters", "model fields"), rows
        )


def required_fields(cfg: Mapping[str, TermCfg]) -> tuple[str, ...]:
    """Per-world model fields that some reset terms write, for the simulation's constructor."""
    names: dict[str, None] = {}
    for name, term in cfg.items():
        names |= dict.fromkeys(
            getattr(resolve_func(f"reset.{name}", term.func), "model_fields", ())
        )
    return tuple(names)
