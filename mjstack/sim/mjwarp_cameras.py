"""Cameras of MuJoCo Warp: its ray caster, and kernels that bring what it draws into tensors."""

# No `from __future__ import annotations` here: Warp reads the annotations as objects.
from collections.abc import Collection, Mapping

import mujoco
import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from mjstack.config.schema import CameraCfg
from mjstack.sim.cameras import PREFIXES, VISIBLE_GROUPS, Cameras, Masks
from mjstack.sim.mujoco_warp import mjw, torch_stream_scope, wp

_AWAY = 1e6  # m above everything: where cameras that draw nothing look up from
TILE = 8
"""Pixels along the edge of the squares in which rays are cast: neighbours on the device are
neighbours in the image."""
BLOCK_DIM = 64
"""Rays of a CUDA block."""


class MjwarpCameras(Cameras):
    """`Cameras` through MJWarp's renderer, which draws all cameras of all worlds in one launch.

    It has no mask. A camera of a world that is not drawn is moved away, where its rays end at once,
    and what it draws there is not copied. All of it can be captured: shapes are fixed, and nothing
    is read.
    """

    mjwarp = True

    def __init__(
        self,
        model: mujoco.MjModel,
        m: mjw.Model,
        d: mjw.Data,
        fields: Collection[str],
        cameras: Mapping[str, CameraCfg],
    ) -> None:
        """Build the renderer of the worlds ``d``, and compile it. The model is also on the device,
        ``m``; ``fields`` are the names of those that differ from world to world.
        """
        self._m = m
        m.block_dim.render = BLOCK_DIM
        self._d = d
        self._wp_device = device = m.geom_type.device
        super().__init__(model, d.nworld, torch.device(wp.device_to_torch(device)), cameras)
        dynamic = "cam_fovy" in fields
        requested = {
            output: [output in camera.outputs for camera in cameras.values()] for output in PREFIXES
        }
        ambient, specular = (
            name in fields or bool(getattr(model, name).any())
            for name in ("light_ambient", "light_specular")
        )
        specular |= bool(model.vis.headlight.specular.any())
        with wp.ScopedDevice(device):
            # What the model has not is compiled out.
            self._context = mjw.create_render_context(
                model,
                d.nworld,
                cam_res=[(width, height) for height, width in (c.size for c in cameras.values())],
                render_rgb=requested["rgb"],
                render_depth=requested["depth"],
                render_seg=requested["segmentation"],
                use_textures=model.ntex > 0,
                enabled_geom_groups=list(VISIBLE_GROUPS),
                cam_active=list(cameras),
                use_precomputed_rays=not dynamic,
                enable_vertex_normals=model.nmesh > 0,
                enable_emission=bool(model.mat_emission.any()),
                enable_per_light_ambient=ambient,
                enable_specular=specular,
            )
            self._labels = wp.array(self._label_of_geom, dtype=int)
            # Rays that are computed for each world know their pixel by their number.
            places = self._arrange_rays(1 if dynamic else TILE)
            self._places = [wp.array(rays, dtype=int) for rays in places]
        self._numbers = {name: number for number, name in enumerate(cameras)}
        self._due = torch.ones((d.nworld, len(cameras)), dtype=torch.bool, device=self._device)
        self.draw({}, {})  # compiles

    @override
    def draw(self, out: Mapping[str, Tensor], masks: Masks) -> None:
        rc = self._context
        whole = all(name in masks and masks[name] is None for name in self.cameras)
        for name, number in self._numbers.items():
            mask = masks.get(name)
            self._due[:, number] = name in masks if mask is None else mask
        due = wp.from_torch(self._due)
        with torch_stream_scope(self._wp_device):
            mjw.camlight(self._m, self._d)
            if not whole:
                wp.launch(
                    send_away,
                    dim=due.shape,
                    inputs=[due, rc.cam_id_map, _AWAY],
                    outputs=[self._d.cam_xpos, self._d.cam_xmat],
                )
            mjw.refit_bvh(self._m, self._d, rc)
            mjw.render(self._m, self._d, rc)
            for name in masks:
                self._copy(out, name, due)

    def _arrange_rays(self, tile: int) -> list[np.ndarray]:
        """Order the rays of each camera by squares of pixels; for each camera the ray of each pixel
        among those of the camera.
        """
        orders = []
        for camera in self.cameras.values():
            y, x = np.indices(camera.size).reshape(2, -1)
            orders.append(np.lexsort((x, y, x // tile, y // tile)))
        first = np.cumsum([0, *map(len, orders)])
        rays = np.concatenate([start + order for start, order in zip(first, orders, strict=False)])
        for name in ("ray", "ray_offset"):
            values = getattr(self._context, name)
            values.assign(values.numpy()[rays])
        return [np.argsort(order) for order in orders]

    def _copy(self, out: Mapping[str, Tensor], name: str, due: wp.array) -> None:
        """Copy what a camera has drawn into its buffers."""
        rc = self._context
        camera = self.cameras[name]
        number = self._numbers[name]
        images = [
            wp.from_torch(out[f"{prefix}.{name}"]) if output in camera.outputs else None
            for output, prefix in PREFIXES.items()
        ]
        pixels = [rc.rgb_adr, rc.depth_adr, rc.seg_adr, rc.rgb_data, rc.depth_data, rc.seg_data]
        places = self._places[number]
        wp.launch(
            copy_pixels,
            dim=(self._nworld, *camera.size),
            inputs=[due, number, places, *pixels, self._labels, camera.size[1]],
            outputs=images,
        )


@wp.kernel(enable_backward=False)
def send_away(
    due: wp.array2d[bool],
    camera_of: wp.array[int],
    height: float,
    xpos: wp.array2d[wp.vec3],
    xmat: wp.array2d[wp.mat33],
) -> None:
    """Put the cameras that draw nothing above everything, looking up."""
    world, number = wp.tid()  # type: ignore[misc]
    if not due[world, number]:
        camera = camera_of[number]
        xpos[world, camera] = wp.vec3(0.0, 0.0, height)
        xmat[world, camera] = wp.mat33(1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -1.0)


@wp.kernel(enable_backward=False)
def copy_pixels(
    due: wp.array2d[bool],
    number: int,
    places: wp.array[int],
    first_word: wp.array[int],
    first_depth: wp.array[int],
    first_geom: wp.array[int],
    words: wp.array2d[wp.uint32],
    depths: wp.array2d[float],
    geoms: wp.array2d[wp.vec2i],
    labels: wp.array[int],
    width: int,
    rgb: wp.array4d[wp.uint8],
    depth: wp.array4d[float],
    segmentation: wp.array3d[int],
) -> None:
    """Images of the worlds that are due, where there is memory for them: red, green and blue from
    words of alpha, red, green and blue; depth; labels of geoms, -1 where there is none.
    """
    world, y, x = wp.tid()  # type: ignore[misc]
    if not due[world, number]:
        return
    place = places[y * width + x]
    if rgb:
        word = words[world, first_word[number] + place]
        rgb[world, y, x, 0] = wp.uint8(word >> wp.uint32(16))
        rgb[world, y, x, 1] = wp.uint8(word >> wp.uint32(8))
        rgb[world, y, x, 2] = wp.uint8(word)
    if depth:
        depth[world, y, x, 0] = depths[world, first_depth[number] + place]
    if segmentation:
        geom = geoms[world, first_geom[number] + place][0]
        segmentation[world, y, x] = -1
        if geom >= 0:
            segmentation[world, y, x] = labels[geom]
