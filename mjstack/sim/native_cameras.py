"""Cameras of native MuJoCo, drawn by OpenGL one world after the other."""

import copy
import threading
from collections.abc import Mapping

import mujoco
import numpy as np
import torch
from torch import Tensor

from mjstack.config.schema import CameraCfg
from mjstack.interrupt import check_interrupt
from mjstack.report.gl import open_renderer
from mjstack.sim.cameras import PREFIXES, VISIBLE_GROUPS, Cameras, Masks

_FAR = 0.999  # share of the far plane beyond which nothing was hit


class NativeCameras(Cameras):
    """`Cameras` through `mujoco.Renderer`.

    An OpenGL context belongs to the thread that has made it, so each thread that draws has its own.
    Shadows, reflections and antialiasing are off: MJWarp has none of them, and images of the two
    backends agree.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        qpos: np.ndarray,
        fields: Mapping[str, np.ndarray],
        cameras: Mapping[str, CameraCfg],
    ) -> None:
        """Take the worlds.

        Args:
            model: The compiled model.
            qpos: The worlds' states, shape ``(nworld, nq)``.
            fields: Their model fields, each ``(nworld, ...)``.
            cameras: The cameras by name.
        """
        super().__init__(model, len(qpos), torch.device("cpu"), cameras)
        self._qpos = qpos
        self._fields = fields
        self._model = drawn = copy.copy(model)
        drawn.vis.quality.offsamples = 0
        sizes = np.array([camera.size for camera in cameras.values()])
        drawn.vis.global_.offheight, drawn.vis.global_.offwidth = sizes.max(axis=0)
        self._far = float(drawn.vis.map.zfar * drawn.stat.extent)
        self._data = mujoco.MjData(drawn)
        self._labels = np.array([*self._label_of_geom, -1], dtype=np.int32)
        self._option = mujoco.MjvOption()
        self._option.geomgroup[:] = 0
        self._option.geomgroup[list(VISIBLE_GROUPS)] = 1
        self._option.sitegroup[:] = 0
        self._own = threading.local()

    def draw(self, out: Mapping[str, Tensor], masks: Masks) -> None:
        """See `Cameras`."""
        worlds = {
            name: np.arange(self._nworld) if mask is None else mask.nonzero()[:, 0].numpy()
            for name, mask in masks.items()
        }
        every = sorted({int(world) for some in worlds.values() for world in some})
        due = {name: set(some.tolist()) for name, some in worlds.items()}
        for world in every:
            check_interrupt()
            self._pose(world)
            for name, some in due.items():
                if world in some:
                    self._draw(out, name, world)

    def close(self) -> None:
        """See `Cameras`; contexts of other threads end with those."""
        for renderer in vars(self._own).pop("renderers", {}).values():
            renderer.close()

    def _pose(self, world: int) -> None:
        """Bring the model and the poses of everything drawn to those of a world."""
        m = self._model
        for name, values in self._fields.items():
            getattr(m, name)[:] = values[world]
        self._data.qpos[:] = self._qpos[world]
        mujoco.mj_kinematics(m, self._data)
        mujoco.mj_comPos(m, self._data)
        mujoco.mj_camlight(m, self._data)

    def _draw(self, out: Mapping[str, Tensor], name: str, world: int) -> None:
        camera = self.cameras[name]
        renderer = self._renderer(*camera.size)
        renderer.update_scene(self._data, name, self._option)
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            renderer.scene.flags[flag] = 0
        for output in camera.outputs:
            image = out[f"{PREFIXES[output]}.{name}"][world].numpy()
            if output == "rgb":
                image[:] = renderer.render()
            elif output == "depth":
                renderer.enable_depth_rendering()
                depth = renderer.render()
                image[..., 0] = np.where(depth < _FAR * self._far, depth, 0.0)
                renderer.disable_depth_rendering()
            else:
                renderer.enable_segmentation_rendering()
                image[:] = self._labels[renderer.render()[..., 0]]
                renderer.disable_segmentation_rendering()

    def _renderer(self, height: int, width: int) -> mujoco.Renderer:
        """This thread's renderer of images of a size."""
        renderers = vars(self._own).setdefault("renderers", {})
        if (height, width) not in renderers:
            renderers[height, width] = open_renderer(self._model, height, width)
        return renderers[height, width]
