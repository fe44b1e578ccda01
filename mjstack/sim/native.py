"""Native MuJoCo over many worlds: one state row per world, stepped by MuJoCo's own threads."""

import copy
import platform
from collections.abc import Callable, Iterator, Mapping, Sequence

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from torch import Tensor
from typing_extensions import override

from mjstack.config.schema import CameraCfg
from mjstack.errors import MjstackError, first_line
from mjstack.interrupt import check_interrupt
from mjstack.process import available_cores
from mjstack.sim.cameras import Cameras
from mjstack.sim.model_fields import SIMPLE_FIELDS, Fields, check_fields, simple_inertia
from mjstack.sim.native_cameras import NativeCameras
from mjstack.sim.simulation import Overflow, Simulation, named_options

_COUNTS = ("ncon", "nefc")
_RESULTS = ("qfrc_actuator", "sensordata")
_COUNTERS = ("contact_count", "constraint_count", "peak_contacts", "peak_constraints", "overflow")
_POSES = ("xpos", "xquat", "site_xpos", "geom_xpos")
# Plain numbers: NumPy looks for attributes of an enum's class, and drops an interrupt meanwhile.
_OVERFLOWS = {
    int(mujoco.mjtWarning.mjWARN_CONTACTFULL): int(Overflow.NARROWPHASE),
    int(mujoco.mjtWarning.mjWARN_CNSTRFULL): int(Overflow.NEFC),
}
_SAMEFRAME = {
    "body_sameframe": {"body_ipos", "body_iquat"},
    "geom_sameframe": {"geom_pos", "geom_quat"},
    "site_sameframe": {"site_pos", "site_quat"},
}
# Without these the position stage is little more than `mj_kinematics`.
_POSES_ONLY = (
    mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    | mujoco.mjtDisableBit.mjDSBL_CONTACT
    | mujoco.mjtDisableBit.mjDSBL_SENSOR
)
_STEPS = 4096  # of a thread in one call of MuJoCo's, which no interrupt ends: some 0.2 s


