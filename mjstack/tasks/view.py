"""The objects of a task as its rules and terms see them: float32, from qpos, qvel and sensordata
alone, which are never stale.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import and_
from typing import Any

import torch
from torch import Tensor

from mjstack.errors import ConfigError, MjstackError, require_names
from mjstack.managers.state import shared
from mjstack.managers.view import EnvView
from mjstack.math import atan2, constant, lowest_point, norm, quat_to_matrix
from mjstack.mdp.geometry import LOADED, gripper_opening, pose_w
from mjstack.mdp.observation import fixture_pos, object_velocity
from mjstack.scene.phases import Phase
from mjstack.sim.simulation import Columns

PhaseNames = Sequence[Sequence[str]]
"""For each object, names of phases."""


def _value(compute: Callable[[Any], Any]) -> Any:
    """Make a method of `Step` a property that is computed once in a pass."""
    return property(shared(compute))


class Step:
    """The state of a task's objects in every world of an environment, as it is now. Within a pass
    each value is computed once.

    A dimension over objects has the order of ``objects``. Forces are those of the last physics
    step. A sensor gives the net force of a jaw on an object; that is the sum of the normal forces
    up to a factor of 1.6, because friction adds at most 1.2 times the normal force across it and
    the normals of one jaw on a convex object do not cancel. The threshold is ten million times
    smaller than a grasp's force: it tells contact from none.

    Attributes:
        env: The environment.
        objects: Names of the objects, the order of every dimension over objects.
        phased: Whether the driver has phases.
        phase: Number of the phase of every world, shape ``(nworld,)``, int64; perhaps None.
        count: Steps so far, shape ``(1,)``, int64.
        stop: Steps from this one on count for no rule that names phases.
        table: Whether a phase counts for a column of a key, shape ``(phases, n)``, bool.
    """

    phase: Tensor | None = None

    def __init__(
        self,
        env: EnvView,
        objects: Sequence[str],
        phases: Sequence[Phase] = (),
        *,
        stop: int = 0,
        force: float = LOADED,
    ) -> None:
        """Read addresses and sizes. ``phases`` are those of the driver. A jaw or a support that
        presses with more than ``force`` touches an object [N].
        """
        self.env = env
        self.objects = list(objects)
        self.phased = bool(phases)
        self.force = force
        self.count = torch.zeros(1, dtype=torch.int64, device=env.device)
        self._phases = [phase.name for phase in phases]
        self.stop = stop
        self.table = torch.zeros((len(phases), 0), dtype=torch.bool, device=env.device)
        self._counters: list[Tensor] = []
        self._columns: dict[tuple[str, ...], Columns] = {}

        index = env.index
        scene = env.cfg.scene
        self.object_cfgs = [scene.objects[name] for name in objects]
        self.top = scene.table_top
        self.half = torch.tensor(
            [object_cfg.half for object_cfg in self.object_cfgs], device=env.device
        )
        self.radius = torch.tensor(
            [object_cfg.radius for object_cfg in self.object_cfgs], device=env.device
        )

        def columns(forces: Mapping[str, Sequence[int]]) -> Columns:
            addresses = itertools.chain(*(forces.get(name, ()) for name in objects))
            return Columns([a + i for a in addresses for i in range(3)], env.device)

        self.jaws = columns(index.jaw_force)
        self.supports = columns(index.support_force)

    def columns(self, names: Sequence[str]) -> Columns:
        """Columns of some objects, made once: a captured step may not copy from the host."""
        key = tuple(names)
        if key not in self._columns:
            self._columns[key] = Columns(list(map(self.number, names)), self.env.device)
        return self._columns[key]

    def number(self, name: str) -> int:
        """Number of an object among those of the task; any other name is an error with those."""
        require_names("object of the check", [name], self.objects)
        return self.objects.index(name)

    def during(self, phases: PhaseNames) -> slice:
        """A key for `Step.judged`: for each column of a rule, the phases in which it counts."""
        if not self.phased:
            return slice(0, 0)
        rows = [[name in column for column in phases] for name in self._phases]
        new = torch.tensor(rows, dtype=torch.bool, device=self.env.device)
        first = self.table.shape[1]
        self.table = torch.cat((self.table, new), dim=1)
        return slice(first, first + len(phases))

    def constant(self, *values: float) -> Tensor:
        """Numbers on the device, copied there once, shape ``(n,)``, float32."""
        return constant(values, self.half)

    def zeros(self, *shape: int, fill: float = 0.0) -> Tensor:
        """A buffer, shape ``(nworld, *shape)``, float32."""
        size = (self.env.nworld, *shape)
        return torch.full(size, fill, dtype=torch.float32, device=self.env.device)

    def counter(self, size: int) -> Tensor:
        """A buffer that `clear` clears, shape ``(nworld, size)``, float32."""
        self._counters.append(self.zeros(size))
        return self._counters[-1]

    def clear(self, mask: Tensor) -> None:
        """Clear all counters of the masked columns, shape ``(nworld, size)``."""
        for counter in self._counters:
            if counter.shape == mask.shape:
                # Not by a product: an earlier attempt may have left NaN.
                counter.masked_fill_(mask, 0.0)

    @_value
    def pose(self) -> Tensor:
        """Position [m] and quaternion (wxyz), shape ``(nworld, objects, 7)``."""
        return self._of_each([pose_w(self.env, name) for name in self.objects])

    @_value
    def pos(self) -> Tensor:
        """Position [m], shape ``(nworld, objects, 3)``."""
        return self.pose[..., :3]

    @_value
    def quat(self) -> Tensor:
        """Orientation (wxyz), shape ``(nworld, objects, 4)``."""
        return self.pose[..., 3:]

    @_value
    def velocity(self) -> Tensor:
        """Velocity as MuJoCo has it: linear [m/s] in the world, angular [rad/s] in the object's
        frame, shape ``(nworld, objects, 6)``.
        """
        env = self.env
        return self._of_each([object_velocity(env, object=name) for name in self.objects])

    @_value
    def turn(self) -> Tensor:
        """Rotation matrices, shape ``(nworld, objects, 3, 3)``."""
        return quat_to_matrix(self.quat)

    @_value
    def height(self) -> Tensor:
        """Height of the lowest point above the table [m], shape ``(nworld, objects)``."""
        forms = [object_cfg.form for object_cfg in self.object_cfgs]
        if forms[1:] == forms[:-1]:  # all alike
            return lowest_point(self.pos, self.quat, *forms[0]) - self.top
        poses = zip(self.pos.unbind(1), self.quat.unbind(1), forms, strict=True)
        lowest = [lowest_point(pos, quat, *form) for pos, quat, form in poses]
        return torch.stack(lowest, dim=1) - self.top

    @_value
    def bounds(self) -> tuple[Tensor, Tensor]:
        """Least and largest coordinates [m] of the corners, or of those of the box around another
        shape, each ``(nworld, objects, 3)``.
        """
        reach = (self.turn.abs() * self.half[:, None]).sum(-1)
        return self.pos - reach, self.pos + reach

    @_value
    def speed(self) -> Tensor:
        """Fastest that any point can be [m/s], shape ``(nworld, objects)``."""
        parts = norm(self.velocity.unflatten(-1, (2, 3)))
        linear, angular = parts.unbind(-1)
        return linear + self.radius * angular

    @_value
    def corner_speed(self) -> Tensor:
        """Speed of the fastest corner [m/s], shape ``(nworld, objects)``."""
        signs = self.constant(*itertools.chain(*itertools.product((-1.0, 1.0), repeat=3)))
        arms = self.half[:, None] * signs.view(8, 3)
        # A free joint's linear velocity is the world's, the angular one the body's, as all here.
        linear = (self.turn * self.velocity[..., :3, None]).sum(-2)
        spin = self.velocity[..., None, 3:].expand(-1, -1, 8, -1)
        swept = torch.linalg.cross(spin, arms.expand_as(spin))
        return norm(linear[..., None, :] + swept).amax(-1)

    @_value
    def pressed(self) -> Tensor:
        """Whether each jaw presses on each object, shape ``(nworld, objects, jaws)``, bool."""
        return self._sensed(self.jaws)

    def center(self, name: str) -> Tensor:
        """Position of an object of the scene [m], shape ``(nworld, 3)``."""
        if name not in self.objects:  # such as a fixture
            return pose_w(self.env, name)[:, :3].float()
        return self.pos[:, self.objects.index(name)]

    def joint(self, name: str) -> Tensor:
        """Position of a fixture's joint [rad, m], shape ``(nworld, 1)``."""
        return fixture_pos(self.env, joint=name).float()[:, None]

    def tilt(self, name: str, axis: str = "z", *, either_end: bool = True) -> Tensor:
        """Angle of an object's axis from the vertical, at most 90 unless ``either_end`` is false
        [deg], shape ``(nworld,)``. Axis ``face``: of the face that a box or a cylinder lies on.
        """
        shape = self.env.cfg.scene.objects[name].shape
        faces = {"box": "xyz", "cylinder": "z"}
        require_names(f"axis of {shape} {name}", [axis], [*"xyz", *["face"] * (shape in faces)])
        axis = faces[shape] if axis == "face" else axis
        cosines = self.turn[:, self.number(name), 2]  # of each axis
        cosines = cosines.abs() if either_end or axis == "xyz" else cosines
        ordered = cosines.sort(-1).values if axis == "xyz" else cosines.roll("zyx".index(axis), -1)
        return atan2(norm(ordered[:, :2]), ordered[:, 2]).rad2deg()

    @_value
    def in_hand(self) -> Tensor:
        """Whether all jaws press on each object, shape ``(nworld, objects)``, bool."""
        return self.pressed.all(-1)

    @_value
    def untouched(self) -> Tensor:
        """Whether no jaw presses on each object, shape ``(nworld, objects)``, bool."""
        return ~self.pressed.any(-1)

    @_value
    def narrowest(self) -> Tensor:
        """Opening of the least open gripper joint as measured, 0 to 1, shape ``(nworld, 1)``."""
        opening = gripper_opening(self.env).float()
        return opening if opening.shape[1] == 1 else opening.amin(1, keepdim=True)

    @_value
    def supported(self) -> Tensor:
        """Whether anything but a jaw presses on each object, shape ``(nworld, objects)``, bool;
        needs ``scene.support_sensors``.
        """
        if not self.env.cfg.scene.support_sensors:
            expected = "true: the check asks what an object rests on"
            raise ConfigError("scene.support_sensors", False, expected)
        return self._sensed(self.supports).any(-1)

    def judged(self, key: slice) -> Tensor:
        """Whether the step counts for a rule, shape ``(nworld, columns)`` or ``(1, 1)``, bool."""
        return self._judged[:, key] if self.phased else self._judged

    @_value
    def _judged(self) -> Tensor:
        """Every column of every key, ``(nworld, n)``; without phases ``(1, 1)``."""
        going = (self.count < self.stop)[:, None]
        if self.phase is None or not self.phased:
            return going
        return self.table.index_select(0, self.phase) & going

    @shared
    def value(self, condition: Callable[["Step"], Tensor]) -> Tensor:
        """The value of a condition."""
        return condition(self)

    def _of_each(self, values: list[Tensor]) -> Tensor:
        if not values:
            raise MjstackError(
                "task.check: a rule asks how objects are, but self.objects names none"
            )
        return torch.stack(values, dim=1).float()

    def _sensed(self, columns: Columns) -> Tensor:
        count = len(self.objects)
        shape = (count, len(columns.indices) // (3 * count or 1), 3)
        forces = self.env.sim.part("sensordata", columns, *shape)
        return norm(forces) > self.force


@dataclass(frozen=True, slots=True)
class AllOf:
    """A condition that holds where all its parts do, each of which keeps a threshold.

    Attributes:
        names: Those of the thresholds.
        parts: Whether each part holds, each ``(nworld, n)`` or ``(nworld,)``, bool; or one tensor
            of all, in its last dimension.
    """

    names: tuple[str, ...]
    parts: Callable[[Step], Tensor | tuple[Tensor, ...]]

    def __call__(self, step: Step) -> Tensor:
        """Shape ``(nworld, n)`` or ``(nworld,)``, bool."""
        holds = self.parts(step)  # in as few calls of torch as there are
        return holds.all(-1) if isinstance(holds, Tensor) else reduce(and_, holds)

    def by_part(self, step: Step) -> Tensor:
        """Whether each part holds for all objects, shape ``(nworld, parts)``, bool."""
        holds = self.parts(step)
        if not isinstance(holds, Tensor):
            holds = torch.stack(torch.broadcast_tensors(*holds), dim=-1)
        return holds if holds.dim() == 2 else holds.all(1)

    def __and__(self, condition: "AllOf") -> "AllOf":
        """A condition of the parts of both, each for all its objects, shape ``(nworld,)``, bool."""

        def parts(step: Step) -> Tensor:
            return torch.cat((self.by_part(step), condition.by_part(step)), dim=-1)

        return AllOf((*self.names, *condition.names), parts)
