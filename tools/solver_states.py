"""Recorded states of MJWarp's worlds, the two solvers on them, and the cost that they minimise."""

from dataclasses import dataclass
from typing import Any

import mujoco
import torch

from mjstack.envs import Env
from mjstack.episodes.rollout import Observer, lacks_episode, rollout
from mjstack.episodes.stage import Stage
from mjstack.errors import MjstackError
from mjstack.math import not_finite
from mjstack.sim import LOST_PHYSICS
from mjstack.sim.fused import constraints
from mjstack.sim.mjwarp import MjwarpSimulation
from mjstack.sim.mujoco_warp import mjw
from mjstack.sim.warp_setup import torch_stream_scope, wp

SCRIPTED = "scripted episodes"
RANDOM = "random actions"
STOCK = "mujoco_warp"
FUSED = "fused"
SOLVERS = (STOCK, FUSED)
VECTORS = {"qacc": "qacc_smooth", "qfrc_constraint": "qfrc_smooth"}
"""Outputs of a solver, and the vectors of the smooth dynamics that are in their units."""
_EPISODE = 2.0  # s, of random actions
_RANDOM_EPISODES = 3  # that a world plays at least
_ELLIPTIC = int(mujoco.mjtConstraint.mjCNSTR_CONTACT_ELLIPTIC)


@dataclass(frozen=True, slots=True)
class Sample:
    """State of all worlds as a physics step begins.

    Attributes:
        state: qpos, qvel, act, ctrl and qacc_warmstart, each of shape ``(nworld, n)``.
        fields: Per-world model fields.
        kind: `SCRIPTED` or `RANDOM`.
    """

    state: dict[str, torch.Tensor]
    fields: dict[str, torch.Tensor]
    kind: str

    @classmethod
    def of(cls, sim: MjwarpSimulation, kind: str) -> "Sample":
        """Copy the state of all worlds, on their device."""
        state = {name: getattr(sim, name).clone() for name in ("qpos", "qvel", "act", "ctrl")}
        state["qacc_warmstart"] = wp.to_torch(sim._d.qacc_warmstart).clone()
        return cls(state, {name: field.clone() for name, field in sim.fields.items()}, kind)


