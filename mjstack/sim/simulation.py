"""The base of every physics backend: torch views of batched state, and how to step it."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from enum import IntFlag
from functools import cached_property

import mujoco
import numpy as np
import torch
from torch import Tensor

from mjstack.config.schema import CameraCfg
from mjstack.errors import ArgumentError, MjstackError
from mjstack.math import describe_tensor
from mjstack.sim.cameras import Cameras
from mjstack.sim.graph import StepGraph
from mjstack.sim.model_fields import REBOUND, Fields
from mjstack.sim.sizes import BatchSizes


class Overflow(IntFlag):
    """Physics that a world lost because a buffer was too small; the values are those of MJWarp's
    ``OverflowType``.
    """

    NEFC = 1 << 0
    NJMAX_NNZ = 1 << 1
    BROADPHASE = 1 << 2
    NARROWPHASE = 1 << 3
    CCD = 1 << 4
    HFIELD = 1 << 5
    CONTACT_MATCH = 1 << 6
    NVMAX = 1 << 7
    EPA_HORIZON = 1 << 8
    TACTILE = 1 << 11


class SolverLimit(IntFlag):
    """Where a world's solver stopped short of its tolerance, which loses no physics; values as in
    `Overflow`.
    """

    ITERATIONS = 1 << 9
    LS_ITERATIONS = 1 << 10


def describe_overflow(bits: int) -> str:
    """The names of the bits, such as ``NEFC, CCD``."""
    return ", ".join(flag.name or "" for flag in Overflow if bits & flag)


LOST_PHYSICS = sum(Overflow)


class Columns:
    """Some columns of a batched view. Where they lie side by side, reading them costs nothing and
    writing is one copy.

    Attributes:
        indices: The columns, in the order in which values are given.
        at: They as a slice where they lie side by side, else as a tensor.
    """

    def __init__(self, indices: Sequence[int] | np.ndarray, device: torch.device) -> None:
        """Take the columns."""
        self.indices = tuple(map(int, indices))
        first = min(self.indices, default=0)
        stop = first + len(self.indices)
        self.at: Tensor | slice = slice(first, stop)
        if self.indices != tuple(range(first, stop)):
            self.at = torch.tensor(self.indices, dtype=torch.int64, device=device)

    def read(self, view: Tensor) -> Tensor:
        """The columns, shape ``(nworld, n, ...)``, perhaps the view's memory: only read it."""
        return view[:, self.at] if isinstance(self.at, slice) else view.index_select(1, self.at)

    def write(self, view: Tensor, value: Tensor) -> None:
        """Write all worlds."""
        view[:, self.at] = value

    def write_masked(self, view: Tensor, mask: Tensor, value: Tensor) -> None:
        """Write the worlds of a ``(nworld,)`` bool mask."""
        value = value.to(view.dtype)
        rows = mask.view(-1, *[1] * (view.dim() - 1))
        part = self.read(view)
        if isinstance(self.at, slice):
            torch.where(rows, value, part, out=part)
        else:
            view[:, self.at] = torch.where(rows, value, part)


