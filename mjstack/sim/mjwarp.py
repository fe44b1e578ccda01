"""MuJoCo Warp: thousands of worlds on CUDA, or on Warp's CPU device for checks."""

import logging
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial

import mujoco
import torch

from mjstack.config.schema import CameraCfg
from mjstack.errors import UnsupportedModel, first_line
from mjstack.sim import fused, fused_smooth
from mjstack.sim.cameras import Cameras
from mjstack.sim.graph import StepGraph, inside_graph, side_by_side
from mjstack.sim.mjwarp_cameras import MjwarpCameras
from mjstack.sim.model_fields import PLACING_FIELDS, Fields, check_fields
from mjstack.sim.simulation import Simulation, named_options
from mjstack.sim.sizes import BatchSizes
from mjstack.sim.substep import (
    ARRANGEMENTS,
    Arrangement,
    can_rearrange,
    place_static_geoms,
    rearranged_step,
)
from mjstack.sim.usage import Usage
from mjstack.sim.warp_setup import mjw, torch_stream_scope, wp

log = logging.getLogger(__name__)
_tell = cache(log.info)  # once per process


class MjwarpSimulation(Simulation):
    """`Simulation` on MuJoCo Warp, float32.

    Box against box uses the primitive collider, as native MuJoCo does: with MJWarp's convex one the
    kept contacts of a resting stack can alternate, and it never comes to rest. The physics
    steps of one `step(n)` are captured into a graph, unless they are a part of a larger one.

    Attributes:
        arrangement: How a captured step is arranged.
    """

    backend = "mjwarp"

    def __init__(
        self,
        model: mujoco.MjModel,
        nworld: int,
        sizes: BatchSizes,
        device: str,
        graph: str = "auto",
        *,
        fields: Sequence[str] = (),
        step: str = "auto",
    ) -> None:
        """Upload the model and allocate nworld worlds at qpos0.

        Args:
            model: The compiled model.
            nworld: Number of worlds.
            sizes: Buffer sizes.
            device: ``"cpu"`` or ``"cuda:N"``.
            graph: Whether `step` replays a captured graph.
            fields: Model fields that may differ from world to world.
            step: How a physics step is done.

        Raises:
            UnknownName: A field does not exist, or cannot differ.
            UnsupportedModel: MJWarp, or the step, does not implement a feature of the model.
        """
        self.model = model
        self.nworld = nworld
        self.sizes = sizes
        self.device = torch.device(device)
        self._device = wp.get_device(device)
        self._graph_mode = graph
        self._graphs: dict[tuple[int, bool], StepGraph] = {}
        names = check_fields(fields)
        self._placing = not PLACING_FIELDS.isdisjoint(names)
        name = self._device.name if self._device.is_cuda else "Warp's CPU device"

        # The model and its data on the device
        with wp.ScopedDevice(self._device):
            try:
                with warnings.catch_warnings():
                    warnings.filterwarnings("error", category=UserWarning)
                    self._m = mjw.put_model(model, batch_sizes=dict.fromkeys(names, nworld))
            except (NotImplementedError, ValueError, UserWarning) as error:
                raise UnsupportedModel(
                    f"MJWarp does not support this model: {first_line(error)}",
                    "Remove the feature from the model, or run sim=native",
                ) from error
            self._m.opt.disableflags |= int(mjw.DisableBit.NATIVECCD)
            self._m.opt.warn_overflow = 0
            self._d = mjw.make_data(model, nworld=nworld, **sizes.as_kwargs(nworld))
            self._best, self._why = self._best_step()
            step = self._resolve(step)
            self._smooth_applies = self._best == "fused" and not fused_smooth.why_not(self._m)
            self._usage = usage = Usage(model, nworld, self.device)

        self.arrangement = ARRANGEMENTS[step]
        described = f"{step} step"
        if self._why and step == self._best:
            described += f" ({self._why})"
            _tell(f"sim.step: {described}")
        self.description = (
            f"MuJoCo Warp {mjw.__version__}, Warp {wp.__version__}, {name}, {described}"
        )

        # Views of state, fields and counters
        for name in (
            *("qpos", "qvel", "act", "ctrl", "xpos", "xquat", "site_xpos", "geom_xpos"),
            *("qfrc_actuator", "sensordata"),
        ):
            setattr(self, name, wp.to_torch(getattr(self._d, name)))
        # `view` never copies: a field that MJWarp holds as vectors or matrices keeps its memory
        # under MuJoCo's shape.
        self.fields = Fields(
            {
                name: wp.to_torch(getattr(self._m, name)).view(nworld, *getattr(model, name).shape)
                for name in names
            }
        )
        self.constraint_count = wp.to_torch(self._d.nefc)
        self.contact_count = usage.contacts
        self.peak_contacts = usage.peak_contacts
        self.peak_constraints = usage.peak_rows
        self.peak_pool = usage.peak_pool
        self.overflow = usage.overflow
        self.solver_limits = usage.limits
        self.step_count = usage.steps
        self._erased = tuple(torch.zeros_like(usage.overflow) for _ in range(3))
        self._mask = torch.zeros(nworld, dtype=torch.bool, device=self.device)
        self._selected = wp.from_torch(self._mask)
        self._warm_up()

    def step(self, n: int = 1, *, kinematics: bool = False) -> None:
        """Advance every world by n physics steps under the current ctrl; the poses follow with
        kinematics.
        """
        with torch_stream_scope(self._device):
            if n == 0 or inside_graph():
                self._decimation(n, kinematics)
            else:
                self.graph_of(n, kinematics=kinematics)()

    def forward(self) -> None:
        """Compute everything that derives from the state, without advancing time."""
        with torch_stream_scope(self._device):
            self._place()
            mjw.forward(self._m, self._d)
            self._usage.count(self._m, self._d, steps=0)

    def kinematics(self, mask: torch.Tensor | None = None) -> None:
        """Bring the poses of all worlds up to the current qpos: a mask would save nothing."""
        self.check_mask(mask)
        with torch_stream_scope(self._device):
            self._pose()

    def reset(self, mask: torch.Tensor | None = None) -> None:
        """Put the masked worlds back to qpos0, at rest, and clear their counters and overflow
        bits.
        """
        self.check_mask(mask)
        self._keep_peaks(mask)
        if mask is None:
            self._mask.fill_(True)
            self._usage.peak_pool.zero_()
        else:
            self._mask.copy_(mask)
        with torch_stream_scope(self._device):
            mjw.reset_data(self._m, self._d, reset=self._selected)
        self._usage.clear(self._mask)

    def option_values(self) -> dict[str, float | int | str]:
        """The physics options as uploaded."""
        opt = self._m.opt
        primitive = bool(int(opt.disableflags) & int(mjw.DisableBit.NATIVECCD))
        return {
            "timestep": float(opt.timestep.numpy()[0]),
            "impratio": float(opt.impratio_invsqrt.numpy()[0]) ** -2,
            "tolerance": float(opt.tolerance.numpy()[0]),
            **named_options(opt),
            "box_box": "primitive" if primitive else "convex",
        }

    def make_cameras(self, cameras: Mapping[str, CameraCfg]) -> Cameras:
        """See `Simulation`; compiles the renderer."""
        return MjwarpCameras(self.model, self._m, self._d, self.fields, cameras)

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
            scratch=False,
        )

    def graph_of(self, n: int = 1, *, kinematics: bool = False) -> StepGraph:
        """The graph that `step(n)` replays."""
        key = (n, kinematics)
        if key not in self._graphs:
            self._graphs[key] = StepGraph(
                lambda: self._decimation(n, kinematics),
                self.device,
                self._graph_mode,
                name=f"step({n})",
                scratch=self.arrangement.scratch,
            )
        return self._graphs[key]

    def latch(self) -> None:
        """Record what the worlds use and have lost by now; `step` does it by itself."""
        with torch_stream_scope(self._device):
            self._usage.count(self._m, self._d, steps=0)

    def arrange(self, arrangement: Arrangement) -> None:
        """Choose how a captured step is arranged, for measurements.

        Raises:
            UnsupportedModel: The arrangement leaves out something that the model needs.
        """
        if not self.allows(arrangement):
            raise UnsupportedModel(f"this step does not apply: {self._why}", "Choose another")
        self.arrangement = arrangement
        self._graphs.clear()

    def allows(self, arrangement: Arrangement) -> bool:
        """Whether an arrangement does all that the model needs."""
        best = ARRANGEMENTS[self._best]
        return arrangement.own_stages <= best.own_stages and arrangement.fused <= best.fused

    def synchronize(self) -> None:
        """Wait for the device."""
        wp.synchronize_device(self._device)

    def close(self) -> None:
        """Drop the graphs; buffers go with the object."""
        self._graphs.clear()

    def _decimation(self, n: int, kinematics: bool) -> None:
        self._place()
        count = partial(self._usage.count, self._m, self._d, steps=1)
        arrangement = self.arrangement
        if not arrangement.own_stages:
            for _ in range(n):
                mjw.step(self._m, self._d)
                count()
            if kinematics:
                self._pose()
            return
        # The use of a step is counted while the next one begins, which touches neither contacts nor
        # rows.
        beside: tuple[Callable[[], None], ...] = ()
        for i in range(n):
            rearranged_step(
                self._m,
                self._d,
                self.device,
                sensors=i == n - 1 or not arrangement.sensors_once,
                branches=arrangement.branches,
                own=arrangement.fused,
                smooth=self._smooth(),
                beside_kinematics=beside,
            )
            beside = (count,)
        side_by_side(
            self.device,
            *((self._pose,) if kinematics else ()),
            *beside,
            branches=arrangement.branches,
        )

    def _best_step(self) -> tuple[str, str]:
        """The fastest step that does all that the model needs, and why it is not faster."""
        if not can_rearrange(self.model, self._m):
            return "stock", "the model has features that only mujoco_warp.step knows"
        why = fused.why_not(self._m, self._d)
        if why:
            return "arranged", why
        slower = {
            "contact rows": fused.why_not_rows(self._m),
            "smooth dynamics": fused_smooth.why_not(self._m),
        }
        return "fused", "; ".join(
            f"MJWarp's {part}, because {why}" for part, why in slower.items() if why
        )

    def _smooth(self) -> bool:
        """Whether smooth dynamics are three kernels."""
        return self.arrangement.fused and self.arrangement.smooth and self._smooth_applies

    def _resolve(self, asked: str) -> str:
        """The step that is done."""
        if asked == "auto":
            return self._best
        if not self.allows(ARRANGEMENTS[asked]):
            raise UnsupportedModel(
                f"sim.step={asked} does not apply: {self._why}", "Use sim.step=auto"
            )
        return asked

    def _pose(self) -> None:
        """Poses of the current qpos, and nothing that a later step would start from: its forward
        computes them anew.
        """
        if self._smooth():
            fused_smooth.positions(self._m, self._d)
        else:
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

    def _warm_up(self) -> None:
        """Compile and load every kernel, then leave the worlds as new."""
        with torch_stream_scope(self._device):
            self._decimation(1, kinematics=True)
        self.synchronize()
        self.reset()
        self.synchronize()
