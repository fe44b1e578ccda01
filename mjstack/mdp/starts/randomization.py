"""What differs from world to world beside the state: masses, friction and servo gains, with all
that follows from each.

Each class writes values into the model fields and reads them back. What follows from a value is
computed in float64 from the value as the field holds it, so that writing what was read changes
nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from mjstack.errors import ParameterError
from mjstack.managers.view import EnvView
from mjstack.scene.index import Columns

MASS_FIELDS = ("body_mass", "body_inertia", "body_subtreemass", "body_invweight0", "dof_invweight0")
FRICTION_FIELDS = ("geom_friction",)
GAIN_FIELDS = ("actuator_gainprm", "actuator_biasprm")


class ObjectMasses:
    """Mass of each free object [kg], in the order of ``index.objects``.

    An object is a body of its own on a free joint, so that what the compiler derives from the mass
    scales with it, and need not be computed anew.
    """

    def __init__(self, env: EnvView) -> None:
        """Needs `MASS_FIELDS`."""
        bodies = [env.index.bodies[name] for name in env.index.objects]
        dofs = [dof + i for _, dof in env.index.objects.values() for i in range(6)]
        self._mass = _Elements(env, "body_mass", bodies)
        self._scaled = [
            _Elements(env, name, bodies) for name in ("body_inertia", "body_subtreemass")
        ]
        self._inverse = _Elements(env, "body_invweight0", bodies)
        self._inverse_dofs = _Elements(env, "dof_invweight0", dofs)
        self.nominal = self._mass.nominal

    def read(self) -> torch.Tensor:
        """Shape ``(nworld, objects)``, in the field's type."""
        return self._mass.read()

    def write(self, mask: torch.Tensor, mass: torch.Tensor) -> None:
        """Writes masses ``(nworld, objects)`` and what follows into the masked worlds."""
        mass = mass.to(self._mass.dtype)
        factor = mass.double() / self.nominal
        self._mass.write(mask, mass)
        for elements in self._scaled:
            elements.scale(mask, factor)
        self._inverse.scale(mask, 1.0 / factor)
        self._inverse_dofs.scale(mask, (1.0 / factor).repeat_interleave(6, dim=1))


class SlidingFriction:
    """Sliding friction of each free object, and of the grip where the jaws have one of their own.

    MuJoCo takes the larger coefficient of the two geoms in a contact, or that of the geom with the
    higher priority. So the table, and jaws of the objects' own priority, get the smallest
    coefficient, which leaves the object's in force; jaws of higher priority (SO-101's) have one of
    their own, the same for both.

    Attributes:
        names: Whose they are: the objects, and ``grip``.
    """

    def __init__(self, env: EnvView, least: float) -> None:
        """Needs `FRICTION_FIELDS`. ``least`` is the smallest coefficient that is ever drawn."""
        model = env.sim.model
        objects = [env.index.geoms[name] for name in env.index.objects]
        priority = 0  # of objects
        bodies = [model.body(name).id for name in env.cfg.robot.jaw_bodies]
        jaws = [g for g in range(model.ngeom) if model.geom_bodyid[g] in bodies]
        above = [g for g in jaws if model.geom_priority[g] > priority]
        level = [model.geom("table").id, *(g for g in jaws if g not in above)]
        self.names = [*env.index.objects, *(["grip"] if above else [])]
        self._view = env.sim.fields["geom_friction"][..., 0]
        self._groups = [Columns(geoms, env.device) for geoms in (*objects, above) if geoms]
        self._lowered = Columns(level, env.device)
        self._least = torch.tensor(least, dtype=self._view.dtype, device=env.device)

    def read(self) -> torch.Tensor:
        """Shape ``(nworld, len(names))``."""
        return torch.stack([group.read(self._view)[:, 0] for group in self._groups], dim=1)

    def write(self, mask: torch.Tensor, values: torch.Tensor) -> None:
        """Writes coefficients ``(nworld, len(names))`` into the masked worlds, and lowers what the
        objects lie on.
        """
        values = values.to(self._view.dtype)
        for number, group in enumerate(self._groups):
            group.write_masked(self._view, mask, values[:, number, None])
        self._lowered.write_masked(self._view, mask, self._least)


class ServoGains:
    """Stiffness and damping of the robot's position servos, over the model's own: one factor per
    servo.
    """

    def __init__(self, env: EnvView) -> None:
        """Needs `GAIN_FIELDS`."""
        servos = env.index.ctrl.tolist()
        # A position servo's gain is kp and its bias (0, -kp, -kv): scaling all of them scales both.
        self._gain, self._bias = (_Elements(env, name, servos) for name in GAIN_FIELDS)
        self._kp = self._gain.nominal[:, 0]

    def read(self) -> torch.Tensor:
        """Shape ``(nworld, servos)``, float64."""
        return self._gain.read()[..., 0].double() / self._kp

    def write(self, mask: torch.Tensor, factor: torch.Tensor) -> None:
        """Writes factors ``(nworld, servos)`` into the masked worlds."""
        held = (factor.double() * self._kp).to(self._gain.dtype).double() / self._kp
        self._gain.scale(mask, held)
        self._bias.scale(mask, held)


def bounds(name: str, values: Sequence[float]) -> tuple[float, float]:
    """The smallest and largest value of a parameter that has both.

    Raises:
        ParameterError: They are not positive, or not in order.
    """
    if len(values) != 2 or not 0.0 < values[0] <= values[1] < math.inf:
        raise ParameterError(name, list(values), "two positive numbers, the smaller one first")
    return float(values[0]), float(values[1])


class _Elements:
    """Some elements of a per-world model field, and the model's own values of them, in float64."""

    def __init__(self, env: EnvView, name: str, elements: Sequence[int]) -> None:
        self._view = env.sim.fields[name]
        self._columns = Columns(elements, env.device)
        self.dtype = self._view.dtype
        self.nominal = torch.from_numpy(getattr(env.sim.model, name)[list(elements)].copy()).to(
            env.device, torch.float64
        )

    def read(self) -> torch.Tensor:
        return self._columns.read(self._view)

    def write(self, mask: torch.Tensor, value: torch.Tensor) -> None:
        self._columns.write_masked(self._view, mask, value)

    def scale(self, mask: torch.Tensor, factor: torch.Tensor) -> None:
        """Writes nominal times factor, ``(nworld, elements)``, into the masked worlds."""
        self.write(mask, self.nominal * factor.view(*factor.shape, *[1] * (self.nominal.dim() - 1)))