class Simulation(ABC):
    """``nworld`` copies of one model, stepped together.

    Views are allocated once and keep their address for life: write into them (``sim.ctrl[:] =
    ...``), never rebind them (``sim.ctrl = ...`` raises). A mask selects worlds: a bool tensor of
    shape ``(nworld,)`` on ``device``.

    When the views are up to date, on every backend:

    - ``qpos``, ``qvel`` and ``act`` are the state, always current.
    - After `step`, the poses (``xpos``, ``xquat``, ``site_xpos``, ``geom_xpos``) belong to the
      state before the last integration, unless ``kinematics=True``. So do ``sensordata``,
      ``contact_count``, ``constraint_count`` and ``qfrc_actuator``, always.
    - `kinematics` brings the poses to the current state, `forward` everything.
    - `reset` leaves poses, ``qfrc_actuator`` and the contact buffers as they were, until
      `kinematics` or `forward`.

    Attributes:
        model: The compiled model; per-world fields are not written into it.
        nworld: Number of worlds.
        backend: ``"native"`` or ``"mjwarp"``.
        device: Where the views live.
        description: Backend and hardware, for reports.
        qpos: Positions [m, rad, quaternions wxyz], shape ``(nworld, nq)``.
        qvel: Velocities [m/s, rad/s], shape ``(nworld, nv)``.
        act: Activations of actuators that have a state, shape ``(nworld, na)``.
        ctrl: Actuator commands, shape ``(nworld, nu)``.
        xpos: Body positions [m], shape ``(nworld, nbody, 3)``.
        xquat: Body orientations wxyz, shape ``(nworld, nbody, 4)``.
        site_xpos: Site positions [m], shape ``(nworld, nsite, 3)``.
        geom_xpos: Geom positions [m], shape ``(nworld, ngeom, 3)``.
        qfrc_actuator: Actuator forces in joint space [N, N m], shape ``(nworld, nv)``.
        sensordata: Sensor outputs, in the model's order, shape ``(nworld, nsensordata)``.
        fields: Per-world model fields that were asked for, by MuJoCo's name. Each is a tensor of
            MuJoCo's shape of that field with ``nworld`` in front, and has the model's values to
            begin with. What is written acts from the next step on. Fields that MuJoCo derives at
            compile time do not follow: with a new ``body_mass`` write ``body_invweight0`` and its
            like too. Two limits are MuJoCo's: ``body_gravcomp`` acts only if the model has some,
            and ``body_ipos`` and ``body_iquat`` must stay as they are where ``body_simple`` is set
            (a free cube), because such a body's mass matrix is diagonal by construction. `reset`
            leaves fields alone, and starts a world from its ``qpos0`` if that is one.
        contact_count: Contacts found by the last step or forward, shape ``(nworld,)``, int32.
        constraint_count: Constraint rows of the last step or forward, shape ``(nworld,)``, int32.
        step_count: Physics steps since the world's last reset, shape ``(nworld,)``, int64.
        overflow: Bits of `Overflow` raised by `step`, sticky until the world is reset, shape
            ``(nworld,)``, int32. `forward` alone raises none on MJWarp.
        peak_contacts: Largest contact_count of all physics steps since the world's last reset,
            shape ``(nworld,)``, int32.
        peak_constraints: Largest constraint_count over the same time, shape ``(nworld,)``, int32.
        sizes: Sizes of fixed buffers; None where there are none, as in native MuJoCo.
        peak_pool: Most contacts, broad-phase pairs, and contacts of one kind of convex collision,
            of all worlds at once since the last full reset, shape ``(3,)``, int32; None where the
            worlds share no pool.
        solver_limits: Bits of `SolverLimit` for worlds whose solver stopped at a limit, shape
            ``(nworld,)``, int32; None where the backend does not tell.
        solver_tolerance: The solver's tolerance, shape ``(1,)``, which may be written; None where
            it is the model's.
    """

    model: mujoco.MjModel
    nworld: int
    backend: str
    device: torch.device
    description: str
    qpos: Tensor
    qvel: Tensor
    act: Tensor
    ctrl: Tensor
    xpos: Tensor
    xquat: Tensor
    site_xpos: Tensor
    geom_xpos: Tensor
    qfrc_actuator: Tensor
    sensordata: Tensor
    fields: Fields
    contact_count: Tensor
    constraint_count: Tensor
    step_count: Tensor
    overflow: Tensor
    peak_contacts: Tensor
    peak_constraints: Tensor
    sizes: BatchSizes | None = None
    peak_pool: Tensor | None = None
    solver_limits: Tensor | None = None
    solver_tolerance: Tensor | None = None
    # Peak contacts, peak rows and overflow bits that masked resets have erased since the last full
    # one. They are taken in just before such a reset, and not in every substep: nothing else lowers
    # a counter, so the two together never miss one, and it costs a step three small operations.
    _erased: tuple[Tensor, ...]

    def __setattr__(self, name: str, value: object) -> None:
        # Captured graphs and the stepping code know the memory, not the attribute: a rebound view
        # would be ignored without a word. Python ends `sim.qpos += 1` by setting the attribute to
        # the tensor that it has just changed in place.
        bound = self.__dict__.get(name)
        if isinstance(bound, (Tensor, Fields)) and bound is not value:
            raise MjstackError(REBOUND.format(f"sim.{name}" + "[name]" * isinstance(bound, Fields)))
        super().__setattr__(name, value)

    def part(self, name: str, columns: Columns | int, *shape: int) -> Tensor:
        """Columns of a view of this name, or a single one by its number, for reading. Each world's
        numbers have a ``shape``, such as ``(2, 3)`` for six columns. Those that lie side by side
        are sliced once, because a view keeps its address for life.
        """
        at = columns if isinstance(columns, int) else columns.at
        which = columns if isinstance(columns, int) else columns.indices
        key = (name, which, *shape)
        if key in self._parts:
            return self._parts[key]
        view = getattr(self, name)
        if isinstance(at, Tensor):
            part = view.index_select(1, at)
            return part.unflatten(1, shape) if shape else part
        with torch.inference_mode(False):
            part = view[:, at]
            self._parts[key] = part.unflatten(1, shape) if shape else part
        return self._parts[key]

    @cached_property
    def no_worlds(self) -> Tensor:
        """A mask of no world, shape ``(nworld,)``, bool. It must not be written into."""
        with torch.inference_mode(False):
            return torch.zeros(self.nworld, dtype=torch.bool, device=self.device)

    @cached_property
    def _parts(self) -> dict[tuple, Tensor]:
        return {}

    def lasting_peaks(self) -> tuple[Tensor, Tensor, Tensor]:
        """Largest contact_count and constraint_count, and bits of `Overflow`, since the last full
        reset (one without a mask), each of shape ``(nworld,)``, int32: those of a run in which
        worlds end and start anew.
        """
        contacts, rows, bits = self._erased
        most_contacts = torch.maximum(contacts, self.peak_contacts)
        return most_contacts, torch.maximum(rows, self.peak_constraints), bits | self.overflow

    @abstractmethod
    def step(self, n: int = 1, *, kinematics: bool = False) -> None:
        """Advance every world by n physics steps, at least 1, under the current ctrl.
        ``kinematics`` brings the poses up to the state after the last of them; the physics is the
        same.
        """

    @abstractmethod
    def forward(self) -> None:
        """Compute everything that derives from qpos, qvel, act and ctrl, without
        advancing time.
        """

    @abstractmethod
    def kinematics(self, mask: Tensor | None = None) -> None:
        """Bring the poses up to the current qpos, without advancing time, in the worlds of the mask
        (None: all). Others may be brought up to date too.

        Raises:
            ArgumentError: As for `reset`.
        """

    @abstractmethod
    def reset(self, mask: Tensor | None = None) -> None:
        """Put the worlds of the mask (None: all) back to the model's qpos0, at rest: act, ctrl,
        sensordata, counters and overflow bits become zero.

        Raises:
            ArgumentError: The mask is not a bool tensor of shape ``(nworld,)`` on the simulation's
                device.
        """

    @abstractmethod
    def make_cameras(self, cameras: Mapping[str, CameraCfg]) -> Cameras:
        """Cameras that draw these worlds; the model has them by name.

        Raises:
            ConfigError: Their images do not fit into the device's memory.
        """

    def graph_of(self, n: int = 1, *, kinematics: bool = False) -> StepGraph | None:
        """The graph that ``step(n)`` replays; None on a backend that captures nothing."""
        return None

    @abstractmethod
    def switch(self, flag: int, *, off: bool) -> None:
        """Switch a feature of the physics off or on, by its bit of MuJoCo's ``mjtDisableBit``."""

    @abstractmethod
    def option_values(self) -> dict[str, float | int | str]:
        """The physics options as this backend holds them, by MuJoCo's names."""

    def model_values(self) -> dict[str, np.ndarray]:
        """The model's arrays as uploaded, by MuJoCo's names; none on native MuJoCo."""
        return {}

    def synchronize(self) -> None:
        """Wait for the device. On native MuJoCo `step` returns when every thread has."""
        return

    def close(self) -> None:
        """Give buffers back. Native MuJoCo's threads end with the last view of their memory."""
        return

    def check_mask(self, mask: Tensor | None) -> None:
        """Check what can be known of a mask without reading it; `reset` has the error."""
        expected = (torch.bool, (self.nworld,), self.device)
        if mask is not None and (
            not isinstance(mask, Tensor) or (mask.dtype, mask.shape, mask.device) != expected
        ):
            text = f"a torch.bool tensor of shape ({self.nworld},) on {self.device}"
            raise ArgumentError("mask", describe_tensor(mask), text)

    def keep_peaks(self, mask: Tensor | None) -> None:
        """Keep the peaks that a reset of some worlds would erase; drop all in a full one."""
        contacts, rows, bits = self._erased
        if mask is None:
            for buffer in self._erased:
                buffer.zero_()
        else:
            torch.maximum(contacts, self.peak_contacts, out=contacts)
            torch.maximum(rows, self.peak_constraints, out=rows)
            bits |= self.overflow


def named_options(option: object) -> dict[str, float | int | str]:
    """Iteration limits and MuJoCo's names of the choices, of a model's or an uploaded option."""
    limits = {name: int(getattr(option, name)) for name in ("iterations", "ls_iterations")}
    return limits | {
        name: getattr(mujoco, f"mjt{name.title()}")(int(getattr(option, name))).name
        for name in ("integrator", "cone", "solver")
    }
