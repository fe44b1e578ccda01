"""Reset terms: they write the start of an episode into the masked worlds, from the model's nominal values each time."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from mjstack.errors import ParameterError
from mjstack.managers.base import EnvView, random_uniform, uses_fields
from mjstack.math import quat_from_yaw
from mjstack.mdp.geometry import named_pose, pose_w, robot
from mjstack.mdp.placement import Placement
from mjstack.scene.index import Columns


def home(env: EnvView, mask: torch.Tensor, *, pose: str = "home") -> None:
    """Puts the robot at its home command, or at ``start``, at rest. Writes qpos, qvel and ctrl."""
    _write_robot(env, mask, named_pose(env, pose).expand(env.nworld, -1))
    env.sim.qvel.masked_fill_(mask[:, None], 0.0)


class JointNoise:
    """Adds uniform noise to the robot's joint positions and commands, within the joints' ranges."""

    label = "reset.joints"  # the manager sets the term's own, so that two of them draw different numbers

    def __init__(self, env: EnvView, *, arm: float, gripper: float = 0.0) -> None:
        """Takes the half-widths.

        Args:
            env: The environment.
            arm: Of the arm's joints [rad].
            gripper: Of the gripper's [rad or m].
        """
        _not_negative("arm", arm)
        _not_negative("gripper", gripper)
        tensors, n_arm = robot(env), env.index.n_arm
        self._width = torch.full_like(tensors.home, gripper)
        self._width[:n_arm] = arm
        both = torch.stack((tensors.range, tensors.ctrl_range))
        self._low, self._high = both[..., 0].amax(0), both[..., 1].amin(0)

    def __call__(self, env: EnvView, mask: torch.Tensor) -> None:
        """Writes qpos and ctrl."""
        noise = random_uniform(env, self.label, self._width.shape[0])
        command = robot(env).ctrl.read(env.sim.ctrl) + self._width * noise
        _write_robot(env, mask, torch.clamp(command, self._low, self._high))


class JitterCubes:
    """Moves each cube a little off the model's own place."""

    label = "reset.cubes"

    def __init__(self, env: EnvView, *, xy: float, yaw: float) -> None:
        """Takes the half-widths.

        Args:
            env: The environment.
            xy: Of x and y [m].
            yaw: Of the rotation about z [rad].
        """
        _not_negative("xy", xy)
        _not_negative("yaw", yaw)
        placement = Placement(env.cfg, env.sim.model, env.index, region=(xy, xy), gap=0.0, pose=env.cfg.robot.home)
        placement.require_all_free("xy", xy)
        self._xy, self._yaw = xy, yaw

    def __call__(self, env: EnvView, mask: torch.Tensor) -> None:
        """Writes qpos."""
        draw = random_uniform(env, self.label, 3 * len(env.index.objects))
        for number, name in enumerate(env.index.objects):
            dx, dy, yaw = draw[:, 3 * number : 3 * number + 3].unbind(1)
            _write_cube(env, mask, name, self._xy * dx, self._xy * dy, self._yaw * yaw)


