"""The scene's box, and how objects lie to it."""

import itertools

import torch
from torch import Tensor

from mjstack.config.schema import BoxCfg, Config
from mjstack.errors import ConfigError
from mjstack.scene import table_top
from mjstack.tasks.view import Step, once_per_step


def scene_box(cfg: Config) -> BoxCfg:
    """The scene's box.

    Raises:
        ConfigError: It has none.
    """
    if cfg.scene.box is None:
        raise ConfigError("scene", cfg.scene.name, "a scene with a box", "Set scene=box")
    return cfg.scene.box


class Inside:
    """The inside of the scene's box, and how objects lie to it."""

    def __init__(self, cfg: Config, tolerance: float) -> None:
        """Reads the box.

        Args:
            cfg: The configuration.
            tolerance: How far a corner may be beyond the inside [m].

        Raises:
            ConfigError: The scene has no box.
        """
        box = scene_box(cfg)
        top = table_top(cfg.scene)
        self.rim = top + box.height
        self._low = [*(box.center[i] - box.half[i] for i in (0, 1)), top + box.floor]
        self._high = [*(box.center[i] + box.half[i] for i in (0, 1)), self.rim]
        self._tolerance = tolerance

    @once_per_step
    def beyond(self, step: Step) -> Tensor:
        """How far the outermost corner is outside [m], negative inside, shape ``(nworld,
        objects)``.
        """
        low, high = step.bounds
        outside = step.view.constant(*self._low) - low, high - step.view.constant(*self._high)
        return torch.maximum(*outside).amax(-1)

    def holds(self, step: Step) -> Tensor:
        """Whether all corners are in the box, shape ``(nworld, objects)``, bool."""
        return self.beyond(step) <= self._tolerance

    def over(self, step: Step) -> Tensor:
        """Whether all corners are over the inside or in it, shape ``(nworld, objects)``, bool."""
        low, high = step.bounds
        inside = (low >= step.view.constant(*self._low)) & (high <= step.view.constant(*self._high))
        return inside[..., :2].all(-1)


@once_per_step
def corner_speed(step: Step) -> Tensor:
    """Speed of the fastest corner [m/s], shape ``(nworld, objects)``."""
    signs = step.view.constant(*itertools.chain(*itertools.product((-1.0, 1.0), repeat=3)))
    arms = step.view.half[:, None] * signs.view(8, 3)
    # A free joint's linear velocity is the world's, its angular velocity the body's: all of it in
    # the body's frame.
    linear = (step.turn * step.velocity[..., :3, None]).sum(-2)
    spin = step.velocity[..., None, 3:].expand(-1, -1, 8, -1)
    swept = torch.linalg.cross(spin, arms.expand_as(spin))
    return torch.linalg.vector_norm(linear[..., None, :] + swept, dim=-1).amax(-1)
