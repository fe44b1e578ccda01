"""Episodes of played worlds as a dataset takes them: their arrays, and images that are rendered
after they have been judged.
"""

import math
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch

from mjstack.datasets.part import PartWriter, ShardFiles
from mjstack.datasets.spec import DatasetSpec, EpisodeData
from mjstack.drivers.driver import Driver
from mjstack.envs import Env
from mjstack.episodes.batches import Batch
from mjstack.episodes.recorder import Channels, Read, read_commands, start_and_every_step
from mjstack.episodes.stage import Stage
from mjstack.jobs.collect_plan import ACTION, IMAGES, REWARD, STATE
from mjstack.managers.episode import required_fields
from mjstack.robots.units import LEROBOT, LerobotUnits
from mjstack.sim import StateRenderer
from mjstack.sim.cameras import with_outputs

POSITIONS = "qpos"  # the channel from which images are rendered
_CHUNK_BYTES = 128 * 2**20  # copied to the host at once
_MOST_RENDERED = 4096  # states at once


def demonstration_channels(stage: Stage) -> list[Channels]:
    """Channels of an episode of a dataset: before each step the measured joints, the observation
    and, with cameras, the positions; after it the joint targets that went to the actuators and the
    reward. All float32.
    """

    def read_before(env: Env, driver: Driver) -> Read:
        qpos = env.sim.qpos
        robot = env.index.on(env.device, qpos.dtype)
        groups = {
            f"observation.{name}": values for name, values in env.observation_manager.groups.items()
        }
        rendered = bool(stage.cfg.scene.cameras)
        return lambda: {
            STATE: robot.qpos.read(qpos).float(),
            **groups,
            **({POSITIONS: qpos.float()} if rendered else {}),
        }

    def read_step(env: Env, driver: Driver) -> Read:
        commands = read_commands(env, driver)
        reward = env.reward_manager.reward
        return lambda: {ACTION: commands()["ctrl"], REWARD: reward[:, None]}

    return [Channels(read_before, start_and_every_step), Channels(read_step)]


