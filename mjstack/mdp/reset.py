"""Reset terms: they write the start of an episode into the masked worlds, from the model's nominal
values each time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from mjstack.errors import ParameterError
from mjstack.managers.term import resolve_func
from mjstack.managers.view import EnvView, offers, random_uniform, uses_fields
from mjstack.math import quat_from_yaw
from mjstack.mdp.geometry import named_pose, pose_w, robot
from mjstack.mdp.starts.placement import Placement
from mjstack.mdp.starts.randomization import (
    FRICTION_FIELDS,
    GAIN_FIELDS,
    MASS_FIELDS,
    ObjectMasses,
    ServoGains,
    SlidingFriction,
    bounds,
)
from mjstack.mdp.starts.reach import require_reach


def home(env: EnvView, mask: torch.Tensor, *, pose: str = "home") -> None:
    """Puts the robot at its home command, or at ``start``, at rest. Writes qpos, qvel and ctrl."""
    _write_robot(env, mask, named_pose(env, pose).expand(env.nworld, -1))
    env.sim.qvel.masked_fill_(mask[:, None], 0.0)


@offers(joint_noise=True)
class JointNoise:
    """Adds uniform noise to the robot's joint positions and commands, within the joints' ranges."""

    label = (  # the manager sets the term's own, so that two of them draw different numbers
        "reset.joints"
    )

    def __init__(self, env: EnvView, *, arm: float, gripper: float = 0.0) -> None:
        """Takes the half-widths.

        Args:
            env: The environment.
            arm: Of the arm's joints [rad].
            gripper: Of the gripper's [rad or m].
        """
        _not_negative("arm", arm)
        _not_negative("gripper", gripper)
        tensors = robot(env)
        n_arm = env.index.n_arm
        self._width = torch.full_like(tensors.home, gripper)
        self._width[:n_arm] = arm
        both = torch.stack((tensors.range, tensors.ctrl_range))
        self._low = both[..., 0].amax(0)
        self._high = both[..., 1].amin(0)

    def __call__(self, env: EnvView, mask: torch.Tensor) -> None:
        """Writes qpos and ctrl."""
        noise = random_uniform(env, self.label, self._width.shape[0])
        command = robot(env).ctrl.read(env.sim.ctrl) + self._width * noise
        _write_robot(env, mask, torch.clamp(command, self._low, self._high))


class JitterObjects:
    """Moves each object a little off its nominal position."""

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
        placement = Placement(
            env.cfg, env.sim.model, env.index, region=(xy, xy), gap=0.0, pose=env.cfg.robot.home
        )
        placement.require_all_free("xy", xy)
        self._xy = xy
        self._yaw = yaw

    def __call__(self, env: EnvView, mask: torch.Tensor) -> None:
        """Writes qpos."""
        draw = random_uniform(env, self.label, 3 * len(env.index.objects))
        for number, name in enumerate(env.index.objects):
            dx, dy, yaw = draw[:, 3 * number : 3 * number + 3].unbind(1)
            _write_object(env, mask, name, self._xy * dx, self._xy * dy, self._yaw * yaw)


@offers(places_objects=True)
class RandomizeObjects:
    """Puts each object anywhere in a region around its nominal position where nothing is in its
    way.

    Objects stay on the table, apart from each other, and clear of what is fixed to the world and of
    the arm at its start, joint noise included. Each world draws some candidates and takes the first
    that fit, so that the number of operations is fixed. Regions that the arm does not reach are
    refused.
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
            gap: Free room around an object, for fingers [m].
            candidates: Draws per object and world.
            pose: Where the arm is then, ``home`` or ``start``.

        Raises:
            ParameterError: A value is out of range, the region leaves no free place, or the arm
                does not reach all of it.
        """
        if len(xy) != 2:
            raise ParameterError("xy", list(xy), "two numbers [m]")
        for name, value in (("xy", xy[0]), ("xy", xy[1]), ("yaw", yaw), ("gap", gap)):
            _not_negative(name, value)
        if candidates < 1:
            raise ParameterError("candidates", candidates, "an integer of at least 1")
        self._yaw = yaw
        self._candidates = candidates
        noise = [
            term.params.get("arm", 0.0)
            for term in env.cfg.reset.values()
            if getattr(resolve_func("reset", term.func), "joint_noise", False)
        ]
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
        require_reach(env, "xy", (xy[0], xy[1]))
        self._placement.to(env.device, env.sim.qpos.dtype)

    def __call__(self, env: EnvView, mask: torch.Tensor) -> None:
        """Writes qpos."""
        count = len(env.index.objects)
        draws = random_uniform(env, self.label, count * (2 * self._candidates + 1)).view(
            env.nworld, count, -1
        )
        offsets = self._placement.choose(
            draws[..., 1:].reshape(env.nworld, count, self._candidates, 2)
        )
        for number, name in enumerate(env.index.objects):
            dx, dy = offsets[:, number].unbind(1)
            _write_object(env, mask, name, dx, dy, self._yaw * draws[:, number, 0])


@uses_fields(*MASS_FIELDS)
class ObjectMass:
    """Scales each object's mass and inertia."""

    label = "reset.mass"

    def __init__(self, env: EnvView, *, scale: Sequence[float]) -> None:
        """Takes the smallest and largest factor."""
        self._low, self._high = bounds("scale", scale)
        self._masses = ObjectMasses(env)
        self._nominal = self._masses.nominal.to(env.sim.qpos.dtype)

    def __call__(self, env: EnvView, mask: torch.Tensor) -> None:
        """Writes the mass fields."""
        factors = random_uniform(env, self.label, len(env.index.objects), self._low, self._high)
        self._masses.write(mask, self._nominal * factors)


