"""Worlds that start in the middle of an expert's episode."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from mjstack.config.fields import Count, Fraction
from mjstack.errors import ParameterError, first_line
from mjstack.files import read_npz, write_npz
from mjstack.managers.view import EnvView, offers, random_uniform

VIEWS = ("qpos", "qvel", "act", "ctrl")
FIELD = "field."  # in front of a model field's name
EPISODE = "episode"


@offers("reset term", starts_midway=True)
class ExpertStates:
    """Some worlds start in a state of an accepted episode of the expert, in any of its phases; the
    others as the terms before say.

    The share of such worlds falls from episode to episode of a world. A world, an episode and a
    state belong together under a seed, and the world gets the masses, friction and gains that it
    had there. Counters and checks are those of any fresh episode.
    """

    label = "reset.expert"

    def __init__(
        self,
        env: EnvView,
        *,
        path: str | None = None,
        share: Fraction = 0.75,
        last_share: Fraction = 0.0,
        episodes: Count = 40,
    ) -> None:
        """Read the states.

        Args:
            env: The environment.
            path: The file; null: trainer=ppo records one at the beginning.
            share: Share of the worlds that start so in their first episode.
            last_share: The share that is left at the end.
            episodes: Episodes of a world over which the share falls.

        Raises:
            ParameterError: There is no file, or it has the states of another scene.
        """
        if path is None:
            expected = "a file of states, which job=train trainer=ppo records in its folder"
            raise ParameterError("path", None, expected)
        try:
            tensors = {name: torch.from_numpy(a) for name, a in read_npz(Path(path)).items()}
            self._source = tensors[EPISODE].to(env.device)
        except Exception as error:  # it may be anything
            expected = f"a file of states; it cannot be read ({first_line(error)})"
            raise ParameterError("path", path, expected, "Record it anew") from error
        self._count = len(self._source)
        # Of the worlds, and the states
        views = {name: view for name in VIEWS if (view := getattr(env.sim, name)).shape[1]}
        fields = {f: field for f, field in env.sim.fields.items() if FIELD + f in tensors}
        self._views, self._fields = (
            [(v, _matching(path, n, v, tensors.get(prefix + n))) for n, v in written.items()]
            for prefix, written in (("", views), (FIELD, fields))
        )
        self._share = share
        self._fall = share - last_share
        self._episodes = episodes

    def __call__(self, env: EnvView, mask: Tensor) -> None:
        """Write the state and the model fields."""
        draw = random_uniform(env, self.label, 2, 0.0, 1.0)
        over = (env.episode.to(draw.dtype) / self._episodes).clamp(0.0, 1.0)
        chosen = draw[:, 0] < self._share - self._fall * over
        state = (draw[:, 1] * self._count).long().clamp(max=self._count - 1)
        episode = self._source.index_select(0, state)
        for pairs, rows in ((self._views, state), (self._fields, episode)):
            for view, values in pairs:
                into = (mask & chosen).view(-1, *[1] * (view.dim() - 1))
                torch.where(into, values.index_select(0, rows), view, out=view)


def write_states(
    path: Path, states: Mapping[str, Tensor], fields: Mapping[str, Tensor], episodes: int
) -> None:
    """Write a file of states: the views of `VIEWS` by name, each ``(times * episodes, width)``, all
    episodes at one time, then all at the next; and model fields of the episodes' worlds by name,
    each ``(episodes, ...)``.

    Raises:
        OSError: The file cannot be written.
    """
    tensors = dict(states) | {FIELD + name: field for name, field in fields.items()}
    arrays = {name: values.cpu().numpy() for name, values in tensors.items()}
    times = len(arrays["qpos"]) // episodes
    write_npz(path, arrays | {EPISODE: np.tile(np.arange(episodes), times)})


def _matching(path: str, name: str, view: Tensor, values: Tensor | None) -> Tensor:
    """The values of a view or a model field, if each is of its shape."""
    shape = tuple(view.shape[1:])
    stored = None if values is None else tuple(values.shape[1:])
    if values is None or stored != shape:
        expected = f"states of this robot and scene: {name} of shape {shape}, not {stored}"
        raise ParameterError("path", path, expected, "Record them anew")
    return values.to(view)
