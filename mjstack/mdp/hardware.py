"""Reset terms in which real arms and their tables differ from the model, drawn for each episode."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from mjstack.config.complete import typed
from mjstack.config.fields import NotNegative
from mjstack.config.schema import ServoCfg
from mjstack.errors import MjstackError, ParameterError, require_names
from mjstack.managers.view import EnvView, random_uniform, uses_fields
from mjstack.mdp.starts.randomization import Elements, Randomized, bounds
from mjstack.scene.build import WORLD, build_model
from mjstack.sim.simulation import Columns

# The figures of group actuator, and the constants that MuJoCo's compiler makes of the armature
_SERVO_FIELDS = (
    "actuator_gainprm",
    "actuator_biasprm",
    "actuator_forcerange",
    "dof_armature",
    "dof_frictionloss",
    "dof_damping",
    "dof_invweight0",
    "body_invweight0",
)


@uses_fields(*_SERVO_FIELDS)
class Servos:
    """Draws one of some servo models for all joints of a world, and how far its stiffness, damping
    and frictions are off, for each joint.
    """

    label = "reset.servos"

    def __init__(
        self, env: EnvView, *, models: Mapping[str, Any], scale: Sequence[float] = (1.0, 1.0)
    ) -> None:
        """Compile the models.

        Args:
            env: The environment.
            models: Servos by joint, as ``robot.servos`` has them, by the name of each model.
            scale: Smallest and largest factor of stiffness and damping, one for both, of the dry
                and of the viscous friction.
        """
        if not models:
            raise ParameterError("models", models, "at least one model of the servos")
        robot = env.cfg.robot
        for term in env.cfg.reset.values():
            if term.func.endswith(".Servos"):
                break
            if term.func.endswith(".GripForce"):
                problem = "reset: GripForce stands before Servos, which writes the forces anew"
                raise MjstackError(problem, "Name it later, such as randomization=[servos,grip]")
        compiled = []
        for name, content in models.items():
            servos = dict(content.get("servos", content))
            require_names(f"models.{name}: joint", servos, robot.joints)
            made = {
                joint: typed(f"models.{name}.{joint}", values, ServoCfg)
                for joint, values in servos.items()
            }
            compiled.append(build_model(replace(env.cfg, robot=replace(robot, servos=made))))
        self._scale = bounds("scale", scale)
        self._count = len(compiled)
        self._fields = env.sim.fields
        self._values = {
            name: torch.from_numpy(np.stack([getattr(model, name) for model in compiled])).to(
                self._fields[name]
            )
            for name in _SERVO_FIELDS
        }
        # Objects keep the inverse weights that the terms before have given them.
        nominal = env.sim.model
        self._weights = {
            name: (values != torch.from_numpy(getattr(nominal, name)).to(values)).any(0)
            for name, values in self._values.items()
            if name.endswith("invweight0")
        }
        self._rows = torch.ones((), dtype=torch.bool, device=env.device)
        self._joints = len(robot.joints)
        servos_at, dofs = (Columns(at, env.device) for at in (env.index.ctrl, env.index.robot_qvel))
        self._scaled = {
            "actuator_gainprm": (servos_at, 0),
            "actuator_biasprm": (servos_at, 0),
            "dof_frictionloss": (dofs, 1),
            "dof_damping": (dofs, 2),
        }

    def __call__(self, env: EnvView, mask: Tensor) -> None:
        """Write the masked worlds' servos."""
        draws = random_uniform(env, self.label, 1 + 3 * self._joints, 0.0, 1.0)
        number = (draws[:, 0].double() * self._count).long().clamp(max=self._count - 1)
        low, high = self._scale
        factors = low + (high - low) * draws[:, 1:].unflatten(1, (3, self._joints))
        for name, values in self._values.items():
            servos = values[number]
            if name in self._scaled:
                columns, kind = self._scaled[name]
                factor = factors[:, kind].view(len(factors), -1, *[1] * (servos.dim() - 2))
                columns.write(servos, columns.read(servos) * factor.to(servos))
            field = self._fields[name]
            written = mask.view(-1, *[1] * (field.dim() - 1)) & self._weights.get(name, self._rows)
            torch.where(written, servos, field, out=field)


