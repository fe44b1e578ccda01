"""Reset terms: they write starts into masked worlds, from the model's nominal values."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from mjstack.config.fields import NotNegative, Repeats
from mjstack.config.functions import offered
from mjstack.errors import ParameterError, require_names
from mjstack.managers.view import EnvView, offers, random_uniform, uses_fields, zero_rows
from mjstack.math import quat_from_yaw, quat_mul
from mjstack.mdp.geometry import Pose, robot, write_robot, zeros
from mjstack.mdp.starts.placement import GAP, Placement, may_meet, require_reach
from mjstack.mdp.starts.randomization import Elements, Randomized, bounds
from mjstack.robots.jaws import jaw_bodies
from mjstack.scene.index import joint_limits
from mjstack.sim.simulation import Columns


@offers("reset term")
def home(env: EnvView, mask: Tensor, *, pose: Pose = "home") -> None:
    """Put the robot at its home, or at ``start``, at rest. Writes qpos, qvel and ctrl."""
    write_robot(env, mask, getattr(robot(env), pose))
    zero_rows(mask, env.sim.qvel)


@offers("reset term", joint_noise=True)
class JointNoise:
    """Adds uniform noise to the robot's joint positions and targets, within the joints' ranges, and
    as equalities between them allow.
    """

    # The manager sets the term's own label, so that two of them draw different numbers
    label = "reset.joints"

    def __init__(self, env: EnvView, *, arm: NotNegative, gripper: NotNegative = 0.0) -> None:
        """Take the half-widths.

        Args:
            env: The environment.
            arm: Of the arm's joints [rad].
            gripper: Of the gripper's [rad or m].
        """
        self._width = torch.full_like(robot(env).home, gripper)
        self._width[: env.index.n_arm] = arm
        self._moving = self._width.cpu().numpy().nonzero()[0]
        limits = joint_limits(env.sim.model, env.cfg.robot)
        self._low, self._high = (torch.from_numpy(limit).to(self._width) for limit in limits)

    def __call__(self, env: EnvView, mask: Tensor) -> None:
        """Write qpos and ctrl."""
        noise = random_uniform(env, self.label, self._width.shape[0])
        command = robot(env).ctrl.read(env.sim.ctrl) + self._width * noise
        command = torch.clamp(command, self._low, self._high)
        env.index.posture.project(command, self._moving, zeros(env))
        write_robot(env, mask, command)


@uses_fields("qpos0", "jnt_range", "actuator_ctrlrange")
class JointZeros:
    """Moves the zero of every joint by a random amount that no sensor shows, as the calibrations of
    real arms differ. Positions and commands count from the zero that the servo believes in, and the
    arm is elsewhere, with what follows it. Its stops stay where they are. Objects are placed clear
    of where it would be without.
    """

    label = "reset.zeros"

    def __init__(
        self,
        env: EnvView,
        *,
        arm: NotNegative | Sequence[NotNegative],
        gripper: NotNegative = 0.0,
    ) -> None:
        """Take the half-widths: of the arm's joints, one for all or for each, and of the gripper's
        [rad or m].
        """
        count = env.index.n_arm
        if not isinstance(arm, int | float) and len(arm) != count:
            raise ParameterError("arm", arm, f"a number, or {count}, one per joint of the arm")
        self._width = torch.full_like(robot(env).home, gripper, dtype=torch.float64)
        self._width[:count] = self._width.new_tensor(arm)
        self._moving = self._width.cpu().numpy().nonzero()[0]
        model = env.sim.model
        joints = model.actuator_trnid[env.index.ctrl, 0].tolist()
        self._zero = Elements(env, "qpos0", env.index.robot_qpos.tolist())
        self._stops = Elements(env, "jnt_range", joints)
        self._commands = Elements(env, "actuator_ctrlrange", env.index.ctrl.tolist())

    def __call__(self, env: EnvView, mask: Tensor) -> None:
        """Write qpos0, from which MuJoCo counts, both ranges, and qpos and ctrl of what follows."""
        moved = self._width * random_uniform(env, self.label, len(self._width))
        self._zero.write(mask, self._zero.nominal - moved)
        for ends in (self._stops, self._commands):
            ends.write(mask, ends.nominal - moved[..., None])
        if env.index.posture.leader.size:
            command = robot(env).ctrl.read(env.sim.ctrl)
            env.index.posture.project(command, self._moving, zeros(env))
            write_robot(env, mask, command)


@offers("reset term")
class JitterObjects:
    """Moves each object a little off its nominal position."""

    label = "reset.cubes"

    def __init__(self, env: EnvView, *, xy: NotNegative, yaw: NotNegative) -> None:
        """Take the half-widths.

        Args:
            env: The environment.
            xy: Of x and y [m].
            yaw: Of the rotation about z [rad].
        """
        placement = Placement(env, region=(xy, xy), gap=0.0, pose=env.cfg.robot.home)
        placement.require_room(xy, candidates=1)
        self._xy = xy
        self._yaw = yaw
        self._poses = _object_poses(env)

    def __call__(self, env: EnvView, mask: Tensor) -> None:
        """Write qpos."""
        draws = random_uniform(env, self.label, 3 * len(env.index.objects)).unflatten(1, (-1, 3))
        xy, yaw = draws[..., :2], draws[..., 2]
        _write_objects(env, mask, self._poses, self._xy * xy, self._yaw * yaw)


@offers("reset term", places_objects=True)
class RandomizeObjects:
    """Puts each object anywhere in a region around its nominal position where nothing is in its
    way.

    Objects stay on the table, apart from each other, and clear of what is fixed to the world and of
    the arm at its start, joint noise included. Each world draws some candidates and takes the first
    that fit together, so that the number of operations is fixed, and all starts that fit are
    equally likely. Regions that the arm does not reach are refused.
    """

    label = "reset.cubes"

    def __init__(
        self,
        env: EnvView,
        *,
        xy: Sequence[NotNegative],
        yaw: NotNegative = math.pi,
        gap: NotNegative = GAP,
        candidates: Repeats = 16,
    ) -> None:
        """Check that the region has room.

        Args:
            env: The environment.
            xy: Half-widths of the region in x and y [m].
            yaw: Half-width of the rotation about z [rad].
            gap: Free room around an object, for fingers [m].
            candidates: Draws per object and world; four times as many where objects may meet.

        Raises:
            ParameterError: The region leaves no free place, or the arm does not reach all of it.
        """
        region = list(xy)
        if len(region) != 2:
            raise ParameterError("xy", region, "two numbers [m]")
        self._yaw = yaw
        self._poses = _object_poses(env)
        self._candidates = candidates
        # The first draws are the same for every scene; the others follow.
        self._more = 3 * candidates if may_meet(env.cfg.scene, region, gap) else 0
        noisy = [term for term in env.cfg.reset.values() if offered(term.func, "joint_noise")]
        self._placement = Placement(
            env,
            region=region,
            gap=gap,
            pose=robot(env).start.tolist(),
            noise=sum(term.params.get("arm", 0.0) for term in noisy),
        )
        self._placement.require_room(region, candidates + self._more)
        require_reach(env, region)
        self._placement.to(env.device, env.sim.qpos.dtype)

    def __call__(self, env: EnvView, mask: Tensor) -> None:
        """Write qpos."""
        count = len(env.index.objects)
        sizes = (count * (2 * self._candidates + 1), 2 * count * self._more)
        draws = random_uniform(env, self.label, sum(sizes))
        first, more = (part.unflatten(1, (count, -1)) for part in draws.split(sizes, dim=1))
        candidates = torch.cat((first[..., 1:], more), dim=2).unflatten(2, (-1, 2))
        offsets, _ = self._placement.choose(candidates)
        _write_objects(env, mask, self._poses, offsets, self._yaw * first[..., 0])


@offers("reset term")
class FixtureJoints:
    """Puts joints of fixtures anywhere in ranges, at rest."""

    label = "reset.fixtures"

    def __init__(self, env: EnvView, *, joints: Mapping[str, Sequence[float]]) -> None:
        """Take the smallest and largest position of each joint [rad, m], by its name."""
        if not isinstance(joints, Mapping) or not joints:
            raise ParameterError("joints", joints, "a mapping of a fixture's joints to two numbers")
        joints = {str(name): ends for name, ends in joints.items()}  # YAML has numbers too
        require_names("joints: joint of a fixture", joints, env.index.joints)
        model = env.sim.model
        for name, ends in joints.items():
            joint = model.joint(name).id
            span = model.jnt_range[joint] if model.jnt_limited[joint] else (-math.inf, math.inf)
            numbers = isinstance(ends, Sequence) and all(isinstance(e, int | float) for e in ends)
            if not numbers or len(ends) != 2 or not span[0] <= ends[0] <= ends[1] <= span[1]:
                expected = f"two numbers in {span[0]:g} to {span[1]:g}, the smaller one first"
                raise ParameterError(f"joints.{name}", ends, expected)
        places = [env.index.joints[name] for name in joints]
        self._qpos, self._qvel = (Columns(at, env.device) for at in zip(*places, strict=True))
        low, high = env.sim.qpos.new_tensor(list(joints.values())).unbind(1)
        self._middle = 0.5 * (low + high)
        self._half = 0.5 * (high - low)

    def __call__(self, env: EnvView, mask: Tensor) -> None:
        """Write qpos and qvel."""
        draws = random_uniform(env, self.label, len(self._half))
        self._qpos.write_masked(env.sim.qpos, mask, self._middle + self._half * draws)
        self._qvel.write_masked(env.sim.qvel, mask, torch.zeros_like(draws))


@uses_fields("body_mass", "body_inertia", "body_subtreemass", "body_invweight0", "dof_invweight0")
class ObjectMass(Randomized):
    """Scales each object's mass and inertia.

    An object is one body on a free joint, so that what the compiler derives from the mass scales
    with it, and need not be computed anew.
    """

    def __init__(self, env: EnvView, *, scale: Sequence[float]) -> None:
        """Take the smallest and largest factor."""
        self.ends = bounds("scale", scale)
        bodies = [env.index.bodies[name] for name in env.index.objects]
        dofs = [dof + i for _, dof in env.index.objects.values() for i in range(6)]
        self._mass, *self._scaled, self._inverse, self._inverse_dofs = (
            Elements(env, name, dofs if name.startswith("dof") else bodies)
            for name in self.model_fields
        )
        self.columns = [f"{name}_mass_kg" for name in env.index.objects]
        self.nominal = self._mass.nominal

    @override
    def read(self) -> Tensor:
        return self._mass.read()

    @override
    def write(self, mask: Tensor, values: Tensor) -> None:
        mass = values.to(self._mass.dtype)
        factor = mass.double() / self.nominal
        self._mass.write(mask, mass)
        for elements in self._scaled:
            elements.scale(mask, factor)
        self._inverse.scale(mask, 1.0 / factor)
        self._inverse_dofs.scale(mask, (1.0 / factor).repeat_interleave(6, dim=1))


@uses_fields("geom_friction")
class ObjectFriction(Randomized):
    """Draws the sliding friction of each object, and of the grip where the jaws have a coefficient
    that counts.

    MuJoCo takes the larger coefficient of the two geoms in a contact, or that of the geom with the
    higher priority. So the table, and jaws of the objects' priority, get the smallest coefficient,
    which leaves the object's in force. Jaws of higher priority (SO-101's) have one coefficient, the
    same for both.
    """

    def __init__(self, env: EnvView, *, sliding: Sequence[float]) -> None:
        """Take the smallest and largest coefficient."""
        self.ends = bounds("sliding", sliding)
        model = env.sim.model
        bodies = np.concatenate(jaw_bodies(model, env.cfg.robot.jaw_bodies))
        jaws = np.flatnonzero(np.isin(model.geom_bodyid, bodies)).tolist()
        grip = [g for g in jaws if model.geom_priority[g] > 0]  # objects have 0
        level = [model.geom("table").id, *(g for g in jaws if g not in grip)]
        geoms = {name: env.index.geoms[name] for name in env.index.objects}
        if grip:
            geoms["grip"] = grip
        self.columns = [f"{name}_friction" for name in geoms]
        self.nominal = torch.ones(len(geoms), dtype=torch.float64, device=env.device)
        self._view = env.sim.fields["geom_friction"][..., 0]
        self._groups = [Columns(group, env.device) for group in geoms.values()]
        self._lowered = Columns(level, env.device)
        self._least = torch.tensor(self.ends[0], dtype=self._view.dtype, device=env.device)

    @override
    def read(self) -> Tensor:
        return torch.stack([group.read(self._view)[:, 0] for group in self._groups], dim=1)

    @override
    def write(self, mask: Tensor, values: Tensor) -> None:
        values = values.to(self._view.dtype)
        for number, group in enumerate(self._groups):
            group.write_masked(self._view, mask, values[:, number, None])
        self._lowered.write_masked(self._view, mask, self._least)


@uses_fields("actuator_gainprm", "actuator_biasprm")
class ActuatorGains(Randomized):
    """Scales the stiffness and damping of each of the robot's position servos by one factor per
    servo.
    """

    def __init__(self, env: EnvView, *, scale: Sequence[float]) -> None:
        """Take the smallest and largest factor."""
        self.ends = bounds("scale", scale)
        servos = env.index.ctrl.tolist()
        # A position servo's gain is kp and its bias (0, -kp, -kv): scaling all of them scales both.
        self._gain, self._bias = (Elements(env, name, servos) for name in self.model_fields)
        self._kp = self._gain.nominal[:, 0]
        self.columns = [f"gain_{name}" for name in env.cfg.robot.joints]
        self.nominal = torch.ones_like(self._kp)

    @override
    def read(self) -> Tensor:
        return self._gain.read()[..., 0].double() / self._kp

    @override
    def write(self, mask: Tensor, values: Tensor) -> None:
        factor = (values.double() * self._kp).to(self._gain.dtype).double() / self._kp
        self._gain.scale(mask, factor)
        self._bias.scale(mask, factor)


def _object_poses(env: EnvView) -> Columns:
    """Columns of the pose of every object that moves, one after the other."""
    return Columns([qpos + i for qpos in env.index.object_qpos for i in range(7)], env.device)


def _write_objects(env: EnvView, mask: Tensor, poses: Columns, offset: Tensor, yaw: Tensor) -> None:
    """Move every object of the masked worlds off the position where the simulation's reset has put
    it, by x and y [m], shape ``(nworld, objects, 2)``, and turn it [rad], ``(nworld, objects)``.
    """
    now = poses.read(env.sim.qpos).unflatten(1, (-1, 7))
    # In float64, so that the rounded cosine and sine are the same on every backend
    turned = quat_from_yaw(yaw.double()).to(offset.dtype)
    if any(thing.turned != [1.0, 0.0, 0.0, 0.0] for thing in env.cfg.scene.free.values()):
        turned = quat_mul(turned, now[..., 3:])
    value = torch.cat((now[..., :2] + offset, now[..., 2:3], turned), dim=-1).flatten(1)
    poses.write_masked(env.sim.qpos, mask, value)
