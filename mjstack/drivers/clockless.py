"""The expert without a clock: it decides from the state alone what is to be done next, so it can be
asked in any state that somebody else has brought about.
"""

import math

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from mjstack.drivers.feedback import State, servo_lag
from mjstack.drivers.moves import find_moves
from mjstack.drivers.servos import ServoInverse
from mjstack.drivers.turning import Due, TurningDriver, directions
from mjstack.managers.view import EnvView
from mjstack.math import norm, quat_to_matrix
from mjstack.mdp.geometry import pose_w, robot

# How fast
_SPEED = 0.5  # m/s, of the grasp point
_CARRY_SPEED = 0.25  # m/s, with an object in the jaws
_PUSH_SPEED = 0.1  # m/s, with one before them
_HASTE = 1.5  # times the mean speed of its phase, along a way that has to be exact
_AHEAD = 0.4  # of a step's way that is led more, for each step by which commands are late
_SLOWING = 0.5  # largest share of the distance that is left, in one step,
_PUSH_SLOWING = 0.4  # and with an object before the jaws
_JOINT = 0.25  # rad, m: largest lead of a joint
_ROLL = 0.1  # rad: largest lead of the roll
_FLIPPED = 0.3  # cosine of the angle between the approach axis and the desired one
_GRIP = 0.3  # largest lead of the gripper, of its opening

# How much farther from the end of a way the grasp point stays for all that is not as it should be
_FUNNEL = 3.0  # m per m off the way
_ROLL_FUNNEL = 0.3  # m per rad between the jaws and a face of the object
_GRIP_FUNNEL = 0.2  # m per share of the opening that lacks
_UP_FIRST = 0.03  # m: so far below its way, the grasp point moves straight up
_HIGH = 0.06  # m: so far from the end, it is still in the phase before
_TURNED = 0.1  # rad: jaws turned by less from a face go down

# Thresholds of the state
_OPEN = 0.85  # share of its opening from which a gripper is open, as measured
_NEAR = 0.004  # m: so near an object, horizontally, open jaws close,
_NEAR_CLOSED = 0.012  # and closed ones do not open again
_DEPTH = 0.013  # m: the same, vertically: fingers may touch the table
_STUCK = 0.010  # m: so much higher above it, where the arm is at a standstill
_STILL = 0.3  # rad/s, m/s: a joint that moves faster is not
_REACH = 0.013  # m: an object whose surface is so near the grasp point is between the jaws
_AT_GOAL = 0.007  # m: so far off the way to its goal, an object is let go of,
_ABOVE = 0.004  # if it is at most so far from the end
_LEFT = 0.08  # m: so near an object that was let go of, the gripper keeps its tilt
_BESIDE = 0.015  # m: so near the way from beside an object to where they push it, jaws push it,
_SHUT = 0.3  # if they are open by no more than this share of their opening
_OFF_CENTER = (0.015, 0.015, 0.010)  # m: so far from the grasp point, an object is made up for


