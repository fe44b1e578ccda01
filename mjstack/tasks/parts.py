"""Parts that checks are made of: conditions of a step, and rules over an episode.

A condition is a function of a `Step` that returns a bool tensor, shape ``(nworld, n)`` or
``(nworld,)``. A rule that judges objects one by one has conditions with a column for each.
"""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from mjstack.managers.view import EnvView
from mjstack.math import quat_angle
from mjstack.mdp.geometry import place_xy
from mjstack.tasks.check import Judgement, Rule
from mjstack.tasks.view import PhaseNames, Step, TaskView

Condition = Callable[[Step], Tensor]


# Conditions


def airborne(*objects: str, height: float) -> Condition:
    """Objects whose lowest point is higher than that above the table [m]. Without phases both jaws
    have to press on them too, so that a throw or a push is none.
    """

    def condition(step: Step) -> Tensor:
        columns = step.view.columns(objects)
        up = columns.read(step.height) > height
        return up if step.view.phased else up & columns.read(step.in_hand)

    return condition


def in_hand(*objects: str) -> Condition:
    """Objects on which all jaws press."""
    return lambda step: step.view.columns(objects).read(step.in_hand)


def released(*objects: str, open_fraction: float) -> Condition:
    """Objects that no jaw touches while the gripper is open by at least that fraction as measured,
    from 0 (closed) to 1 (open).
    """

    def condition(step: Step) -> Tensor:
        open_wide = step.narrowest >= open_fraction
        return step.view.columns(objects).read(step.untouched) & open_wide

    return condition


def on_top(object: str, onto: str, *, xy_err: float, dz_min: float, dz_max: float) -> Condition:
    """An object above another one: horizontal distance of the centres and difference of their
    heights [m].
    """

    def condition(step: Step) -> Tensor:
        apart, dz = offset(step, object, onto)
        return (apart <= xy_err) & (dz.clamp(dz_min, dz_max) == dz)

    return condition


def offset(step: Step, object: str, onto: str) -> tuple[Tensor, Tensor]:
    """Horizontal distance of the centres [m], and height of the first above the second [m], each
    ``(nworld,)``.
    """
    apart = step.pos[:, step.view.column(object)] - step.pos[:, step.view.column(onto)]
    return torch.linalg.vector_norm(apart[:, :2], dim=1), apart[:, 2]


def on_top_of(step: Step, onto: str, object: str) -> Tensor:
    """Centre of an object that stands on the middle of another one [m], shape ``(nworld, 3)``."""
    objects = step.view.env.cfg.scene.objects
    height = objects[onto].half_height + objects[object].half_height
    return step.pos[:, step.view.column(onto)] + step.view.constant(0.0, 0.0, height)


def at_place(object: str, place: str, *, distance: float) -> Condition:
    """An object whose centre is within a horizontal distance of a place [m]."""
    return lambda step: away(step, object, place) <= distance


def away(step: Step, object: str, place: str) -> Tensor:
    """Horizontal distance of an object's centre from a place [m], shape ``(nworld,)``."""
    xy = step.pos[:, step.view.column(object), :2]
    return torch.linalg.vector_norm(xy - place_xy(step.view.env, place).float(), dim=1)


def on_table(object: str, *, gap: float) -> Condition:
    """An object that stands on the table: its lowest point within ``gap`` of the top [m], its
    centre at least half its size from the edges.
    """

    def condition(step: Step) -> Tensor:
        view = step.view
        scene = view.env.cfg.scene
        column = view.column(object)
        half = scene.objects[object].half
        room = view.constant(*(scene.table_half[i] - half[i] for i in (0, 1)), gap)
        center = view.constant(*scene.table_center[:2], 0.0)
        at = torch.cat((step.pos[:, column, :2], step.height[:, column, None]), dim=1)
        return ((at - center).abs() <= room).all(1)

    return condition


# Rules


