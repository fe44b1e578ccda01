"""Domain randomisation of the model: masses, friction and servo gains, with all that follows from
each.

Each class writes values into the model fields and reads them back. Everything that follows from a
value is computed in float64 from the value that the field holds, so that writing what was read
changes nothing.
"""

import math
from collections.abc import Sequence
from typing import ClassVar, Protocol

import torch
from torch import Tensor
from typing_extensions import override

from mjstack.errors import ParameterError
from mjstack.managers.view import EnvView
from mjstack.scene.index import ALL, Columns, Rows


class Quantity(Protocol):
    """A quantity of the model that may differ between worlds.

    Attributes:
        fields: The model fields that it needs.
        columns: Names of its numbers in a file of starts.
        nominal: The numbers that a range is relative to, shape ``(n,)``, float64.
    """

    fields: ClassVar[tuple[str, ...]]
    columns: list[str]
    nominal: Tensor

    def __init__(self, env: EnvView) -> None:
        """Find the elements of the fields."""

    def read(self) -> Tensor:
        """The numbers of every world, shape ``(nworld, n)``."""

    def write(self, mask: Tensor, values: Tensor, at: Rows = ALL) -> None:
        """Write numbers ``(nworld, n)``, and what follows from them, into the masked worlds. Where
        ``at`` has their numbers, the values have their rows alone.
        """


class ObjectMasses(Quantity):
    """Mass of each free object [kg], in the order of ``index.objects``.

    An object is one body on a free joint, so that what the compiler derives from the mass scales
    with it, and need not be computed anew.
    """

    fields = ("body_mass", "body_inertia", "body_subtreemass", "body_invweight0", "dof_invweight0")

    def __init__(self, env: EnvView) -> None:
        """Find the bodies."""
        bodies = [env.index.bodies[name] for name in env.index.objects]
        dofs = [dof + i for _, dof in env.index.objects.values() for i in range(6)]
        self._mass, *self._scaled, self._inverse, self._inverse_dofs = (
            Elements(env, name, dofs if name.startswith("dof") else bodies) for name in self.fields
        )
        self.columns = [f"{name}_mass_kg" for name in env.index.objects]
        self.nominal = self._mass.nominal

    @override
    def read(self) -> Tensor:
        return self._mass.read()

    @override
    def write(self, mask: Tensor, values: Tensor, at: Rows = ALL) -> None:
        mass = values.to(self._mass.dtype)
        factor = mass.double() / self.nominal
        self._mass.write(mask, mass, at)
        for elements in self._scaled:
            elements.scale(mask, factor, at)
        self._inverse.scale(mask, 1.0 / factor, at)
        self._inverse_dofs.scale(mask, (1.0 / factor).repeat_interleave(6, dim=1), at)


class SlidingFriction(Quantity):
    """Sliding friction of each free object, and of the grip where the jaws have a coefficient that
    counts.

    MuJoCo takes the larger coefficient of the two geoms in a contact, or that of the geom with the
    higher priority. So the table, and jaws of the objects' priority, get the smallest coefficient,
    which leaves the object's in force. Jaws of higher priority (SO-101's) have one coefficient, the
    same for both.
    """

    fields = ("geom_friction",)

    def __init__(self, env: EnvView, least: float = 0.0) -> None:
        """Find the geoms. ``least`` is the smallest coefficient that is ever drawn."""
        model = env.sim.model
        bodies = [model.body(name).id for name in env.cfg.robot.jaw_bodies]
        jaws = [g for g in range(model.ngeom) if model.geom_bodyid[g] in bodies]
        grip = [g for g in jaws if model.geom_priority[g] > 0]  # objects have 0
        level = [model.geom("table").id, *(g for g in jaws if g not in grip)]
        geoms = {name: env.index.geoms[name] for name in env.index.objects}
        if grip:
            geoms["grip"] = grip
        self.columns = [f"{name}_friction" for name in geoms]
        self.nominal = torch.ones(len(geoms), dtype=torch.float64, device=env.device)
        self._view = env.sim.fields["geom_friction"][..., 0]
        self._groups = [Columns(group, env.device) for group in geoms.values()]
        self._lowered = Columns(level, env.device)
        self._least = torch.tensor(least, dtype=self._view.dtype, device=env.device)

    @override
    def read(self) -> Tensor:
        return torch.stack([group.read(self._view)[:, 0] for group in self._groups], dim=1)

    def write(self, mask: Tensor, values: Tensor, at: Rows = ALL) -> None:
        """See `Quantity`; lowers what the objects lie on."""
        values = values.to(self._view.dtype)
        for number, group in enumerate(self._groups):
            group.write_masked(self._view, mask, values[:, number, None], at)
        self._lowered.write_masked(self._view, mask, self._least, at)


class ServoGains(Quantity):
    """Stiffness and damping of the robot's position servos, over the model's own: one factor per
    servo.
    """

    fields = ("actuator_gainprm", "actuator_biasprm")

    def __init__(self, env: EnvView) -> None:
        """Find the servos."""
        servos = env.index.ctrl.tolist()
        # A position servo's gain is kp and its bias (0, -kp, -kv): scaling all of them scales both.
        self._gain, self._bias = (Elements(env, name, servos) for name in self.fields)
        self._kp = self._gain.nominal[:, 0]
        self.columns = [f"gain_{name}" for name in env.cfg.robot.joints]
        self.nominal = torch.ones_like(self._kp)

    def read(self) -> Tensor:
        """See `Quantity`; float64."""
        return self._gain.read()[..., 0].double() / self._kp

    @override
    def write(self, mask: Tensor, values: Tensor, at: Rows = ALL) -> None:
        factor = (values.double() * self._kp).to(self._gain.dtype).double() / self._kp
        self._gain.scale(mask, factor, at)
        self._bias.scale(mask, factor, at)


def bounds(name: str, values: Sequence[float]) -> tuple[float, float]:
    """The smallest and largest value of a parameter that has both.

    Raises:
        ParameterError: They are not positive, or not in order.
    """
    if len(values) != 2 or not 0.0 < values[0] <= values[1] < math.inf:
        raise ParameterError(name, list(values), "two positive numbers, the smaller one first")
    return float(values[0]), float(values[1])


class Elements:
    """Some elements of a per-world model field.

    Attributes:
        dtype: The field's type.
        nominal: The model's own values of them.
    """

    def __init__(
        self, env: EnvView, name: str, elements: Sequence[int], *, exact: bool = True
    ) -> None:
        """Find them; nominal values are float64 if they are to be ``exact``, else of the field's
        type.
        """
        self._view = env.sim.fields[name]
        self._columns = Columns(elements, env.device)
        self.dtype = self._view.dtype
        nominal = torch.from_numpy(getattr(env.sim.model, name)[list(elements)].copy())
        self.nominal = nominal.to(env.device, torch.float64 if exact else self.dtype)

    def read(self) -> Tensor:
        """Values of every world."""
        return self._columns.read(self._view)

    def write(self, mask: Tensor, value: Tensor, at: Rows) -> None:
        """Write the masked worlds' values, a row for each of ``at``."""
        self._columns.write_masked(self._view, mask, value, at)

    def scale(self, mask: Tensor, factor: Tensor, at: Rows) -> None:
        """Write nominal times factor, ``(nworld, elements)``, into the masked worlds."""
        factor = factor.view(*factor.shape, *[1] * (self.nominal.dim() - 1))
        self.write(mask, self.nominal * factor, at)
