"""The expert without a clock: it decides from the state alone what is to be done next, so it can be
asked in any state that somebody else has brought about.
"""

import math
from typing import NamedTuple

import mujoco
import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from mjstack.drivers.feedback import STAY, FeedbackDriver, State, servo_lag
from mjstack.drivers.moves import find_moves
from mjstack.managers.view import EnvView
from mjstack.math import atan2, norm, quat_to_matrix
from mjstack.mdp.geometry import pose_w, robot

# How fast
_SPEED = 0.5  # m/s, of the grasp point
_CARRY_SPEED = 0.25  # m/s, with an object in the jaws
_HASTE = 1.5  # times the mean speed of its phase, at most: pushing, or where a phase aligns
_SLOWING = 0.5  # largest share of the distance that is left, in one step
_JOINT = 0.25  # rad, m: largest lead of a joint
_ROLL = 0.1  # rad: largest lead of the roll
_UPRIGHT = 1e-3  # horizontal part of an approach axis that points straight down
_FLIPPED = 0.3  # cosine of the angle between the approach axis and the desired one
_GRIP = 0.3  # largest lead of the gripper, of its opening

# The way to a target: how much farther back the grasp point stays for all that is not as it should be
_FUNNEL = 3.0  # m per m off the way
_ROLL_FUNNEL = 0.3  # m per rad between the jaws and a face of the object
_GRIP_FUNNEL = 0.2  # m per share of the opening that lacks
_UP_FIRST = 0.03  # m: so far below its way, the grasp point moves straight up
_HIGH = 0.06  # m: so far before its target, the grasp point is still in the phase before
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
_ABOVE = 0.004  # if it is at most so far before the end
_LEFT = 0.08  # m: so near an object that was let go of, the gripper keeps its tilt
_BESIDE = 0.015  # m: so near the way from beside an object to where they push it, jaws push it,
_SHUT = 0.3  # if they are open by no more than this share of their opening
_OFF_CENTER = (0.015, 0.015, 0.010)  # m: so far from the grasp point, an object is made up for


class _Due(NamedTuple):
    """The next thing to do in each world: the number of the move and of its object; from its centre
    to the grasp point that moves it; whether the jaws push, and whether the object is grasped or
    being pushed; whether it is led along with the grasp point; whether jaws close on it, let go of
    it, and whether all is done; how far the roll is off, and whether the gripper is beside an
    object that was let go of.
    """

    move: Tensor
    object: Tensor
    offset: Tensor
    pushes: Tensor
    grasped: Tensor
    led: Tensor
    closes: Tensor
    opens: Tensor
    over: Tensor
    beside: Tensor


