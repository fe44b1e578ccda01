"""The state-based expert: it decides from the state alone what is to be done next, so it can be
asked in any state that somebody else has brought about.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from mjstack.drivers.feedback import STAY, FeedbackDriver, ServoInverse, State, servo_lag
from mjstack.drivers.roles import Role, find_roles
from mjstack.managers.view import EnvView, offers
from mjstack.math import atan2, norm, quat_to_matrix
from mjstack.mdp.geometry import pose_w, robot

# How fast
_SPEED = 0.5  # m/s, of the grasp point
_CARRY_SPEED = 0.25  # m/s, with an object in the jaws
_PUSH_SPEED = 0.1  # m/s, with one before them
_AHEAD = 0.4  # of a step's way that is led more, for each step by which commands are late
_SLOWING = 0.5  # largest share of the distance that is left, in one step,
_PUSH_SLOWING = 0.4  # and with an object before the jaws
_JOINT = 0.25  # rad, m: largest lead of a joint
_ROLL = 0.1  # rad: largest lead of the roll
_UPRIGHT = 1e-3  # horizontal part of an approach axis that points straight down
_FLIPPED = 0.3  # cosine of the angle between the approach axis and the desired one
_GRIP = 0.3  # largest lead of the gripper, of its opening

# The way to a target: how much higher the grasp point stays for all that is not as it should be
_FUNNEL = 3.0  # m per m of horizontal distance
_ROLL_FUNNEL = 0.3  # m per rad between the jaws and a face of the object
_GRIP_FUNNEL = 0.2  # m per share of the opening that lacks
_UP_FIRST = 0.03  # m: so far below its way, the grasp point moves straight up
_HIGH = 0.06  # m: so far over its target, the grasp point is still in the phase before
_TURNED = 0.1  # rad: jaws turned by less from a face go down

# Thresholds of the state
_OPEN = 0.85  # share of its opening from which a gripper is open, as measured
_NEAR = 0.004  # m: so near an object, horizontally, open jaws close,
_NEAR_CLOSED = 0.012  # and closed ones do not open again
_DEPTH = 0.013  # m: the same, vertically: fingers may touch the table
_STUCK = 0.010  # m: so much higher above it, where the arm is at a standstill
_STILL = 0.3  # rad/s, m/s: a joint that moves faster is not
_REACH = 0.013  # m: an object whose surface is so near the grasp point is between the jaws
_AT_GOAL = 0.007  # m: horizontally so near its goal, an object is let go of,
_ABOVE = 0.004  # if it is at most this much higher than the phases let go of it
_LEFT = 0.08  # m: so near an object that was let go of, the gripper keeps its tilt
_BESIDE = 0.015  # m: so near the way from beside an object to where they push it, jaws push it,
_SHUT = 0.3  # if they are open by no more than this share of their opening
_OFF_CENTER = (0.015, 0.015, 0.010)  # m: so far from the grasp point, an object is made up for


class _Due(NamedTuple):
    """The next thing to do: the role, the phases of the object's roles, the object's number,
    from its centre to the grasp point that moves it, whether the jaws are to push it, whether it
    is grasped or being pushed, whether the grasp point is led along with it, whether the way is a
    funnel, how far the roll is off, and whether objects were let go of before, and the gripper is
    still beside one.
    """

    role: Tensor
    phases: Tensor
    object: Tensor
    offset: Tensor
    pushes: Tensor
    grasped: Tensor
    led: Tensor
    funnel: Tensor
    turn: Tensor
    later: Tensor
    beside: Tensor


@offers("driver")
class StateBasedDriver(FeedbackDriver):
    """Joint targets that are a function of the simulation's state: no clock, no memory.

    The objects that the phases grasp go to their goals one after the other, as far as
    `EpisodeCheck.placed` and the measured positions do not find them there. The configured phases
    say where the grasp point goes: over the object, down, close, up and over its goal, down, open,
    up. The state says which of these is due in each world. The grasp point stays as high above a
    target as it is away from it horizontally, the jaws are turned or the gripper is not open, and
    moves straight up where it is too low. A held object that is off the grasp point is made up
    for. One that no phase lets go of, as in a lift, is kept where the phases bring it last.

    Closed jaws push an object in the same order: over the place beside it, down, to the object
    and with it to its goal, open, up. Where nothing is moved, as in reach, the grasp point goes to
    the only target of the phases.

    A check judges it as it judges a policy: it has no phases. ``error`` and ``retries`` stay 0.

    Attributes:
        due: Number of the configured phase to whose target the last command led, shape
            ``(nworld,)``, int64.
    """

    stateless = True

    def __init__(self, env: EnvView, nominal: np.ndarray) -> None:
        """Allocate for the environment's worlds; arguments and errors as of `FeedbackDriver`. It is
        also an error if the task has no check, or as of `find_roles`.
        """
        super().__init__(env, nominal, clock=False)
        cfg = env.cfg
        device = env.device
        plan = self._plan
        self.due = torch.zeros_like(self.phase)

        # The task: objects, the phases that move each, and its column of `EpisodeCheck.placed`
        self._check = env.check
        moved = find_roles(cfg, plan)
        things = list(cfg.scene.objects)
        judged = self._check.objects
        tensor = self._tensor
        columns = [1 + judged.index(r.name) if r.name in judged else 0 for r in moved]
        self._judged = tensor(columns)
        self._moved = tensor(things.index(r.name) for r in moved)
        self._grasps = tensor(r.way == "grasp" for r in moved)
        self._pushed = [k for k, r in enumerate(moved) if r.way == "push"]
        self._pushes = tensor(r.way == "push" for r in moved)
        self._opened = tensor(phase.spec.gripper == "open" for phase in plan)
        self._roles = tensor(r.phases for r in moved)
        self._leaves = self._roles[:, Role.open] != self._roles[:, Role.place]
        self._lets_go = self._opened[self._roles[:, Role.open]]
        size = tensor(max(cfg.scene.objects[r.name].half) + _REACH for r in moved)
        beside = norm(self._target[self._roles[:, Role.down], :2])
        self._reach = size + beside * self._pushes

        # Heights of targets: over an object that is not carried, wherever it is, or over the table
        self._above = tensor(target.above for _, target in self._aimed)
        self._follows = tensor(
            phase.spec.level != "table" and phase.carried != target.source < len(things)
            for phase, target in self._aimed
        )
        self._off_center = tensor(_OFF_CENTER)

        # The robot
        aligned = cfg.robot.roll_joint if self._aligns else None
        locked = cfg.robot.locked.items()
        self._locked = [(cfg.robot.joints.index(k), v) for k, v in locked if k != aligned]
        tensors = robot(env)
        self._quarters = 0.5 * math.pi * torch.arange(4, device=device)[:, None]
        self._grip_lead = _GRIP * (tensors.gripper_open - tensors.gripper_closed).abs().float()
        lag = servo_lag(env.sim.model, env.index.ctrl[: self._n_arm].tolist())
        # A servo that lags has to be led by more than it is to move in a step.
        self._lead = 1.0 / (1.0 - math.exp(-cfg.timing.step_dt / lag))
        self._servos: ServoInverse | None = None
        if cfg.robot.servos or cfg.robot.backlash or "dof_frictionloss" in env.sim.fields:
            self._servos = ServoInverse(env)
            self._lead = 1.0
        self._pace = torch.ones_like(self.error)
        self._always = torch.ones((env.nworld, len(things)), dtype=torch.bool, device=device)

    @override
    def command(self) -> Tensor:
        self._observe(self._always)
        self._pace = 1.0 + _AHEAD * self._env.command_delay.steps
        state = self._measure()
        due = self._decide(state)
        target, phase = self._lead_point(state, due)
        self.due.copy_(phase)

        # The arm, from where it is
        q = state.q
        start = q.clone()
        for column, value in self._locked:
            start[:, column] = value
        if self._aligns:
            rolls = (due.role == Role.down) | due.pushes
            most = _ROLL * self._pace
            start[:, self._roll_column] += due.turn.clamp(-most, most) * rolls
        approach = None if self._tilt is None else self._tilted(state, due, phase)
        if approach is not None:
            # From a gripper that points elsewhere, the shortest way may end at a joint's limit.
            flipped = (state.approach * approach).sum(1, keepdim=True) < _FLIPPED
            roll = start[:, self._roll_column].clone()
            start = torch.where(flipped, self._nominal[phase], start)
            start[:, self._roll_column] = roll
        change = self._solve(start, target, phase, approach)[0] - q
        if self._servos is not None:
            change = self._servos.lead(change, state, holds=due.role == Role.close)
        largest = change.abs().amax(1, keepdim=True)
        command = q + change * (_JOINT / largest.clamp(min=1e-6)).clamp(max=1.0)

        # The gripper
        now = q[:, self._n_arm :]
        most = self._pace[:, None] * self._grip_lead
        grip = (self._grip[phase] - now).clamp(-most, most)
        command[:, self._n_arm :] = now + grip
        return self._as_read(self._keep_finite(command))

    def _decide(self, state: State) -> _Due:
        """The next thing to do in every world."""
        # The first object that is not done
        offsets = self._grasp_offsets(state)
        delivered, grasped, between = self._find_delivered(state, offsets)
        letting_go = delivered & between & (state.opening < _OPEN)[:, None] & self._lets_go
        done = delivered & ~letting_go
        number = done.long().cumprod(1).sum(1)
        all_done = number == done.shape[1]
        number = number.clamp(max=done.shape[1] - 1)
        phases = self._roles[number]
        thing = self._moved[number]
        pushes = self._pushes[number]
        grasped = grasped[self._worlds, number] & ~all_done
        letting_go = letting_go[self._worlds, number]

        # Its role
        in_jaws = state.in_hand[self._worlds, thing]
        foreign = (state.in_hand.sum(1) > in_jaws) & ~grasped & ~letting_go
        offset = state.point - self._point(state, phases[:, Role.close])
        near = _NEAR_CLOSED + (_NEAR - _NEAR_CLOSED) * state.opening.clamp(0.0, 1.0)
        there = norm(offset[:, :2]) <= near
        stuck = _STUCK * (1.0 - state.speed / _STILL).clamp(min=0.0)
        there &= (offset[:, 2] >= -_DEPTH) & (offset[:, 2] <= _DEPTH + stuck)
        role = torch.where(there, Role.close, Role.down)
        role.masked_fill_(grasped, Role.place)
        role.masked_fill_(letting_go | foreign, Role.open)
        role.masked_fill_(all_done, Role.retreat)
        return _Due(
            role,
            phases,
            thing,
            offsets[self._worlds, number],
            pushes,
            grasped,
            led=grasped | letting_go | foreign,
            funnel=(role == Role.down) | (role == Role.place) | (role == Role.retreat),
            turn=self._turn_left(state, thing, pushes),
            later=number > 0,
            beside=(done & (self._gap(state) <= _LEFT)).any(1),
        )

    def _find_delivered(self, state: State, offsets: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Whether each object is where it is let go of, is grasped or being pushed, and is between
        or before the jaws, each ``(nworld, objects)``, bool.
        """
        pos = state.pos.index_select(1, self._moved)
        between = self._gap(state) <= self._reach
        grasped = state.in_hand.index_select(1, self._moved) & between & self._grasps
        for k in self._pushed:
            # On the way from beside it to where they push it, closed jaws push it.
            off = state.point - pos[:, k] - offsets[:, k]
            beside = self._point(state, self._roles[k, Role.down].expand(len(pos)))
            way = (beside - pos[:, k] - offsets[:, k])[:, :2]
            share = (off[:, :2] * way).sum(1) / way.square().sum(1).clamp(min=1e-9)
            miss = off[:, :2] - share.clamp(0.0, 1.0)[:, None] * way
            near = norm(miss) <= _BESIDE
            between[:, k] = near & (off[:, 2] <= _BESIDE)
            grasped[:, k] = between[:, k] & (state.opening <= _SHUT)
        placed = self._env.state.value(self._check.placed)
        unknown = torch.zeros_like(placed[:, :1])  # of an object that the check does not judge
        placed = torch.cat((unknown, placed), dim=1).index_select(1, self._judged)
        places = [self._point(state, row[Role.place].expand(len(pos))) for row in self._roles]
        offset = pos - (torch.stack(places, dim=1) - offsets)
        across = norm(offset[..., :2])
        there = (across <= _AT_GOAL) & (offset[..., 2] <= _ABOVE)
        return (there | placed & ~grasped) & self._leaves, grasped, between

    def _lead_point(self, state: State, due: _Due) -> tuple[Tensor, Tensor]:
        """Where the grasp point is led [m], ``(nworld, 3)``, and the phase, ``(nworld,)``."""
        point = state.point

        # Where it goes: an object in the jaws is what arrives, one of another goal is let go here
        phase = due.phases[self._worlds, due.role]
        thing = state.pos[self._worlds, due.object]
        pushing = due.grasped & due.pushes
        off = point - thing - due.offset
        touches = 1.0 - norm(off[:, :2]) / _BESIDE
        far = norm(point - thing) > self._reach.amax()
        off = torch.minimum(torch.maximum(off, -self._off_center), self._off_center)
        off[:, 2] *= ~due.pushes  # fingers of any height push
        end = self._point(state, phase) + off * due.led[:, None]
        end = torch.where((due.led & far)[:, None], point, end)
        # Jaws that push go to the object first.
        share = torch.where(pushing, touches.clamp(min=0.0), 1.0)
        end = torch.lerp(thing + due.offset, end, share[:, None])

        # How high on the way there
        away = (due.role == Role.retreat) & due.pushes
        before = torch.where(due.grasped, Role.carry, torch.where(away, Role.retreat, Role.over))
        before = due.phases[self._worlds, before]
        clear = self._point(state, self._roles[0, Role.retreat].expand_as(phase))[:, 2]
        most = torch.maximum(self._point(state, before)[:, 2], end[:, 2])
        most = torch.where(due.later & ~due.grasped, torch.maximum(most, clear), most)
        across = norm((end - point)[:, :2])
        higher = _FUNNEL * (across - _NEAR).clamp(min=0.0)
        ready = _ROLL_FUNNEL * (due.turn.abs() - _TURNED).clamp(min=0.0)
        opens = self._opened[due.phases[:, Role.down]]
        lack = torch.where(opens, _OPEN - state.opening, state.opening - (1.0 - _OPEN))
        ready = ready + _GRIP_FUNNEL * lack.clamp(min=0.0)
        higher = higher + ready * (due.role == Role.down)
        way = torch.minimum(end[:, 2] + higher * due.funnel, most)
        level = 1.0 - ((way - point[:, 2]) / _UP_FIRST - 0.33).clamp(0.0, 1.0)

        # How far in this step
        move = torch.cat(((end - point)[:, :2] * level[:, None], (way - point[:, 2])[:, None]), 1)
        distance = norm(move)
        slow = torch.where(due.pushes, _PUSH_SPEED, _CARRY_SPEED)
        speed = torch.where(due.grasped, slow, _SPEED) * self._cfg.timing.step_dt * self._pace
        slowing = torch.where(pushing, _PUSH_SLOWING, _SLOWING)
        lead = self._lead * torch.minimum(speed, slowing * distance)
        # Fingers that touch the table are not pressed onto it.
        lead = torch.where(due.role == Role.close, distance.clamp(max=_DEPTH), lead)
        target = point + move * (lead / distance.clamp(min=1e-6))[:, None]
        target[:, 2] = torch.where(pushing, way, target[:, 2])  # a slow arm must not sink
        return target, torch.where(due.funnel & (higher > _HIGH), before, phase)

    def _tilted(self, state: State, due: _Due, phase: Tensor) -> Tensor:
        """Desired approach axis, shape ``(nworld, 3)``: as the object's goal needs it; with the
        object in the jaws, the one with which it is upright; beside one that was let go of, as it
        is.
        """
        assert self._tilt is not None
        tilt = self._tilt.release_approach(state.q, phase, self._aim(self._tilt.place[phase]))
        stays = due.beside & ~due.led | (due.role == Role.close)
        tilt = torch.where(stays[:, None], state.approach, tilt)

        # The turn of the object's axis that points up most, to the vertical, by Rodrigues' formula
        env = self._env
        quat = torch.stack([pose_w(env, name)[:, 3:] for name in self._cfg.scene.objects], dim=1)
        axes = quat_to_matrix(quat.float()[self._worlds, due.object])
        up = axes[self._worlds, :, axes[:, 2].abs().argmax(1)]
        up = up * torch.sign(up[:, 2:])
        x, y, z = up.unbind(1)
        turn = torch.stack((y, -x, torch.zeros_like(x)), dim=1)  # up x vertical
        a = state.approach
        along = (turn * a).sum(1, keepdim=True) / (1.0 + z[:, None])
        upright = a * z[:, None] + torch.linalg.cross(turn, a) + turn * along
        return torch.where(due.led[:, None], upright, tilt)

    def _turn_left(self, state: State, thing: Tensor, pushes: Tensor) -> Tensor:
        """How far the open jaws have to roll to the nearer face of an object [rad], shape
        ``(nworld,)``; where it has no faces or is pushed, to where they are locked.
        """
        if not self._aligns:
            return torch.zeros_like(state.opening)
        roll = state.q[:, self._roll_column] - self._nominal[0, self._roll_column]
        yaw = self._seen[self._worlds, thing, 2]

        # The closing axis at a roll of zero: horizontal. The way from there to a face is the same
        # at any roll. So the face that is chosen is still the nearer one after the next step.
        x, y, z = state.approach.unbind(1)
        level = torch.where(torch.hypot(x, y) > _UPRIGHT, atan2(x, -y), 0.0)
        axis = torch.stack((torch.cos(level), torch.sin(level), torch.zeros_like(z)), dim=1)
        side = torch.linalg.cross(state.approach, axis)
        now = atan2((state.closing * side).sum(1), (state.closing * axis).sum(1))
        faces = (yaw - level) + self._quarters
        there = atan2(-torch.sin(faces), torch.cos(faces) * (-z).clamp(min=0.2))
        change = there - now
        change = -self._roll_sign * atan2(torch.sin(change), torch.cos(change))
        rolls = roll + change
        cost = (rolls - STAY * roll).abs() + self._beyond(rolls)
        oblong = self._oblong[thing]
        cost += oblong * self._detour(rolls, roll)
        cost[1::2].masked_fill_(oblong, math.inf)
        nearest = cost.argmin(0, keepdim=True)
        share = torch.where(oblong, 1.0, self._cfg.controller.yaw_alignment)
        goal = share * rolls.gather(0, nearest)[0]
        return goal * (self._has_faces[thing] & ~pushes) - roll

    def _gap(self, state: State) -> Tensor:
        """Distance of the grasp point from each moved object [m], ``(nworld, objects)``."""
        pos = state.pos.index_select(1, self._moved)
        return norm(state.point[:, None] - pos)

    def _point(self, state: State, phase: Tensor) -> Tensor:
        """Target of each world's phase, from where its anchor is [m], shape ``(nworld, 3)``."""
        aim = self._aim(phase)
        source = self._source[phase].clamp(max=state.pos.shape[1] - 1)
        height = state.pos[self._worlds, source, 2] + self._above[phase]
        z = torch.where(self._follows[phase], height, aim[:, 2])
        return torch.cat((aim[:, :2], z[:, None]), dim=1)

    def _grasp_offsets(self, state: State) -> Tensor:
        """From each moved object's centre to the grasp point that grasps it, or pushes it to its
        goal, by the phases [m], shape ``(nworld, objects, 3)``.
        """
        pos = state.pos.index_select(1, self._moved)
        offsets = torch.zeros_like(pos)
        offsets[..., 2] = self._above[self._roles[:, Role.close]]
        for k in self._pushed:
            place = self._roles[k, Role.place].expand(len(pos))
            offsets[:, k] = self._point(state, place)
            offsets[:, k, :2] -= self._last_seen(self._source, place)[:, :2]
            offsets[:, k, 2] -= pos[:, k, 2]
        return offsets
