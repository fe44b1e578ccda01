"""MuJoCo Warp: thousands of worlds on CUDA, or on Warp's CPU device for checks."""

# No `from __future__ import annotations` here: Warp reads the annotations as objects.
import logging
import warnings
from collections.abc import Mapping, Sequence
from functools import cache, partial
from types import SimpleNamespace

import mujoco
import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from mjstack.config.schema import CameraCfg, Config
from mjstack.errors import MjstackError, first_line
from mjstack.sim.cameras import Cameras
from mjstack.sim.clearance import PROVED_BY
from mjstack.sim.compiling import compile_step
from mjstack.sim.fused import constraints
from mjstack.sim.fused.launch import arguments
from mjstack.sim.fused.smooth import positions
from mjstack.sim.fused.step import (
    RELEASES,
    StepPlan,
    disagreement,
    plan_step,
    prepare_stock,
    rearranged_forward,
    rearranged_step,
)
from mjstack.sim.graph import StepGraph, side_by_side
from mjstack.sim.mjwarp_cameras import MjwarpCameras
from mjstack.sim.model_fields import PLACING_FIELDS, Fields, check_fields
from mjstack.sim.mujoco_warp import mjw, torch_stream_scope, wp
from mjstack.sim.simulation import Simulation, named_options
from mjstack.sim.sizes import BatchSizes
from mjstack.sim.usage import Usage

log = logging.getLogger(__name__)
_log_once = cache(log.info)  # in a process


