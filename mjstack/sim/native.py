"""Native MuJoCo over many worlds: one state row per world, stepped by MuJoCo's own threads."""

import copy
import os
import platform
from collections.abc import Iterator, Mapping, Sequence

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch

from mjstack.config.schema import CameraCfg
from mjstack.errors import UnsupportedModel, first_line
from mjstack.interrupt import check_interrupt
from mjstack.sim.cameras import Cameras
from mjstack.sim.model_fields import Fields, SimpleBodies, check_fields
from mjstack.sim.native_cameras import NativeCameras
from mjstack.sim.simulation import Overflow, Simulation, named_options

_COUNTS = ("ncon", "nefc")
_OTHERS = ("qfrc_actuator", "sensordata")
_POSES = ("xpos", "xquat", "site_xpos", "geom_xpos")
_OVERFLOWS = {
    mujoco.mjtWarning.mjWARN_CONTACTFULL: Overflow.NARROWPHASE,
    mujoco.mjtWarning.mjWARN_CNSTRFULL: Overflow.NEFC,
}
_SAMEFRAME = {
    "body_sameframe": {"body_ipos", "body_iquat"},
    "geom_sameframe": {"geom_pos", "geom_quat"},
    "site_sameframe": {"site_pos", "site_quat"},
}
# Without these the position stage is little more than `mj_kinematics`.
_POSES_ONLY = int(
    mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    | mujoco.mjtDisableBit.mjDSBL_CONTACT
    | mujoco.mjtDisableBit.mjDSBL_SENSOR
)
_STEPS = 4096  # of a thread in one call of MuJoCo's, which no interrupt ends: some 0.2 s