class AtLeast(Rule):
    """A number of each object gets to some threshold.

    It counts in some phases of the driver, or without phases at any time before the settled window.
    A subclass updates ``best``.

    Attributes:
        least: The threshold.
        key: Of the phases in which it counts, for `Step.judged`.
        best: The number so far, shape ``(nworld, objects)``, float32.
    """

    def __init__(
        self,
        name: str,
        text: str,
        objects: Sequence[str],
        value: str,
        least: float,
        *,
        phases: PhaseNames,
    ) -> None:
        """Describe the rule; see `Rule`. ``value`` is the name of the number, with ``{}`` for the
        suffix of the object, and ``least`` the threshold.
        """
        super().__init__(name, text, objects)
        self.wanted = [f"at least {least:g}"] * len(phases)
        self.least = least
        self._value = value
        self.phases = phases

    def start(self, view: TaskView) -> None:
        """Allocate the numbers."""
        self.key = view.during(self.phases)
        self.best = view.counter(len(self.objects))

    def held(self) -> Tensor:
        """Whether it has held so far, shape ``(nworld, objects)``, bool."""
        return self.best >= self.least

    def judge(self, end: Step) -> Judgement:
        """See `Rule`."""
        return self.held(), self.by_object(self._value, self.best)


class Streak(AtLeast):
    """A condition holds for some steps in a row, for every object."""

    def __init__(
        self,
        name: str,
        text: str,
        objects: Sequence[str],
        condition: Condition,
        steps: int,
        *,
        phases: PhaseNames,
        after: AtLeast | None = None,
        anew: PhaseNames = (),
        distance: float | None = None,
    ) -> None:
        """Describe the rule; see `Rule`.

        The condition has a column for each object. Without phases it counts once the rule ``after``
        holds. Phases ``anew`` of an object clear every counter of the check. ``distance`` is that
        of `Carried` [m].
        """
        value = f"{name.lower()}_steps{{}}" if distance is None else f"{name.lower()}{{}}_m"
        least = steps if distance is None else distance
        super().__init__(name, text, objects, value, least, phases=phases)
        self._steps = steps
        self._condition = condition
        self._after = after
        self._anew = anew

    def start(self, view: TaskView) -> None:
        """Allocate the streaks."""
        super().start(view)
        self.length = view.counter(len(self.objects))  # of the current streak
        self._clears = view.during(self._anew)

    def update(self, step: Step) -> None:
        """Extend or end the streaks."""
        if self._anew and step.view.phased:
            step.view.clear(step.judged(self._clears))
        self.length.add_(1.0).mul_(self._counts(step))
        torch.maximum(self.best, self.length, out=self.best)

    def _counts(self, step: Step) -> Tensor:
        counts = self._condition(step) & step.judged(self.key)
        if self._after is not None and not step.view.phased:
            counts &= self._after.held()
        return counts


class Carried(Streak):
    """During an uninterrupted streak of at least some steps, an object gets some horizontal
    ``distance`` away from where the streak began.
    """

    def start(self, view: TaskView) -> None:
        """Allocate the streaks."""
        super().start(view)
        size = len(self.objects)
        self._from = view.zeros(size, 2)  # where the streak began
        self._far = view.counter(size)  # farthest from there

    def update(self, step: Step) -> None:
        """Extend or end the streaks."""
        counts = self._counts(step)
        xy = step.view.columns(self.objects).read(step.pos)[..., :2]
        begins = counts & (self.length == 0.0)
        self._from.copy_(torch.where(begins[..., None], xy, self._from))
        self.length.add_(1.0).mul_(counts)
        away = torch.linalg.vector_norm(xy - self._from, dim=-1)
        self._far.copy_(torch.where(counts, torch.maximum(self._far, away), 0.0))
        far = torch.where(self.length >= self._steps, self._far, 0.0)
        torch.maximum(self.best, far, out=self.best)


class InWindow(Rule):
    """A condition holds in all of the last steps of the episode."""

    at_end = True

    def __init__(
        self,
        name: str,
        text: str,
        condition: Condition,
        window: int,
        *,
        measure: Callable[[Step], dict[str, Tensor]] = lambda end: {},
    ) -> None:
        """Describe the rule; see `Rule`. If the condition has several columns, all have to hold.
        ``measure`` gives values at the end of the episode, by name with unit.
        """
        self._value = f"{name.lower()}_steps"
        super().__init__(name, text, wanted=f"at least {window}")
        self._condition = condition
        self._window = window
        self._measure = measure

    def start(self, view: TaskView) -> None:
        """Allocate the streak that lasts to the end."""
        self.length = view.zeros()

    def update(self, step: Step) -> None:
        """Extend or end the streak."""
        holds = self._condition(step)
        self.length.add_(1.0).mul_(holds if holds.dim() == 1 else holds.all(1))

    def judge(self, end: Step) -> Judgement:
        """See `Rule`."""
        return self.length >= self._window, {self._value: self.length, **self._measure(end)}