class MjwarpSimulation(Simulation):
    """`Simulation` on MuJoCo Warp, float32.

    Box against box uses the primitive collider, as native MuJoCo does: with MJWarp's convex one the
    kept contacts of a resting stack can alternate, and it never comes to rest. The physics
    steps of one `step(n)` are captured into a graph, unless they are a part of a larger one.
    """

    backend = "mjwarp"

    def __init__(
        self,
        model: mujoco.MjModel,
        cfg: Config,
        nworld: int,
        sizes: BatchSizes,
        device: str,
        fields: Sequence[str],
    ) -> None:
        """Upload the model and allocate the worlds at qpos0, on ``"cpu"`` or ``"cuda:N"``;
        arguments as of `make_simulation`.

        Raises:
            UnknownName: A field does not exist, or cannot differ.
            MjstackError: MJWarp does not implement a feature of the model.
        """
        self.model = model
        self.nworld = nworld
        self.sizes = sizes
        self.device = torch.device(device)
        self._device = wp.get_device(device)
        self._graph_mode = cfg.graph
        self._graphs: dict[tuple[int, bool], StepGraph] = {}
        names = check_fields(fields)
        self._placing = not PLACING_FIELDS.isdisjoint(names)

        # The model and its data on the device
        with wp.ScopedDevice(self._device):
            try:
                with warnings.catch_warnings():
                    warnings.filterwarnings("error", category=UserWarning)
                    self._m = mjw.put_model(model, batch_sizes=dict.fromkeys(names, nworld))
            except (NotImplementedError, ValueError, UserWarning) as error:
                raise MjstackError(
                    f"MJWarp does not support this model: {first_line(error)}",
                    "Remove the feature from the model, or run sim=native",
                ) from error
            self._m.opt.disableflags |= int(mjw.DisableBit.NATIVECCD)
            self._m.opt.warn_overflow = 0
            self._d = mjw.make_data(model, nworld=nworld, **sizes.as_kwargs())
            self._stepped = self._m  # what steps are made of, but for stock ones
            self.plan = StepPlan()  # how a physics step is done
            if cfg.sim.step != "stock":
                self.plan = plan_step(model, self._m, self._d)
            if self.plan.name != "stock" and mjw.__version__ not in RELEASES:
                with torch_stream_scope(self._device):
                    wrong = disagreement(model, self._m, self._d, self.device, self.plan)
                if wrong:
                    releases = f"mujoco-warp {', '.join(RELEASES)}"
                    self.plan = StepPlan(
                        reason=f"mjstack's was written for {releases}, and {wrong}"
                    )
            self._usage = Usage(model, nworld, self.device)
            # MJWarp's kernel skips geoms that are welded to the world, but not to a mocap body:
            # with these it skips all others
            moves = (model.body_weldid > 0) | (model.body_mocapid[model.body_rootid] >= 0)
            self._swapped = SimpleNamespace(
                body_weldid=wp.array(1 - moves, dtype=int),
                body_mocapid=wp.full(model.nbody, -1, dtype=int),
            )

            if self.plan.name != "stock" and PROVED_BY.isdisjoint(names):
                self._stepped = constraints.without_far_pairs(model, self._m)

        if self.plan.reason:
            _log_once(f"sim.step: {self.plan}")
        if omitted := len(self._m.nxn_geom_pair_filtered) - len(
            self._stepped.nxn_geom_pair_filtered
        ):
            count = f"{omitted} of {len(self._m.nxn_geom_pair_filtered)} pairs of geoms"
            _log_once(f"{count} are left out of collision: no posture lets them touch")
        hardware = self._device.name if self._device.is_cuda else "Warp's CPU device"
        self.description = (
            f"MuJoCo Warp {mjw.__version__}, Warp {wp.__version__}, {hardware}, {self.plan}"
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
        self.solver_tolerance = wp.to_torch(self._m.opt.tolerance)
        for name, view in self._usage.views.items():
            setattr(self, name, view)
        self._erased = tuple(torch.zeros_like(self.overflow) for _ in range(3))
        self._mask = torch.zeros(nworld, dtype=torch.bool, device=self.device)
        self._selected = wp.from_torch(self._mask)

        # Compile and load every kernel, then leave the worlds as new
        compile_step(model, self._stepped, sizes, self._device, self.plan)
        with torch_stream_scope(self._device):
            self._decimation(1, kinematics=True)
        self.synchronize()
        self.reset()
        self.synchronize()

    @override
    def step(self, n: int = 1, *, kinematics: bool = False) -> None:
        with torch_stream_scope(self._device):
            self.graph_of(n, kinematics=kinematics)()

    @override
    def forward(self) -> None:
        with torch_stream_scope(self._device):
            self._place()
            if self.plan.name == "stock":
                prepare_stock(self._m, self._d)
                mjw.forward(self._m, self._d)
            else:  # the same kernels as a step's, so that no others are compiled
                rearranged_forward(self._stepped, self._d, self.device, self.plan, sensors=True)
        self.latch()

    def kinematics(self, mask: Tensor | None = None) -> None:
        """Bring the poses of all worlds up to the current qpos: a mask would save nothing."""
        self.check_mask(mask)
        with torch_stream_scope(self._device):
            self._pose()

    @override
    def reset(self, mask: Tensor | None = None) -> None:
        self.check_mask(mask)
        self.keep_peaks(mask)
        if mask is None:
            self._mask.fill_(True)
            self._usage.views["peak_pool"].zero_()
        else:
            self._mask.copy_(mask)
        with torch_stream_scope(self._device):
            mjw.reset_data(self._m, self._d, reset=self._selected)
        self._usage.clear(self._mask)

    @override
    def switch(self, flag: int, *, off: bool) -> None:
        option = self._m.opt
        option.disableflags = option.disableflags | flag if off else option.disableflags & ~flag
        self._graphs.clear()

    @override
    def option_values(self) -> dict[str, float | int | str]:
        opt = self._m.opt
        primitive = opt.disableflags & mjw.DisableBit.NATIVECCD
        return {
            "timestep": float(opt.timestep.numpy()[0]),
            "impratio": float(opt.impratio_invsqrt.numpy()[0]) ** -2,
            "tolerance": float(opt.tolerance.numpy()[0]),
            **named_options(opt),
            "box_box": "primitive" if primitive else "convex",
        }

    @override
    def model_values(self) -> dict[str, np.ndarray]:
        values = {}
        for name in dir(self.model):
            uploaded, array = getattr(self._m, name, None), getattr(self.model, name)
            if isinstance(uploaded, wp.array) and isinstance(array, np.ndarray) and array.size:
                values[name] = uploaded.numpy().ravel()[: array.size].reshape(array.shape)
        return values

    @override
    def make_cameras(self, cameras: Mapping[str, CameraCfg]) -> Cameras:
        return MjwarpCameras(self.model, self._m, self._d, self.fields, cameras)

    @override
    def graph_of(self, n: int = 1, *, kinematics: bool = False) -> StepGraph:
        key = (n, kinematics)
        if key not in self._graphs:
            work = partial(self._decimation, *key)
            self._graphs[key] = StepGraph(work, self.device, self._graph_mode, name=f"step({n})")
        return self._graphs[key]

    def latch(self) -> None:
        """Record what the worlds use and have lost by now; `step` does it by itself."""
        with torch_stream_scope(self._device):
            self._usage.count(self._m, self._d, steps=0)

    @override
    def synchronize(self) -> None:
        wp.synchronize_device(self._device)

    @override
    def close(self) -> None:
        self._graphs.clear()

    def _decimation(self, n: int, kinematics: bool) -> None:
        self._place()
        count = partial(self._usage.count, self._m, self._d, steps=1)
        if self.plan.name == "stock":
            for _ in range(n):
                prepare_stock(self._m, self._d)
                mjw.step(self._m, self._d)
                count()
            if kinematics:
                self._pose()
            return
        # The use of a step is counted while the next one begins, which touches neither contacts nor
        # rows.
        step = partial(rearranged_step, self._stepped, self._d, self.device, self.plan)
        for i in range(n):
            step(sensors=i == n - 1, beside_kinematics=(count,) if i else ())
        side_by_side(self.device, *((self._pose,) if kinematics else ()), count)

    def _pose(self) -> None:
        """Poses of the current qpos, and nothing that a later step would start from: its forward
        computes them anew.
        """
        (positions if self.plan.smooth else mjw.kinematics)(self._m, self._d)
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
        kernel = mjw._src.smooth._geom_local_to_global
        inputs = [*arguments(kernel, m, d, self._swapped)]
        wp.launch(kernel, dim=(self.nworld, m.ngeom), inputs=inputs)