def available_cores() -> int:
    """Cores that this process may use: under torchrun its share of the machine's."""
    found = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return max(1, (found or 1) // int(os.environ.get("LOCAL_WORLD_SIZE", 1)))


class NativeSimulation(Simulation):
    """`Simulation` on native MuJoCo, float64 on the CPU.

    A world's whole state, warm start included (``qacc_warmstart``), is a row of a
    `mujoco.batch.Batch`. Its threads load a row into their MjData before physics steps, and the
    world's model fields into their MjModel, if there are any; so it does not matter to a world
    which thread it gets. MuJoCo's automatic reset of a diverged world is switched off, because it
    would hide the divergence; a world whose state is not finite is not stepped any more, and its
    derived arrays are NaN.

    Attributes:
        batch: The worlds in MuJoCo's hands.
    """

    backend = "native"

    def __init__(
        self,
        model: mujoco.MjModel,
        nworld: int,
        *,
        fields: Sequence[str] = (),
        nthread: int | None = None,
    ) -> None:
        """Allocate nworld worlds at qpos0.

        Args:
            model: The compiled model.
            nworld: Number of worlds.
            fields: Model fields that may differ from world to world.
            nthread: Threads; all cores by default.

        Raises:
            UnknownName: A field does not exist, or cannot differ.
            UnsupportedModel: The model sleeps, or has IPC contacts: what MuJoCo keeps of these from
                step to step is not in the state.
        """
        names = check_fields(fields)
        self.model = m = copy.copy(model)
        m.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        self.nworld = nworld
        self.device = torch.device("cpu")
        self.nthread = nthread = max(1, min(nthread or available_cores(), nworld))
        self.description = (
            f"MuJoCo {mujoco.__version__} on {nthread} thread{'s' if nthread > 1 else ''},"
            f" {platform.machine()} CPU"
        )
        own = copy.copy(m)
        # MuJoCo skips an offset that was zero when it compiled: these flags make it read the field.
        for kind, offsets in _SAMEFRAME.items():
            if not offsets.isdisjoint(names):
                getattr(own, kind)[:] = int(mujoco.mjtSameFrame.mjSAMEFRAME_NONE)
        try:
            self.batch = batch = Batch(own, nworld, nthread)
        except ValueError as error:
            raise UnsupportedModel(
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
        for name, array in zip(_POSES, self._poses, strict=True):
            array.flags.writeable = True  # a diverged world's become NaN
            setattr(self, name, torch.from_numpy(array))
        self._found = {name: batch.bind(name) for name in (*_OTHERS, *_COUNTS)}
        self._others = {name: self._found[name].copy() for name in _OTHERS}
        for name, array in self._others.items():
            setattr(self, name, torch.from_numpy(array))
        # Columns: contacts, rows, peak contacts, peak rows, overflow bits.
        self._counts = np.zeros((nworld, 5), dtype=np.int32)
        (
            self.contact_count,
            self.constraint_count,
            self.peak_contacts,
            self.peak_constraints,
            self.overflow,
        ) = torch.from_numpy(self._counts).unbind(1)
        self._erased = torch.zeros((3, nworld), dtype=torch.int32).unbind(0)
        self._steps = np.zeros(nworld, dtype=np.int64)
        self.step_count = torch.from_numpy(self._steps)

        # Model fields
        self._flags = batch.expand("opt.disableflags")
        self._fields = {name: batch.expand(name).astype(float, copy=False) for name in names}
        # MuJoCo has colors and the like in single precision.
        expanded = [(batch.expand(name), values) for name, values in self._fields.items()]
        self._single = [(own, values) for own, values in expanded if own is not values]
        self.fields = Fields(
            {name: torch.from_numpy(values) for name, values in self._fields.items()}
        )
        derive = not self._fields.keys().isdisjoint(SimpleBodies.FIELDS) and m.dof_simplenum.any()
        self._simple = SimpleBodies(m, self._fields, batch.expand("dof_M0")) if derive else None
        self.reset()

    def step(self, n: int = 1, *, kinematics: bool = False) -> None:
        """See `Simulation`."""
        if n:
            self._compute(n, kinematics)
        elif kinematics:
            self.kinematics()

    def forward(self) -> None:
        """See `Simulation`; warm starts stay as they are."""
        self._compute(0, kinematics=False)

    def kinematics(self, mask: torch.Tensor | None = None) -> None:
        """See `Simulation`; the other worlds are not visited."""
        for worlds in self._visit(self._finite_worlds(self._poses, mask=mask), 1):
            self._pose(worlds)

    def reset(self, mask: torch.Tensor | None = None) -> None:
        """See `Simulation`."""
        rows = self._rows(mask)
        self.batch.state[rows] = self._initial
        if "qpos0" in self._fields:
            self.qpos.numpy()[rows] = self._fields["qpos0"][rows]
        self._others["sensordata"][rows] = 0
        self._keep_peaks(mask)
        self._counts[rows] = 0
        self._steps[rows] = 0

    @property
    def world_bytes(self) -> int:
        """Memory that a world takes."""
        arrays = (self.batch.state, *self._poses, *self._others.values())
        return sum(a.nbytes for a in (*arrays, *self._fields.values())) // self.nworld

    def option_values(self) -> dict[str, float | int | str]:
        """The physics options of the model."""
        option = self.model.opt
        numbers = {name: getattr(option, name) for name in ("timestep", "impratio", "tolerance")}
        return {**numbers, **named_options(option), "box_box": "primitive"}

    def make_cameras(self, cameras: Mapping[str, CameraCfg]) -> Cameras:
        """See `Simulation`; their OpenGL contexts open with the first image."""
        return NativeCameras(self.model, self.qpos.numpy(), self._fields, cameras)

    def synchronize(self) -> None:
        """Nothing to wait for: `step` returns when every thread has."""

    def close(self) -> None:
        """Nothing to do: the threads sleep, and end with the last view of their memory."""

    def _rows(self, mask: torch.Tensor | None) -> np.ndarray:
        """The mask as numpy sees it; every world for None."""
        self.check_mask(mask)
        return np.ones(self.nworld, dtype=bool) if mask is None else mask.numpy()

    def _finite_worlds(
        self, derived: Sequence[np.ndarray], mask: torch.Tensor | None = None
    ) -> np.ndarray:
        """The masked worlds that can be computed; the others' derived arrays become NaN.

        A diverged world is left alone: MuJoCo would spend every solver iteration on its NaN, and
        gain nothing.
        """
        worlds = np.flatnonzero(self._rows(mask))
        some = len(worlds) < self.nworld
        finite = np.isfinite(self._physics[worlds] if some else self._physics).all(axis=1)
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
        if self._simple is not None:
            self._simple.update()
        for own, values in self._single:
            own[:] = values
        finite = self._finite_worlds([*self._poses, *self._others.values()])
        for worlds in self._visit(finite, max(n, 1)):
            self._flags[worlds] = self.model.opt.disableflags
            batch.warning[worlds] = 0
            counts = self._counts[worlds]
            if n:
                counts[:, 2:4] = np.maximum(counts[:, 2:4], self._integrate(worlds, n))
                self._steps[worlds] += n
            else:
                batch.forward(worlds)
            for name, array in self._others.items():
                array[worlds] = self._found[name][worlds]
            for column, name in enumerate(_COUNTS):
                counts[:, column] = self._found[name][worlds]
            np.maximum(counts[:, 2:4], counts[:, :2], out=counts[:, 2:4])
            for warning, bit in _OVERFLOWS.items():
                counts[batch.warning[worlds, int(warning), 1] > 0, 4] |= int(bit)
            self._counts[worlds] = counts
            if kinematics:
                self._pose(worlds)
        if kinematics:
            self._finite_worlds(self._poses)

    def _integrate(self, worlds: np.ndarray, n: int) -> np.ndarray:
        """Step worlds n times; their largest numbers of contacts and rows on the way."""
        batch = self.batch
        begun = batch.bind("time")[worlds]
        found = batch.rollout(n, record=_COUNTS, ids=worlds)
        most = np.stack([found[name].max(axis=1) for name in _COUNTS], axis=1)
        # A rollout leaves a world where MuJoCo warned. It goes on step by step.
        warned = np.flatnonzero(batch.warning[worlds, :, 1].any(axis=1))
        if len(warned):
            taken = (batch.bind("time")[worlds] - begun) / self.model.opt.timestep
            left = n - np.rint(taken[warned]).astype(int)
            for k in range(left.max()):
                late = warned[left > k]
                batch.step(worlds[late])
                now = [self._found[name][worlds[late]] for name in _COUNTS]
                most[late] = np.maximum(most[late], np.stack(now, axis=1))
        return most

    def _pose(self, worlds: np.ndarray) -> None:
        """Bring the poses of worlds up to date."""
        self._flags[worlds] = self.model.opt.disableflags | _POSES_ONLY
        self.batch.forward(worlds, mujoco.mjtStage.mjSTAGE_POS)
