"""Images that a policy learns from: drawn from the positions of demonstrations as they are needed,
on the device.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from mjstack.config.schema import VisionCfg
from mjstack.episodes.stage import Stage
from mjstack.managers.episode import required_fields
from mjstack.policy import Vision
from mjstack.train.demonstrations import Demonstrations

_FIRST_SEED = 2**40  # from which on nothing else has seeds
_AT_ONCE = 2048  # states that are drawn at most, where more are needed


class ImagePool:
    """Images of some steps of demonstrations, of which the oldest give way to new ones.

    The content follows from the seed and the number of the batch alone, so training goes on after
    any batch. If all steps fit, each is drawn once and stays.

    Attributes:
        steps: The step that each row shows, shape ``(rows,)``, int64.
        images: Images of those steps, one for each camera, each ``(rows, height, width, 3)``,
            uint8.
    """

    def __init__(
        self,
        stage: Stage,
        settings: VisionCfg,
        vision: Vision,
        demonstrations: Demonstrations,
        steps: Tensor,
        batch_size: int,
        seed: int,
    ) -> None:
        """Allocate.

        Args:
            stage: The stage, for its scene and its device.
            settings: How many images are kept, and how often each is used.
            vision: The images that the policy sees.
            demonstrations: The episodes.
            steps: Those of their steps that are drawn, shape ``(n,)``, int64.
            batch_size: Steps of a batch.
            seed: Of the choice of steps.

        Raises:
            MjstackError: The images do not fit into memory.
        """
        assert demonstrations.qpos is not None
        self._qpos = demonstrations.qpos
        self._fields = demonstrations.fields
        self._episode = demonstrations.episode()
        self._from = steps
        self._names = list(vision.sizes)
        device = steps.device
        self._whole = len(steps) <= settings.pool
        self._fresh = max(1, batch_size // settings.uses)
        if self._whole:
            self._fresh = min(_AT_ONCE, len(steps))
        rows = len(steps) if self._whole else -(-settings.pool // self._fresh) * self._fresh
        self._count = -(-rows // self._fresh)
        fields = required_fields(stage.cfg.reset)
        self._renderer = stage.color_renderer(self._fresh, fields, self._names)
        self._generator = torch.Generator(device)
        self._seed = _FIRST_SEED + seed
        self.steps = torch.zeros(rows, dtype=torch.int64, device=device)
        self.images = [
            torch.zeros((rows, *vision.sizes[name], 3), dtype=torch.uint8, device=device)
            for name in self._names
        ]

    def fill(self, batch: int) -> None:
        """Draw what the pool has after a batch of this number."""
        if self._whole:
            for first in range(0, len(self.steps), self._fresh):
                self._draw(first, self._from[first : first + self._fresh])
        else:
            for number in range(batch - self._count + 1, batch + 1):
                self._draw_part(number)

    def advance(self, batch: int) -> None:
        """Draw new images for a batch in the place of the oldest."""
        if not self._whole:
            self._draw_part(batch)

    def _draw_part(self, number: int) -> None:
        """Draw the part of the pool that has this number."""
        self._generator.manual_seed(self._seed + number + self._count)
        device = self.steps.device
        size = (self._fresh,)
        chosen = torch.randint(len(self._from), size, generator=self._generator, device=device)
        self._draw(number % self._count * self._fresh, self._from[chosen])

    def _draw(self, first: int, steps: Tensor) -> None:
        """Draw steps into the rows from ``first`` on."""
        rows = slice(first, first + len(steps))
        self.steps[rows] = steps
        episodes = self._episode[steps]
        fields = {name: values[episodes] for name, values in self._fields.items()}
        rendered = self._renderer.draw(self._qpos[steps], fields)
        for name, images in zip(self._names, self.images, strict=True):
            images[rows] = rendered[f"images.{name}"]

    def close(self) -> None:
        """Give the worlds for drawing back."""
        self._renderer.close()


class Augmentation:
    """Random shifts and colours of a batch of images. What it draws lies in tensors, so a graph can
    hold the rest.
    """

    def __init__(self, settings: VisionCfg, cameras: int, count: int, device: torch.device) -> None:
        """Allocate for batches of ``count`` steps."""
        self._shift = settings.shift
        self._color = settings.color
        self._moves = torch.zeros((cameras, count, 2), dtype=torch.int64, device=device)
        self._tints = torch.zeros((cameras, count, 2, 4), device=device)

    def draw(self, generator: torch.Generator) -> None:
        """Draw the numbers of a batch."""
        self._moves.random_(0, 2 * self._shift + 1, generator=generator)
        self._tints.uniform_(-1.0, 1.0, generator=generator)

    def __call__(self, pool: Sequence[Tensor], rows: Tensor) -> list[Tensor]:
        """Augmented images of some rows of a pool, each ``(n, height, width, 3)``, float32, 0 to
        255. What a shift leaves open repeats the border.
        """
        out = []
        for images, moves, tints in zip(pool, self._moves, self._tints, strict=True):
            moves = (moves - self._shift)[..., None]
            y, x = (
                (torch.arange(size, device=rows.device) + moves[:, axis]).clamp(0, size - 1)
                for axis, size in enumerate(images.shape[1:3])
            )
            picked = images[rows[:, None, None], y[:, :, None], x[:, None, :]].float()
            # Of all colours, and of each
            change = 0.5 * self._color * (tints[..., :1] + tints[..., 1:])
            gain = 1.0 + change[:, None, None, 0]
            offset = 127.5 * change[:, None, None, 1]
            out.append((picked * gain + offset).clamp(0.0, 255.0))
        return out
