"""The closed-loop driver: every world goes through its phases by itself, observes its objects, and
needs no host.
"""

import math

import numpy as np
import torch

from mjstack.config.schema import Config
from mjstack.drivers.driver import Driver, require_joint_targets
from mjstack.drivers.open_loop import OpenLoopPlanner, smoothstep
from mjstack.drivers.tilt import CarryTilt
from mjstack.envs import Env
from mjstack.errors import ArgumentError
from mjstack.kinematics.batched_ik import BatchedIk
from mjstack.managers.view import EnvView
from mjstack.mdp.geometry import objects_in_hand, place_xy, pose_w, robot
from mjstack.scene.phases import Target, build_phases, source_names
from mjstack.tasks.check import make_check

_QUARTER = 0.5 * math.pi
STAY = 0.3  # how much a roll made so far weighs against the face that is nearer
_ROLL_STEP = 0.05  # rad per step
_DONE = 1e-3  # steps: a phase is over this much before its last step would be


class ClosedLoopDriver(Driver):
    """Phase, time and targets of every world as tensors; targets from where its objects are;
    batched inverse kinematics.

    A phase moves the grasp point by smoothstep from the last phase's target to its own. Where it
    says ``observe``, its anchor is measured when it begins. A grasp without load on both jaws at
    its end is tried again, from the phase ``retry``, once for each object and if the rest can be
    done in time: such a world then goes faster than the others, at most ``controller.speed_limit``
    times.

    Where the robot has an ``approach_gain``, the gripper tilts at the grasp as it must where the
    object is let go (`CarryTilt`).

    A world that the environment has reset starts over by itself. The `Driver`'s ``error`` and
    ``retries`` are those of the current episode.

    Attributes:
        unreachable: Whether a target was farther than ``controller.ik_tolerance``, shape
            ``(nworld,)``, bool.
    """

    def __init__(self, env: EnvView, nominal: np.ndarray) -> None:
        """Allocate for the environment's worlds.

        Args:
            env: The environment; its action terms must take absolute joint commands.
            nominal: Commands at the end of each phase of the nominal plan, which redundant joints
                keep close to, shape ``(phases, nu)``.

        Raises:
            MjstackError: The environment takes other actions, or worlds have moved on.
        """
        cfg = env.cfg
        device = env.device

        # The environment
        require_joint_targets(cfg, "absolute joint commands, which the expert gives")
        if bool((env.episode_step != 0).any()):  # it begins where the environment's episodes do
            found = "worlds that have moved on"
            raise ArgumentError("env", found, "worlds at their start", "Call env.reset() before")

        # Plan and inverse kinematics
        phases = build_phases(cfg)
        super().__init__(env.nworld, phases[-1].stop, device, phases)
        self._env = env
        self._cfg = cfg
        self._build_tables(cfg, device)
        c = cfg.controller
        self._ik = BatchedIk(
            env.sim.model,
            cfg.robot,
            env.nworld,
            device,
            iterations=c.step_iterations,
            posture_gain=c.posture_gain,
            approach_gain=c.approach_gain,
            tolerance=c.ik_tolerance,
        )
        self._n_arm = env.index.n_arm
        self._nominal = torch.as_tensor(nominal, dtype=torch.float32, device=device)
        # Where nothing is carried, the gripper points down as far as it can.
        carries = any(phase.grasps is not None for phase in c.phases.values())
        self._tilt = (
            CarryTilt(env.sim.model, cfg, self.phases, self._ik, self._nominal)
            if c.approach_gain > 0.0 and carries
            else None
        )
        self._home_grip = robot(env).home[self._n_arm :].float()

        # Buffers
        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
            return torch.zeros((env.nworld, *shape), dtype=dtype, device=device)

        self._time = zeros()
        self._rate = zeros()
        self.unreachable = zeros(dtype=torch.bool)
        # Whose grasp has been tried again
        self._tried = zeros(len(cfg.scene.objects), dtype=torch.bool)
        self._again = zeros(dtype=torch.bool)  # the phase was entered to try a grasp once more
        self._seen = zeros(len(source_names(cfg.scene)), 3)  # x, y and yaw of objects and places
        # Grasp point and gripper at both ends of the phase
        self._from = zeros(3 + len(cfg.robot.gripper_joints))
        self._to = torch.zeros_like(self._from)
        self._command = zeros(len(cfg.robot.home))
        self._roll = zeros()
        aligns = cfg.controller.yaw_alignment > 0.0
        self._roll_column, self._roll_sign = self._find_roll() if aligns else (0, 1.0)

    def command(self) -> torch.Tensor:
        """Commands of the next step, shape ``(nworld, nu)``, float32. The controller's own memory:
        do not write into it.
        """
        fresh = self._env.episode_step == 0
        self._advance(fresh)
        length = self._length[self.phase]
        u = (self._time / length).clamp(max=1.0)
        s = smoothstep(u)[:, None]
        # After an empty grasp straight up first, and only then to where the object is now: it may
        # stand beside the jaws.
        up = smoothstep((2.0 * u).clamp(max=1.0))
        over = smoothstep((2.0 * u - 1.0).clamp(min=0.0))
        share = torch.where(self._again[:, None], torch.stack((over, over, up), dim=1), s)
        target = torch.lerp(self._from[:, :3], self._to[:, :3], share)
        posture = self._nominal[self.phase]
        start = torch.where(fresh[:, None], posture, self._command)
        start[:, self._n_arm :] = torch.lerp(self._from[:, 3:], self._to[:, 3:], s)
        if self._cfg.controller.yaw_alignment > 0.0:
            self._turn(start, fresh)
        approach = None
        if self._tilt is not None:
            there = self._aim(self._tilt.place[self.phase])
            approach = self._tilt.desired_approach(start, self.phase, there, fresh)
        command, distance = self._ik.solve(
            start, target, posture if self._cfg.controller.posture_gain > 0.0 else None, approach
        )
        # A world whose state is not finite keeps its command, and the check fails it
        self._command.copy_(torch.where(torch.isfinite(command), command, self._command))
        last = self._time >= length - _DONE
        _put(self.error, last, torch.maximum(self.error, distance))
        self.unreachable |= last & ~(distance <= self._cfg.controller.ik_tolerance)
        return self._command

    def _advance(self, fresh: torch.Tensor) -> None:
        """Time goes on by a step; worlds whose phase is over enter the next one, or try their grasp
        again.
        """
        length = self._length[self.phase]
        over = (self._time >= length - _DONE) & (self.phase < len(self.phases) - 1) & ~fresh
        retry, rate = self._judge_grasp(over)
        phase = torch.where(retry, self._retry_to[self.phase], self.phase + over)
        phase.masked_fill_(fresh, 0)
        _put(self._rate, retry, rate)
        self._rate.masked_fill_(fresh, 1.0)
        left_over = (self._time - length).clamp(min=0.0) * over
        entering = over | fresh
        _put(self._time, entering, left_over * ~fresh)
        self._time += self._rate
        self.retries += retry
        _put(self._again, entering, retry)
        self.phase.copy_(phase)
        for buffer in (self.retries, self.error, self.unreachable):
            buffer.masked_fill_(fresh, 0)
        self._tried.masked_fill_(fresh[:, None], False)

        self._observe(entering, fresh)
        holds = self._holds[phase][:, None]
        target = torch.where(holds, self._to[:, :3], self._aim(phase))
        home = torch.cat((target, self._home_grip.expand(len(target), -1)), dim=1)
        _put(self._from, entering, torch.where(fresh[:, None], home, self._to))
        _put(self._to, entering, torch.cat((target, self._grip[phase]), dim=1))

    def _aim(self, phase: torch.Tensor) -> torch.Tensor:
        """Target of each world's phase, from where its anchor was last seen [m], shape ``(nworld,
        3)``.
        """
        table = self._target[phase]
        seen = self._last_seen(self._source, phase)[:, :2]
        offset = table[:, :2]
        if any(spec.toward is not None for spec in self._cfg.controller.phases.values()):
            away = self._last_seen(self._toward, phase)[:, :2] - seen
            angle = torch.atan2(away[:, 1], away[:, 0])
            angle = angle * self._turns[phase]
            along, left = offset.unbind(1)
            cos = torch.cos(angle)
            sin = torch.sin(angle)
            offset = torch.stack((along * cos - left * sin, along * sin + left * cos), dim=1)
        return torch.cat((offset + seen, table[:, 2:]), dim=1)

    def _last_seen(self, sources: torch.Tensor, phase: torch.Tensor) -> torch.Tensor:
        """x, y [m] and yaw [rad] of each world's source of a phase, shape ``(nworld, 3)``."""
        source = sources[phase]
        return self._seen.gather(1, source[:, None, None].expand(-1, 1, 3))[:, 0]

    def _judge_grasp(self, over: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Worlds that try their grasp again, ``(nworld,)`` bool, and how fast they go on,
        ``(nworld,)``.
        """
        held = objects_in_hand(self._env.index, self._env.sim)
        grasps = self._grasps[self.phase]
        number = grasps.clamp(min=0)[:, None]
        empty = over & (grasps >= 0) & ~held.gather(1, number)[:, 0]
        again = self._retry_to[self.phase]
        time_left = (self.steps - self._rest - self._env.episode_step).clamp(min=1)
        rate = (self._needed[again] / time_left).clamp(min=1.0)
        first = ~self._tried.gather(1, number)[:, 0] & (again >= 0)
        retry = empty & first & (rate <= self._cfg.controller.speed_limit)
        self._tried |= retry[:, None] & (grasps[:, None] == self._numbers)
        return retry, rate

    def _turn(self, command: torch.Tensor, fresh: torch.Tensor) -> None:
        """Roll the open jaws towards a face of the object that a phase observes, by a little per
        step.

        A box has a face every quarter turn. A roll about the approach axis turns the closing
        axis less in the horizontal plane than about the axis, the more the gripper is tilted.
        """
        self._roll.masked_fill_(fresh, 0.0)
        column = self._nominal[0, self._roll_column]
        command[:, self._roll_column] = column + self._roll
        _, closing, approach = self._ik.forward(command)
        yaw = self._last_seen(self._source, self.phase)[:, 2]
        off = yaw - torch.atan2(closing[:, 1], closing[:, 0])
        off = off - _QUARTER * torch.round(off / _QUARTER)
        # Two faces are in question, a quarter turn apart; what has been turned so far counts for
        # its own.
        both = torch.stack((off, off - torch.copysign(torch.full_like(off, _QUARTER), off)))
        upright = (-approach[:, 2]).clamp(min=0.2)
        wanted = self._roll + self._roll_sign * torch.atan2(
            torch.sin(both), torch.cos(both) * upright
        )
        cost = (wanted - STAY * self._roll).abs()
        wanted = torch.where(cost[0] <= cost[1], wanted[0], wanted[1])
        step = (self._cfg.controller.yaw_alignment * wanted - self._roll).clamp(
            -_ROLL_STEP, _ROLL_STEP
        )
        self._roll += step * self._aligns[self.phase]
        command[:, self._roll_column] = column + self._roll

    def _find_roll(self) -> tuple[int, float]:
        """Column of the joint that rolls the gripper, and which way it turns the closing axis, seen
        from above.
        """
        column = self._cfg.robot.joints.index(str(self._cfg.robot.roll_joint))
        command = self._nominal[:1].expand(self._env.nworld, -1).clone()
        closing = []
        for turn in (0.0, 0.1):
            command[:, column] += turn
            closing.append(self._ik.forward(command)[1][0].double().cpu())
        (x0, y0, _), (x1, y1, _) = closing
        return column, math.copysign(1.0, float(x0 * y1 - y0 * x1))

    def _observe(self, entering: torch.Tensor, fresh: torch.Tensor) -> None:
        """Measure the objects that the phases which begin observe; everything where an episode
        begins.
        """
        wanted = self._observes[self.phase]
        objects = self._cfg.scene.objects
        for number, name in enumerate(objects):
            pose = pose_w(self._env, name).float()
            w, x, y, z = pose[:, 3:].unbind(1)
            yaw = torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
            seen = torch.cat((pose[:, :2], yaw[:, None]), dim=1)
            _put(self._seen[:, number], fresh | entering & wanted[:, number], seen)
        for number, name in enumerate(self._cfg.scene.places, start=len(objects)):
            self._seen[:, number, :2] = place_xy(self._env, name).float()

    def _build_tables(self, cfg: Config, device: torch.device) -> None:
        """Make tensors of all that the phases say, a row per phase."""
        names = [phase.name for phase in self.phases]
        things = list(cfg.scene.objects)
        rows = []
        for phase in self.phases:
            spec = phase.spec
            target = phase.target or Target(0, -1, (0.0, 0.0), 0.0, 0.0)
            rows.append(
                (
                    float(phase.stop - phase.start),
                    # From its start to that of the last phase, where the arm rests.
                    float(self.phases[-1].start - phase.start),
                    [*target.offset, target.z],
                    cfg.robot.grips[spec.gripper],
                    target.source,
                    max(target.toward, 0),
                    float(target.toward >= 0),
                    phase.target is None,
                    phase.grasped,
                    names.index(spec.retry) if spec.retry else -1,
                    spec.observe and spec.gripper == "open" and spec.anchor in things,
                    [spec.observe and name in (spec.anchor, spec.toward) for name in things],
                )
            )
        (
            self._length,
            self._needed,
            self._target,
            self._grip,
            self._source,
            self._toward,
            self._turns,
            self._holds,
            self._grasps,
            self._retry_to,
            self._aligns,
            self._observes,
        ) = (torch.tensor(column, device=device) for column in zip(*rows, strict=True))
        self._numbers = torch.arange(len(things), device=device)
        window = 0 if cfg.task.check is None else make_check(cfg).settle_steps
        self._rest = window + math.ceil(cfg.controller.rest_seconds / cfg.timing.step_dt)


def _put(buffer: torch.Tensor, mask: torch.Tensor, values: torch.Tensor) -> None:
    """Write the rows of a ``(nworld,)`` bool mask; the buffer keeps its address."""
    rows = mask if buffer.dim() == 1 else mask[:, None]
    buffer.copy_(torch.where(rows, values, buffer))


def make_expert(env: Env) -> ClosedLoopDriver:
    """Closed-loop driver of an environment: call ``command()`` once before every
    ``env.step``.

    Worlds may end and start anew whenever they like; each goes through its own phases from its own
    reset on.

    Args:
        env: The environment, built with ``action=joint_absolute``.

    Raises:
        ArgumentError: Its actions are not absolute joint commands, or its worlds have moved on
            since their reset.
        Unreachable: A nominal target is out of the arm's reach.
    """
    return ClosedLoopDriver(env, OpenLoopPlanner(env.cfg).nominal)