class RandomizeCubes:
    """Puts each cube anywhere in a region around its place where nothing is in its way.

    Both cubes stay on the table, apart from each other, and clear of the arm at its start, joint noise included. Each world
    draws some candidates and takes the first that fits, so that the number of operations is fixed.
    """

    label = "reset.cubes"

    def __init__(
        self,
        env: EnvView,
        *,
        xy: Sequence[float],
        yaw: float = math.pi,
        gap: float = 0.01,
        candidates: int = 16,
        pose: str = "start",
    ) -> None:
        """Checks that the region has room.

        Args:
            env: The environment.
            xy: Half-widths of the region in x and y [m].
            yaw: Half-width of the rotation about z [rad].
            gap: Free room around a cube, for fingers [m].
            candidates: Draws per cube and world.
            pose: Where the arm is then, ``home`` or ``start``.

        Raises:
            ParameterError: A value is out of range, or the region leaves no free place.
        """
        if len(xy) != 2:
            raise ParameterError("xy", list(xy), "two numbers [m]")
        for name, value in (("xy", xy[0]), ("xy", xy[1]), ("yaw", yaw), ("gap", gap)):
            _not_negative(name, value)
        if candidates < 1:
            raise ParameterError("candidates", candidates, "an integer of at least 1")
        self._yaw, self._candidates = yaw, candidates
        noise = [term.params.get("arm", 0.0) for term in env.cfg.reset.values() if term.func.endswith(".JointNoise")]
        self._placement = Placement(
            env.cfg,
            env.sim.model,
            env.index,
            region=(xy[0], xy[1]),
            gap=gap,
            pose=named_pose(env, pose).tolist(),
            noise=sum(noise),
        )
        self._placement.require_room("xy", list(xy), candidates)
        self._placement.to(env.device, env.sim.qpos.dtype)

    def __call__(self, env: EnvView, mask: torch.Tensor) -> None:
        """Writes qpos."""
        draws = random_uniform(env, self.label, 2 * (2 * self._candidates + 1)).view(env.nworld, 2, -1)
        offsets = self._placement.choose(draws[..., 1:].reshape(env.nworld, 2, self._candidates, 2))
        for number, name in enumerate(env.index.objects):
            dx, dy = offsets[:, number].unbind(1)
            _write_cube(env, mask, name, dx, dy, self._yaw * draws[:, number, 0])


@uses_fields("body_mass", "body_inertia", "body_subtreemass", "body_invweight0", "dof_invweight0")
class CubeMass:
    """Scales each cube's mass and inertia.

    A cube is a body of its own on a free joint, so that what the compiler derives from the mass scales with it, and need
    not be computed anew.
    """

    label = "reset.mass"

    def __init__(self, env: EnvView, *, scale: Sequence[float]) -> None:
        """Takes the smallest and largest factor."""
        self._low, self._high = _bounds("scale", scale)
        bodies = list(env.index.bodies.values())
        dofs = [dof + i for _, dof in env.index.objects.values() for i in range(6)]
        self._columns = {
            "body_mass": _Columns(env, "body_mass", bodies),
            "body_inertia": _Columns(env, "body_inertia", bodies),
            "body_subtreemass": _Columns(env, "body_subtreemass", bodies),
        }
        self._inverse = {
            "body_invweight0": _Columns(env, "body_invweight0", bodies),
            "dof_invweight0": _Columns(env, "dof_invweight0", dofs),
        }

    def __call__(self, env: EnvView, mask: torch.Tensor) -> None:
        """Writes the mass fields."""
        factors = random_uniform(env, self.label, len(env.index.bodies), self._low, self._high)
        for columns in self._columns.values():
            columns.write(mask, factors)
        self._inverse["body_invweight0"].write(mask, 1.0 / factors)
        self._inverse["dof_invweight0"].write(mask, (1.0 / factors).repeat_interleave(6, dim=1))


@uses_fields("geom_friction")
class CubeFriction:
    """Draws the sliding friction of each cube, and of the grip.

    MuJoCo takes the larger coefficient of the two geoms in a contact, or that of the geom with the higher priority. So the
    table, and jaws of the cubes' own priority, get the smallest coefficient, which leaves the cube's draw in force; jaws of
    higher priority (SO-101's) get a draw of their own, the same for both.
    """

    label = "reset.friction"

    def __init__(self, env: EnvView, *, sliding: Sequence[float]) -> None:
        """Takes the smallest and largest coefficient."""
        self._low, self._high = _bounds("sliding", sliding)
        model, device = env.sim.model, env.device
        cubes = list(env.index.geoms.values())
        priority = model.geom_priority[cubes[0][0]]
        bodies = [model.body(name).id for name in env.cfg.robot.jaw_bodies]
        jaws = [g for g in range(model.ngeom) if model.geom_bodyid[g] in bodies]
        above = [g for g in jaws if model.geom_priority[g] > priority]
        level = [model.geom("table").id, *(g for g in jaws if g not in above)]
        self._drawn = [Columns(geoms, device) for geoms in (*cubes, above) if geoms]
        self._lowered = Columns(level, device)
        self._least = torch.tensor(self._low, dtype=env.sim.qpos.dtype, device=device)

    def __call__(self, env: EnvView, mask: torch.Tensor) -> None:
        """Writes geom_friction."""
        sliding = env.sim.fields["geom_friction"][..., 0]
        values = random_uniform(env, self.label, len(self._drawn), self._low, self._high).to(sliding.dtype)
        for number, geoms in enumerate(self._drawn):
            geoms.write_masked(sliding, mask, values[:, number, None])
        self._lowered.write_masked(sliding, mask, self._least)


