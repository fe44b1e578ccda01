"""Episodes of played worlds as a dataset takes them: their arrays, and images that are drawn after
they have been judged.
"""

import itertools
import math
import time
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import torch

from mjstack.datasets import EpisodeData
from mjstack.episodes.context import RunContext
from mjstack.jobs.demonstration import IMAGES, STATE, Played
from mjstack.managers.episode import required_fields
from mjstack.sim import StateRenderer
from mjstack.sim.cameras import color_cameras

_MOST_DRAWN = 4096  # states at once


class EpisodeSource:
    """Makes the episodes of played worlds. With cameras their images are drawn after they have been
    judged, as many steps at once as there are worlds.

    Attributes:
        drawing: Time that images have taken [s].
    """

    def __init__(self, context: RunContext, config_sha256: str, most: int) -> None:
        """Prepare for a run.

        Args:
            context: The run.
            config_sha256: Hash of what episodes depend on.
            most: Largest number of states that are drawn at once.
        """
        self._context = context
        self._config_sha256 = config_sha256
        self._most = min(most, _MOST_DRAWN)
        self.drawing = 0.0
        self._count = 0
        self._renderer: StateRenderer | None = None
        self._cameras = color_cameras(context.cfg.scene.cameras)
        # Steps from one image to the next, as the environment draws them
        hz = context.cfg.task.control_hz
        self._every = {name: round(hz / (each.rate or hz)) for name, each in self._cameras.items()}

    def close(self) -> None:
        """Give back what draws."""
        if self._renderer is not None:
            self._renderer.close()

    def episodes(self, played: Played, worlds: Sequence[int]) -> Iterator[EpisodeData]:
        """Some worlds' episodes, with their images if there are cameras.

        Raises:
            MjstackError: The worlds in which images are drawn do not fit into memory.
        """
        rows = [played.worlds.index(world) for world in worlds]
        images: Iterator[dict[str, np.ndarray]] = itertools.repeat({})
        if played.states is not None and rows:
            images = self._images(played, rows)
        for (row, arrays), shown in zip(played.episodes(rows), images, strict=False):
            yield self._episode(played, row, arrays, shown)

    def _episode(
        self,
        played: Played,
        world: int,
        arrays: dict[str, np.ndarray],
        images: dict[str, np.ndarray],
    ) -> EpisodeData:
        """A world's steps and its result. `next.success` is true in the last step of a successful
        episode alone.
        """
        task = self._context.cfg.task
        broken = self._context.check.rules.describe(int(played.failed[world]))
        last = np.arange(len(arrays[STATE])) == len(arrays[STATE]) - 1
        return EpisodeData(
            arrays={**arrays, "next.done": last, "next.success": last & (not broken)},
            images=images,
            task=task.instruction or task.name,
            success=not broken,
            seed=played.seed,
            world=played.worlds[world],
            values={
                "retries": int(played.retries[world]),
                "failed_rules": broken,
                "config_sha256": self._config_sha256,
            },
        )

    def _images(self, played: Played, rows: Sequence[int]) -> Iterator[dict[str, np.ndarray]]:
        """Images of some worlds' episodes on the host, by column, each ``(steps, height, width,
        3)``, uint8.
        """
        assert played.states is not None
        if self._renderer is None:
            self._count = min(self._most, len(played.worlds))
            self._renderer = self._context.stage.color_renderer(
                self._count, required_fields(self._context.cfg.reset)
            )
        steps = len(played.states)
        step = math.gcd(*self._every.values())
        states = played.states[::step]
        at_once = max(1, self._count // len(states))
        for first in range(0, len(rows), at_once):
            began = time.perf_counter()
            some = torch.tensor(rows[first : first + at_once])
            shown = states.index_select(1, some.to(states.device)).transpose(0, 1).flatten(0, 1)
            fields = {
                name: values[some.to(values.device)].repeat_interleave(len(states), 0)
                for name, values in played.fields.items()
            }
            drawn = self._draw(self._renderer, shown, fields)
            self.drawing += time.perf_counter() - began
            for row in range(len(some)):
                rows_of = slice(row * len(states), (row + 1) * len(states))
                episode = {}
                for name, every in self._every.items():
                    images = drawn[name][rows_of][:: every // step]
                    if every > 1:
                        images = np.repeat(images, every, axis=0)[:steps]
                    episode[f"{IMAGES}.{name}"] = images
                yield episode

    def _draw(
        self, renderer: StateRenderer, qpos: torch.Tensor, fields: Mapping[str, torch.Tensor]
    ) -> dict[str, np.ndarray]:
        """Images of any number of states by camera, on the host."""
        shapes = {name: (len(qpos), *each.size, 3) for name, each in self._cameras.items()}
        out = {name: np.empty(shape, np.uint8) for name, shape in shapes.items()}
        for first in range(0, len(qpos), self._count):
            rows = slice(first, first + self._count)
            looks = {name: values[rows] for name, values in fields.items()}
            images = renderer.draw(qpos[rows], looks)
            for name, whole in out.items():
                torch.from_numpy(whole[rows]).copy_(images[f"images.{name}"])
        return out
