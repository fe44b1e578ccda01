"""Task *box*: objects into a box, one after the other, each to its place."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from typing_extensions import override

from mjstack.config.fields import spec
from mjstack.config.schema import RobotCfg
from mjstack.errors import ConfigError, require_names
from mjstack.managers.state import shared
from mjstack.managers.view import EnvView
from mjstack.mdp.geometry import place_xy
from mjstack.report.figure import Figure
from mjstack.robots.jaws import jaw_bodies
from mjstack.scene.index import lowest_height
from mjstack.tasks import parts
from mjstack.tasks.check import EpisodeCheck, Judgement, Rule
from mjstack.tasks.placed import HeldSuccess
from mjstack.tasks.view import AllOf, PhaseNames, Step


class BoxCheck(EpisodeCheck):
    """Each object has been grasped, lifted, carried over the box, let go of there, and is at rest
    in the box.

    An object is loaded while all jaws press on it, and airborne while it is loaded, up from the
    table and touches no support.

    With phases, such as ``lift_red``, worlds may be in different ones. An object's approach clears
    what was found before: a world that goes back to it to grasp anew is judged from its last
    attempt.

    Without phases, an object is grasped, lifted and carried in that order at any time before the
    settled window. A load that is lost after the lift is a drop, unless the object is over the box
    and low in it. It is released once no jaw touches it and the gripper is open after the carry,
    and has to be at rest in the box for the window at some time after that.
    """

    @dataclass(kw_only=True, slots=True)
    class Thresholds:
        """When an episode of the box task succeeded, for each object. Sampled at step ends; forces
        are those of the step's last physics step.
        """

        objects: list[str] = spec()
        """The objects, in the order in which they go into the box."""
        places: list[str] = spec()
        """The place of each in the box."""
        into: str = spec()
        """The box: a fixed object along the world's axes, with a part ``floor`` between others."""
        force: float = spec(unit="N", gt=0.0)
        """A jaw, or a support, that presses with more than this touches."""
        grasp_steps: int = spec(unit="steps", ge=1, le=1_000_000)
        """Consecutive steps, while closing, in which both jaws press."""
        lift_height: float = spec(unit="m", gt=0.0)
        """Height of the lowest corner above the table."""
        lift_steps: int = spec(unit="steps", ge=1, le=1_000_000)
        """Consecutive steps with both jaws pressing and no support touched."""
        carry_steps: int = spec(unit="steps", ge=1, le=1_000_000)
        """Least number of such steps in a row of a carry."""
        carry_distance: float = spec(unit="m", gt=0.0)
        """Horizontal distance from where those steps began."""
        drop_height: float = spec(unit="m", gt=0.0)
        """Without phases: an object that is let go of, or falls, this much above where it rests in
        the box was dropped, also if it is caught again."""
        open_fraction: float = spec(gt=0.0, le=1.0)
        """Share of the gripper's opening, as measured, once released."""
        inside: float = spec(unit="m", ge=0.0)
        """How far a corner may be beyond the inside of the box."""
        rest_speed: float = spec(unit="m/s", gt=0.0)
        """Speed of the fastest corner."""
        window: int = spec(unit="steps", ge=1, le=10_000)
        """Last steps without contact to a jaw, in which an object must be inside and slow."""
        jaw_clearance: float = spec(unit="m", gt=0.0)
        """Lowest jaw geometry above the box's rim at the end."""

    t: Thresholds

    @override
    def build(self) -> list[Rule]:
        t = self.t
        self.objects = list(t.objects)
        self._read_box()
        self.summaries = {
            "beyond_max": ("beyond_m", "max"),
            "corner_speed_max": ("corner_speed_m_per_s", "max"),
            "jaw_clearance_min": ("jaw_clearance_m", "min"),
        }
        for name in self.objects:
            self.summaries |= {
                f"slot_err_{name}_max": (f"slot_err_{name}_m", "max"),
                f"grasp_steps_{name}_min": (f"grasp_steps_{name}", "min"),
                f"settled_steps_{name}_min": (f"settled_steps_{name}", "min"),
            }

        self.resting = AllOf(
            ("untouched", "inside", "rest_speed"),
            lambda step: (step.untouched, self.placed(step), step.corner_speed < t.rest_speed),
        )
        hold = parts.in_hand(*self.objects)
        grasp = parts.Streak(
            *("GRASP", "{object} not grasped", self.objects, hold, t.grasp_steps),
            phases=self._during("close"),
            anew=self._during("approach"),
        )
        lift = parts.Streak(
            *("LIFT", "{object} not lifted", self.objects, self.airborne, t.lift_steps),
            phases=self._during("lift", "carry"),
            after=grasp,
        )
        text = "{object} not carried over the box"
        carry = _CarriedOver(
            *("CARRY", text, self.objects, self.airborne, t.carry_steps),
            distance=t.carry_distance,
            phases=self._during("carry"),
            after=lift,
            inside=self.over_box,
            hold=self._during("hold"),
        )
        drop = _Drop(
            *("DROP", "{object} dropped", self.objects, hold, 0),
            value="unloaded_steps{}",
            phases=self._during("close", "lift", "carry", "hold"),
            grasp=grasp,
            lift=lift,
            carry=carry,
            high=self.high,
        )
        release = _Release(
            *("RELEASE", "{object} not released", self.objects),
            lambda step: step.untouched,
            t.open_fraction,
            value="opening{}",  # widest without contact
            phases=self._during("open", "retreat", "settle"),
            after=carry,
        )
        text = "{object} not at rest in the box after its release"
        settled = _Settled(
            *("SETTLED", text, self.objects, self.resting, t.window),
            phases=self._during("settle"),
            after=release,
        )
        text = "an object not at rest in the box at the end"
        inside = ("INSIDE", text, self.resting, t.window)
        measured = [Figure(f"slot_err_{name}", unit="m") for name in self.objects]
        measured += [Figure("beyond", unit="m"), Figure("corner_speed", unit="m/s")]
        return [
            *(grasp, lift, carry, drop, release, settled),
            _Order(self.objects, release),
            parts.InWindow(*inside, measure=self.trace, measured=measured),
            _JawClear(self.cfg.robot, self._high[2], t.jaw_clearance),
        ]

    def _during(self, *roles: str) -> list[list[str]]:
        """Names of each object's phases of some roles."""
        return [[f"{role}_{name}" for role in roles] for name in self.objects]

    def _read_box(self) -> None:
        """Read the scene's box, and raise unless every object fits into it at its place."""
        t = self.t
        scene = self.cfg.scene
        require_names("task.check.into: object", [t.into], scene.objects)
        box = scene.objects[t.into]
        floor = box.parts.get("floor")
        if floor is None or box.yaw or box.quat or box.pos:
            expected = "a fixed object on the table, not turned, with a part floor"
            raise ConfigError("task.check.into", t.into, expected, "Set scene=box")
        center = [box.xy[i] + floor.pos[i] for i in (0, 1)]
        bottom, rim = (
            scene.table_top + max(shape.pos[2] + shape.size[2] for shape in parts)
            for parts in ([floor], box.parts.values())
        )
        self._low = [*(center[i] - floor.size[i] for i in (0, 1)), bottom]
        self._high = [*(center[i] + floor.size[i] for i in (0, 1)), rim]
        if len(t.places) != len(t.objects):
            raise ConfigError("task.check.places", t.places, "a place for each object")
        self.slots = dict(zip(t.objects, t.places, strict=True))
        require_names("task.check.places: place", t.places, scene.places)
        for name, slot in self.slots.items():
            if name not in scene.objects:
                continue  # the base class reports it
            xy = scene.places[slot].xy
            half = scene.objects[name].half
            if not all(abs(xy[i] - center[i]) <= floor.size[i] - half[i] for i in (0, 1)):
                raise ConfigError(f"scene.places.{slot}.xy", xy, f"a place in the box for {name}")

    @shared
    def airborne(self, step: Step) -> Tensor:
        """Whether each object is held in the air, shape ``(nworld, objects)``, bool."""
        lifted = step.bounds[0][..., 2] - step.top >= self.t.lift_height
        return step.in_hand & lifted & ~step.supported

    @shared
    def outside(self, step: Step) -> Tensor:
        """How far the outermost corner is beyond the inside of the box along each axis [m],
        negative inside, shape ``(nworld, objects, 3)``.
        """
        low, high = step.bounds
        constant = step.constant
        return torch.maximum(constant(*self._low) - low, high - constant(*self._high))

    def high(self, step: Step) -> Tensor:
        """Whether each object is too high to be let go of, ``(nworld, objects)``, bool."""
        heights = [self._low[2] + object_cfg.half_height for object_cfg in step.object_cfgs]
        return step.pos[..., 2] - step.constant(*heights) > self.t.drop_height

    def over_box(self, step: Step) -> Tensor:
        """Whether each object is over the box or in it."""
        return (self.outside(step)[..., :2] <= 0.0).all(-1)

    def placed(self, step: Step) -> Tensor:
        """Whether each object is in the box."""
        return self.outside(step).amax(-1) <= self.t.inside

    @override
    def goals(self, step: Step) -> dict[str, Tensor]:
        goals = {}
        for name, slot in self.slots.items():
            xy = place_xy(step.env, slot).float()
            height = self._low[2] + self.cfg.scene.objects[name].half_height
            goals[name] = torch.cat((xy, torch.full_like(xy[:, :1], height)), dim=1)
        return goals

    @override
    def trace(self, step: Step) -> dict[str, Tensor]:
        slots = self.slots.items()
        return {
            **{f"slot_err_{name}_m": parts.away(step, name, slot) for name, slot in slots},
            "beyond_m": self.outside(step).amax((1, 2)),
            "corner_speed_m_per_s": step.corner_speed.amax(1),
        }

    def headline(self, values: Mapping[str, float]) -> str:
        """How well the objects are placed."""
        offsets = [f"{name} {1e3 * values[f'slot_err_{name}_m']:.1f} mm" for name in self.objects]
        clearance = 1e3 * values["jaw_clearance_m"]
        return f"{', '.join(offsets)} off their places, jaws {clearance:.0f} mm above the rim"