def record_states(stage: Stage, sim: MjwarpSimulation, states: int) -> list[Sample]:
    """Record at least so many states, half in scripted episodes, half under random actions.

    A task without phases has random actions alone, and an episode has at most a state per control
    step.
    """
    scripted = not lacks_episode(stage.cfg)
    count = -(-states // ((1 + scripted) * sim.nworld))
    env = stage.start(sim, stage.cfg.reset)
    samples = []
    if scripted:
        driver = stage.driver(env)
        recorder = _Recorder(sim, max(1, driver.steps // count))
        advance = stage.progress.advance
        rollout(env, driver, [recorder], advance=advance, label="steps of the episodes")
        samples += recorder.samples
    return samples + _record_random(stage, env, sim, count)


def _record_random(stage: Stage, env: Env, sim: MjwarpSimulation, count: int) -> list[Sample]:
    """So many samples under joint targets over their full range, new in every control step.

    A sample follows such a target by 0, 1, ... physics steps. A world starts an episode every 2 s,
    each at its own time.
    """
    decimation = stage.cfg.timing.decimation
    age = round(_EPISODE / stage.cfg.timing.step_dt)
    steps = max(count, _RANDOM_EPISODES * age)
    every = steps // count
    low, high = torch.as_tensor(sim.model.actuator_ctrlrange).float().to(sim.device).unbind(1)
    generator = torch.Generator(sim.device).manual_seed(stage.cfg.seed)
    offset = torch.arange(sim.nworld, device=sim.device) * age // sim.nworld
    samples = []
    for step in range(steps):
        env.reset(mask=(step + offset) % age == 0 if step else None)
        noise = torch.rand(sim.ctrl.shape, generator=generator, device=sim.device)
        sim.ctrl.copy_(low + (high - low) * noise)
        sampled = step // every % decimation if step % every == every - 1 else -1
        for substep in range(decimation):
            if substep == sampled:
                samples.append(Sample.of(sim, RANDOM))
            sim.step(1)
        stage.progress.advance("steps of random actions", step + 1, steps)
    return samples


class _Recorder(Observer):
    """Records every k-th step of an episode."""

    def __init__(self, sim: MjwarpSimulation, every: int) -> None:
        self.samples: list[Sample] = []
        self._sim = sim
        self._every = every

    def after_step(self, step: int) -> None:
        if step % self._every == self._every - 1:
            self.samples.append(Sample.of(self._sim, SCRIPTED))


class Pipeline:
    """MJWarp's worlds, brought to just before the solver, and both solvers."""

    def __init__(self, sim: MjwarpSimulation) -> None:
        """Take the worlds.

        Raises:
            MjstackError: The fused solver does not cover the model.
        """
        self.sim = sim
        self._m: Any = sim._m
        self._d: Any = sim._d
        self._solvers = {STOCK: mjw.solve, FUSED: constraints.solve}
        if reason := constraints.why_not(self._m, self._d):
            raise MjstackError(f"the fused solver does not cover this model: {reason}")

    def array(self, name: str) -> torch.Tensor:
        """A view of an array of MJWarp's data, such as ``efc.J``."""
        owner: Any = self._d
        for part in name.split("."):
            owner = getattr(owner, part)
        return wp.to_torch(owner)

    @property
    def tolerance(self) -> torch.Tensor:
        """The solvers' tolerance, of each world or of all."""
        return wp.to_torch(self._m.opt.tolerance)

    def prepare(self, sample: Sample) -> torch.Tensor:
        """Load a sample, and compute all that a solver reads.

        Returns:
            Worlds that lost physics to a buffer, or whose state is not finite, shape ``(nworld,)``.
        """
        for name, values in sample.state.items():
            self.array(name).copy_(values)
        for name, values in sample.fields.items():
            self.sim.fields[name].copy_(values)
        d = self._d
        lost = self.array("overflow").zero_()
        with torch_stream_scope(self.sim._device):
            self.sim._place()
            mjw.fwd_position(self._m, d)
            mjw.fwd_velocity(self._m, d)
            mjw.fwd_actuation(self._m, d)
            mjw.fwd_acceleration(self._m, d, factorize=True)
        pool = torch.maximum(self.array("nacon"), self.array("ncollision"))
        void = ((lost & LOST_PHYSICS) != 0) | (self.array("nefc") > d.njmax) | (pool > d.naconmax)
        return void | not_finite(*sample.state.values())

    def solve(self, solver: str) -> dict[str, torch.Tensor]:
        """Outputs of a solver, by name; NaN or -1 where it has written none."""
        names = (*VECTORS, "efc.Ma", "efc.force", "efc.state", "solver_niter")
        for name in names:
            output = self.array(name)
            output.fill_(torch.nan if output.is_floating_point() else -1)
        self.array("overflow").zero_()
        with torch_stream_scope(self.sim._device):
            self._solvers[solver](self._m, self._d)
        return {name: self.array(name).clone() for name in (*names, "overflow")}

    def inertia(self) -> torch.Tensor:
        """The mass matrix in float64, shape ``(nworld, nv, nv)``."""
        rows, columns = (wp.to_torch(i).long() for i in (self._m.M_hinit_i, self._m.M_colind))
        values = self.array("M")[:, : len(columns)].double()
        inertia = values.new_zeros((len(values), self._m.nv, self._m.nv))
        inertia[:, rows, columns] = values
        inertia[:, columns, rows] = values
        return inertia

    def residuals(self, qacc: torch.Tensor) -> torch.Tensor:
        """J qacc - aref in float64, shape ``(nworld, rows)``, rows as many as a world has at
        most.
        """
        most = max(1, min(self._d.njmax, int(self.array("nefc").max())))
        jacobian = self.array("efc.J")[:, :most, : self._m.nv].double()
        product = torch.einsum("wri,wi->wr", jacobian, qacc.double())
        return product - self.array("efc.aref")[:, :most].double()

    def cost(self, qacc: torch.Tensor) -> torch.Tensor:
        """Cost of an acceleration in the prepared rows, in float64, shape ``(nworld,)``: both
        solvers minimise it.
        """
        # Inertia, about the acceleration of qfrc_smooth alone
        inertia = self.inertia()
        change = qacc.double() - torch.linalg.solve(inertia, self.array("qfrc_smooth").double())
        cost = 0.5 * torch.einsum("wi,wij,wj->w", change, inertia, change)

        # Single rows: equalities, then friction loss, then those that push one way
        ne, nf, nefc = (self.array(name).long()[:, None] for name in ("ne", "nf", "nefc"))
        x = self.residuals(qacc)
        most = x.shape[1]
        weight = self.array("efc.D")[:, :most].double()
        loss = self.array("efc.frictionloss")[:, :most].double()
        quadratic = 0.5 * weight * x**2
        friction = torch.where(
            x.abs() < loss / weight, quadratic, loss * (x.abs() - 0.5 * loss / weight)
        )
        row = torch.arange(most, device=x.device)
        costs = torch.where(row < ne + nf, friction, torch.where(x < 0, quadratic, 0.0))
        costs = torch.where(row < ne, quadratic, costs)
        elliptic = self.array("efc.type")[:, :most] == _ELLIPTIC
        costs = torch.where((row < nefc) & ~elliptic, costs, 0.0)
        return (cost + costs.sum(1)).index_add_(0, *self._cone_costs(x, weight, elliptic))

    def _cone_costs(
        self, x: torch.Tensor, weight: torch.Tensor, elliptic: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """World and cost of each contact with an elliptic cone, from the residuals and weights of
        all rows.
        """
        # The contacts that have rows, and their residuals
        count = min(int(self.array("nacon")), self._d.naconmax)
        world, first, dim = (
            self.array(f"contact.{name}")[:count].long()
            for name in ("worldid", "efc_address", "dim")
        )
        first = first[:, 0]
        used = (first >= 0) & (first + dim <= x.shape[1])
        used &= elliptic[world, first.clamp(0, x.shape[1] - 1)]
        world, first, dim = (numbers[used] for numbers in (world, first, dim))
        rows = first[:, None] + torch.arange(6, device=x.device)
        within = rows < (first + dim)[:, None]
        at = (world[:, None], rows.clamp(max=x.shape[1] - 1))
        residual = torch.where(within, x[at], 0.0)

        # Below the cone, in its middle, above it
        friction = self.array("contact.friction")[:count][used].double()
        invsqrt = wp.to_torch(self._m.opt.impratio_invsqrt).double()
        mu = friction[:, 0] * invsqrt[world % len(invsqrt)]
        normal = residual[:, 0] * mu
        tangent = (residual[:, 1:] * friction).norm(dim=1)
        below = 0.5 * torch.where(within, weight[at] * residual**2, 0.0).sum(1)
        middle = 0.5 * weight[at][:, 0] / (mu**2 * (1 + mu**2)) * (normal - mu * tangent) ** 2
        cost = torch.where(mu * normal + tangent <= 0, below, middle)
        return world, torch.where(normal >= mu * tangent, 0.0, cost)
