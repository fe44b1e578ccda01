"""Parts that checks are made of: conditions of a step, and rules over an episode.

A condition is a function of a `Step` that returns a bool tensor, shape ``(nworld, n)`` or
``(nworld,)``. A rule that judges objects one by one has conditions with a column for each.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace

import torch
from torch import Tensor
from typing_extensions import override

from mjstack.math import norm, quat_angle, quat_to_matrix
from mjstack.mdp.geometry import place_xy, pose_w
from mjstack.report.figure import Figure
from mjstack.tasks.check import Judgement, Rule
from mjstack.tasks.view import AllOf, PhaseNames, Step

Condition = Callable[[Step], Tensor]


# Conditions


def airborne(*objects: str, height: float) -> Condition:
    """Objects whose lowest point is higher than that above the table [m]. Without phases both jaws
    have to press on them too, so that a throw or a push is none.
    """

    def condition(step: Step) -> Tensor:
        columns = step.columns(objects)
        above_height = columns.read(step.height) > height
        return above_height if step.phased else above_height & columns.read(step.in_hand)

    return condition


def in_hand(*objects: str) -> Condition:
    """Objects on which all jaws press."""
    return lambda step: step.columns(objects).read(step.in_hand)


def released(*objects: str, open_fraction: float) -> AllOf:
    """Objects that no jaw touches while the gripper is open by at least that fraction as measured,
    from 0 (any opening will do) to 1 (open).
    """
    least = open_fraction or -math.inf

    def conditions(step: Step) -> tuple[Tensor, ...]:
        wide = step.narrowest >= least
        return step.columns(objects).read(step.untouched) if objects else wide, wide

    return AllOf(("untouched", "open_fraction"), conditions)


def on_top(object: str, onto: str, *, xy_err: float, dz_min: float, dz_max: float) -> AllOf:
    """An object above another one: horizontal distance of the centres and difference of their
    heights [m].
    """

    def conditions(step: Step) -> tuple[Tensor, ...]:
        separation, dz = offset(step, object, onto)
        return separation <= xy_err, dz.clamp(dz_min, dz_max) == dz

    return AllOf(("xy_err", "dz"), conditions)


def offset(step: Step, object: str, onto: str) -> tuple[Tensor, Tensor]:
    """Horizontal distance of the centres [m], and height of the first above the second [m], each
    ``(nworld,)``.
    """
    separation = step.center(object) - step.center(onto)
    return norm(separation[:, :2]), separation[:, 2]


def on_top_of(step: Step, onto: str, object: str) -> Tensor:
    """Centre of an object that stands on the middle of another one [m], shape ``(nworld, 3)``."""
    objects = step.env.cfg.scene.objects
    height = objects[onto].half_height + objects[object].half_height
    return step.center(onto) + step.constant(0.0, 0.0, height)


def at_place(object: str, place: str, *, distance: float) -> AllOf:
    """An object whose centre is within a horizontal distance of a place [m]."""
    return AllOf(("distance",), lambda step: (away(step, object, place) <= distance,))


def away(step: Step, object: str, place: str) -> Tensor:
    """Horizontal distance of an object's centre from a place [m], shape ``(nworld,)``."""
    separation = step.center(object)[:, :2] - place_xy(step.env, place).float()
    return norm(separation)


def on_table(object: str, *, gap: float) -> AllOf:
    """An object that stands on the table, however it is turned: its lowest point within ``gap`` of
    the top [m], its centre at least half its size from the edges.
    """

    def conditions(step: Step) -> Tensor:
        scene = step.env.cfg.scene
        half = scene.objects[object].half
        room = step.constant(*(scene.table_half[i] - half[i] for i in (0, 1)), gap)
        center = step.constant(*scene.table_center[:2], 0.0)
        height = step.height[:, step.number(object), None]
        at = torch.cat((step.center(object)[:, :2], height), dim=1)
        return (at - center).abs() <= room

    return AllOf(("x", "y", "gap"), conditions)


def upright(object: str, *, tilt_deg: float, axis: str = "z", either_end: bool = True) -> AllOf:
    """An object whose axis is within an angle of the vertical. Either end of it may be up, unless
    ``either_end`` is false.
    """

    def conditions(step: Step) -> tuple[Tensor, ...]:
        return (step.tilt(object, axis, either_end=either_end) <= tilt_deg,)

    return AllOf(("tilt_deg",), conditions)


