"""How two runs are compared."""

from __future__ import annotations

import torch

from mjstack.sim import Simulation


def assert_same_run(a: torch.Tensor, b: torch.Tensor, backend: str) -> None:
    """Bit for bit on the CPU backends. CUDA sums in no fixed order: there two runs agree to
    rounding (docs/design.md).
    """
    if backend.endswith("cuda"):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-3)
    else:
        assert torch.equal(a, b)


def assert_worlds_step_alone(many: Simulation, one: Simulation, backend: str) -> None:
    """World k of many ends as the only world of a simulation does that starts in its state, with
    its model fields.
    """
    views = ("qpos", "qvel", "ctrl")
    initial = {name: getattr(many, name).clone() for name in views}
    for _ in range(3):
        many.step(10)
    for k in range(many.nworld):
        one.reset()
        for name, field in one.fields.items():
            field[0] = many.fields[name][k]
        for name in views:
            getattr(one, name)[0] = initial[name][k]
        one.forward()
        for _ in range(3):
            one.step(10)
        assert_same_run(one.qpos[0], many.qpos[k], backend)
        assert_same_run(one.qvel[0], many.qvel[k], backend)