@uses_fields("actuator_gainprm", "actuator_biasprm")
class ActuatorGains:
    """Scales the stiffness and damping of each of the robot's position servos by one factor per servo."""

    label = "reset.gains"

    def __init__(self, env: EnvView, *, scale: Sequence[float]) -> None:
        """Takes the smallest and largest factor."""
        self._low, self._high = _bounds("scale", scale)
        servos = env.index.ctrl.tolist()
        # A position servo's gain is kp and its bias (0, -kp, -kv): scaling all of them scales both.
        self._columns = [_Columns(env, name, servos) for name in ("actuator_gainprm", "actuator_biasprm")]

    def __call__(self, env: EnvView, mask: torch.Tensor) -> None:
        """Writes gains and biases."""
        factors = random_uniform(env, self.label, len(env.index.ctrl), self._low, self._high)
        for columns in self._columns:
            columns.write(mask, factors)


class _Columns:
    """Some elements of a per-world model field, and the model's own values of them."""

    def __init__(self, env: EnvView, name: str, elements: Sequence[int]) -> None:
        self._view = env.sim.fields[name]
        self._elements = Columns(elements, env.device)
        nominal = torch.from_numpy(getattr(env.sim.model, name)[list(elements)].copy())
        self._nominal = nominal.to(env.device, self._view.dtype)

    def write(self, mask: torch.Tensor, factors: torch.Tensor) -> None:
        """Writes nominal times factor, ``(nworld, elements)``, into the masked worlds."""
        extra = [1] * (self._nominal.dim() - 1)
        value = self._nominal * factors.to(self._view.dtype).view(*factors.shape, *extra)
        self._elements.write_masked(self._view, mask, value)


def _write(view: torch.Tensor, mask: torch.Tensor, value: torch.Tensor) -> None:
    """Writes the masked rows of a ``(nworld, d)`` view."""
    torch.where(mask[:, None], value.to(view.dtype), view, out=view)


def _write_robot(env: EnvView, mask: torch.Tensor, command: torch.Tensor) -> None:
    tensors = robot(env)
    tensors.qpos.write_masked(env.sim.qpos, mask, command)
    tensors.ctrl.write_masked(env.sim.ctrl, mask, command)


def _write_cube(env: EnvView, mask: torch.Tensor, name: str, dx: torch.Tensor, dy: torch.Tensor, yaw: torch.Tensor) -> None:
    """Moves the masked worlds' cube off the place where the simulation's reset has put it."""
    view = pose_w(env, name)
    place = view[:, :3] + torch.stack((dx, dy, torch.zeros_like(dx)), dim=1)
    _write(view, mask, torch.cat((place, quat_from_yaw(yaw)), dim=1))


def _not_negative(name: str, value: float) -> None:
    if not (isinstance(value, int | float) and math.isfinite(value) and value >= 0.0):
        raise ParameterError(name, value, "a number that is not negative")


def _bounds(name: str, values: Sequence[float]) -> tuple[float, float]:
    if len(values) != 2 or not 0.0 < values[0] <= values[1] < math.inf:
        raise ParameterError(name, list(values), "two positive numbers, the smaller one first")
    return float(values[0]), float(values[1])
