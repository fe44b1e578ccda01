"""What every physics backend offers: torch views of batched state, `step`, `forward`, `reset` and what was lost on the way."""

from __future__ import annotations

from enum import IntFlag
from typing import Protocol

import mujoco
import torch


class Overflow(IntFlag):
    """What a world lost because a buffer was too small. The values are MJWarp's ``OverflowType``.

    Iteration limits are not here: they say how far the solver converged, not that physics was dropped.
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


def describe_overflow(bits: int) -> str:
    """The names of the bits, such as ``NEFC, CCD``."""
    return ", ".join(flag.name or "" for flag in Overflow if bits & flag)


LOST_PHYSICS = int(sum(Overflow))


class Simulation(Protocol):
    """``nworld`` copies of one model, stepped together.

    Views are allocated once and keep their address. Write into them (``sim.ctrl[:] = ...``); a masked world is selected by a
    bool tensor. After `step`, ``xpos``, ``xquat``, ``site_xpos`` and the counts belong to the state before the last
    integration, on both backends; `forward` brings them up to date.

    Attributes:
        model: The compiled model.
        nworld: Number of worlds.
        backend: ``"native"`` or ``"mjwarp"``.
        device: Where the views live.
        description: Backend and hardware, for reports.
        qpos: Positions [m, rad, quaternions wxyz], shape ``(nworld, nq)``.
        qvel: Velocities [m/s, rad/s], shape ``(nworld, nv)``.
        ctrl: Actuator commands, shape ``(nworld, nu)``.
        xpos: Body positions [m], shape ``(nworld, nbody, 3)``.
        xquat: Body orientations wxyz, shape ``(nworld, nbody, 4)``.
        site_xpos: Site positions [m], shape ``(nworld, nsite, 3)``.
        qfrc_actuator: Actuator forces in joint space [N, N m], shape ``(nworld, nv)``.
        contact_count: Contacts found by the last step or forward, shape ``(nworld,)``, int32.
        constraint_count: Constraint rows likewise, shape ``(nworld,)``, int32.
        step_count: Physics steps since the world's last reset, shape ``(nworld,)``, int64.
        overflow: Bits of `Overflow` raised by `step`, sticky until the world is reset, shape ``(nworld,)``, int32. `forward`
            alone raises none on MJWarp.
        peak_contacts: Largest contact_count over all substeps since the world's last reset, shape ``(nworld,)``, int32.
        peak_constraints: Largest constraint_count likewise, shape ``(nworld,)``, int32.
    """

    model: mujoco.MjModel
    nworld: int
    backend: str
    device: torch.device
    description: str
    qpos: torch.Tensor
    qvel: torch.Tensor
    ctrl: torch.Tensor
    xpos: torch.Tensor
    xquat: torch.Tensor
    site_xpos: torch.Tensor
    qfrc_actuator: torch.Tensor
    contact_count: torch.Tensor
    constraint_count: torch.Tensor
    step_count: torch.Tensor
    overflow: torch.Tensor
    peak_contacts: torch.Tensor
    peak_constraints: torch.Tensor

    def step(self, n: int = 1) -> None:
        """Advances every world by n physics steps under the current ctrl."""

    def forward(self) -> None:
        """Computes everything that derives from qpos, qvel and ctrl, without advancing time."""

    def reset(self, mask: torch.Tensor | None = None) -> None:
        """Puts the worlds of a ``(nworld,)`` bool mask (None: all) back to the model's qpos0, at rest, counters cleared.

        Derived arrays are stale until `forward`.
        """

    def option_values(self) -> dict[str, float | int | str]:
        """The physics options as this backend holds them, by MuJoCo's names."""

    def synchronize(self) -> None:
        """Waits for the device."""

    def close(self) -> None:
        """Gives threads and buffers back."""
