"""Cameras of native MuJoCo, drawn by OpenGL one world after the other."""

import copy
import threading
from collections.abc import Mapping

import mujoco
import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

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
        """Take the model, the worlds' states, shape ``(nworld, nq)``, and their model fields, each
        ``(nworld, ...)``.
        """
        super().__init__(model, len(qpos), torch.device("cpu"), cameras)
        self._qpos = qpos
        self._fields = fields
        self._model = scene_model = copy.copy(model)
        scene_model.vis.quality.offsamples = 0
        sizes = np.array([camera.size for camera in cameras.values()])
        scene_model.vis.global_.offheight, scene_model.vis.global_.offwidth = sizes.max(axis=0)
        self._farthest = _FAR * float(scene_model.vis.map.zfar * scene_model.stat.extent)
        self._data = mujoco.MjData(scene_model)
        self._labels = np.array([*self._label_of_geom, -1], dtype=np.int32)
        self._option = mujoco.MjvOption()
        self._option.geomgroup[:] = 0
        self._option.geomgroup[list(VISIBLE_GROUPS)] = 1
        self._option.sitegroup[:] = 0
        self._thread = threading.local()

    @override
    def draw(self, out: Mapping[str, Tensor], masks: Masks) -> None:
        worlds = {
            name: np.arange(self._nworld) if mask is None else mask.nonzero()[:, 0].numpy()
            for name, mask in masks.items()
        }
        due = {name: set(numbers.tolist()) for name, numbers in worlds.items()}
        for world in sorted(set().union(*due.values())):
            check_interrupt()
            self._pose(world)
            for name, numbers in due.items():
                if world in numbers:
                    self._draw(out, name, world)

    def close(self) -> None:
        """See `Cameras`; contexts of other threads end with those."""
        for renderer in vars(self._thread).pop("renderers", {}).values():
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
                image[..., 0] = np.where(depth < self._farthest, depth, 0.0)
                renderer.disable_depth_rendering()
            else:
                renderer.enable_segmentation_rendering()
                image[:] = self._labels[renderer.render()[..., 0]]
                renderer.disable_segmentation_rendering()

    def _renderer(self, height: int, width: int) -> mujoco.Renderer:
        """This thread's renderer of images of a size."""
        renderers = vars(self._thread).setdefault("renderers", {})
        if (height, width) not in renderers:
            renderers[height, width] = open_renderer(self._model, height, width)
        return renderers[height, width]
