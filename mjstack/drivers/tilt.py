"""Approach tilt of a grasp, so that an object arrives upright."""

from collections.abc import Sequence

import mujoco
import torch
from torch import Tensor

from mjstack.config.schema import Config
from mjstack.kinematics.batched_ik import BatchedIk
from mjstack.scene.index import turn_sign
from mjstack.scene.phases import Phase


class CarryTilt:
    """Desired approach axis of every world: at the grasp, as the release pose needs it; from then
    on, as it was at the grasp.

    An arm that grasps near its base can point straight down, and far from it must tilt. An object
    grasped upright would arrive there tilted by the difference, on an edge, and may fall. So a
    virtual copy of the arm tracks the release pose, a few iterations per step, and gives its tilt.
    The open gripper keeps its tilt until it observes the next object, so that it does not turn the
    released one.

    The desired axis turns about the vertical with the arm's first joint: its angle to the vertical
    is kept.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        cfg: Config,
        phases: Sequence[Phase],
        ik: BatchedIk,
        nominal: Tensor,
    ) -> None:
        """Allocate for the worlds of the solver.

        Args:
            model: The compiled scene.
            cfg: The configuration; ``controller.approach_gain`` must be positive.
            phases: The phases.
            ik: The driver's solver.
            nominal: Commands at the end of each phase of the nominal plan, shape ``(phases, nu)``,
                float32.

        Raises:
            ConfigError: The arm's first joint does not turn about the vertical.
        """
        self._ik = ik
        self._nominal = nominal
        c = cfg.controller
        device = ik.device
        self._there_ik = BatchedIk(
            model,
            cfg.robot,
            ik.nworld,
            device,
            iterations=c.step_iterations,
            approach_gain=c.approach_gain,
        )
        self._sign = turn_sign(model, cfg.robot)
        self._keeps = torch.tensor(_keeps(phases), device=device)
        self._grasps = torch.tensor([phase.grasped >= 0 for phase in phases], device=device)
        self.place = torch.tensor(_places(phases), device=device)
        self._there = nominal.new_zeros((ik.nworld, nominal.shape[1]))
        self._last_axis = nominal.new_zeros((ik.nworld, 3))
        self._last_turn = nominal.new_zeros(ik.nworld)

    def desired_approach(
        self, command: Tensor, phase: Tensor, there: Tensor, fresh: Tensor
    ) -> Tensor:
        """Desired approach axis of the next step. Fixed shapes, no host read.

        Args:
            command: Joint positions at which the arm starts [rad, m], shape ``(nworld, nu)``,
                float32.
            phase: Number of each world's phase, shape ``(nworld,)``, int64.
            there: Target of the phase ``place[phase]``, where the next object or the held one is
                released [m], shape ``(nworld, 3)``.
            fresh: Worlds that start an episode, shape ``(nworld,)``, bool.

        Returns:
            Unit vectors, shape ``(nworld, 3)``, float32.
        """
        start = torch.where(fresh[:, None], self._nominal[self.place[phase]], self._there)
        self._there.copy_(self._there_ik.solve(start, there)[0])
        grasps = self._grasps[phase]
        keeps = self._keeps[phase]
        approach = self._ik.forward(command)[2]
        self._last_axis.copy_(torch.where(grasps[:, None], approach, self._last_axis))
        self._last_turn.copy_(torch.where(grasps, command[:, 0], self._last_turn))
        axis = self._there_ik.forward(self._there)[2]
        axis = torch.where(keeps[:, None], self._last_axis, axis)
        since = torch.where(keeps, self._last_turn, self._there[:, 0])
        return turn_about_z(axis, self._sign * (command[:, 0] - since))

    def release_approach(self, command: Tensor, phase: Tensor, there: Tensor) -> Tensor:
        """Approach axis of the release pose, turned about the vertical to where the arm looks; from
        these arguments alone, which are those of `desired_approach`. Fixed shapes, no host read.
        """
        arm = self._there_ik.solve(self._nominal[self.place[phase]], there)[0]
        axis = self._there_ik.forward(arm)[2]
        return turn_about_z(axis, self._sign * (command[:, 0] - arm[:, 0]))


def turn_about_z(vectors: Tensor, angle: Tensor) -> Tensor:
    """Vectors, shape ``(n, 2)`` or ``(n, 3)``, turned about the vertical [rad], shape ``(n,)``."""
    x, y, *z = vectors.unbind(1)
    cos = torch.cos(angle)
    sin = torch.sin(angle)
    return torch.stack((cos * x - sin * y, sin * x + cos * y, *z), dim=1)


def _keeps(phases: Sequence[Phase]) -> list[bool]:
    """Whether the tilt of the last grasp is kept in each phase."""
    out = []
    fixed = False
    for phase in phases:
        fixed = fixed and not (phase.spec.observe and phase.spec.gripper == "open")
        out.append(fixed and phase.grasped < 0)
        fixed = fixed or phase.grasped >= 0
    return out


def _places(phases: Sequence[Phase]) -> list[int]:
    """Number of the phase at whose target the next object, or the held one, is released, for each
    phase; after all of them, the last.
    """
    carries = [phase.carried >= 0 for phase in phases] + [False]
    ends = [k for k in range(len(phases)) if carries[k] and not carries[k + 1]] or [len(phases) - 1]
    out = []
    for k in range(len(phases)):
        place = next((end for end in ends if end >= k), ends[-1])
        while place > 0 and phases[place].target is None:  # the target before holds
            place -= 1
        out.append(place)
    return out
