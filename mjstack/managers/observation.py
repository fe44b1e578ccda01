"""The observation manager: groups of terms, each group one tensor, with noise, clipping, scaling
and history.
"""

import math
from collections.abc import Mapping, Sequence

import mujoco
import torch
from torch import Tensor

from mjstack.config.functions import offered
from mjstack.config.schema import ObservationGroupCfg, ObservationTermCfg
from mjstack.errors import TermError
from mjstack.managers.term import Term, first_value, render_table
from mjstack.managers.view import EnvView, random_uniform
from mjstack.sim.simulation import Columns

_SLIDE = 0.1  # m: as much noise for a sliding joint as 1 rad for another


class _Part:
    """One term of a group."""

    def __init__(self, label: str, cfg: ObservationTermCfg, env: EnvView) -> None:
        if cfg.clip is not None and not cfg.clip[0] < cfg.clip[-1]:
            expected = "expected two numbers, the smaller one first"
            raise TermError(label, f"clip={list(cfg.clip)}: {expected}")
        self.cfg = cfg
        self.term = Term(label, cfg, env)
        if self.term.has_memory:
            raise TermError(
                label,
                "has a reset(mask), so it keeps something from step to step, and observations are"
                " computed twice where a world resets: use history, or keep it in a reward or"
                " termination term",
            )
        self.width = first_value(self.term, env, dims=(1, 2))[0].numel()
        self.dim = self.width * cfg.history

    def value(self, env: EnvView) -> Tensor:
        """The term's value, shape ``(nworld, width)``."""
        value = self.term(env)
        return value if value.dim() == 2 else value[:, None]


class _Group:
    """Where the terms of one group lie in a step of all groups, and what they have had before."""

    def __init__(self, name: str, cfg: ObservationGroupCfg, env: EnvView, first: int) -> None:
        """Build the terms; ``first`` is the group's first column in a step."""
        self.name = name
        self.noisy = cfg.noise
        self._env = env
        label = f"observation.{name}"
        if not cfg.terms:
            raise TermError(label, "has no terms: expected at least one, or no such group")
        self.parts = {
            term: _Part(f"{label}.terms.{term}", part, env) for term, part in cfg.terms.items()
        }
        parts = self.parts.values()
        self.dim = sum(part.dim for part in parts)
        self.width = sum(part.width for part in parts)
        self._columns = slice(first, first + self.width)

        # Only columns with noise get numbers: where one stands in the draw follows from them alone.
        slides = slide_joints(env.sim.model, env.cfg.robot.joints)
        sizes = [size for p in parts for size in column_noise(p.cfg, p.width, slides)]
        noise = {first + n: size for n, size in enumerate(sizes) if size and cfg.noise}
        self._noise_columns = Columns([*noise], env.device)
        self._noise = torch.tensor([*noise.values()], dtype=torch.float32, device=env.device)
        # Where each column of the group comes from: for `append` in the group before and the new
        # step behind it, where a part's steps move up by one; for `restart` in the new step.
        shift: list[int] = []
        repeat: list[int] = []
        start = 0  # of the part's columns within one step
        for part in parts:
            newest = range(start, start + part.width)
            begin = len(shift)
            shift += range(begin + part.width, begin + part.dim)
            shift += [self.dim + column for column in newest]
            repeat += [*newest] * part.cfg.history
            start += part.width
        self.remembers = start < self.dim
        width = self.dim if self.remembers else 0
        self.past = torch.zeros((env.nworld, width), dtype=torch.float32, device=env.device)
        self._shift, self._repeat = (
            torch.tensor(columns, dtype=torch.int64, device=env.device)
            for columns in (shift, repeat)
        )

    def add_noise(self, step: Tensor) -> None:
        """Add the group's noise to a step."""
        size = len(self._noise_columns.indices)
        if not size:
            return
        name = f"observation.{self.name}"
        now = self._env.episode_step
        draw = random_uniform(self._env, name, size, step=now, dtype=torch.float32)
        columns = self._noise_columns.at
        if isinstance(columns, slice):
            step[:, columns].add_(self._noise * draw)
        else:
            step.index_add_(1, columns, self._noise * draw)

    def append(self, out: Tensor, step: Tensor) -> None:
        """Take in a new step of every world, and forget the oldest."""
        step = step[:, self._columns]
        if self.remembers:
            steps = torch.cat((self.past, step), dim=1)
            step = torch.index_select(steps, 1, self._shift, out=self.past)
        out.copy_(step)

    def restart(self, out: Tensor, step: Tensor, mask: Tensor) -> None:
        """The whole history of the masked worlds becomes the current step."""
        step = step[:, self._columns]
        if self.remembers:
            step = step.index_select(1, self._repeat)
            torch.where(mask[:, None], step, self.past, out=self.past)
        torch.where(mask[:, None], step, out, out=out)