def flat(object: str, *, tilt_deg: float) -> AllOf:
    """A box on any of its faces, or a cylinder on either end, within an angle."""
    return upright(object, tilt_deg=tilt_deg, axis="face")


def in_zone(object: str, frame: str, *, low: Sequence[float], high: Sequence[float]) -> AllOf:
    """An object whose centre is between two corners, in the frame of another one such as a fixture:
    least and largest x, y and perhaps z [m].
    """

    def conditions(step: Step) -> Tensor:
        pose = pose_w(step.env, frame).float()
        separation = step.center(object) - pose[:, :3]
        at = (quat_to_matrix(pose[:, 3:]) * separation[..., None]).sum(-2)[:, : len(low)]
        constant = step.constant
        return at.clamp(constant(*low), constant(*high)) == at

    return AllOf(("along_x", "along_y", "along_z")[: len(low)], conditions)


# Rules


@dataclass(eq=False)
class AtLeast(Rule):
    """A number of each object gets to some threshold.

    It counts in some phases of the driver, or without phases at any time before the settled window.
    A subclass updates ``best``.

    Attributes:
        name: See `Rule`; also ``text`` and ``objects``.
        condition: What counts, with a column for each object.
        least: The threshold.
        phases: For each object, the phases in which it counts.
        after: Without phases it counts once this rule holds.
        value: Name of the number, with ``{}`` for the suffix of the object, if it is no steps.
        key: Of the phases, for `Step.judged`.
        best: The number so far, shape ``(nworld, objects)``, float32.
    """

    name: str
    text: str
    objects: list[str]
    condition: Condition
    least: float
    _: KW_ONLY
    phases: PhaseNames
    after: "AtLeast | None" = None
    value: str = ""

    def __post_init__(self) -> None:
        super().__init__(self.name, self.text, self.objects, self.counts())

    def counts(self) -> list[Figure]:
        """Figures of each object."""
        return [Figure(self.value or f"{self.name.lower()}_steps{{}}", low=self.least)]

    @override
    def start(self, step: Step) -> None:
        self.key = step.during(self.phases)
        self.best = step.counter(len(self.objects))

    def holds(self) -> Tensor:
        """Whether it has held so far, shape ``(nworld, objects)``, bool."""
        return self.best >= self.least

    def unlocked(self) -> Tensor | bool:
        """Whether the rule ``after`` holds, shape ``(nworld, objects)``, bool."""
        return self.after is None or self.after.holds()

    @override
    def judge(self, end: Step) -> Judgement:
        return self.holds(), self.by_object(self.best)


@dataclass(eq=False)
class Streak(AtLeast):
    """A condition holds for at least so many steps in a row, for every object.

    Attributes:
        anew: For each object, phases that clear every counter of the check.
        length: Of the current streak, shape ``(nworld, objects)``, float32.
    """

    anew: PhaseNames = field(default=(), kw_only=True)

    @override
    def start(self, step: Step) -> None:
        super().start(step)
        self.length = step.counter(len(self.objects))
        self._clears = step.during(self.anew)

    @override
    def update(self, step: Step) -> None:
        if self.anew and step.phased:
            step.clear(step.judged(self._clears))
        self.length.add_(1.0).mul_(self._counts(step))
        torch.maximum(self.best, self.length, out=self.best)

    def _counts(self, step: Step) -> Tensor:
        counts = self.condition(step) & step.judged(self.key)
        return counts if step.phased else counts & self.unlocked()


@dataclass(eq=False)
class Carried(Streak):
    """During an uninterrupted streak of at least some steps, an object gets some horizontal
    ``distance`` [m] away from where the streak began.
    """

    distance: float = field(kw_only=True)

    @override
    def counts(self) -> list[Figure]:
        self._steps = self.least
        self.least = self.distance
        name = self.name.lower()
        return [
            Figure(f"{name}{{}}", unit="m", low=self.least),
            Figure(f"{name}_steps{{}}", low=self._steps),
        ]

    @override
    def start(self, step: Step) -> None:
        super().start(step)
        size = len(self.objects)
        self._from = step.zeros(size, 2)  # where the streak began
        self._far = step.counter(size)  # farthest from there
        self._longest = step.counter(size)

    @override
    def update(self, step: Step) -> None:
        counts = self._counts(step)
        xy = step.columns(self.objects).read(step.pos)[..., :2]
        begins = counts & (self.length == 0.0)
        self._from.copy_(torch.where(begins[..., None], xy, self._from))
        self.length.add_(1.0).mul_(counts)
        away = norm(xy - self._from)
        self._far.copy_(torch.where(counts, torch.maximum(self._far, away), 0.0))
        torch.maximum(self._longest, self.length, out=self._longest)
        far = torch.where(self.length >= self._steps, self._far, 0.0)
        torch.maximum(self.best, far, out=self.best)

    @override
    def judge(self, end: Step) -> Judgement:
        return self.holds(), self.by_object(self.best, self._longest)