class NativeSimulation(Simulation):
    """`Simulation` on native MuJoCo, float64 on the CPU.

    A world's whole state, warm start included (``qacc_warmstart``), is a row of a
    `mujoco.batch.Batch`. Its threads load a row into their MjData before physics steps, and the
    world's model fields into their MjModel, if there are any; so it does not matter to a world
    which thread it gets. MuJoCo's automatic reset of a diverged world is switched off, because it
    would hide the divergence; a world whose state is not finite is not stepped any more, and its
    derived arrays are NaN.
    """

    backend = "native"

    def __init__(self, model: mujoco.MjModel, nworld: int, *, fields: Sequence[str] = ()) -> None:
        """Allocate the worlds at qpos0, for a thread on each core; arguments as of
        `make_simulation`.

        Raises:
            UnknownName: A field does not exist, or cannot differ.
            MjstackError: The model sleeps, or has IPC contacts: what MuJoCo keeps of these from
                step to step is not in the state.
        """
        names = check_fields(fields)
        self.model = m = copy.copy(model)
        m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self.nworld = nworld
        self.device = torch.device("cpu")
        self.nthread = nthread = min(available_cores(), nworld)
        self.description = (
            f"MuJoCo {mujoco.__version__} on {nthread} thread{'s' if nthread > 1 else ''},"
            f" {platform.machine()} CPU"
        )
        stepped = copy.copy(m)
        # MuJoCo skips an offset that was zero when it compiled: these flags make it read the field.
        for kind, offsets in _SAMEFRAME.items():
            if not offsets.isdisjoint(names):
                getattr(stepped, kind)[:] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
        if "geom_size" in names:  # its boxes around bodies, too, are those that it compiled
            stepped.bvh_aabb[:, 3:] *= 1.5
        try:
            self.batch = batch = Batch(stepped, nworld, nthread)
        except ValueError as error:
            raise MjstackError(
                f"MuJoCo cannot step many worlds of this model: {first_line(error)}",
                "Remove the feature from the model",
            ) from error

        # The state
        self._initial = batch.state[0].copy()
        for name in ("qpos", "qvel", "act", "qacc_warmstart", "ctrl"):
            setattr(self, name, torch.from_numpy(batch.bind(name)))
        self._physics = batch.state[:, 1 : 1 + m.nq + m.nv + m.na]

        # Derived arrays and counters
        # The position stage, which brings poses up to date, would leave another world's numbers in
        # the rest: that is copied out before.
        self._poses = [batch.bind(name) for name in _POSES]
        for array in self._poses:
            array.flags.writeable = True  # a diverged world's become NaN
        self._bound = {name: batch.bind(name) for name in (*_RESULTS, *_COUNTS)}
        self._copies = {name: self._bound[name].copy() for name in _RESULTS}
        self._counts = np.zeros((nworld, len(_COUNTERS)), dtype=np.int32)
        views = (*_POSES, *_RESULTS, *_COUNTERS)
        for name, array in zip(views, (*self._derived, *self._counts.T), strict=True):
            setattr(self, name, torch.from_numpy(array))
        self._erased = torch.zeros((3, nworld), dtype=torch.int32).unbind(0)
        self._steps = np.zeros(nworld, dtype=np.int64)
        self.step_count = torch.from_numpy(self._steps)

        # Model fields
        self._flags = batch.expand("opt.disableflags")
        self._fields = {name: batch.expand(name).astype(float, copy=False) for name in names}
        # MuJoCo has colors and the like in single precision.
        expanded = [(batch.expand(name), values) for name, values in self._fields.items()]
        self._single = [pair for pair in expanded if pair[0] is not pair[1]]
        self.fields = Fields(
            {name: torch.from_numpy(values) for name, values in self._fields.items()}
        )
        self._derive: Callable[[], None] | None = None
        if not self._fields.keys().isdisjoint(SIMPLE_FIELDS):
            self._derive = simple_inertia(m, self._fields, batch.expand("dof_M0"))
        self.reset()

    @override
    def step(self, n: int = 1, *, kinematics: bool = False) -> None:
        self._compute(n, kinematics)

    @override
    def forward(self) -> None:
        self._compute(0, kinematics=False)

    @override
    def kinematics(self, mask: Tensor | None = None) -> None:
        for worlds in self._visit(self._finite_worlds(self._poses, mask), 1):
            self._pose(worlds)

    @override
    def reset(self, mask: Tensor | None = None) -> None:
        rows = self._rows(mask)
        self.batch.state[rows] = self._initial
        if "qpos0" in self._fields:
            self.qpos.numpy()[rows] = self._fields["qpos0"][rows]
        self._copies["sensordata"][rows] = 0
        self.keep_peaks(mask)
        self._counts[rows] = 0
        self._steps[rows] = 0

    @property
    def _derived(self) -> list[np.ndarray]:
        """Arrays that a step writes besides the state."""
        return [*self._poses, *self._copies.values()]

    @property
    def world_bytes(self) -> int:
        """Memory that a world takes."""
        arrays = (self.batch.state, *self._derived, *self._fields.values())
        return sum(array.nbytes for array in arrays) // self.nworld

    @override
    def switch(self, flag: int, *, off: bool) -> None:
        option = self.model.opt
        option.disableflags = option.disableflags | flag if off else option.disableflags & ~flag

    @override
    def option_values(self) -> dict[str, float | int | str]:
        option = self.model.opt
        numbers = {name: getattr(option, name) for name in ("timestep", "impratio", "tolerance")}
        return {**numbers, **named_options(option), "box_box": "primitive"}

    @override
    def make_cameras(self, cameras: Mapping[str, CameraCfg]) -> Cameras:
        return NativeCameras(self.model, self.qpos.numpy(), self._fields, cameras)

    def _rows(self, mask: Tensor | None) -> np.ndarray:
        """The mask as numpy sees it; every world for None."""
        self.check_mask(mask)
        return np.ones(self.nworld, dtype=bool) if mask is None else mask.numpy()

    def _finite_worlds(
        self, derived: Sequence[np.ndarray], mask: Tensor | None = None
    ) -> np.ndarray:
        """The masked worlds that can be computed; the others' derived arrays become NaN.

        A diverged world is left alone: MuJoCo would spend every solver iteration on its NaN, and
        gain nothing.
        """
        worlds = np.flatnonzero(self._rows(mask))
        subset = len(worlds) < self.nworld
        finite = np.isfinite(self._physics[worlds] if subset else self._physics).all(axis=1)
        if not finite.all():
            for array in derived:
                array[worlds[~finite]] = np.nan
        return worlds[finite]

    def _visit(self, worlds: np.ndarray, n: int) -> Iterator[np.ndarray]:
        """Worlds in parts that take n steps in one call of MuJoCo's."""
        size = self.nthread * max(1, _STEPS // n)
        for first in range(0, len(worlds), size):
            check_interrupt()
            yield worlds[first : first + size]

    def _compute(self, n: int, kinematics: bool) -> None:
        """Step every world n times, 0 meaning forward."""
        batch = self.batch
        if self._derive is not None:
            self._derive()
        for single, values in self._single:
            single[:] = values
        finite = self._finite_worlds(self._derived)
        for worlds in self._visit(finite, max(n, 1)):
            self._flags[worlds] = self.model.opt.disableflags
            batch.warning[worlds] = 0
            counts = self._counts[worlds]
            peaks = counts[:, 2:4]
            if n:
                np.maximum(peaks, self._integrate(worlds, n), out=peaks)
                self._steps[worlds] += n
            else:
                batch.forward(worlds)
            for name, array in self._copies.items():
                array[worlds] = self._bound[name][worlds]
            counts[:, :2] = self._contacts(worlds)
            np.maximum(peaks, counts[:, :2], out=peaks)
            for warning, bit in _OVERFLOWS.items():
                counts[batch.warning[worlds, warning, 1] > 0, 4] |= bit
            self._counts[worlds] = counts
            if kinematics:
                self._pose(worlds)
        if kinematics:
            self._finite_worlds(self._poses)

    def _integrate(self, worlds: np.ndarray, n: int) -> np.ndarray:
        """Step worlds n times; their largest numbers of contacts and rows on the way."""
        batch = self.batch
        begun = batch.bind("time")[worlds]
        records = batch.rollout(n, record=_COUNTS, ids=worlds)
        most = np.stack([records[name].max(axis=1) for name in _COUNTS], axis=1)
        # A rollout leaves a world where MuJoCo warned. It goes on step by step.
        warned = np.flatnonzero(batch.warning[worlds, :, 1].any(axis=1))
        if len(warned):
            steps_made = (batch.bind("time")[worlds] - begun) / self.model.opt.timestep
            left = n - np.rint(steps_made[warned]).astype(int)
            for k in range(left.max()):
                late = warned[left > k]
                batch.step(worlds[late])
                most[late] = np.maximum(most[late], self._contacts(worlds[late]))
        return most

    def _contacts(self, worlds: np.ndarray) -> np.ndarray:
        """Contacts and rows of some worlds now, shape ``(n, 2)``."""
        return np.stack([self._bound[name][worlds] for name in _COUNTS], axis=1)

    def _pose(self, worlds: np.ndarray) -> None:
        """Bring the poses of worlds up to date."""
        self._flags[worlds] = self.model.opt.disableflags | _POSES_ONLY
        self.batch.forward(worlds, mujoco.mjtStage.mjSTAGE_POS)
