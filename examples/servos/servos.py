"""Another servo model in every episode of every world, so that a policy learns to act with each."""

from collections.abc import Sequence

import numpy as np
import torch

from mjstack.config import load_config
from mjstack.managers import EnvView, random_uniform, uses_fields
from mjstack.scene.build import build_model

# The figures of group actuator, and the constants that MuJoCo's compiler makes of the armature
FIELDS = ("actuator_gainprm", "actuator_biasprm", "actuator_forcerange", "dof_armature")
FIELDS += ("dof_frictionloss", "dof_damping", "dof_invweight0", "body_invweight0")


@uses_fields(*FIELDS)
class AnyServo:
    """Draws one of some choices of ``actuator`` for all joints of a world."""

    label = "reset.servos"

    def __init__(self, env: EnvView, *, names: Sequence[str]) -> None:
        """Take the names of the choices."""
        robot = f"robot={env.cfg.robot.name}"
        task = f"task={env.cfg.task.name}"
        models = [build_model(load_config([robot, task, f"actuator={name}"])) for name in names]
        self._count = len(names)
        self._values = {
            name: torch.from_numpy(np.stack([getattr(model, name) for model in models])).to(
                env.sim.fields[name]
            )
            for name in FIELDS
        }

    def __call__(self, env: EnvView, mask: torch.Tensor) -> None:
        """Write the masked worlds' servos."""
        share = random_uniform(env, self.label, 1, low=0.0, high=1.0)[:, 0].double()
        number = (share * self._count).long().clamp(max=self._count - 1)
        for name, values in self._values.items():
            field = env.sim.fields[name]
            chosen = mask.view(-1, *[1] * (field.dim() - 1))
            torch.where(chosen, values[number], field, out=field)