@dataclass(eq=False)
class InWindow(Rule):
    """A condition holds in all of the last steps of the episode. Of an `AllOf` each part is
    counted, so that a failure names it.

    Attributes:
        name: See `Rule`; also ``text``.
        condition: If it has several columns, all have to hold.
        window: How many steps.
        measure: Gives values at the end of the episode, by the keys of ``measured``.
    """

    name: str
    text: str
    condition: Condition
    window: int
    _: KW_ONLY
    measure: Callable[[Step], dict[str, Tensor]] = lambda end: {}
    measured: Sequence[Figure] = ()

    at_end = True

    def __post_init__(self) -> None:
        rule = self.condition
        self._rule = rule if isinstance(rule, AllOf) else AllOf(("",), lambda step: (rule(step),))
        names = self._rule.names if len(self._rule.names) > 1 else ()
        steps = Figure(f"{self.name.lower()}_steps", low=self.window)
        total = replace(steps, low=-math.inf) if names else steps  # its parts have the limit
        counts = [total, *(replace(steps, column=name) for name in names)]
        super().__init__(self.name, self.text, figures=counts)

    @override
    def start(self, step: Step) -> None:
        self.length = step.zeros(len(self._rule.names))  # of the streaks that last to the end

    @override
    def update(self, step: Step) -> None:
        self.length.add_(1.0).mul_(self._rule.by_part(step))

    @override
    def judge(self, end: Step) -> Judgement:
        total = self.length.amin(1)
        conditions = self.length.unbind(1) if self.length.shape[1] > 1 else ()
        return total >= self.window, [total, *conditions, *self.measure(end).values()]


@dataclass(eq=False)
class AtRest(Rule):
    """Objects are at rest in the last steps of the episode: three rules.

    REST_SPEED: the root mean square of the speed that any point may have. REST_POSITION: the
    largest distance between any two steps. REST_ROTATION: the largest angle between any two steps.

    Attributes:
        window: How many steps.
        speed: [m/s].
        position: [m].
        rotation_deg: [deg].
    """

    window: int
    speed: float
    position: float
    rotation_deg: float

    def __post_init__(self) -> None:
        self.texts = {
            "REST_SPEED": "object moving",
            "REST_POSITION": "object drifting",
            "REST_ROTATION": "object turning",
        }
        self.figures = [
            [Figure("rest_speed", unit="m/s", high=self.speed)],
            [Figure("rest_position", unit="m", high=self.position)],
            [Figure("rest_rotation", unit="deg", high=self.rotation_deg)],
        ]
        self.measured = [Figure("peak_speed", unit="m/s")]

    @override
    def start(self, step: Step) -> None:
        size = len(step.objects)
        # The last steps. A ring that is not filled fails: NaN compares false with everything.
        self._poses = step.zeros(self.window, size, 7, fill=math.nan)
        self._speeds = step.zeros(self.window, size, fill=math.nan)

    @override
    def update(self, step: Step) -> None:
        slot = step.count.remainder(self.window)  # of the oldest step
        self._poses.index_copy_(1, slot, step.pose[:, None])
        self._speeds.index_copy_(1, slot, step.speed[:, None])

    @override
    def judge(self, end: Step) -> Judgement:
        rms = self._speeds.square().mean(1).sqrt().amax(1)
        distance = torch.zeros_like(rms)
        angle = torch.zeros_like(rms)
        # The pairs one lag apart at a time.
        for lag in range(1, self.window):
            a = self._poses[:, : self.window - lag]
            b = self._poses[:, lag:]
            # amax hands NaN on, so that an unfilled or diverged window fails its rule.
            separation = norm(a[..., :3] - b[..., :3])
            distance = torch.maximum(distance, separation.amax((1, 2)))
            angle = torch.maximum(angle, quat_angle(a[..., 3:], b[..., 3:]).amax((1, 2)))
        turn = math.radians(self.rotation_deg)
        holds = (rms <= self.speed, distance <= self.position, angle <= turn)
        peak = self._speeds.amax((1, 2))
        return torch.stack(holds, dim=1), (rms, distance, angle.double().rad2deg(), peak)
