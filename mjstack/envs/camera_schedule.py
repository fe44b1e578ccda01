"""When the cameras of an environment are drawn, and into which buffers."""

from collections.abc import Mapping
from dataclasses import replace

from torch import Tensor

from mjstack.config.schema import Config
from mjstack.managers.view import EnvView
from mjstack.sim.cameras import Cameras, Masks


class CameraSchedule:
    """Draws each camera at its rate, counted from the start of each world's episode, into
    ``images`` by output and camera, as of `Cameras.allocate`; and cameras with ``terminal`` in the
    last state of an episode into ``final_images``. Without cameras ``cameras`` is None.
    """

    def __init__(self, env: EnvView) -> None:
        """Allocate the buffers, if there are cameras.

        Raises:
            ConfigError: They do not fit into the device's memory.
        """
        cameras = {n: camera for n, camera in env.cfg.scene.cameras.items() if camera.outputs}
        self._env = env
        timing = env.cfg.timing
        self._decimation = timing.policy_decimation
        self.cameras: Cameras | None = env.sim.make_cameras(cameras) if cameras else None
        self._terminal = [name for name, camera in cameras.items() if camera.terminal]
        # Control steps from one image to the next
        self._steps = {
            name: 1 if camera.rate is None else round(1.0 / (camera.rate * timing.step_dt))
            for name, camera in cameras.items()
        }
        self.images: dict[str, Tensor] = {}
        self.final_images: dict[str, Tensor] = {}
        if self.cameras is not None:
            self.images = self.cameras.allocate()
            self.final_images = self.cameras.allocate(terminal=True)

    def draw_started(self, mask: Tensor | None) -> None:
        """Draw the worlds that have been started outside of a step, shape ``(nworld,)``, bool; None
        for all.
        """
        self._draw(self.images, dict.fromkeys(self._steps, mask))

    def draw_step(self) -> None:
        """Draw the cameras that are due after a step and its resets."""
        step = self._env.episode_step
        masks = {
            name: None if period <= self._decimation else step % period < self._decimation
            for name, period in self._steps.items()
        }
        self._draw(self.images, masks)

    def draw_ended(self, done: Tensor) -> None:
        """Draw the worlds that are about to be reset, shape ``(nworld,)``, bool."""
        if self._terminal and (done.is_cuda or bool(done.any())):
            self._draw(self.final_images, dict.fromkeys(self._terminal, done))

    def close(self) -> None:
        """Give what drawing needs back."""
        if self.cameras is not None:
            self.cameras.close()

    def _draw(self, out: Mapping[str, Tensor], masks: Masks) -> None:
        if self.cameras is not None and masks:
            self.cameras.draw(out, masks)


def without_images(cfg: Config) -> Config:
    """The configuration of an environment that draws nothing, with the same scene."""
    cameras = {name: replace(camera, outputs=[]) for name, camera in cfg.scene.cameras.items()}
    return replace(cfg, scene=replace(cfg.scene, cameras=cameras))