class EpisodeSource:
    """Makes the episodes of played worlds. With cameras their images are rendered after they have
    been judged, as many steps at once as there are worlds.

    Attributes:
        drawing: Time that images have taken [s].
    """

    def __init__(self, stage: Stage, spec: DatasetSpec, folder: Path) -> None:
        self._stage = stage
        self._spec = spec
        self._folder = folder
        self.drawing = 0.0
        self._units: LerobotUnits | None = None
        if stage.cfg.job.units == LEROBOT:
            self._units = LerobotUnits(stage.index.n_arm, stage.index.servo_range)
        self._most_rendered = 0  # states at once
        self._renderer: StateRenderer | None = None
        self._cameras = with_outputs(stage.cfg.scene.cameras, ["rgb"])
        # Steps from one image to the next, as the environment draws them
        hz = stage.cfg.task.control_hz
        self._strides = {
            name: round(hz / (camera.rate or hz)) for name, camera in self._cameras.items()
        }

    def close(self) -> None:
        """Give back the renderer."""
        if self._renderer is not None:
            self._renderer.close()

    def write(
        self, batch: Batch, chosen: Sequence[int], episode: int, frame: int
    ) -> list[ShardFiles]:
        """Write this rank's part of a batch into hidden files: of the worlds of all ranks those
        that are ``chosen``. ``episode`` and ``frame`` are numbers in the dataset: of the first of
        these episodes, and of its first frame. An OSError if a file cannot be written.
        """
        worlds = batch.plan.worlds
        order = {world: number for number, world in enumerate(chosen) if world in worlds}
        episodes = self.episodes(batch, [worlds.index(world) for world in order])
        images_gib = self._stage.cfg.job.buffer_gib
        files: list[ShardFiles] = []
        writer: PartWriter | None = None
        try:
            for count, (number, data) in enumerate(zip(order.values(), episodes, strict=True), 1):
                if writer is None:
                    name = f"rank{self._stage.ranks.rank:04d}-{len(files)}"
                    writer = PartWriter(self._folder, self._spec, name, images_gib)
                first_frame = frame + number * len(data.arrays[STATE])
                writer.write(data, episode + number, first_frame)
                if writer.is_full() or count == len(order):
                    files.append(writer.complete())
                    writer = None
                label = f"episodes of seed {batch.plan.seed}"
                self._stage.progress.advance(label, count, len(order))
            return files
        except BaseException:
            if writer is not None:
                writer.abandon()
            raise

    def episodes(self, batch: Batch, rows: Sequence[int]) -> Iterator[EpisodeData]:
        """The episodes of some worlds of a batch, by their rows, with images if there are cameras.
        They come to the host in chunks.

        Raises:
            MjstackError: The worlds in which images are rendered do not fit into memory.
        """
        if self._cameras and rows and self._renderer is None:
            self._most_rendered = min(_MOST_RENDERED, len(batch.plan.worlds))
            fields = required_fields(self._stage.cfg.reset)
            self._renderer = self._stage.color_renderer(self._most_rendered, fields)
        steps = range(len(batch.rows[ACTION]))
        rendered_steps = steps[:: math.gcd(*self._strides.values()) or 1]
        columns = [name for name in batch.rows if name != POSITIONS]
        size = _CHUNK_BYTES // sum(batch.rows[name][:, 0].nbytes for name in columns)
        if self._cameras:
            size = self._most_rendered // len(rendered_steps)
        size = max(1, size)
        for first in range(0, len(rows), size):
            chunk = rows[first : first + size]
            worlds = torch.tensor(chunk, device=batch.rows[ACTION].device)
            host = {name: batch.select(name, worlds).cpu().numpy() for name in columns}
            rendered = self._render(batch, worlds, rendered_steps) if self._cameras else {}
            for number, row in enumerate(chunk):
                arrays = {name: values[number, : len(steps)] for name, values in host.items()}
                if self._units is not None:
                    arrays |= {name: self._units.from_si(arrays[name]) for name in (STATE, ACTION)}
                images = {}
                for name, stride in self._strides.items():
                    frame = np.array(steps) // stride * stride // rendered_steps.step
                    images[f"{IMAGES}.{name}"] = rendered[name][number, frame]
                yield self._episode(batch, row, arrays, images)

    def _episode(
        self, batch: Batch, row: int, arrays: dict[str, np.ndarray], images: dict[str, np.ndarray]
    ) -> EpisodeData:
        """A world's steps and its result. `next.success` is true in the last step of a successful
        episode alone.
        """
        broken = self._stage.check.rules.describe(int(batch.episode.failed[row]))
        last = np.arange(len(arrays[STATE])) == len(arrays[STATE]) - 1
        arrays |= {"next.done": last, "next.success": last & (not broken)}
        return EpisodeData(
            arrays={name: arrays[name] for name in self._spec.features},
            images=images,
            row={
                "success": not broken,
                "seed": batch.plan.seed,
                "world": batch.plan.worlds[row],
                "retries": int(batch.episode.retries[row]),
                "failed_rules": broken,
                "config_sha256": self._spec.config_sha256,
            },
        )

    def _render(self, batch: Batch, worlds: torch.Tensor, steps: range) -> dict[str, np.ndarray]:
        """Images of some worlds before some steps, on the host, by camera: each ``(worlds, steps,
        height, width, 3)``, uint8.
        """
        assert self._renderer is not None
        began = time.perf_counter()
        qpos = batch.select(POSITIONS, worlds)[:, list(steps)].flatten(0, 1)
        fields = {
            name: values[worlds.to(values.device)].repeat_interleave(len(steps), 0)
            for name, values in batch.env.sim.fields.items()
        }
        shapes = {name: (len(qpos), *camera.size, 3) for name, camera in self._cameras.items()}
        image_arrays = {name: np.empty(shape, np.uint8) for name, shape in shapes.items()}
        for first in range(0, len(qpos), self._most_rendered):
            rows = slice(first, first + self._most_rendered)
            chunk_fields = {name: values[rows] for name, values in fields.items()}
            images = self._renderer.draw(qpos[rows], chunk_fields)
            for name, whole in image_arrays.items():
                torch.from_numpy(whole[rows]).copy_(images[f"images.{name}"])
        self.drawing += time.perf_counter() - began
        return {
            name: whole.reshape(len(worlds), len(steps), *whole.shape[1:])
            for name, whole in image_arrays.items()
        }
