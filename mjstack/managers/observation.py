"""The observation manager: groups of terms, each group one tensor, with noise, clipping, scaling and history."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch

from mjstack.config.schema import ObservationGroupCfg, ObservationTermCfg
from mjstack.errors import TermError
from mjstack.managers.base import EnvView, Term, first_value, random_uniform, render_table, show_params


class _Part:
    """One term of a group: its slice, and its last values where it keeps a history."""

    def __init__(self, label: str, cfg: ObservationTermCfg, env: EnvView) -> None:
        if cfg.history < 1:
            raise TermError(label, f"history={cfg.history}: expected an integer of at least 1")
        if not (math.isfinite(cfg.noise) and cfg.noise >= 0.0):
            raise TermError(label, f"noise={cfg.noise}: expected a number that is not negative")
        if not math.isfinite(cfg.scale):
            raise TermError(label, f"scale={cfg.scale}: expected a finite number")
        if cfg.clip is not None and not (len(cfg.clip) == 2 and cfg.clip[0] < cfg.clip[1]):
            raise TermError(label, f"clip={list(cfg.clip)}: expected two numbers, the smaller one first")
        self.cfg = cfg
        self.term = Term(label, cfg, env)
        if self.term.has_memory:
            raise TermError(
                label,
                "has a reset(mask), so it keeps something from frame to frame, and observations are computed twice where a "
                "world resets: use history, or keep it in a reward or termination term",
            )
        value = first_value(self.term, env, dims=(1, 2))
        self.width = 1 if value.dim() == 1 else value.shape[1]
        self.dim = self.width * cfg.history
        self.past = torch.zeros((env.nworld, cfg.history, self.width), dtype=torch.float32, device=env.device)

    def value(self, env: EnvView, noise: torch.Tensor | None) -> torch.Tensor:
        value = self.term(env).to(torch.float32).view(env.nworld, self.width)
        if noise is not None:
            value = value + self.cfg.noise * noise
        if self.cfg.clip is not None:
            value = value.clamp(*self.cfg.clip)
        return value if self.cfg.scale == 1.0 else self.cfg.scale * value


class ObservationManager:
    """Computes every group into one tensor of shape ``(nworld, group_dim)``, float32.

    Attributes:
        group_dims: Width of each group.
        groups: The tensors, by group. They are written anew at every step.
    """

    def __init__(self, env: EnvView, cfg: Mapping[str, ObservationGroupCfg]) -> None:
        """Builds the terms and calls each once.

        Raises:
            TermError: A term cannot be found, or returns what a group cannot hold.
        """
        self._env = env
        self._parts = {
            group: {name: _Part(f"observation.{group}.terms.{name}", term, env) for name, term in group_cfg.terms.items()}
            for group, group_cfg in cfg.items()
        }
        for group, parts in self._parts.items():
            if not parts:
                raise TermError(f"observation.{group}", "has no terms: expected at least one, or no such group")
        self._noisy = {group: group_cfg.noise for group, group_cfg in cfg.items()}
        self.group_dims = {group: sum(part.dim for part in parts.values()) for group, parts in self._parts.items()}
        self.groups = {
            group: torch.full((env.nworld, dim), math.nan, dtype=torch.float32, device=env.device)
            for group, dim in self.group_dims.items()
        }

    def compute(self) -> dict[str, torch.Tensor]:
        """Takes in a new frame of every world, and returns `groups`."""
        for group in self._parts:
            self._write(group, None)
        return self.groups

    def refresh(self, mask: torch.Tensor) -> dict[str, torch.Tensor]:
        """Computes the masked worlds anew after their reset; their whole history becomes the first frame."""
        for group in self._parts:
            self._write(group, mask)
        return self.groups

    def not_finite_terms(self, world: int) -> list[str]:
        """Names of the terms whose last value in a world is not finite. Waits for the device."""
        return [
            part.term.label
            for parts in self._parts.values()
            for part in parts.values()
            if not bool(torch.isfinite(part.past[world]).all())
        ]

    def _write(self, group: str, mask: torch.Tensor | None) -> None:
        out, start = self.groups[group], 0
        for part, noise in zip(self._parts[group].values(), self._noise(group), strict=True):
            value = part.value(self._env, noise)
            if mask is not None:
                part.past.copy_(torch.where(mask[:, None, None], value[:, None], part.past))
            elif part.cfg.history > 1:
                part.past.copy_(torch.cat((part.past[:, 1:], value[:, None]), dim=1))
            else:
                part.past[:, 0] = value
            out[:, start : start + part.dim] = part.past.flatten(1)
            start += part.dim

    def _noise(self, group: str) -> list[torch.Tensor | None]:
        """Numbers in [-1, 1) for every term that has noise, from one draw."""
        parts = self._parts[group].values()
        wanted = [part.width if self._noisy[group] and part.cfg.noise > 0.0 else 0 for part in parts]
        if not any(wanted):
            return [None] * len(wanted)
        draw = random_uniform(self._env, f"observation.{group}", sum(wanted), step=self._env.frame).float()
        return [piece if piece.shape[1] else None for piece in draw.split(wanted, dim=1)]

    def __str__(self) -> str:
        rows = []
        for group, parts in self._parts.items():
            for name, part in parts.items():
                cfg = part.cfg
                noise = cfg.noise if self._noisy[group] else 0.0
                params = show_params(part.term.params)
                rows.append((group, name, part.dim, cfg.history, noise, cfg.clip or "", cfg.scale, params))
        title = "observation: " + ", ".join(f"{group} {dim}" for group, dim in self.group_dims.items())
        return render_table(title, ("group", "term", "dim", "history", "noise", "clip", "scale", "parameters"), rows)