class AtRest(Rule):
    """Objects are at rest in the last steps of the episode: three rules.

    REST_SPEED: the root mean square of the speed that any point may have. REST_POSITION: the
    largest distance between any two steps. REST_ROTATION: the largest angle between any two steps.
    """

    def __init__(self, window: int, *, speed: float, position: float, rotation_deg: float) -> None:
        """Describe the rules.

        Args:
            window: How many steps.
            speed: [m/s].
            position: [m].
            rotation_deg: [deg].
        """
        super().__init__("REST", "")
        self.texts = {
            "REST_SPEED": "object moving",
            "REST_POSITION": "object drifting",
            "REST_ROTATION": "object turning",
        }
        self.suffixes = ["speed_m_per_s", "position_m", "rotation_deg"]
        self.wanted = [f"at most {limit:g}" for limit in (speed, position, rotation_deg)]
        self._window = window
        self._speed = speed
        self._position = position
        self._rotation = math.radians(rotation_deg)

    def start(self, view: TaskView) -> None:
        """Allocate a ring of the last steps."""
        size = len(view.objects)
        # A ring that is not filled fails: NaN compares false with everything.
        self._poses = view.zeros(self._window, size, 7, fill=math.nan)
        self._speeds = view.zeros(self._window, size, fill=math.nan)

    def update(self, step: Step) -> None:
        """Keep the step in place of the oldest one."""
        slot = step.view.count.remainder(self._window)
        self._poses.index_copy_(1, slot, step.pose[:, None])
        self._speeds.index_copy_(1, slot, step.speed[:, None])

    def judge(self, end: Step) -> Judgement:
        """See `Rule`."""
        rms = self._speeds.square().mean(1).sqrt().amax(1)
        distance = torch.zeros_like(rms)
        angle = torch.zeros_like(rms)
        # The pairs one lag apart at a time.
        for lag in range(1, self._window):
            a = self._poses[:, : self._window - lag]
            b = self._poses[:, lag:]
            # amax hands NaN on, so that an unfilled or diverged window fails its rule.
            apart = torch.linalg.vector_norm(a[..., :3] - b[..., :3], dim=-1)
            distance = torch.maximum(distance, apart.amax((1, 2)))
            angle = torch.maximum(angle, quat_angle(a[..., 3:], b[..., 3:]).amax((1, 2)))
        held = (rms <= self._speed, distance <= self._position, angle <= self._rotation)
        return torch.stack(held, dim=1), {
            "rest_speed_m_per_s": rms,
            "peak_speed_m_per_s": self._speeds.amax((1, 2)),
            "rest_position_m": distance,
            "rest_rotation_deg": angle.double().rad2deg(),
        }


# Success of a step


class HeldSuccess:
    """Achieved while a condition has held for some steps in a row.

    Attributes:
        nowhere: Whether it was seen, on the CPU, that the condition holds in no world.
    """

    nowhere = False

    def __init__(self, env: EnvView, condition: Callable[[], Tensor], steps: int) -> None:
        """Allocate the streaks.

        Args:
            env: The environment.
            condition: Whether it holds now, shape ``(nworld,)``, bool.
            steps: How many steps in a row.
        """
        self._condition = condition
        self._steps = steps
        self._length = torch.zeros(env.nworld, dtype=torch.int32, device=env.device)

    def __call__(self, env: EnvView) -> Tensor:
        """Process a step; shape ``(nworld,)``, bool."""
        holds = self._condition()
        self.nowhere = not holds.is_cuda and not bool(holds.any())
        if self.nowhere:
            self._length.zero_()
            return holds
        self._length.add_(1).mul_(holds)
        return self._length >= self._steps

    def reset(self, mask: Tensor) -> None:
        """Forget the masked worlds."""
        self._length.masked_fill_(mask, 0)
