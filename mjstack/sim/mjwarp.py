"""MuJoCo Warp: thousands of worlds on CUDA, or on Warp's CPU device for checks."""

from __future__ import annotations

import dataclasses
import gc
import logging
import warnings
from collections.abc import Sequence

import mujoco
import torch
import warp as wp

from mjstack.config.schema import GraphMode
from mjstack.errors import MjstackError, UnsupportedModel
from mjstack.sim.counters import count_contacts, record_peaks
from mjstack.sim.fields import PLACING_FIELDS, check_fields
from mjstack.sim.memory import array_bytes, borrowed_bytes
from mjstack.sim.simulation import LOST_PHYSICS
from mjstack.sim.sizes import BatchSizes
from mjstack.sim.static_geoms import place_static_geoms
from mjstack.sim.streams import torch_stream_scope
from mjstack.sim.views import Fields, FixedViews, check_mask

wp.config.log_level = wp.LOG_ERROR  # before mujoco_warp, which starts Warp on import
import mujoco_warp as mjw  # noqa: E402

log = logging.getLogger(__name__)


class MjwarpSimulation(FixedViews):
    """`Simulation` on MuJoCo Warp, float32.

    Box against box uses the primitive collider, as native MuJoCo does: with MJWarp's convex one the kept contacts of a
    resting stack can alternate, and it never comes to rest. The substeps of one `step(n)` are captured into a graph.

    Attributes:
        peak_pool: Most contacts, and most broad-phase pairs, of all worlds at once since the last full reset, shape ``(2,)``.
        solver_limits: MJWarp's bits for worlds whose solver stopped at an iteration limit, shape ``(nworld,)``, int32.
    """

    backend = "mjwarp"

    def __init__(
        self,
        model: mujoco.MjModel,
        nworld: int,
        sizes: BatchSizes,
        device: str,
        graph: GraphMode = GraphMode.auto,
        *,
        fields: Sequence[str] = (),
    ) -> None:
        """Uploads the model and allocates nworld worlds at qpos0.

        Args:
            model: The compiled model.
            nworld: Number of worlds.
            sizes: Buffer sizes.
            device: ``"cpu"`` or ``"cuda:N"``.
            graph: Whether `step` replays a captured graph.
            fields: Model fields that may differ from world to world.

        Raises:
            UnknownName: A field does not exist, or cannot differ.
            UnsupportedModel: MJWarp does not implement a feature of the model.
        """
        self.model, self.nworld, self.sizes = model, nworld, sizes
        self.device = torch.device(device)
        self._device = wp.get_device(device)
        self._graph_mode = graph
        self._graphs: dict[tuple[int, bool], object] = {}
        names = check_fields(fields)
        self._placing = not PLACING_FIELDS.isdisjoint(names)
        name = self._device.name if self._device.is_cuda else "Warp's CPU device"
        self.description = f"MuJoCo Warp {mjw.__version__}, Warp {wp.__version__}, {name}"
        with wp.ScopedDevice(self._device):
            try:
                with warnings.catch_warnings():
                    warnings.filterwarnings("error", category=UserWarning)
                    self._m = mjw.put_model(model, batch_sizes=dict.fromkeys(names, nworld))
            except (NotImplementedError, ValueError, UserWarning) as error:
                raise UnsupportedModel((str(error) or repr(error)).splitlines()[0].rstrip(".")) from error
            self._m.opt.disableflags |= int(mjw.DisableBit.NATIVECCD)
            self._m.opt.warn_overflow = 0
            self._d = mjw.make_data(model, nworld=nworld, **sizes.as_kwargs(nworld))
            self._contacts = wp.zeros(nworld, dtype=int)
            self._peak_nefc = wp.zeros(nworld, dtype=int)
            self._peak_contacts = wp.zeros(nworld, dtype=int)
            self._peak_pool = wp.zeros(2, dtype=int)
            self._lost = wp.zeros(nworld, dtype=int)
            self._limits = wp.zeros(nworld, dtype=int)
            self._steps = wp.zeros(nworld, dtype=wp.int64)
            self._mask = wp.zeros(nworld, dtype=bool)
        d = self._d
        self.qpos, self.qvel, self.act, self.ctrl = map(wp.to_torch, (d.qpos, d.qvel, d.act, d.ctrl))
        self.xpos, self.xquat = wp.to_torch(d.xpos), wp.to_torch(d.xquat)
        self.site_xpos, self.geom_xpos = wp.to_torch(d.site_xpos), wp.to_torch(d.geom_xpos)
        self.qfrc_actuator, self.sensordata = wp.to_torch(d.qfrc_actuator), wp.to_torch(d.sensordata)
        # `view` never copies: a field that MJWarp holds as vectors or matrices keeps its memory under MuJoCo's shape.
        self.fields = Fields(
            {name: wp.to_torch(getattr(self._m, name)).view(nworld, *getattr(model, name).shape) for name in names}
        )
        self.constraint_count = wp.to_torch(d.nefc)
        self.contact_count = wp.to_torch(self._contacts)
        self.peak_constraints = wp.to_torch(self._peak_nefc)
        self.peak_contacts = wp.to_torch(self._peak_contacts)
        self.peak_pool = wp.to_torch(self._peak_pool)
        self.overflow = wp.to_torch(self._lost)
        self.solver_limits = wp.to_torch(self._limits)
        self.step_count = wp.to_torch(self._steps)
        self._torch_mask = wp.to_torch(self._mask)
        # What masked resets would erase. It is taken in there, just before, and not in every substep: nothing else lowers a
        # counter, so the two together never miss one, and it costs a captured step three small operations.
        self._most_contacts, self._most_constraints, self._overflow_ever = (torch.zeros_like(self.overflow) for _ in range(3))
        self._warm_up()

    def step(self, n: int = 1, *, kinematics: bool = False) -> None:
        """Advances every world by n physics steps under the current ctrl; the poses follow with kinematics."""
        graph = self._graph(n, kinematics)
        with torch_stream_scope(self._device):
            if graph is None:
                self._substeps(n, kinematics)
            else:
                wp.capture_launch(graph)

    def forward(self) -> None:
        """Computes everything that derives from the state, without advancing time."""
        with torch_stream_scope(self._device):
            self._place()
            mjw.forward(self._m, self._d)
            self._count(steps=0)

    def kinematics(self, mask: torch.Tensor | None = None) -> None:
        """Brings the poses of all worlds up to the current qpos: a mask would save nothing."""
        if mask is not None:
            check_mask(mask, self.nworld, self.device)
        with torch_stream_scope(self._device):
            self._pose()

    def reset(self, mask: torch.Tensor | None = None) -> None:
        """Puts the masked worlds back to qpos0, at rest, and clears their counters and overflow bits."""
        if mask is None:
            self._torch_mask.fill_(True)
            self.peak_pool.zero_()
        else:
            check_mask(mask, self.nworld, self.device)
            self._torch_mask.copy_(mask)
        self._keep_peaks(clear=mask is None)
        with torch_stream_scope(self._device):
            mjw.reset_data(self._m, self._d, reset=self._mask)
        keep = ~self._torch_mask
        counters = (self.overflow, self.solver_limits, self.peak_contacts, self.peak_constraints, self.contact_count)
        for buffer in (self.step_count, *counters):
            buffer *= keep

    @property
    def most_contacts(self) -> torch.Tensor:
        """Largest contact_count since the last full reset."""
        return torch.maximum(self._most_contacts, self.peak_contacts)

    @property
    def most_constraints(self) -> torch.Tensor:
        """Largest constraint_count since the last full reset."""
        return torch.maximum(self._most_constraints, self.peak_constraints)

    @property
    def overflow_ever(self) -> torch.Tensor:
        """Overflow bits since the last full reset."""
        return self._overflow_ever | self.overflow

    def memory_bytes(self) -> int:
        """Bytes of MJWarp's data: all that grows with nworld, but for per-world fields and what a step borrows."""
        return array_bytes(self._d)

    def borrowed_bytes(self) -> int | None:
        """The most that a step borrows at once beside it, or None if Warp does not tell. Convex pairs are most of it."""
        return borrowed_bytes(self.forward)

    def option_values(self) -> dict[str, float | int | str]:
        """The physics options as uploaded."""
        opt = self._m.opt
        primitive = bool(int(opt.disableflags) & int(mjw.DisableBit.NATIVECCD))
        return {
            "timestep": float(opt.timestep.numpy()[0]),
            "iterations": int(opt.iterations),
            "ls_iterations": int(opt.ls_iterations),
            "impratio": float(opt.impratio_invsqrt.numpy()[0]) ** -2,
            "tolerance": float(opt.tolerance.numpy()[0]),
            "integrator": mujoco.mjtIntegrator(int(opt.integrator)).name,
            "cone": mujoco.mjtCone(int(opt.cone)).name,
            "solver": mujoco.mjtSolver(int(opt.solver)).name,
            "box_box": "primitive" if primitive else "convex",
        }

    def synchronize(self) -> None:
        """Waits for the device."""
        wp.synchronize_device(self._device)

    def close(self) -> None:
        """Drops the graphs; buffers go with the object."""
        self._graphs.clear()

    def _keep_peaks(self, *, clear: bool) -> None:
        """Takes in the counters that a reset is about to erase, or forgets all of them."""
        if clear:
            for buffer in (self._most_contacts, self._most_constraints, self._overflow_ever):
                buffer.zero_()
            return
        torch.maximum(self._most_contacts, self.peak_contacts, out=self._most_contacts)
        torch.maximum(self._most_constraints, self.peak_constraints, out=self._most_constraints)
        self._overflow_ever |= self.overflow

    def _substeps(self, n: int, kinematics: bool) -> None:
        self._place()
        for _ in range(n):
            mjw.step(self._m, self._d)
            self._count(steps=1)
        if kinematics:
            self._pose()

    def _pose(self) -> None:
        """Poses of the current qpos, and nothing that a later step would start from: its forward computes them anew."""
        mjw.kinematics(self._m, self._d)
        self._place(posed=True)

    def _place(self, *, posed: bool = False) -> None:
        """Puts the geoms that never move where the fields say: MJWarp does it once, when it makes the data."""
        if not self._placing:
            return
        m, d = self._m, self._d
        if not posed:
            mjw.kinematics(m, d)
        wp.launch(
            place_static_geoms,
            dim=(self.nworld, m.ngeom),
            inputs=[m.body_rootid, m.body_weldid, m.body_mocapid, m.geom_bodyid, m.geom_pos, m.geom_quat, d.xpos, d.xquat],
            outputs=[d.geom_xpos, d.geom_xmat],
        )

    def _count(self, *, steps: int) -> None:
        """Two launches: steps made, what each world uses now, and the most it has used."""
        d = self._d
        self._contacts.zero_()
        wp.launch(count_contacts, dim=d.contact.worldid.shape[0], inputs=[d.nacon, d.contact.worldid, self._contacts])
        wp.launch(
            record_peaks,
            dim=self.nworld,
            inputs=[
                d.nefc,
                d.nacon,
                d.ncollision,
                self._contacts,
                d.overflow,
                self._peak_nefc,
                self._peak_contacts,
                self._peak_pool,
                LOST_PHYSICS,
                self._lost,
                self._limits,
                steps,
                self._steps,
            ],
        )

    def _warm_up(self) -> None:
        """Compiles and loads every kernel, then leaves the worlds as new."""
        with torch_stream_scope(self._device):
            self._substeps(1, kinematics=True)
        self.synchronize()
        self.reset()
        self.synchronize()

    def _graph(self, n: int, kinematics: bool) -> object | None:
        if self._graph_mode is GraphMode.off or n == 0:
            return None
        key = (n, kinematics)
        if key not in self._graphs:
            self._graphs[key] = self._capture(n, kinematics)
        return self._graphs[key]

    def _capture(self, n: int, kinematics: bool) -> object | None:
        """Captures n substeps. Python's collector waits, so that nothing is freed in the middle of a capture."""
        self.synchronize()
        collecting = gc.isenabled()
        gc.disable()
        try:
            with wp.ScopedDevice(self._device), wp.ScopedCapture() as capture:
                self._substeps(n, kinematics)
        except Exception as error:
            if self._graph_mode is GraphMode.require:
                raise MjstackError(f"graph=require: {n} substeps cannot be captured: {error}. Use graph=auto.") from error
            log.warning("substeps run uncaptured: %s", error)
            return None
        finally:
            if collecting:
                gc.enable()
        return capture.graph


def data_bytes(model: mujoco.MjModel, nworld: int, sizes: BatchSizes) -> int:
    """What `MjwarpSimulation.memory_bytes` would be for these sizes, without allocating it.

    Every array is as long as nworld, as the contact pool, or constant. So two small ones on the CPU tell the rest.

    Args:
        model: The compiled model.
        nworld: Number of worlds.
        sizes: Buffer sizes.
    """
    share = dataclasses.replace(sizes, naconmax=None, naccdmax=None)
    with wp.ScopedDevice("cpu"):
        one, two, longer = (
            array_bytes(mjw.make_data(model, nworld=n, **dataclasses.replace(share, nconmax=c).as_kwargs(n)))
            for n, c in ((1, sizes.nconmax), (2, sizes.nconmax), (1, sizes.nconmax + 1))
        )
    per_contact = longer - one
    per_world = two - one - sizes.nconmax * per_contact
    constant = one - per_world - sizes.nconmax * per_contact
    return constant + nworld * per_world + sizes.contact_pool(nworld) * per_contact
