"""MuJoCo Warp: thousands of worlds on CUDA, or on Warp's CPU device for checks."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from functools import partial

import mujoco
import torch
import warp as wp

from mjstack.config.schema import GraphMode
from mjstack.errors import UnsupportedModel
from mjstack.sim.engine import mjw
from mjstack.sim.graph import StepGraph, inside_graph, side_by_side
from mjstack.sim.memory import array_bytes, borrowed_bytes, keep_arrays
from mjstack.sim.model_fields import PLACING_FIELDS, Fields, check_fields
from mjstack.sim.sizes import BatchSizes
from mjstack.sim.static_geoms import place_static_geoms
from mjstack.sim.substep import Arrangement, can_rearrange, rearranged_step
from mjstack.sim.usage import Usage
from mjstack.sim.views import FixedViews, check_mask
from mjstack.sim.warp_setup import torch_stream_scope


class MjwarpSimulation(FixedViews):
    """`Simulation` on MuJoCo Warp, float32.

    Box against box uses the primitive collider, as native MuJoCo does: with MJWarp's convex one the
    kept contacts of a resting stack can alternate, and it never comes to rest. The decimation of
    one `step(n)` are captured into a graph, unless they are a part of a larger one.

    Attributes:
        peak_pool: Most contacts, broad-phase pairs, and contacts of one kind of convex collision,
            of all worlds at once since the last full reset, shape ``(3,)``, int32. The third bounds
            what nccdmax must hold.
        version: Grows whenever something changes that a graph has baked in.
        arrangement: How a captured step is arranged.
        solver_limits: Bits of `SolverLimit` for worlds whose solver stopped at a limit, shape
            ``(nworld,)``, int32.
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
        """Upload the model and allocates nworld worlds at qpos0.

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
        self.model = model
        self.nworld = nworld
        self.sizes = sizes
        self.device = torch.device(device)
        self._device = wp.get_device(device)
        self._graph_mode = graph
        self._graphs: dict[tuple[int, bool], StepGraph] = {}
        self.version = 0
        self.arrangement = Arrangement()
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
                raise UnsupportedModel(
                    (str(error) or repr(error)).splitlines()[0].rstrip(".")
                ) from error
            self._m.opt.disableflags |= int(mjw.DisableBit.NATIVECCD)
            self._m.opt.warn_overflow = 0
            self._d = mjw.make_data(model, nworld=nworld, **sizes.as_kwargs(nworld))
            self._can_rearrange = can_rearrange(model, self._m)
            self._usage = Usage(model, nworld)
        d = self._d
        self.qpos, self.qvel, self.act, self.ctrl = map(
            wp.to_torch, (d.qpos, d.qvel, d.act, d.ctrl)
        )
        self.xpos = wp.to_torch(d.xpos)
        self.xquat = wp.to_torch(d.xquat)
        self.site_xpos = wp.to_torch(d.site_xpos)
        self.geom_xpos = wp.to_torch(d.geom_xpos)
        self.qfrc_actuator = wp.to_torch(d.qfrc_actuator)
        self.sensordata = wp.to_torch(d.sensordata)
        # `view` never copies: a field that MJWarp holds as vectors or matrices keeps its memory
        # under MuJoCo's shape.
        self.fields = Fields(
            {
                name: wp.to_torch(getattr(self._m, name)).view(nworld, *getattr(model, name).shape)
                for name in names
            }
        )
        self.constraint_count = wp.to_torch(d.nefc)
        usage = self._usage
        self.contact_count = usage.contacts
        self.peak_contacts = usage.peak_contacts
        self.peak_constraints = usage.peak_rows
        self.peak_pool = usage.peak_pool
        self.overflow = usage.overflow
        self.solver_limits = usage.limits
        self.step_count = usage.steps
        self._warm_up()

    def step(self, n: int = 1, *, kinematics: bool = False) -> None:
        """Advance every world by n physics steps under the current ctrl; the poses follow with
        kinematics.
        """
        with torch_stream_scope(self._device):
            if n == 0 or inside_graph():
                self._decimation(n, kinematics)
            else:
                self._graph(n, kinematics)()

    def forward(self) -> None:
        """Compute everything that derives from the state, without advancing time."""
        with torch_stream_scope(self._device):
            self._place()
            mjw.forward(self._m, self._d)
            self._count(steps=0)

    def kinematics(self, mask: torch.Tensor | None = None) -> None:
        """Bring the poses of all worlds up to the current qpos: a mask would save nothing."""
        if mask is not None:
            check_mask(mask, self.nworld, self.device)
        with torch_stream_scope(self._device):
            self._pose()

    def reset(self, mask: torch.Tensor | None = None) -> None:
        """Put the masked worlds back to qpos0, at rest, and clears their counters and overflow
        bits.
        """
        if mask is not None:
            check_mask(mask, self.nworld, self.device)
        selected = self._usage.select(mask)
        with torch_stream_scope(self._device):
            mjw.reset_data(self._m, self._d, reset=selected)
            self._usage.clear()

    @property
    def most_contacts(self) -> torch.Tensor:
        """Largest contact_count since the last full reset."""
        return torch.maximum(self._usage.most[0], self.peak_contacts)

    @property
    def most_constraints(self) -> torch.Tensor:
        """Largest constraint_count since the last full reset."""
        return torch.maximum(self._usage.most[1], self.peak_constraints)

    @property
    def overflow_ever(self) -> torch.Tensor:
        """Overflow bits since the last full reset."""
        return self._usage.most[2] | self.overflow

    def memory_bytes(self) -> int:
        """Bytes of MJWarp's data: all that grows with nworld, but for per-world fields and what a
        step borrows.
        """
        return array_bytes(self._d)

    def borrowed_bytes(self) -> int | None:
        """The most that a step borrows at once beside it, or None if Warp does not tell. Convex
        pairs are most of it.
        """
        return borrowed_bytes(self.forward, self._device.alias)

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

    def bare_step(self) -> StepGraph:
        """One plain ``mujoco_warp.step``, captured and replayed with nothing else: what the rest is
        measured by.
        """

        def work() -> None:
            with torch_stream_scope(self._device):
                mjw.step(self._m, self._d)

        return StepGraph(
            work,
            self.device,
            self._graph_mode,
            name="a bare step",
            version=lambda: self.version,
            scratch=lambda: False,
        )

    def graph_of(self, n: int = 1, *, kinematics: bool = False) -> StepGraph:
        """The graph that `step(n)` replays."""
        return self._graph(n, kinematics)

    def latch(self) -> None:
        """Record what the worlds use and have lost by now; `step` does it by itself."""
        with torch_stream_scope(self._device):
            self._count(steps=0)

    def resize(self, sizes: BatchSizes) -> None:
        """Give the worlds other buffer sizes. Their state and every view stay; contacts and rows
        are empty until a step.

        Args:
            sizes: The new sizes.
        """
        self.synchronize()  # a graph may still write into what goes now
        self._graphs.clear()
        with wp.ScopedDevice(self._device):
            fresh = mjw.make_data(self.model, nworld=self.nworld, **sizes.as_kwargs(self.nworld))
            keep_arrays(fresh, self._d)
            for count in (fresh.nacon, fresh.nefc, fresh.ncollision):
                count.zero_()
        self._d = fresh
        self.sizes = sizes
        self.version += 1

    def arrange(self, arrangement: Arrangement) -> None:
        """Choose how a captured step is arranged; for measurements, because the numbers stay the
        same.
        """
        self.arrangement = arrangement
        self.version += 1

    def set_options(
        self,
        *,
        iterations: int | None = None,
        ls_iterations: int | None = None,
        tolerance: float | None = None,
        impratio: float | None = None,
    ) -> None:
        """Change the constraint solver's limits; graphs, which have them baked in, are captured
        anew.

        Args:
            iterations: Most Newton iterations.
            ls_iterations: Most line-search iterations.
            tolerance: At which the solver stops; at least 1e-6 counts.
            impratio: Ratio of frictional to normal constraint impedance.
        """
        opt = self._m.opt
        opt.iterations = opt.iterations if iterations is None else iterations
        opt.ls_iterations = opt.ls_iterations if ls_iterations is None else ls_iterations
        if tolerance is not None:
            opt.tolerance.fill_(max(tolerance, 1e-6))
        if impratio is not None:
            opt.impratio_invsqrt.fill_(impratio**-0.5)
        self.version += 1

    def synchronize(self) -> None:
        """Wait for the device."""
        wp.synchronize_device(self._device)

    def close(self) -> None:
        """Drop the graphs; buffers go with the object."""
        self._graphs.clear()

    def _decimation(self, n: int, kinematics: bool) -> None:
        self._place()
        count = partial(self._count, steps=1)
        arrangement = self.arrangement
        if not (self._can_rearrange and arrangement.own_stages):
            for _ in range(n):
                mjw.step(self._m, self._d)
                count()
            if kinematics:
                self._pose()
            return
        # What a step has used is counted while the next one begins, which touches neither contacts
        # nor rows.
        beside: tuple[Callable[[], None], ...] = ()
        for i in range(n):
            rearranged_step(
                self._m,
                self._d,
                self.device,
                sensors=i == n - 1 or not arrangement.sensors_once,
                branches=arrangement.branches,
                beside_kinematics=beside,
            )
            beside = (count,)
        side_by_side(
            self.device,
            *((self._pose,) if kinematics else ()),
            *beside,
            branches=arrangement.branches,
        )

    def _pose(self) -> None:
        """Poses of the current qpos, and nothing that a later step would start from: its forward
        computes them anew.
        """
        mjw.kinematics(self._m, self._d)
        self._place(posed=True)

    def _place(self, *, posed: bool = False) -> None:
        """Put the geoms that never move where the fields say: MJWarp does it once, when it makes
        the data.
        """
        if not self._placing:
            return
        m = self._m
        d = self._d
        if not posed:
            mjw.kinematics(m, d)
        wp.launch(
            place_static_geoms,
            dim=(self.nworld, m.ngeom),
            inputs=[
                m.body_rootid,
                m.body_weldid,
                m.body_mocapid,
                m.geom_bodyid,
                m.geom_pos,
                m.geom_quat,
                d.xpos,
                d.xquat,
            ],
            outputs=[d.geom_xpos, d.geom_xmat],
        )

    def _count(self, *, steps: int) -> None:
        """Count steps made, what each world uses now, and the most it has used."""
        self._usage.count(self._m, self._d, steps)

    def _warm_up(self) -> None:
        """Compile and loads every kernel, then leaves the worlds as new."""
        with torch_stream_scope(self._device):
            self._decimation(1, kinematics=True)
        self.synchronize()
        self.reset()
        self.synchronize()

    def _graph(self, n: int, kinematics: bool) -> StepGraph:
        key = (n, kinematics)
        if key not in self._graphs:
            self._graphs[key] = StepGraph(
                lambda: self._decimation(n, kinematics),
                self.device,
                self._graph_mode,
                name=f"step({n})",
                version=lambda: self.version,
                scratch=lambda: self.arrangement.scratch,
            )
        return self._graphs[key]