class ClocklessDriver(TurningDriver):
    """Joint targets that are a function of the simulation's state. Objects that the phases move go
    to their goals one after the other, where `EpisodeCheck.placed` and the measured positions do
    not find them there. The phases give the ways: to the object, and on with it. Of those on whose
    way the grasp point is, the last one is due. It stays as far from the end of that way as it is
    off it, the jaws are turned or the gripper is not open, and moves up where it is too low. A held
    object that is off the grasp point is made up for. Where a phase aligns, an object goes on only
    where it is off the way by less than the check tolerates, turned to a face of the anchor, and as
    fast as the phases say.
    An object that no phase lets go of, as in a lift, is kept where the phases bring it last.

    Closed jaws push an object in the same order. Where nothing is moved, as in reach, the grasp
    point goes to the only target of the phases. A check judges it as it judges a policy: it has no
    phases. ``error`` and ``retries`` stay 0.

    Attributes:
        due: Number of the configured phase to whose target the last command led, shape
            ``(nworld,)``, int64.
    """

    stateless = True

    def __init__(self, env: EnvView, nominal: np.ndarray) -> None:
        """Allocate for the environment's worlds; arguments and errors as of `FeedbackDriver`. It is
        also an error if the task has no check, or as of `find_moves`.
        """
        super().__init__(env, nominal)
        cfg = env.cfg
        plan = self._plan
        tensor = self._tensor
        self.due = torch.zeros_like(self.phase)
        self._check = env.check
        # The moves: objects, their columns of `EpisodeCheck.placed`, and phases
        self._moves = moves = find_moves(cfg, plan)
        things = list(cfg.scene.objects)
        judged = self._check.objects
        self._judged = tensor(1 + judged.index(m.name) if m.name in judged else 0 for m in moves)
        self._moved = tensor(things.index(m.name) for m in moves)
        self._grasps = tensor(m.way == "grasp" for m in moves)
        self._pushed = [k for k, m in enumerate(moves) if m.way == "push"]
        self._pushes = tensor(m.way == "push" for m in moves)
        self._close = tensor(m.close for m in moves)
        self._open = tensor(m.open for m in moves)
        self._retreat = tensor(m.retreat for m in moves)
        self._down = tensor(m.reach[-1] for m in moves)
        self._place = tensor(m.carry[-1] for m in moves)
        longest = max(2, *(len(way) for m in moves for way in (m.reach, m.carry)))
        ways = ([m.reach for m in moves], [m.carry for m in moves])
        self._ways = tensor([[w[:1] * (longest - len(w)) + w for w in kind] for kind in ways])
        self._top = tensor(max(self._aimed[k][1].z for k in m.lifts) for m in moves)
        opened = tensor(phase.spec.gripper == "open" for phase in plan)
        self._leaves = self._open != self._place
        self._lets_go = opened[self._open]
        self._wide = opened[self._down]
        size = tensor(max(cfg.scene.objects[m.name].half) + _REACH for m in moves)
        self._reach = size + norm(self._target[self._down, :2]) * self._pushes

        # How exactly an object goes: as its check asks where phases align
        self._exact = tensor(any(plan[k].spec.align for k in m.carry) for m in moves)
        half = tensor(min(cfg.scene.objects[m.name].half[:2]) for m in moves)
        self._half = half * self._has_faces[self._moved]
        self._align = tensor(phase.spec.align for phase in plan)
        self._slack = torch.where(self._align, self._check.tolerance, _AT_GOAL)
        self._seconds = tensor(phase.spec.seconds for phase in plan)

        # Heights of targets: over an object that is not carried, wherever it is, or over the table
        self._above = tensor(target.above for _, target in self._aimed)
        self._follows = tensor(
            phase.spec.level != "table" and phase.carried != target.source < len(things)
            for phase, target in self._aimed
        )
        self._off_center = tensor(_OFF_CENTER)
        self._phase_numbers = torch.arange(len(plan), device=env.device).expand(env.nworld, -1)
        self._order = torch.arange(1, longest + 1, device=env.device)

        # The robot
        aligned = cfg.robot.roll_joint if self._aligns else None
        locked = cfg.robot.locked.items()
        self._locked = [(cfg.robot.joints.index(k), v) for k, v in locked if k != aligned]
        tensors = robot(env)
        self._grip_lead = _GRIP * (tensors.gripper_open - tensors.gripper_closed).abs().float()
        actuators = env.index.ctrl[: self._n_arm].tolist()
        # A servo that lags has to be led by more than it is to move in a step.
        lag = servo_lag(env.sim.model, actuators)
        self._lead = 1.0 / (1.0 - math.exp(-cfg.timing.step_dt / lag))
        self._servos = ServoInverse(env)
        # Measured servos differ, stick and have backlash: each is led by its own figures.
        differ = cfg.robot.backlash > 0.0 or "dof_frictionloss" in env.sim.fields
        self._measured = bool(cfg.robot.servos) or differ
        self._lead = 1.0 if self._measured else self._lead
        self._pace = torch.ones_like(self.error)
        self._always = torch.ones_like(self._seen[:, : len(things), 0], dtype=torch.bool)

    @override
    def command(self) -> Tensor:
        self._observe(self._always)
        self._pace = 1.0 + _AHEAD * self._env.command_delay.steps
        state = self._measure()
        points = self._points(state)
        due = self._decide(state, points)
        target, phase, turn = self._lead_point(state, points, due)
        self.due.copy_(phase)

        # The arm, from where it is
        q = state.q
        start = q.clone()
        for column, value in self._locked:
            start[:, column] = value
        if self._aligns:
            most = _ROLL * self._pace
            start[:, self._roll_column] += turn.clamp(-most, most)
        approach = None if self._tilt is None else self._tilted(state, due, phase)
        if approach is not None:
            # From a gripper that points elsewhere, the shortest way may end at a joint's limit.
            flipped = (state.approach * approach).sum(1, keepdim=True) < _FLIPPED
            roll = start[:, self._roll_column].clone()
            start = torch.where(flipped, self._nominal[phase], start)
            start[:, self._roll_column] = roll
        change = self._solve(start, target, phase, approach)[0] - q
        if self._measured:
            change = self._servos.lead(change, state, holds=due.closes)
        largest = change.abs().amax(1, keepdim=True)
        command = q + change * (_JOINT / largest.clamp(min=1e-6)).clamp(max=1.0)
        if not self._measured:
            command[:, : self._n_arm] += self._servos.sag(state)[:, : self._n_arm]

        # The gripper
        now = q[:, self._n_arm :]
        most = self._pace[:, None] * self._grip_lead
        grip = (self._grip[phase] - now).clamp(-most, most)
        command[:, self._n_arm :] = now + grip
        return self._as_read(self._keep_finite(command))

    def _decide(self, state: State, points: Tensor) -> Due:
        """The next thing to do in every world."""
        # The first object that is not done
        pos = state.pos.index_select(1, self._moved)
        offsets = self._grasp_offsets(pos, points)
        delivered, grasped, between = self._find_delivered(state, points, pos, offsets)
        letting_go = delivered & between & (state.opening < _OPEN)[:, None] & self._lets_go
        done = delivered & ~letting_go
        number = done.long().cumprod(1).sum(1)
        over = number == done.shape[1]
        number = number.clamp(max=done.shape[1] - 1)
        thing = self._moved[number]
        grasped = grasped[self._worlds, number] & ~over
        letting_go = letting_go[self._worlds, number] & ~over

        # What is to be done with it
        in_jaws = state.in_hand[self._worlds, thing]
        foreign = (state.in_hand.sum(1) > in_jaws) & ~grasped & ~letting_go & ~over
        offset = state.point - points[self._worlds, self._close[number]]
        near = _NEAR_CLOSED + (_NEAR - _NEAR_CLOSED) * state.opening.clamp(0.0, 1.0)
        stuck = _STUCK * (1.0 - state.speed / _STILL).clamp(min=0.0)
        high = torch.where(self._exact[number], _ABOVE, _DEPTH + stuck)
        there = (norm(offset[:, :2]) <= near) & (offset[:, 2] >= -_DEPTH) & (offset[:, 2] <= high)
        opens = letting_go | foreign
        return Due(
            number,
            thing,
            offsets[self._worlds, number],
            self._pushes[number],
            grasped,
            led=grasped | opens,
            closes=there & ~grasped & ~opens & ~over,
            opens=opens,
            over=over,
            beside=(done & (norm(state.point[:, None] - pos) <= _LEFT)).any(1),
        )

    def _find_delivered(
        self, state: State, points: Tensor, pos: Tensor, offsets: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Whether each object is where it is let go of, is grasped or being pushed, and is between
        or before the jaws, each ``(nworld, objects)``, bool.
        """
        between = norm(state.point[:, None] - pos) <= self._reach
        grasped = state.in_hand.index_select(1, self._moved) & between & self._grasps
        for k in self._pushed:
            # On the way from beside it to where they push it, closed jaws push it.
            off = state.point - pos[:, k] - offsets[:, k]
            way = (points[:, self._moves[k].reach[-1]] - pos[:, k] - offsets[:, k])[:, :2]
            share = (off[:, :2] * way).sum(1) / way.square().sum(1).clamp(min=1e-9)
            miss = off[:, :2] - share.clamp(0.0, 1.0)[:, None] * way
            between[:, k] = (norm(miss) <= _BESIDE) & (off[:, 2] <= _BESIDE)
            grasped[:, k] = between[:, k] & (state.opening <= _SHUT)
        placed = self._env.state.value(self._check.placed)
        unknown = torch.zeros_like(placed[:, :1])  # of an object that the check does not judge
        placed = torch.cat((unknown, placed), dim=1).index_select(1, self._judged)
        ends = points[:, self._place]
        left = ends - pos - offsets
        way, _ = directions(points[:, self._ways[1, :, -2]], ends)
        along = (left * way).sum(-1)
        across = norm(left - along[..., None] * way)
        there = (across <= self._slack[self._place]) & (along <= _ABOVE)
        return (there | placed & ~grasped) & self._leaves, grasped, between

    def _lead_point(self, state: State, points: Tensor, due: Due) -> tuple[Tensor, Tensor, Tensor]:
        """Where the grasp point is led [m], ``(nworld, 3)``, the phase, and how far the jaws are to
        roll [rad], each ``(nworld,)``.
        """
        point = state.point
        worlds = self._worlds
        thing = state.pos[worlds, due.object]
        pushing = due.grasped & due.pushes

        # The object in the jaws is what arrives
        off = point - thing - due.offset
        touches = 1.0 - norm(off[:, :2]) / _BESIDE
        far = norm(point - thing) > self._reach.amax()
        off = torch.minimum(torch.maximum(off, -self._off_center), self._off_center)
        off[:, 2] *= ~due.pushes  # fingers of any height push
        at = point - off * (due.led & ~pushing)[:, None]

        # The ways, of which the first one begins over its end: objects are lifted, others passed
        ways = self._ways[due.grasped.long(), due.move]
        ways = torch.where(due.over[:, None], self._retreat[-1], ways)
        ends = points[worlds[:, None], ways]
        clear = torch.where(
            (due.move > 0) & ~due.over, points[:, self._moves[0].retreat, 2], -math.inf
        )
        first = ends[:, 0].clone()
        first[:, 2].clamp_(min=torch.where(due.grasped, self._top[due.move], clear))
        begins = torch.cat((first[:, None], ends[:, :-1]), dim=1)
        way, length = directions(begins, ends)

        # How far the jaws, or the object in them, have to turn
        aligns = self._align[ways] & due.grasped[:, None]
        turn = self._turn_left(state, due, aligns[:, -1], ways[:, -1])

        # How far from the end of each it stays, and the last one that it is on
        left = ends - at[:, None]
        across = norm(left - (left * way).sum(-1, keepdim=True) * way)
        across = across + (self._half[due.move] * turn.abs())[:, None] * aligns
        slack = torch.where(aligns, 0.5 * self._slack[ways], _NEAR)
        funnel = torch.where(aligns, (length / slack).clamp(min=_FUNNEL), _FUNNEL)
        lack = torch.where(self._wide[due.move], _OPEN - state.opening, state.opening - 1.0 + _OPEN)
        ready = _ROLL_FUNNEL * (turn.abs() - _TURNED).clamp(min=0.0)
        ready = (ready + _GRIP_FUNNEL * lack.clamp(min=0.0)) * ~(due.led | due.over)
        stay = funnel * (across - slack).clamp(min=0.0) + ready[:, None]
        number = ((stay < length) * self._order).amax(1)
        on = number > 0
        number = (number - 1).clamp(min=0)
        stay = stay[worlds, number]
        way = way[worlds, number]
        goal = torch.where(on[:, None], ends[worlds, number] - stay[:, None] * way, first)

        # Where jaws close, let go, or push: to the object first
        goal = torch.where(due.closes[:, None], points[worlds, self._close[due.move]], goal)
        goal = torch.where((due.opens | due.led & far)[:, None], at, goal)
        push = torch.lerp(thing + due.offset, goal + off, touches.clamp(min=0.0)[:, None])
        goal = torch.where(pushing[:, None], push, goal)

        # How far in this step; along an exact way as its phase
        move = goal - at
        phase = ways[worlds, number]
        dt = self._cfg.timing.step_dt
        most = _HASTE * length[worlds, number] / self._seconds[phase] * (dt / _SLOWING)
        along = (move * way).sum(1)
        exact = self._exact[due.move] & on & ~due.over & ~due.closes
        move -= ((along - along.clamp(-most, most)) * exact)[:, None] * way
        move[:, :2] *= 1.0 - (move[:, 2:] / _UP_FIRST - 0.33).clamp(0.0, 1.0)
        distance = norm(move)
        speed = torch.where(due.pushes, _PUSH_SPEED, _CARRY_SPEED)
        speed = torch.where(due.grasped, speed, _SPEED) * dt * self._pace
        slowing = torch.where(pushing, _PUSH_SLOWING, _SLOWING)
        lead = self._lead * torch.minimum(speed, slowing * distance)
        # Fingers that touch the table are not pressed onto it.
        lead = torch.where(due.closes, distance.clamp(max=_DEPTH), lead)
        target = point + move * (lead / distance.clamp(min=1e-6))[:, None]
        target[:, 2] = torch.where(pushing, goal[:, 2], target[:, 2])  # a slow arm must not sink

        # The phase: the one before, where the way is still long
        before = ways[worlds, (number - 1).clamp(min=0)]
        phase = torch.where(on & (stay > _HIGH), before, phase)
        phase = torch.where(due.closes, self._close[due.move], phase)
        phase = torch.where(due.opens, self._open[due.move], phase)
        rolls = aligns[:, -1] | ~(due.led | due.closes | due.over) | due.pushes
        return target, phase, turn * rolls

    def _tilted(self, state: State, due: Due, phase: Tensor) -> Tensor:
        """Desired approach axis, shape ``(nworld, 3)``: as the object's goal needs it; with the
        object in the jaws, the one with which it is upright; beside one that was let go of, as it
        is.
        """
        assert self._tilt is not None
        tilt = self._tilt.release_approach(state.q, phase, self._aim(self._tilt.place[phase]))
        stays = due.beside & ~due.led | due.closes
        tilt = torch.where(stays[:, None], state.approach, tilt)

        # Turned in the arm's vertical plane, by as much as the object's most upright axis
        names = self._cfg.scene.objects
        quat = torch.stack([pose_w(self._env, name)[:, 3:] for name in names], dim=1)
        axes = quat_to_matrix(quat.float()[self._worlds, due.object])
        up = axes[self._worlds, :, axes[:, 2].abs().argmax(1)]
        out = (state.point - self._env.sim.xpos[:, self._base[0]].float())[:, :2]
        x, y = (out / norm(out).clamp(min=1e-6)[:, None]).unbind(1)
        sin = -(up[:, 0] * x + up[:, 1] * y) * torch.sign(up[:, 2])
        cos = (1.0 - sin.square()).clamp(min=0.0).sqrt()
        normal = torch.stack((-y, x, torch.zeros_like(x)), dim=1)
        upright = torch.linalg.cross(normal, state.approach) * sin[:, None]
        upright += state.approach * cos[:, None]
        return torch.where(due.led[:, None], upright, tilt)

    def _points(self, state: State) -> Tensor:
        """Target of every phase, from where its anchor is [m], shape ``(nworld, phases, 3)``."""
        points = self._aim(self._phase_numbers)
        source = self._source.clamp(max=state.pos.shape[1] - 1)
        height = state.pos[:, source, 2] + self._above
        points[..., 2] = torch.where(self._follows, height, points[..., 2])
        return points

    def _grasp_offsets(self, pos: Tensor, points: Tensor) -> Tensor:
        """From each moved object's centre to the grasp point that grasps it, or pushes it to its
        goal, by the phases [m], shape ``(nworld, objects, 3)``.
        """
        offsets = torch.zeros_like(pos)
        offsets[..., 2] = self._above[self._close]
        for k in self._pushed:
            place = self._moves[k].carry[-1]
            offsets[:, k] = points[:, place]
            offsets[:, k, :2] -= self._seen[:, self._aimed[place][1].source, :2]
            offsets[:, k, 2] -= pos[:, k, 2]
        return offsets