def slide_joints(model: mujoco.MjModel, joints: Sequence[str]) -> list[bool]:
    """Which joints slide, and have metres in place of radians."""
    return [model.joint(name).type[0] == mujoco.mjtJoint.mjJNT_SLIDE for name in joints]


def column_noise(cfg: ObservationTermCfg, width: int, slides: Sequence[bool]) -> list[float]:
    """Half-width of the noise of each of a term's columns in one step, before its scale. What a
    term of joints has in radians, a sliding one has in decimetres.
    """
    joints = offered(cfg.func, "unit") in ("joint", "joint/s") and width == len(slides)
    return [cfg.noise * (_SLIDE if joints and slides[column] else 1.0) for column in range(width)]


class ObservationManager:
    """Computes every group into one tensor of shape ``(nworld, group_dim)``, float32.

    A step of all groups is one tensor, so that terms are put together, clipped and scaled for all
    of them at once.

    Attributes:
        group_dims: Width of each group.
        term_dims: Width of each term, history included, by group and name, in the order of the
            columns.
        groups: The tensors, by group. They are written anew at every step.
        remembers: Whether a term has a history, which needs every control step.
        reads_state: Whether all terms are marked as reading the state alone, see `offers`.
    """

    def __init__(self, env: EnvView, cfg: Mapping[str, ObservationGroupCfg]) -> None:
        """Build the terms and call each once.

        Raises:
            TermError: A term cannot be found, or returns what a group cannot hold.
        """
        self._env = env
        self._groups: dict[str, _Group] = {}
        for name, group in cfg.items():
            first = sum(earlier.width for earlier in self._groups.values())
            self._groups[name] = _Group(name, group, env, first)
        self.remembers = any(group.remembers for group in self._groups.values())
        self.group_dims = {name: group.dim for name, group in self._groups.items()}
        self.term_dims = {
            name: {term: p.dim for term, p in group.parts.items()}
            for name, group in self._groups.items()
        }
        empty = torch.full((env.nworld, 1), math.nan, dtype=torch.float32, device=env.device)
        self.groups = {name: empty.repeat(1, dim) for name, dim in self.group_dims.items()}
        self._parts = [p for group in self._groups.values() for p in group.parts.values()]
        self.reads_state = all(part.term.reads_state for part in self._parts)
        self._clips = any(part.cfg.clip for part in self._parts)
        self._scales = any(part.cfg.scale != 1.0 for part in self._parts)
        # Limits and scale of each column of one step
        widest = (-math.inf, math.inf)
        columns = [
            (*(part.cfg.clip or widest), part.cfg.scale)
            for part in self._parts
            for _ in range(part.width)
        ]
        table = torch.tensor(columns, dtype=torch.float32, device=env.device).view(-1, 3)
        self._low, self._high, self._scale = table.T.contiguous()

    def compute(self) -> dict[str, Tensor]:
        """Take in a new step of every world, and return `groups`."""
        if self._parts:
            step = self._step()
            for name, group in self._groups.items():
                group.append(self.groups[name], step)
        return self.groups

    def refresh(self, mask: Tensor) -> dict[str, Tensor]:
        """Compute the masked worlds anew after their reset; their whole history becomes the first
        step.
        """
        if self._parts:
            step = self._step()
            for name, group in self._groups.items():
                group.restart(self.groups[name], step, mask)
        return self.groups

    def _step(self) -> Tensor:
        """One step of all groups, shape ``(nworld, sum of widths)``, float32."""
        step = torch.cat([part.value(self._env) for part in self._parts], dim=1).float()
        for group in self._groups.values():
            group.add_noise(step)
        if self._clips:
            step.clamp_(self._low, self._high)
        return step.mul_(self._scale) if self._scales else step

    def not_finite_terms(self, world: int) -> list[str]:
        """Names of the terms whose last value in a world is not finite. Waits for the device."""
        values = torch.cat([values[world] for values in self.groups.values()])
        finite = torch.isfinite(values).split([part.dim for part in self._parts])
        pairs = zip(self._parts, finite, strict=True)
        return [part.term.label for part, terms in pairs if not bool(terms.all())]

    def __str__(self) -> str:
        rows = []
        for group, terms in self._groups.items():
            for name, part in terms.parts.items():
                cfg = part.cfg
                noise = cfg.noise if terms.noisy else 0.0
                settings = (part.dim, cfg.history, noise, cfg.clip or "", cfg.scale)
                rows.append((group, name, *settings, part.term.params))
        dims = ", ".join(f"{group} {dim}" for group, dim in self.group_dims.items())
        columns = ("group", "term", "dim", "history", "noise", "clip", "scale")
        return render_table(f"observation: {dims}", columns, rows)
