"""Images that a policy learns from. Its own rounds have rendered them; they stay on the device."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence

import torch
from torch import Tensor

from mjstack.config.schema import CloneJobCfg, VisionCfg
from mjstack.episodes.stage import Stage
from mjstack.errors import ConfigError
from mjstack.sim.memory import free_memory

AT_ONCE = 2048  # states that are rendered, or images that are copied, at once
_GOLDEN = 2654435769  # of 2**32: multiples of it are spread evenly
_PERIOD = 2**32

ReadImages = Callable[[Tensor], Mapping[str, Tensor]]
"""Gives images of n steps by camera, each ``(n, height, width, 3)``."""


class ImagePool:
    """Images of all steps while they fit, else of an even share of them.

    A step's number alone decides how long it is kept, so the content depends neither on the order
    in which steps came nor on how many came at once.

    Attributes:
        steps: The step that each row shows, counted from the first call of `add` on, shape
            ``(rows,)``, int64; -1 where there is none yet.
        images: Images of those steps by camera, each ``(rows, height, width, 3)``, uint8.
    """

    def __init__(
        self, sizes: Mapping[str, Sequence[int]], rows: int, device: torch.device | str
    ) -> None:
        """Allocate rows for images of these heights and widths."""
        self._before = 0  # steps of earlier calls
        self.steps = torch.full((rows,), -1, dtype=torch.int64, device=device)
        self.images = {
            name: torch.zeros((rows, *size, 3), dtype=torch.uint8, device=device)
            for name, size in sizes.items()
        }

    def add(self, steps: Tensor, count: int, read: ReadImages) -> None:
        """Keep images of some of the next ``count`` steps: of ``steps``, counted from 0 on, shape
        ``(n,)``, int64, some of which ``read`` is asked for.
        """
        rows = len(self.steps)
        candidates = torch.cat([self.steps, self._before + steps])
        order = torch.where(candidates < 0, _PERIOD, candidates * _GOLDEN % _PERIOD)
        stays = torch.zeros_like(order, dtype=torch.bool)
        stays[order.topk(rows, largest=False).indices] = True
        free = (~stays[:rows]).nonzero()[:, 0].split(AT_ONCE)
        chosen = steps[stays[rows:]].split(AT_ONCE)
        for into, part in zip(free, chosen, strict=True):
            self.steps[into] = self._before + part
            for name, images in read(part).items():
                self.images[name][into] = images
        self._before += count

    def rows(self) -> Tensor:
        """Rows that show a step, in the order of these, shape ``(n,)``, int64."""
        order = self.steps.argsort()
        return order[self.steps[order] >= 0]


def pool_rows(stage: Stage, steps: int) -> int:
    """Number of rows of the pool of a training: job.vision.pool, or as many as half of the free
    memory has place for, and no more than there will be images in episodes of so many steps.

    Raises:
        ConfigError: They, or the images of one batch of worlds, do not fit into memory.
    """
    job: CloneJobCfg = stage.cfg.job
    answers = math.ceil(math.ceil(job.length * steps) / job.execute)
    cameras = stage.cfg.scene.cameras
    size = 3 * sum(math.prod(cameras[name].size) for name in job.vision.cameras)
    free = free_memory(torch.device(stage.backend[1]))
    most = free // size - answers * min(stage.cfg.nworld, job.episodes)  # beside those of a batch
    rows = most // 2 if job.vision.pool is None else job.vision.pool
    if not 1 <= rows <= most:
        expected = f"at most {max(0, most)}, for which the device has memory ({free / 2**30:.3g}"
        expected += f" GiB are free; a step takes {size / 2**20:.3g} MiB), beside one of nworld"
        raise ConfigError("job.vision.pool", job.vision.pool, expected, "Or make images smaller")
    return min(rows, answers * job.episodes * (job.rounds + 1))


class Augmentation:
    """Random shifts and colours of a batch of images. What it draws lies in tensors, so a graph can
    hold the rest.
    """

    def __init__(self, settings: VisionCfg, cameras: int, count: int, device: torch.device) -> None:
        """Allocate for batches of ``count`` steps."""
        self._shift = settings.shift
        self._color = settings.color
        self._moves = torch.zeros((cameras, count, 2), dtype=torch.int64, device=device)
        # Bytes are whole numbers in bfloat16 too, in which CUDA convolves
        self._dtype = torch.bfloat16 if device.type == "cuda" else torch.float32
        self._tints = torch.zeros((cameras, count, 2, 4), device=device)

    def draw(self, generator: torch.Generator) -> None:
        """Draw the numbers of a batch."""
        self._moves.random_(0, 2 * self._shift + 1, generator=generator)
        self._tints.uniform_(-1.0, 1.0, generator=generator)

    def __call__(self, pool: Iterable[Tensor], rows: Tensor) -> list[Tensor]:
        """Augmented images of some rows of a pool, each ``(n, height, width, 3)``, 0 to 255,
        bfloat16 on CUDA, else float32. What a shift leaves open repeats the border.
        """
        out = []
        for images, moves, tints in zip(pool, self._moves, self._tints, strict=True):
            height, width = images.shape[1:3]
            y, x = (
                (torch.arange(size, device=rows.device) + move[:, None]).clamp(0, size - 1)
                for size, move in zip((height, width), (moves - self._shift).T, strict=True)
            )
            # Pixels are gathered as bytes
            pixels = (rows[:, None, None] * height + y[:, :, None]) * width + x[:, None, :]
            picked = images.view(-1, 3).index_select(0, pixels.flatten()).to(self._dtype)
            picked = picked.view(*pixels.shape, 3)
            # Of all colours, and of each
            change = (0.5 * self._color * (tints[..., :1] + tints[..., 1:])).to(self._dtype)
            gain = 1.0 + change[:, None, None, 0]
            offset = 127.5 * change[:, None, None, 1]
            out.append(picked.mul_(gain).add_(offset).clamp_(0.0, 255.0))
        return out