class ClocklessDriver(FeedbackDriver):
    """Joint targets that are a function of the simulation's state: no clock, no memory.

    The objects that the phases move go to their goals one after the other, as far as
    `EpisodeCheck.placed` and the measured positions do not find them there. The configured phases
    say where the grasp point goes: over the object, down, close, up and over its goal, down, open,
    up. The state says which of these is due in each world: of the phases that lead somewhere, the
    last one whose way the grasp point is on. It stays as far before the end of a way as it is off
    it, the jaws are turned or the gripper is not open, and moves straight up where it is too low. A
    held object that is off the grasp point is made up for. Where a phase aligns, it goes on once
    the object is on its way as exactly as the task's check asks, at the speed of that phase, and
    turned to a face of the anchor. An object that no phase lets go of, as in a lift, is kept where
    the phases bring it last.

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
        also an error if the task has no check, or as of `find_moves`.
        """
        super().__init__(env, nominal, clock=False)
        cfg = env.cfg
        device = env.device
        plan = self._plan
        self.due = torch.zeros_like(self.phase)

        # The task: objects, the phases that move each, and its column of `EpisodeCheck.placed`
        self._check = env.check
        moves = find_moves(cfg, plan)
        things = list(cfg.scene.objects)
        judged = self._check.objects
        tensor = self._tensor
        self._judged = tensor(1 + judged.index(m.name) if m.name in judged else 0 for m in moves)
        self._moved = tensor(things.index(m.name) for m in moves)
        self._grasps = tensor(m.way == "grasp" for m in moves)
        self._pushed = [k for k, m in enumerate(moves) if m.way == "push"]
        self._pushes = tensor(m.way == "push" for m in moves)
        self._opened = tensor(phase.spec.gripper == "open" for phase in plan)
        self._close, self._open, self._retreat, self._place, self._down = (
            tensor(m)
            for m in zip(
                *((m.close, m.open, m.retreat, m.carry[-1], m.reach[-1]) for m in moves),
                strict=True,
            )
        )
        # The ways: to each object, and on with it, as long as the longest
        longest = max(len(way) for m in moves for way in (m.reach, m.carry))
        ways = [[m.reach for m in moves], [m.carry for m in moves]]
        self._ways = tensor(
            [[way[:1] * (longest - len(way)) + way for way in kind] for kind in ways]
        )
        top = [max(plan[k].target.z for k in m.clear if plan[k].target) for m in moves]
        self._top = tensor(top)
        self._leaves = self._open != self._place
        self._lets_go = self._opened[self._open]
        size = tensor(max(cfg.scene.objects[m.name].half) + _REACH for m in moves)
        beside = norm(self._target[self._down, :2])
        self._reach = size + beside * self._pushes

        # How exactly an object goes: as its check asks where phases align
        half = tensor(min(cfg.scene.objects[m.name].half[:2]) for m in moves)
        self._half = half * self._has_faces[self._moved]
        self._align = tensor(phase.spec.align for phase in plan)
        tolerance = self._check.tolerance
        self._exact = tensor(any(plan[k].spec.align for k in m.carry) for m in moves)
        self._slack = tensor(tolerance if phase.spec.align else _AT_GOAL for phase in plan)
        self._seconds = tensor(phase.spec.seconds for phase in plan)

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
        self._build_gravity()
        self._always = torch.ones((env.nworld, len(things)), dtype=torch.bool, device=device)

    @override
    def command(self) -> Tensor:
        self._observe(self._always)
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
            start[:, self._roll_column] += turn.clamp(-_ROLL, _ROLL)
        approach = None if self._tilt is None else self._tilted(state, due, phase)
        if approach is not None:
            # From a gripper that points elsewhere, the shortest way may end at a joint's limit.
            flipped = (state.approach * approach).sum(1, keepdim=True) < _FLIPPED
            roll = start[:, self._roll_column].clone()
            start = torch.where(flipped, self._nominal[phase], start)
            start[:, self._roll_column] = roll
        change = self._solve(start, target, phase, approach)[0] - q
        largest = change.abs().amax(1, keepdim=True)
        command = q + change * (_JOINT / largest.clamp(min=1e-6)).clamp(max=1.0)
        command[:, : self._n_arm] += self._sag()

        # The gripper
        now = q[:, self._n_arm :]
        grip = (self._grip[phase] - now).clamp(-self._grip_lead, self._grip_lead)
        command[:, self._n_arm :] = now + grip
        return self._keep_finite(command)

    def _decide(self, state: State, points: Tensor) -> _Due:
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

        # What it is
        in_jaws = state.in_hand[self._worlds, thing]
        foreign = (state.in_hand.sum(1) > in_jaws) & ~grasped & ~letting_go & ~over
        offset = state.point - points[self._worlds, self._close[number]]
        near = _NEAR_CLOSED + (_NEAR - _NEAR_CLOSED) * state.opening.clamp(0.0, 1.0)
        there = norm(offset[:, :2]) <= near
        stuck = _STUCK * (1.0 - state.speed / _STILL).clamp(min=0.0)
        deep = torch.where(self._exact[number], _ABOVE, _DEPTH + stuck)
        there &= (offset[:, 2] >= -_DEPTH) & (offset[:, 2] <= deep)
        opens = letting_go | foreign
        return _Due(
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
            way = (points[:, self._down[k]] - pos[:, k] - offsets[:, k])[:, :2]
            share = (off[:, :2] * way).sum(1) / way.square().sum(1).clamp(min=1e-9)
            miss = off[:, :2] - share.clamp(0.0, 1.0)[:, None] * way
            near = norm(miss) <= _BESIDE
            between[:, k] = near & (off[:, 2] <= _BESIDE)
            grasped[:, k] = between[:, k] & (state.opening <= _SHUT)
        placed = self._env.state.value(self._check.placed)
        unknown = torch.zeros_like(placed[:, :1])  # of an object that the check does not judge
        placed = torch.cat((unknown, placed), dim=1).index_select(1, self._judged)
        ends = points[:, self._place]
        before = points[:, self._ways[1, :, -2]] if self._ways.shape[2] > 1 else ends
        before = torch.cat((before[..., :2], torch.maximum(before[..., 2:], ends[..., 2:])), 2)
        way = ends - before
        length = norm(way)[..., None]
        way = way / length.clamp(min=1e-6)
        off = ends - pos - offsets
        along = (off * way).sum(-1)
        across = norm(off - along[..., None] * way)
        there = (across <= self._slack[self._place]) & (along <= _ABOVE)
        return (there | placed & ~grasped) & self._leaves, grasped, between

    def _lead_point(
        self, state: State, points: Tensor, due: _Due
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Where the grasp point is led [m], ``(nworld, 3)``, the phase, ``(nworld,)``, and how far
        the roll is off [rad], ``(nworld,)``.
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
        at = point - off * due.led[:, None]

        # The way, over its beginning at first
        ways = self._ways[due.grasped.long(), due.move]  # (nworld, n)
        ways = torch.where(due.over[:, None], self._retreat[-1:, None], ways)
        ends = points[worlds[:, None], ways]
        clear = points[:, self._retreat[0], 2]
        later = (due.move > 0) & ~due.grasped & ~due.over
        above = torch.where(due.grasped, self._top[due.move], torch.where(later, clear, -math.inf))
        first = ends[:, :1].clone()
        first[:, 0, 2] = torch.maximum(first[:, 0, 2], above)
        begins = torch.cat((first, ends[:, :-1]), dim=1)
        ways_before = torch.cat((ways[:, :1], ways[:, :-1]), dim=1)

        # How far the jaws, or the held object, have to turn
        aligns = self._align[ways[:, -1]] & due.grasped
        turn = self._turn_left(state, due, aligns, ways[:, -1])

        # How far back it stays on each, and the last one that it is on
        way = ends - begins
        length = norm(way)
        way = way / length.clamp(min=1e-6)[..., None]
        left = ends - at[:, None]
        along = (left * way).sum(-1)
        across = norm(left - along[..., None] * way)
        align = self._align[ways] & due.grasped[:, None]
        across = across + (self._half[due.move] * turn.abs())[:, None] * align
        slack = torch.where(align, 0.5 * self._slack[ways], _NEAR)
        funnel = torch.where(align, (length / slack).clamp(min=_FUNNEL), _FUNNEL)
        stay = funnel * (across - slack).clamp(min=0.0)
        ready = _ROLL_FUNNEL * (turn.abs() - _TURNED).clamp(min=0.0)
        wide = self._opened[self._down[due.move]]
        lack = torch.where(wide, _OPEN - state.opening, state.opening - (1.0 - _OPEN))
        ready = ready + _GRIP_FUNNEL * lack.clamp(min=0.0)
        stay = stay + (ready * ~(due.led | due.over))[:, None]
        numbers = torch.arange(1, ways.shape[1] + 1, device=point.device)
        number = ((stay < length) * numbers).amax(1)
        on = number > 0
        number = (number - 1).clamp(min=0)
        end = torch.where(on[:, None], ends[worlds, number], first[:, 0])
        stay = stay[worlds, number] * on
        goal = end - stay[:, None] * way[worlds, number]
        phase = ways[worlds, number]
        before = ways_before[worlds, number]

        # Closing, letting go, pushing
        close = points[worlds, self._close[due.move]]
        goal = torch.where(due.closes[:, None], close, goal)
        goal = torch.where((due.opens | due.led & far)[:, None], at, goal)
        touch = thing + due.offset
        share = torch.where(pushing, touches.clamp(min=0.0), 1.0)
        goal = torch.lerp(torch.where(pushing[:, None], touch, goal), goal, share[:, None])
        if self._pushed:
            at = torch.where(pushing[:, None], point, at)
            goal = torch.where(
                pushing[:, None],
                torch.lerp(touch, end + off, share[:, None]), goal)

        # How far in this step
        move = goal - at
        level = 1.0 - ((move[:, 2:]) / _UP_FIRST - 0.33).clamp(0.0, 1.0)
        move = torch.cat((move[:, :2] * level, move[:, 2:]), dim=1)
        # Where it has to be exact, off the way as fast as ever, and on along it as its phase
        exact = self._exact[due.move] & on & ~due.over & ~due.closes
        own = _HASTE * length[worlds, number] / self._seconds[phase] * self._cfg.timing.step_dt
        ahead = way[worlds, number]
        far_ahead = (move * ahead).sum(1)
        excess = far_ahead - torch.minimum(torch.maximum(far_ahead, -own / _SLOWING), own / _SLOWING)
        move = move - (excess * exact)[:, None] * ahead
        distance = norm(move)
        slow = torch.where(due.pushes, 0.1, _CARRY_SPEED)
        speed = torch.where(due.grasped, slow, _SPEED) * self._cfg.timing.step_dt
        lead = self._lead * torch.minimum(speed, torch.where(pushing, .4, _SLOWING) * distance)
        # Fingers that touch the table are not pressed onto it.
        lead = torch.where(due.closes, distance.clamp(max=_DEPTH), lead)
        target = point + move * (lead / distance.clamp(min=1e-6))[:, None]
        target[:, 2] = torch.where(pushing, goal[:, 2], target[:, 2])  # a slow arm must not sink

        # The phase: that before, where the way is still long
        phase = torch.where(on & (stay > _HIGH), before, phase)
        phase = torch.where(due.closes, self._close[due.move], phase)
        phase = torch.where(due.opens, self._open[due.move], phase)
        rolls = aligns | ~(due.led | due.closes | due.over) | due.pushes
        return target, phase, turn * rolls

    def _build_gravity(self) -> None:
        """Take from the model by which servo, link and mass the arm sags."""
        model = self._env.sim.model
        column = self._tensor
        actuators = self._env.index.ctrl[: self._n_arm].tolist()
        joints = model.actuator_trnid[actuators, 0]
        weight = model.body_mass * (1.0 - model.body_gravcomp) * abs(model.opt.gravity[2])
        self._links = column(model.jnt_bodyid[joints].tolist())
        self._axes = column(model.jnt_axis[joints].tolist())
        self._anchors = column(model.jnt_pos[joints].tolist())
        self._hinges = column((model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_HINGE).tolist())
        self._heavy = column(np.flatnonzero(weight[: model.nbody]).tolist())
        self._centers = column(model.body_ipos[self._heavy.cpu()].tolist())
        below = np.zeros((len(joints), model.nbody))
        for row, link in enumerate(model.jnt_bodyid[joints]):
            for body in range(model.nbody):
                above = body
                while above not in (0, link):
                    above = model.body_parentid[above]
                below[row, body] = weight[body] * (above == link)
        stiffness = model.actuator_gainprm[actuators, 0][:, None]
        self._bends = column((below / stiffness)[:, self._heavy.cpu()].tolist())

    def _sag(self) -> Tensor:
        """How far the arm's servos give under its weight [rad, m], ``(nworld, n_arm)``."""
        xpos = self._env.sim.xpos.float()
        turn = quat_to_matrix(self._env.sim.xquat.float())
        links = turn[:, self._links]
        axes = (links * self._axes[:, None]).sum(-1)
        anchors = xpos[:, self._links] + (links * self._anchors[:, None]).sum(-1)
        heavy = self._heavy
        centers = xpos[:, heavy] + (turn[:, heavy] * self._centers[:, None]).sum(-1)
        arm = centers[:, None, :, :2] - anchors[:, :, None, :2]
        torque = axes[..., None, 0] * arm[..., 1] - axes[..., None, 1] * arm[..., 0]
        force = torch.where(self._hinges[:, None], torque, axes[..., None, 2])
        return (force * self._bends).sum(-1)

    def _tilted(self, state: State, due: _Due, phase: Tensor) -> Tensor:
        """Desired approach axis, shape ``(nworld, 3)``: as the object's goal needs it; with the
        object in the jaws, the one with which it is upright; beside one that was let go of, as it
        is.
        """
        assert self._tilt is not None
        tilt = self._tilt.release_approach(state.q, phase, self._aim(self._tilt.place[phase]))
        stays = due.beside & ~due.led | due.closes
        tilt = torch.where(stays[:, None], state.approach, tilt)

        # Turned in the arm's vertical plane, until the object's axis that points up most does
        env = self._env
        quat = torch.stack([pose_w(env, name)[:, 3:] for name in self._cfg.scene.objects], dim=1)
        axes = quat_to_matrix(quat.float()[self._worlds, due.object])
        up = axes[self._worlds, :, axes[:, 2].abs().argmax(1)]
        up = up * torch.sign(up[:, 2:])
        out = state.point - env.sim.xpos[:, self._links[0]].float()
        length = norm(out[:, :2]).clamp(min=1e-6)
        x, y = out[:, 0] / length, out[:, 1] / length
        sin = -(up[:, 0] * x + up[:, 1] * y)
        normal = torch.stack((-y, x, torch.zeros_like(x)), dim=1)
        a = state.approach
        cos = (1.0 - sin.square()).clamp(min=0.0).sqrt()
        upright = a * cos[:, None] + torch.linalg.cross(normal, a) * sin[:, None]
        return torch.where(due.led[:, None], upright, tilt)

    def _turn_left(self, state: State, due: _Due, aligns: Tensor, phase: Tensor) -> Tensor:
        """How far the open jaws have to roll to the nearer face of an object [rad], shape
        ``(nworld,)``; where it has no faces or is pushed, to where they are locked. Where a phase
        aligns, how far the held object has to, to a face of the anchor.
        """
        if not self._aligns:
            return torch.zeros_like(state.opening)
        roll = state.q[:, self._roll_column] - self._nominal[0, self._roll_column]
        yaw = self._seen[self._worlds, due.object, 2]

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
        held = yaw - self._seen[self._worlds, self._source[phase], 2] + self._quarters
        change = torch.where(aligns, held, change)
        change = -self._roll_sign * atan2(torch.sin(change), torch.cos(change))
        rolls = roll + change
        cost = (rolls - STAY * roll).abs() + self._beyond(rolls)
        oblong = self._oblong[due.object]
        cost += oblong * self._detour(rolls, roll)
        cost[1::2].masked_fill_(oblong, math.inf)
        nearest = cost.argmin(0, keepdim=True)
        share = torch.where(oblong | aligns, 1.0, self._cfg.controller.yaw_alignment)
        goal = share * rolls.gather(0, nearest)[0]
        has = self._has_faces[due.object]
        return torch.where(aligns & ~has, 0.0, goal * (has & ~due.pushes) - roll)

    def _points(self, state: State) -> Tensor:
        """Target of every phase, from where its anchor is [m], shape ``(nworld, phases, 3)``."""
        seen = self._seen[:, self._source, :2]
        offset = self._target[:, :2].expand_as(seen)
        if any(spec.toward is not None for spec in self._cfg.controller.phases.values()):
            away = self._seen[:, self._toward, :2] - seen
            angle = atan2(away[..., 1], away[..., 0])
            cos, sin = torch.cos(angle), torch.sin(angle)
            x, y = offset.unbind(-1)
            offset = torch.stack((cos * x - sin * y, sin * x + cos * y), dim=-1)
        height = state.pos[:, self._source.clamp(max=state.pos.shape[1] - 1), 2] + self._above
        z = torch.where(self._follows, height, self._target[:, 2])
        return torch.cat((seen + offset, z[..., None]), dim=-1)

    def _grasp_offsets(self, pos: Tensor, points: Tensor) -> Tensor:
        """From each moved object's centre to the grasp point that grasps it, or pushes it to its
        goal, by the phases [m], shape ``(nworld, objects, 3)``.
        """
        offsets = torch.zeros_like(pos)
        offsets[..., 2] = self._above[self._close]
        for k in self._pushed:
            place = self._place[k]
            offsets[:, k] = points[:, place]
            offsets[:, k, :2] -= self._seen[:, self._source[place], :2]
            offsets[:, k, 2] -= pos[:, k, 2]
        return offsets
