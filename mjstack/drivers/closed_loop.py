"""The closed-loop driver: every world goes through its phases by itself, observes its objects, and
needs no host.
"""

import math

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from mjstack.config.schema import Config
from mjstack.drivers.clockless import ClocklessDriver
from mjstack.drivers.driver import Driver
from mjstack.drivers.feedback import STAY, FeedbackDriver
from mjstack.drivers.open_loop import OpenLoopPlanner, smoothstep
from mjstack.envs import Env
from mjstack.managers.view import EnvView, offers
from mjstack.math import atan2, norm
from mjstack.mdp.geometry import jaw_forces, objects_in_hand, robot

_QUARTER = 0.5 * math.pi
_ROLL_STEP = 0.05  # rad per step
_ALIGN = 0.1  # share of a held object's turn that is left, per step
_OFF = 0.03  # m: so far off the grasp point, a held object is made up for
_REST = 0.2  # s between the last motion and the window of rest after a retry
_DONE = 1e-3  # steps: a phase is over this much before its last step would be


@offers("driver")
class ClosedLoopDriver(FeedbackDriver):
    """Phase, time and targets of every world as tensors; targets from where its objects are.

    A phase moves the grasp point by smoothstep from the last phase's target to its own. Where it
    says ``observe``, its anchor is measured when it begins. A grasp without load on both jaws at
    its end is tried again, from the phase ``retry``, once for each object and if the rest can be
    done in time: such a world then goes faster than the others, at most ``controller.speed_limit``
    times.

    Where the robot has an ``approach_gain``, the gripper tilts at the grasp as it must where the
    object is let go (`CarryTilt`).

    A world that the environment has reset starts over by itself. The `Driver`'s ``error`` and
    ``retries`` are those of the current episode.
    """

    phased = True
    measures = True  # objects, in phases that say so

    @classmethod
    @override
    def chosen(cls, cfg: Config) -> type[Driver]:
        return cls if cfg.controller.clock else ClocklessDriver

    def __init__(self, env: EnvView, nominal: np.ndarray) -> None:
        """Allocate for the environment's worlds; see `FeedbackDriver`."""
        super().__init__(env, nominal, clock=True)
        self._build_timetable()
        self._home_grip = robot(env).home[self._n_arm :].float()

        # Buffers
        self._time = torch.zeros_like(self.error)
        self._rate = torch.zeros_like(self.error)
        self._roll = torch.zeros_like(self.error)
        # Whether the phase was entered to try a grasp once more, and whose has been tried again
        self._again = torch.zeros_like(self.error, dtype=torch.bool)
        self._tried = self._again[:, None].repeat(1, len(self._cfg.scene.objects))
        # Grasp point and gripper at both ends of the phase
        self._from = self.error.new_zeros((env.nworld, 3 + len(self._cfg.robot.gripper_joints)))
        self._to = torch.zeros_like(self._from)
        self._at = torch.zeros_like(self._from)  # what the last command led to

    def command(self) -> Tensor:
        """Commands of the next step, shape ``(nworld, nu)``, float32. The controller's own memory:
        do not write into it.
        """
        fresh = self._env.episode_step == 0
        self._advance(fresh)
        length = self._length[self.phase]
        u = (self._time / length).clamp(max=1.0)
        s = smoothstep(u)[:, None]
        # After an empty grasp straight up, then to where the object is: perhaps beside the jaws.
        up = smoothstep((2.0 * u).clamp(max=1.0))
        over = smoothstep((2.0 * u - 1.0).clamp(min=0.0))
        share = torch.where(self._again[:, None], torch.stack((over, over, up), dim=1), s)
        target = torch.lerp(self._from[:, :3], self._to[:, :3], share)
        start = torch.where(fresh[:, None], self._nominal[self.phase], self._command)
        start[:, self._n_arm :] = torch.lerp(self._from[:, 3:], self._to[:, 3:], s)
        self._at.copy_(torch.cat((target, start[:, self._n_arm :]), dim=1))
        if self._aligns:
            self._turn(start, fresh)
        approach = None
        if self._tilt is not None:
            there = self._aim(self._tilt.place[self.phase])
            approach = self._tilt.desired_approach(start, self.phase, there, fresh)
        command, distance = self._solve(start, target, self.phase, approach)
        command = self._as_read(self._keep_finite(command))
        _put(self.error, self._time >= length - _DONE, torch.maximum(self.error, distance))
        return command

    def _advance(self, fresh: Tensor) -> None:
        """A step later: worlds whose phase is over enter the next one, or retry their grasp."""
        length = self._length[self.phase]
        over = (self._time >= length - _DONE) & (self.phase < len(self.phases) - 1) & ~fresh
        if self._any_until:  # a phase that has met its condition ends where it is
            early = self._has_met() & (self.phase < len(self.phases) - 1) & ~fresh & ~over
            _put(self._to, early, self._at)
            over = over | early
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
        self.retries.masked_fill_(fresh, 0)
        self.error.masked_fill_(fresh, 0)
        self._tried.masked_fill_(fresh[:, None], False)

        self._observe(fresh[:, None] | entering[:, None] & self._observes[phase])
        target = torch.where(self._holds[phase][:, None], self._to[:, :3], self._aim(phase))
        if self._any_align:
            off = (self._to[:, :2] - self._carried_pose()[:, :2]).clamp(-_OFF, _OFF)
            target[:, :2] += off * self._alignment[phase][:, None]
        home = torch.cat((target, self._home_grip.expand(len(target), -1)), dim=1)
        _put(self._from, entering, torch.where(fresh[:, None], home, self._to))
        _put(self._to, entering, torch.cat((target, self._grip[phase]), dim=1))

    def _has_met(self) -> Tensor:
        """Worlds whose phase has met a condition that ends it, ``(nworld,)`` bool."""
        env = self._env
        force = [jaw_forces(env.index, env.sim, name).amin(1) for name in self._cfg.scene.objects]
        pressing = torch.stack(force, dim=1)[self._worlds, self._handled[self.phase]]
        point = self._measure().point
        left = norm(point - self._to[:, :3])
        pressed = pressing >= self._until_force[self.phase]
        return (left <= self._until_within[self.phase]) | pressed

    def _judge_grasp(self, over: Tensor) -> tuple[Tensor, Tensor]:
        """Worlds that retry their grasp, bool, and how fast they go on, each ``(nworld,)``."""
        in_hand = objects_in_hand(self._env.index, self._env.sim)
        grasps = self._grasps[self.phase]
        number = grasps.clamp(min=0)
        empty = over & (grasps >= 0) & ~in_hand[self._worlds, number]
        again = self._retry_to[self.phase]
        time_left = (self.steps - self._rest - self._env.episode_step).clamp(min=1)
        rate = (self._needed[again] / time_left).clamp(min=1.0)
        first = ~self._tried[self._worlds, number] & (again >= 0)
        retry = empty & first & (rate <= self._cfg.controller.speed_limit)
        self._tried |= retry[:, None] & (grasps[:, None] == self._numbers)
        return retry, rate

    def _turn(self, command: Tensor, fresh: Tensor) -> None:
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
        off = yaw - atan2(closing[:, 1], closing[:, 0])
        oblong = self._oblong_anchor[self.phase]
        # Two faces are in question; what has been turned so far counts for its own.
        faces = torch.stack(_nearest_turns(off, oblong))
        upright = (-approach[:, 2]).clamp(min=0.2)
        rolls = self._roll + self._roll_sign * atan2(torch.sin(faces), torch.cos(faces) * upright)
        cost = (rolls - STAY * self._roll).abs()
        cost = cost + oblong * (self._beyond(rolls) + self._detour(rolls, self._roll))
        goal = torch.where(cost[0] <= cost[1], rolls[0], rolls[1])
        step = torch.where(oblong, 1.0, self._cfg.controller.yaw_alignment) * goal - self._roll
        step = step.clamp(-_ROLL_STEP, _ROLL_STEP)
        self._roll += step * self._turns_jaws[self.phase]
        if self._any_align:
            off = yaw - self._carried_pose()[:, 2]
            turns = _nearest_turns(off, self._oblong[self._carried[self.phase]])
            off, back = (self._roll_sign * turn for turn in turns)
            # The farther one where the nearer one is out of range
            cost = off.abs() + self._beyond(self._roll + off)
            off = torch.where(cost <= back.abs() + self._beyond(self._roll + back), off, back)
            off = (_ALIGN * off).clamp(-_ROLL_STEP, _ROLL_STEP)
            self._roll += off * self._turns_held[self.phase]
        command[:, self._roll_column] = column + self._roll

    def _carried_pose(self) -> Tensor:
        """x, y [m] and yaw [rad] of the carried object, shape ``(nworld, 3)``."""
        return self._planar()[self._worlds, self._carried[self.phase]]

    def _build_timetable(self) -> None:
        """Make tensors of when and how the phases follow each other, a row per phase."""
        cfg = self._cfg
        phases = self.phases
        specs = [phase.spec for phase in phases]
        names = [phase.name for phase in phases]
        objects = list(cfg.scene.objects)
        with_faces = [name for name, thing in cfg.scene.objects.items() if thing.has_faces]
        column = self._tensor
        self._length = column(float(phase.stop - phase.start) for phase in phases)
        # From its start to that of the last phase, where the arm rests
        self._needed = column(float(phases[-1].start - phase.start) for phase in phases)
        self._holds = column(phase.target is None for phase in phases)
        self._grasps = column(phase.grasped for phase in phases)
        self._retry_to = column(names.index(s.retry) if s.retry else -1 for s in specs)
        self._turns_jaws = column(
            s.observe and s.gripper == "open" and s.anchor in with_faces for s in specs
        )
        self._oblong_anchor = column(s.anchor in self._long for s in specs)
        self._observes = column(
            [s.observe and name in (s.anchor, s.toward) for name in objects] for s in specs
        )
        self._alignment = column(float(s.align) for s in specs)
        self._any_align = any(s.align for s in specs)
        self._turns_held = column(p.spec.align and objects[p.carried] in with_faces for p in phases)
        self._carried = column(max(phase.carried, 0) for phase in phases)
        self._any_until = any(s.until_force or s.until_within for s in specs)
        self._until_force = column(s.until_force or math.inf for s in specs)
        self._until_within = column(s.until_within or -1.0 for s in specs)
        self._handled = column(max(phase.grasped, phase.carried, 0) for phase in phases)
        self._numbers = torch.arange(len(objects), device=self.phase.device)
        window = 0 if cfg.task.check is None else self._env.check.settle_steps
        self._rest = window + math.ceil(_REST / cfg.timing.step_dt)


def _nearest_turns(off: Tensor, oblong: Tensor) -> tuple[Tensor, Tensor]:
    """The nearest turn after which an angle [rad] is 0, and that to the other side: a box is alike
    every quarter turn, an oblong one every half.
    """
    apart = torch.where(oblong, 2.0 * _QUARTER, _QUARTER)
    nearest = off - apart * torch.round(off / apart)
    return nearest, nearest - torch.copysign(apart, nearest)


def _put(buffer: Tensor, mask: Tensor, values: Tensor) -> None:
    """Write the rows of a ``(nworld,)`` bool mask; the buffer keeps its address."""
    rows = mask if buffer.dim() == 1 else mask[:, None]
    buffer.copy_(torch.where(rows, values, buffer))


def make_expert(env: Env) -> ClosedLoopDriver:
    """Closed-loop driver of an environment built with ``action=joint_absolute``: call ``command()``
    once before every ``env.step``. Worlds may end and start anew whenever they like; each goes
    through its own phases from its own reset on.

    Raises:
        ArgumentError: Its actions are not absolute joint commands, or its worlds have moved on
            since their reset.
        Unreachable: A nominal target is out of the arm's reach.
    """
    return ClosedLoopDriver(env, OpenLoopPlanner(env.cfg).nominal)