@dataclass(eq=False, kw_only=True)
class _CarriedOver(parts.Carried):
    """CARRY: carried, and over the box when it is let go of."""

    inside: parts.Condition
    hold: PhaseNames

    def counts(self) -> list[Figure]:
        return [*super().counts(), Figure("over_box{}")]

    def start(self, step: Step) -> None:
        super().start(step)
        self._hold = step.during(self.hold)
        self.over_box = step.counter(len(self.objects))  # in the hold's or any load's last step

    def update(self, step: Step) -> None:
        super().update(step)
        hold = step.judged(self._hold) if step.phased else step.in_hand
        self.over_box.copy_(torch.where(hold, self.inside(step), self.over_box))

    def judge(self, end: Step) -> Judgement:
        holds = self.holds() & (self.over_box > 0.0)
        return holds, self.by_object(self.best, self._longest, self.over_box)


@dataclass(eq=False, kw_only=True)
class _Drop(parts.AtLeast):
    """DROP: no step without load between the last grasp and the release."""

    grasp: parts.Streak
    lift: parts.Streak
    carry: _CarriedOver
    high: parts.Condition

    def counts(self) -> list[Figure]:
        return [Figure(self.value, high=0.0)]

    def start(self, step: Step) -> None:
        super().start(step)
        self._loaded = step.zeros(len(self.objects))  # in the step before

    def update(self, step: Step) -> None:
        if step.phased:
            # A grasp that slips while the jaws still close is made anew; the last one counts.
            grasped = self.grasp.length == self.grasp.least
            self.best.masked_fill_(step.judged(self.grasp.key) & grasped, 0.0)
            lost = self.grasp.holds() & step.judged(self.key)
        else:
            # High over the box, and let go of now, or in free fall
            falls = self.high(step) & ((self._loaded > 0.0) | ~step.supported)
            lost = self.lift.holds() & ((self.carry.over_box == 0.0) | falls)
        self._loaded.copy_(self.condition(step))
        self.best.add_(lost & ~self.condition(step))

    def holds(self) -> Tensor:
        return self.best == 0.0