@uses_fields("actuator_forcerange")
class GripForce(Randomized):
    """Draws the largest torque or force of the gripper's servos."""

    def __init__(self, env: EnvView, *, effort: Sequence[float]) -> None:
        """Take the smallest and largest one [N m, N]."""
        self.ends = bounds("effort", effort)
        servos = env.index.ctrl[env.index.n_arm :].tolist()
        self._range = Elements(env, "actuator_forcerange", servos)
        self.columns = [f"{name}_effort" for name in env.cfg.robot.gripper_joints]
        self.nominal = torch.ones(len(servos), dtype=torch.float64, device=env.device)

    @override
    def read(self) -> Tensor:
        return self._range.read()[..., 1]

    @override
    def write(self, mask: Tensor, values: Tensor) -> None:
        self._range.write(mask, torch.stack((-values, values), dim=-1).to(self._range.dtype))


_SIZE_FIELDS = ("geom_size", "geom_aabb", "geom_rbound")


@uses_fields(*_SIZE_FIELDS)
class ObjectSize:
    """Makes each box larger or smaller, by as much along each of its edges. Mass and height stay,
    so that it starts half as much in or over its table, and checks judge the nominal size.
    """

    label = "reset.size"

    def __init__(self, env: EnvView, *, edge: NotNegative) -> None:
        """Take the half-width of the change of an edge's length [m], less than any edge."""
        boxes = [
            n for n, thing in env.cfg.scene.free.items() if thing.shape == "box" and not thing.file
        ]
        if not boxes:
            raise ParameterError("edge", edge, "0, or a scene with a box that moves")
        if edge >= (least := 2.0 * min(min(env.cfg.scene.free[name].half) for name in boxes)):
            raise ParameterError("edge", edge, f"less than {least:g} m, the shortest edge")
        geoms = [env.index.geoms[name][0] for name in boxes]
        self._half = 0.5 * edge
        self._size, self._box, self._bound = (Elements(env, n, geoms) for n in _SIZE_FIELDS)

    def __call__(self, env: EnvView, mask: Tensor) -> None:
        """Write the sizes."""
        count = len(self._size.nominal)
        change = self._half * random_uniform(env, self.label, count).double()
        size = self._size.nominal + change[..., None]
        self._size.write(mask, size.to(self._size.dtype))
        box = self._box.nominal.expand(len(change), *self._box.nominal.shape).clone()
        box.view(len(change), count, 2, 3)[:, :, 1] = size
        self._box.write(mask, box.to(self._box.dtype))
        self._bound.write(mask, size.norm(dim=2).to(self._bound.dtype))


@uses_fields("body_pos")
class BaseHeight:
    """Raises or lowers the arm against its table, as a table's height differs from the drawing."""

    label = "reset.base"

    def __init__(self, env: EnvView, *, z: NotNegative) -> None:
        """Take the half-width [m]."""
        model = env.sim.model
        body = model.body_rootid[model.jnt_bodyid[model.joint(env.cfg.robot.arm_joints[0]).id]]
        if model.body(body).name == WORLD:
            raise MjstackError("the arm's first joint is in the world body", "Leave the term out")
        self._pos = Elements(env, "body_pos", [int(body)])
        self._z = z

    def __call__(self, env: EnvView, mask: Tensor) -> None:
        """Write body_pos."""
        change = self._z * random_uniform(env, self.label, 1).double()
        pos = self._pos.nominal.expand(len(change), -1, -1).clone()
        pos[..., 2] += change
        self._pos.write(mask, pos.to(self._pos.dtype))
