"""The observation manager: groups of terms, each group one tensor, with noise, clipping, scaling
and history.
"""

import math
from collections.abc import Iterable, Mapping, Sequence

import torch

from mjstack.config.schema import ObservationGroupCfg, ObservationTermCfg
from mjstack.errors import TermError
from mjstack.managers.term import Term, first_value, render_table
from mjstack.managers.view import EnvView, random_uniform, rows_of
from mjstack.scene.index import ALL, Rows


class _Part:
    """One term of a group."""

    def __init__(self, label: str, cfg: ObservationTermCfg, env: EnvView) -> None:
        if cfg.clip is not None and not cfg.clip[0] < cfg.clip[-1]:
            raise TermError(
                label, f"clip={list(cfg.clip)}: expected two numbers, the smaller one first"
            )
        self.cfg = cfg
        self.term = Term(label, cfg, env)
        if self.term.has_memory:
            raise TermError(
                label,
                "has a reset(mask), so it keeps something from step to step, and observations are"
                " computed twice where a world resets: use history, or keep it in a reward or"
                " termination term",
            )
        value = first_value(self.term, env, dims=(1, 2))
        self.width = 1 if value.dim() == 1 else value.shape[1]
        self.dim = self.width * cfg.history


class _Group:
    """The terms of one group: noise, clipping and scaling are done for all columns at once."""

    def __init__(self, name: str, cfg: ObservationGroupCfg, env: EnvView) -> None:
        self.name = name
        self.noisy = cfg.noise
        self._env = env
        self.parts = {
            term: _Part(f"observation.{name}.terms.{term}", c, env) for term, c in cfg.terms.items()
        }
        if not self.parts:
            raise TermError(
                f"observation.{name}", "has no terms: expected at least one, or no such group"
            )
        parts = self.parts.values()
        self.dim = sum(part.dim for part in parts)

        def indices(columns: Sequence[int]) -> torch.Tensor:
            return torch.tensor(columns, dtype=torch.int64, device=env.device)

        widths = indices([part.width for part in parts])

        def row(values: Iterable[float]) -> torch.Tensor:
            """A number for each column of one step, from one for each part."""
            numbers = torch.tensor([*values], dtype=torch.float32, device=env.device)
            return numbers.repeat_interleave(widths)

        # Only columns with noise get numbers: where one stands in the draw follows from them alone.
        noise = row(part.cfg.noise if cfg.noise else 0.0 for part in parts)
        self._noise_columns = noise.nonzero()[:, 0]
        self._noise = noise[self._noise_columns]
        clips = [part.cfg.clip or (-math.inf, math.inf) for part in parts]
        self._clips = any(part.cfg.clip for part in parts)
        self._low = row(low for low, _ in clips)
        self._high = row(high for _, high in clips)
        self._scales = any(part.cfg.scale != 1.0 for part in parts)
        self._scale = row(part.cfg.scale for part in parts)
        # Where each column of the group comes from: for `append` in the group before and the new
        # step behind it, where a part's steps move up by one; for `restart` in the new step.
        shift: list[int] = []
        repeat: list[int] = []
        first = 0  # of the part's columns within one step
        for part in parts:
            newest = range(first, first + part.width)
            start = len(shift)
            shift += range(start + part.width, start + part.dim)
            shift += [self.dim + column for column in newest]
            repeat += [*newest] * part.cfg.history
            first += part.width
        self._has_history = first < self.dim
        self._shift = indices(shift)
        self._repeat = indices(repeat)
        self._past = torch.zeros((env.nworld, self.dim), dtype=torch.float32, device=env.device)

    def compute(self, at: Rows = ALL) -> torch.Tensor:
        """One step of some worlds, shape ``(n, sum of widths)``."""
        env = self._env
        parts = self.parts.values()
        values = [part.term(env).reshape(env.nworld, part.width)[at] for part in parts]
        step = torch.cat(values, dim=1).float()
        if len(self._noise_columns):
            size = len(self._noise_columns)
            draw = random_uniform(
                env, f"observation.{self.name}", size, step=env.episode_step, at=at
            ).float()
            step.index_add_(1, self._noise_columns, self._noise * draw)
        if self._clips:
            step.clamp_(self._low, self._high)
        return step.mul_(self._scale) if self._scales else step

    def append(self, out: torch.Tensor) -> None:
        """Take in a new step of every world, and forget the oldest."""
        step = self.compute()
        if not self._has_history:
            out.copy_(step)
            return
        both = torch.cat((self._past, step), dim=1)
        torch.index_select(both, 1, self._shift, out=self._past)
        out.copy_(self._past)

    def restart(self, out: torch.Tensor, mask: torch.Tensor) -> None:
        """The whole history of the masked worlds becomes the current step."""
        at = rows_of(mask)
        step = self.compute(at)
        kept = self._past if self._has_history else out
        if self._has_history:
            step = step.index_select(1, self._repeat)
        if isinstance(at, torch.Tensor):
            kept.index_copy_(0, at, step)
        else:
            torch.where(mask[:, None], step, kept, out=kept)
        if self._has_history:
            out.copy_(self._past)


class ObservationManager:
    """Computes every group into one tensor of shape ``(nworld, group_dim)``, float32.

    Attributes:
        group_dims: Width of each group.
        term_dims: Width of each term, history included, by group and name, in the order of the
            columns.
        groups: The tensors, by group. They are written anew at every step.
    """

    def __init__(self, env: EnvView, cfg: Mapping[str, ObservationGroupCfg]) -> None:
        """Build the terms and call each once.

        Raises:
            TermError: A term cannot be found, or returns what a group cannot hold.
        """
        self._groups = {name: _Group(name, group, env) for name, group in cfg.items()}
        self.group_dims = {name: group.dim for name, group in self._groups.items()}
        self.term_dims = {
            name: {term: p.dim for term, p in group.parts.items()}
            for name, group in self._groups.items()
        }
        self.groups = {
            name: torch.full((env.nworld, dim), math.nan, dtype=torch.float32, device=env.device)
            for name, dim in self.group_dims.items()
        }

    def compute(self) -> dict[str, torch.Tensor]:
        """Take in a new step of every world, and return `groups`."""
        for name, group in self._groups.items():
            group.append(self.groups[name])
        return self.groups

    def refresh(self, mask: torch.Tensor) -> dict[str, torch.Tensor]:
        """Compute the masked worlds anew after their reset; their whole history becomes the first
        step.
        """
        for name, group in self._groups.items():
            group.restart(self.groups[name], mask)
        return self.groups

    def not_finite_terms(self, world: int) -> list[str]:
        """Names of the terms whose last value in a world is not finite. Waits for the device."""
        names = []
        for name, group in self._groups.items():
            values = self.groups[name][world].split([part.dim for part in group.parts.values()])
            for part, value in zip(group.parts.values(), values, strict=True):
                if not bool(torch.isfinite(value).all()):
                    names.append(part.term.label)
        return names

    def __str__(self) -> str:
        rows = []
        for group, terms in self._groups.items():
            for name, part in terms.parts.items():
                cfg = part.cfg
                noise = cfg.noise if terms.noisy else 0.0
                shown = (part.dim, cfg.history, noise, cfg.clip or "", cfg.scale)
                rows.append((group, name, *shown, part.term.params))
        dims = ", ".join(f"{group} {dim}" for group, dim in self.group_dims.items())
        columns = ("group", "term", "dim", "history", "noise", "clip", "scale")
        return render_table(f"observation: {dims}", columns, rows)