class _Release(parts.AtLeast):
    """RELEASE: out of the jaws, the gripper open."""

    def update(self, step: Step) -> None:
        opens = step.judged(self.key) if step.phased else self.unlocked()
        wide = torch.where(opens & self.condition(step), step.narrowest, 0.0)
        torch.maximum(self.best, wide, out=self.best)


class _Settled(parts.AtLeast):
    """SETTLED: at rest in the box after the release."""

    def start(self, step: Step) -> None:
        super().start(step)
        self._rest = step.zeros(len(self.objects))  # steps at rest in a row

    def update(self, step: Step) -> None:
        self._rest.add_(1.0).mul_(self.condition(step))
        if step.phased:  # as of the settling's last step, or else the most
            settled = torch.where(step.judged(self.key), self._rest, self.best)
        else:
            settled = torch.maximum(self.best, self._rest * self.unlocked())
        self.best.copy_(settled)


class _Order(Rule):
    """ORDER: no object is grasped before the one before it is released."""

    def __init__(self, objects: Sequence[str], release: _Release) -> None:
        pairs = itertools.pairwise(objects)
        text = " or ".join(f"{later} grasped before {name} was released" for name, later in pairs)
        super().__init__("ORDER", text or "never broken", figures=[Figure("too_early", high=0.0)])
        self._release = release

    def start(self, step: Step) -> None:
        self._premature = step.zeros()

    def update(self, step: Step) -> None:
        premature = step.in_hand[:, 1:] & ~self._release.holds()[:, :-1]
        self._premature.masked_fill_(premature.any(1), 1.0)

    def judge(self, end: Step) -> Judgement:
        return self._premature == 0.0, [self._premature]


class _JawClear(Rule):
    """JAW_CLEAR: the jaws are above the box at the end."""

    at_end = True

    def __init__(self, robot: RobotCfg, rim: float, least: float) -> None:
        figures = [Figure("jaw_clearance", unit="m", low=least)]
        super().__init__("JAW_CLEAR", "gripper too low at the end", figures=figures)
        self._robot = robot
        self._rim = rim
        self._least = least

    def judge(self, end: Step) -> Judgement:
        sim = end.env.sim
        sim.kinematics()
        jaws = [body for jaw in jaw_bodies(sim.model, self._robot.jaw_bodies) for body in jaw]
        clearance = lowest_height(sim.model, jaws, sim.xpos, sim.xquat) - self._rim
        return clearance >= self._least, [clearance]


class BoxSuccess(HeldSuccess):
    """Achieved while all objects have been at rest in the box, let go of, for the whole window. It
    shares the thresholds of the task's check.
    """

    def __init__(self, env: EnvView) -> None:
        """Allocate the streak.

        Raises:
            MjstackError: The task has another check.
        """
        check = BoxCheck.from_env(env)
        let_go = parts.released(*check.objects, open_fraction=check.t.open_fraction)
        super().__init__(env, [check.resting, let_go], check.settle_steps)