@uses_fields(*FRICTION_FIELDS)
class ObjectFriction:
    """Draws the sliding friction of each object, and of the grip; see `SlidingFriction`."""

    label = "reset.friction"

    def __init__(self, env: EnvView, *, sliding: Sequence[float]) -> None:
        """Takes the smallest and largest coefficient."""
        self._low, self._high = bounds("sliding", sliding)
        self._friction = SlidingFriction(env, self._low)

    def __call__(self, env: EnvView, mask: torch.Tensor) -> None:
        """Writes geom_friction."""
        self._friction.write(
            mask, random_uniform(env, self.label, len(self._friction.names), self._low, self._high)
        )


@uses_fields(*GAIN_FIELDS)
class ActuatorGains:
    """Scales the stiffness and damping of each of the robot's position servos by one factor per
    servo.
    """

    label = "reset.gains"

    def __init__(self, env: EnvView, *, scale: Sequence[float]) -> None:
        """Takes the smallest and largest factor."""
        self._low, self._high = bounds("scale", scale)
        self._gains = ServoGains(env)

    def __call__(self, env: EnvView, mask: torch.Tensor) -> None:
        """Writes gains and biases."""
        self._gains.write(
            mask, random_uniform(env, self.label, len(env.index.ctrl), self._low, self._high)
        )


def _write(view: torch.Tensor, mask: torch.Tensor, value: torch.Tensor) -> None:
    """Writes the masked rows of a ``(nworld, d)`` view."""
    torch.where(mask[:, None], value.to(view.dtype), view, out=view)


def _write_robot(env: EnvView, mask: torch.Tensor, command: torch.Tensor) -> None:
    tensors = robot(env)
    tensors.qpos.write_masked(env.sim.qpos, mask, command)
    tensors.ctrl.write_masked(env.sim.ctrl, mask, command)


def _write_object(
    env: EnvView,
    mask: torch.Tensor,
    name: str,
    dx: torch.Tensor,
    dy: torch.Tensor,
    yaw: torch.Tensor,
) -> None:
    """Moves the masked worlds' object off the position where the simulation's reset has put it."""
    view = pose_w(env, name)
    place = view[:, :3] + torch.stack((dx, dy, torch.zeros_like(dx)), dim=1)
    # Float64, because a float32 cosine need not be that of any angle, and a file of starts has the
    # angle.
    _write(view, mask, torch.cat((place, quat_from_yaw(yaw.double()).to(place.dtype)), dim=1))


def _not_negative(name: str, value: float) -> None:
    if not (isinstance(value, int | float) and math.isfinite(value) and value >= 0.0):
        raise ParameterError(name, value, "a number that is not negative")
