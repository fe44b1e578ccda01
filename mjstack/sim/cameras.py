"""Cameras of a batch: what they draw, where it goes, and the memory it takes."""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import mujoco
import torch
from torch import Tensor

from mjstack.config.schema import CameraCfg
from mjstack.errors import ConfigError
from mjstack.sim.memory import free_memory

VISIBLE_GROUPS = (0, 1, 2)  # of geoms, as in MuJoCo's viewer; collision geoms are in group 3
PREFIXES = {"rgb": "images", "depth": "depth", "segmentation": "segmentation"}
_TYPES = {
    "rgb": (torch.uint8, (3,)),
    "depth": (torch.float32, (1,)),
    "segmentation": (torch.int32, ()),
}
# Bytes of a pixel in MJWarp's own buffers, and of a geom in its bounding volume hierarchy
_RENDERED = {"rgb": 4, "depth": 4, "segmentation": 8}
_PER_GEOM = 110

Masks = Mapping[str, Tensor | None]
"""Worlds of each camera, shape ``(nworld,)``, bool; None for all. A camera that is left out is not
drawn."""


class Cameras(ABC):
    """Draws the worlds of a simulation, as its poses are, by ``cameras``, which have names.

    The numbers of segmentation are places in the list ``labels``, and -1 where the ray hits
    nothing. A body is a thing with a label, and so is each geom that is fixed to the world.
    """

    mjwarp = False  # whether MJWarp draws

    def __init__(
        self,
        model: mujoco.MjModel,
        nworld: int,
        device: torch.device,
        cameras: Mapping[str, CameraCfg],
    ) -> None:
        """Take the model, which has cameras of these names.

        Raises:
            ConfigError: The images of so many worlds do not fit into the device's memory.
        """
        self.cameras = cameras
        self._nworld = nworld
        self._device = device
        check_image_memory(model, cameras, nworld, device, mjwarp=self.mjwarp)
        of_geoms = [thing_of(model, geom) for geom in range(model.ngeom)]
        self.labels = list(dict.fromkeys(of_geoms))
        self._label_of_geom = [self.labels.index(name) for name in of_geoms]

    def allocate(self, *, terminal: bool = False) -> dict[str, Tensor]:
        """Buffers for every output of every camera, or of those that draw the ends of episodes,
        zero. By name: ``images.CAMERA`` ``(nworld, height, width, 3)``, uint8; ``depth.CAMERA``
        ``(nworld, height, width, 1)``, float32, metres along the camera's axis, 0 where the ray
        hits nothing; ``segmentation.CAMERA`` ``(nworld, height, width)``, int32.
        """
        return {
            f"{PREFIXES[output]}.{name}": torch.zeros(
                (self._nworld, *camera.size, *_TYPES[output][1]),
                dtype=_TYPES[output][0],
                device=self._device,
            )
            for name, camera, output in _outputs(self.cameras)
            if camera.terminal or not terminal
        }

    @abstractmethod
    def draw(self, out: Mapping[str, Tensor], masks: Masks) -> None:
        """Draw the cameras and worlds of the masks into buffers of `allocate`. The images of other
        worlds stay.

        Raises:
            MjstackError: This machine cannot draw.
        """

    def close(self) -> None:
        """Give what drawing needs back; MJWarp's memory goes with the last reference."""
        return


def with_outputs(
    cameras: Mapping[str, CameraCfg], outputs: Sequence[str], names: Sequence[str] | None = None
) -> dict[str, CameraCfg]:
    """Some cameras, or all, with other outputs; none draws the ends of episodes."""
    chosen = cameras if names is None else names
    return {name: replace(cameras[name], outputs=[*outputs], terminal=False) for name in chosen}


def image_bytes(
    model: mujoco.MjModel, cameras: Mapping[str, CameraCfg], nworld: int, *, mjwarp: bool
) -> int:
    """Bytes of all images, and of what MJWarp needs to draw them."""
    size = 0
    for _, camera, output in _outputs(cameras):
        dtype, shape = _TYPES[output]
        pixel = (1 + camera.terminal) * dtype.itemsize * math.prod(shape)
        size += math.prod(camera.size) * (pixel + mjwarp * _RENDERED[output])
    visible = sum(int(group) in VISIBLE_GROUPS for group in model.geom_group)
    return nworld * (size + mjwarp * visible * _PER_GEOM)


def check_image_memory(
    model: mujoco.MjModel,
    cameras: Mapping[str, CameraCfg],
    nworld: int,
    device: torch.device,
    *,
    mjwarp: bool,
) -> None:
    """Raise a `ConfigError` if the images do not fit into the memory that the device has left."""
    size = image_bytes(model, cameras, nworld, mjwarp=mjwarp)
    free = free_memory(device)
    if size > free:
        sizes = [f"{name} {'x'.join(map(str, camera.size))}" for name, camera in cameras.items()]
        expected = (
            f"images that fit into the memory of {device}, where {nworld} worlds need"
            f" {size / 2**30:.3g} GiB and {free / 2**30:.3g} GiB are free"
        )
        fix = "Lower nworld, or the cameras' size"
        raise ConfigError("scene.cameras", ", ".join(sizes), expected, fix)


def _outputs(cameras: Mapping[str, CameraCfg]) -> Iterator[tuple[str, CameraCfg, str]]:
    for name, camera in cameras.items():
        for output in camera.outputs:
            yield name, camera, output


def thing_of(model: mujoco.MjModel, geom: int) -> str:
    """The thing that a geom belongs to."""
    body = model.geom_bodyid[geom]
    return (model.body(body).name or f"body_{body}") if body else model.geom(geom).name or "world"
