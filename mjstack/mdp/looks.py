"""Reset terms that change what cameras see: light, colours, and the cameras themselves.

Each draws new values for every episode, as all reset terms do. Physics does not read them.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from mjstack.config.fields import Fraction, NotNegative
from mjstack.errors import MjstackError, ParameterError, suggest
from mjstack.managers.view import EnvView, random_uniform, uses_fields
from mjstack.math import quat_mul
from mjstack.mdp.starts.randomization import Elements, bounds


@uses_fields("light_pos", "light_dir", "light_diffuse")
class Light:
    """Moves every light, still aimed at the same point, and changes its brightness and colour."""

    label = "reset.light"

    def __init__(
        self,
        env: EnvView,
        *,
        pos: NotNegative = 0.0,
        brightness: Sequence[float] = (1.0, 1.0),
        tint: Fraction = 0.0,
    ) -> None:
        """Take the ranges.

        Args:
            env: The environment.
            pos: Half-width of the move along each axis [m].
            brightness: Smallest and largest factor.
            tint: Half-width of a further factor of each colour, about 1.
        """
        _require_pictures(env, "lights")
        lights = range(env.sim.model.nlight)
        self._pos, self._dir, self._diffuse = (
            Elements(env, f"light_{name}", lights, exact=False)
            for name in ("pos", "dir", "diffuse")
        )
        self._move = pos
        self._brightness = bounds("brightness", brightness)
        self._tint = tint
        # Points on the table at which they are aimed; of a light aimed elsewhere, 1 m away
        top = env.cfg.scene.table_top
        down = self._dir.nominal[:, 2:]
        far = (top - self._pos.nominal[:, 2:]) / torch.where(down < -0.1, down, -1.0)
        far = torch.where((down < -0.1) & (far > 0.1), far, 1.0)
        self._aim = self._pos.nominal + far * self._dir.nominal

    def __call__(self, env: EnvView, mask: Tensor) -> None:
        """Write light_pos, light_dir and light_diffuse."""
        count = len(self._aim)
        draw = random_uniform(env, self.label, 7 * count).unflatten(1, (count, 7))
        draw = draw.to(self._aim.dtype)
        pos = self._pos.nominal + self._move * draw[..., :3]
        aim = torch.nn.functional.normalize(self._aim - pos, dim=-1)
        low, high = self._brightness
        factor = low + 0.5 * (high - low) * (draw[..., 3:4] + 1.0)
        color = factor * (1.0 + self._tint * draw[..., 4:])
        self._pos.write(mask, pos)
        self._dir.write(mask, aim)
        self._diffuse.write(mask, (self._diffuse.nominal * color).clamp(0.0, 1.0))


@uses_fields("geom_rgba")
class Colors:
    """Changes the colours of things: the scene's objects, its table, its floor."""

    label = "reset.colors"

    def __init__(
        self, env: EnvView, *, spread: Fraction, things: Sequence[str] | None = None
    ) -> None:
        """Take the things.

        Args:
            env: The environment.
            spread: Half-width of the change of red, green and blue, which stay between 0 and 1.
            things: Names of objects, or of geoms that are fixed to the world, such as table and
                floor. null: all objects. All geoms of a thing get one colour.

        Raises:
            ParameterError: There is no such thing.
        """
        model = env.sim.model
        fixed = [geom for geom in range(model.ngeom) if model.geom_bodyid[geom] == 0]
        known = {model.geom(geom).name: [geom] for geom in fixed if model.geom(geom).name}
        known |= env.index.geoms
        names = list(env.index.geoms if things is None else things)
        for name in names:
            if name not in known:
                raise ParameterError("things", names, f"names of things. {suggest(name, known)}")
        self._spread = spread
        self._looks = [Elements(env, "geom_rgba", known[n], exact=False) for n in names]

    def __call__(self, env: EnvView, mask: Tensor) -> None:
        """Write geom_rgba."""
        draw = random_uniform(env, self.label, 3 * len(self._looks))
        for number, look in enumerate(self._looks):
            change = self._spread * draw[:, None, 3 * number : 3 * number + 3]
            value = look.nominal.expand(len(draw), -1, -1).clone()
            value[..., :3] = (value[..., :3] + change).clamp(0.0, 1.0)
            look.write(mask, value)


@uses_fields("cam_pos", "cam_quat")
class CameraPoses:
    """Moves and turns every camera."""

    label = "reset.camera_poses"

    def __init__(self, env: EnvView, *, pos: NotNegative = 0.0, angle: NotNegative = 0.0) -> None:
        """Take the half-widths.

        Args:
            env: The environment.
            pos: Of the move along each axis of what carries the camera [m].
            angle: Of the turn about each axis of the camera [rad].
        """
        cameras = range(len(_cameras(env)))
        self._pos = Elements(env, "cam_pos", cameras, exact=False)
        self._quat = Elements(env, "cam_quat", cameras, exact=False)
        self._move = pos
        self._angle = angle

    def __call__(self, env: EnvView, mask: Tensor) -> None:
        """Write cam_pos and cam_quat."""
        draw = _draw_cameras(env, self.label, 6).to(self._pos.nominal.dtype)
        half = 0.5 * self._angle * draw[..., 3:]
        turn = torch.cat((torch.ones_like(half[..., :1]), half), dim=-1)
        turn = torch.nn.functional.normalize(turn, dim=-1)
        quat = self._quat.nominal.expand(len(draw), -1, -1)
        self._pos.write(mask, self._pos.nominal + self._move * draw[..., :3])
        self._quat.write(mask, quat_mul(quat, turn))


@uses_fields("cam_fovy")
class FieldOfView:
    """Scales the vertical field of view of every camera."""

    label = "reset.camera_fovy"

    def __init__(self, env: EnvView, *, scale: Sequence[float]) -> None:
        """Take the smallest and largest factor."""
        self._fovy = Elements(env, "cam_fovy", range(len(_cameras(env))), exact=False)
        self._ends = bounds("scale", scale)

    def __call__(self, env: EnvView, mask: Tensor) -> None:
        """Write cam_fovy."""
        factor = _draw_cameras(env, self.label, 1, *self._ends)[..., 0]
        self._fovy.write(mask, self._fovy.nominal * factor)


def _cameras(env: EnvView) -> list[str]:
    """Names of the model's cameras, in its order."""
    _require_pictures(env, "cameras")
    return [env.sim.model.camera(number).name for number in range(env.sim.model.ncam)]


def _require_pictures(env: EnvView, what: str) -> None:
    """Raise where the model has no light, which only pictures need."""
    if not env.sim.model.nlight:
        raise MjstackError(
            f"the scene has no {what}, because nothing is drawn", "Set cameras=front"
        )


def _draw_cameras(
    env: EnvView, label: str, size: int, low: float = -1.0, high: float = 1.0
) -> Tensor:
    """Numbers of each camera by its name, so that another camera changes none of them, shape
    ``(nworld, cameras, size)``.
    """
    names = _cameras(env)
    draws = [random_uniform(env, f"{label}.{name}", size, low, high) for name in names]
    return torch.stack(draws, dim=1)
