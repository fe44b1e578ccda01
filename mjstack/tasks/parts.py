"""Parts that checks are made of: conditions of a step, and rules over an episode.

A condition is a function of a `Step` that returns a bool tensor, shape ``(nworld, n)`` or
``(nworld,)``. A rule that judges objects one by one has conditions with a column for each.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import torch

from mjstack.math import quat_angle
from mjstack.mdp.geometry import place_xy
from mjstack.tasks.check import Rule
from mjstack.tasks.view import Step, TaskView

Condition = Callable[[Step], torch.Tensor]


# Conditions


def airborne(*objects: str, height: float) -> Condition:
    """Objects whose lowest point is higher than that above the table [m]. Without phases both jaws
    have to press on them too, so that a throw or a push is none.
    """

    def condition(step: Step) -> torch.Tensor:
        columns = step.view.columns(objects)
        up = step.height[:, columns] > height
        return up if step.view.phased else up & step.in_hand[:, columns]

    return condition


def in_hand(*objects: str) -> Condition:
    """Objects on which all jaws press."""
    return lambda step: step.in_hand[:, step.view.columns(objects)]


def on_top(object: str, onto: str, *, xy_err: float, dz_min: float, dz_max: float) -> Condition:
    """An object above another one: horizontal distance of the centres and difference of their
    heights [m].
    """

    def condition(step: Step) -> torch.Tensor:
        apart, dz = offset(step, object, onto)
        return (apart <= xy_err) & (dz >= dz_min) & (dz <= dz_max)

    return condition


def offset(step: Step, object: str, onto: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Horizontal distance of the centres [m], and height of the first above the second [m], each
    ``(nworld,)``.
    """
    apart = step.pos[:, step.view.column(object)] - step.pos[:, step.view.column(onto)]
    return torch.linalg.vector_norm(apart[:, :2], dim=1), apart[:, 2]


def at_place(object: str, place: str, *, distance: float) -> Condition:
    """An object whose centre is within a horizontal distance of a place [m]."""

    def condition(step: Step) -> torch.Tensor:
        return away(step, object, place) <= distance

    return condition


def away(step: Step, object: str, place: str) -> torch.Tensor:
    """Horizontal distance of an object's centre from a place [m], shape ``(nworld,)``."""
    xy = step.pos[:, step.view.column(object), :2]
    return torch.linalg.vector_norm(xy - place_xy(step.view.env, place).float(), dim=1)


def on_table(object: str, *, gap: float) -> Condition:
    """An object that stands on the table: its lowest point within ``gap`` of the top [m], its
    centre at least half its size from the edges.
    """

    def condition(step: Step) -> torch.Tensor:
        view = step.view
        scene = view.env.cfg.scene
        column = view.column(object)
        off = (step.pos[:, column, :2] - view.constant(*scene.table_center[:2])).abs()
        half = scene.objects[object].half
        room = view.constant(*(scene.table_half[i] - half[i] for i in (0, 1)))
        return (step.height[:, column].abs() <= gap) & (off <= room).all(1)

    return condition


# Rules


class Streak(Rule):
    """A condition holds for some steps in a row, for every object.

    It counts in some phases of the driver, or without phases at any time before the settled window.
    """

    def __init__(
        self,
        name: str,
        text: str,
        objects: Sequence[str],
        condition: Condition,
        steps: int,
        *,
        phases: Sequence[Sequence[str]],
        doing: str,
        after: Streak | None = None,
    ) -> None:
        """Describes the rule; see `Rule`.

        Args:
            name: Of the rule.
            text: What went wrong.
            objects: The objects.
            condition: With a column for each.
            steps: How many in a row.
            phases: For each object, the phases in which it counts.
            doing: The condition in words, such as ``in the air``.
            after: Without phases it counts once this one holds.
        """
        super().__init__(name, text, objects)
        self._condition = condition
        self._steps = steps
        self._phases = phases
        self._doing = doing
        self._after = after
        self._value = f"{name.lower()}_steps{{}}"

    def start(self, view: TaskView) -> None:
        """Allocates the streaks."""
        size = len(self.objects)
        self._key = view.during(self._phases)
        self.length = view.counter(size)  # of the current streak
        self.best = view.counter(size)

    def update(self, step: Step) -> None:
        """Extends or ends the streaks."""
        self.length.add_(1.0).mul_(self._counts(step))
        torch.maximum(self.best, self.length, out=self.best)

    def _counts(self, step: Step) -> torch.Tensor:
        counts = self._condition(step) & step.judged(self._key)
        if self._after is not None and not step.view.phased:
            counts &= self._after.held()
        return counts

    def held(self) -> torch.Tensor:
        """Whether it has held so far, shape ``(nworld, objects)``, bool."""
        return self.best >= self._steps

    def judge(self, end: Step) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """See `Rule`."""
        return self.held(), self.by_object(self._value, self.best)

    def report(self, values: Mapping[str, float]) -> list[tuple[str, str]]:
        """See `Rule`."""
        return [
            (
                f"{values[self._value.format(suffix)]:.0f} steps {self._doing} in a row",
                f"at least {self._steps}{_in(phases)}",
            )
            for suffix, phases in zip(self.suffixes, self._phases, strict=True)
        ]


class Carried(Streak):
    """During an uninterrupted streak of at least some steps, an object gets some horizontal
    distance away from where the streak began.
    """

    def __init__(self, *args: object, distance: float, **kwargs: object) -> None:
        """Takes the arguments of `Streak` and the distance [m]."""
        super().__init__(*args, **kwargs)  # type: ignore[arg-type]
        self._distance = distance
        self._value = self._value.replace("_steps{}", "{}_m")

    def start(self, view: TaskView) -> None:
        """Allocates the streaks."""
        super().start(view)
        size = len(self.objects)
        self._columns = view.columns(self.objects)
        self._from = view.zeros(size, 2)  # where the streak began
        self._far = view.counter(size)  # farthest from there

    def update(self, step: Step) -> None:
        """Extends or ends the streaks."""
        counts = self._counts(step)
        xy = step.pos[:, self._columns, :2]
        begins = counts & (self.length == 0.0)
        self._from.copy_(torch.where(begins[..., None], xy, self._from))
        self.length.add_(1.0).mul_(counts)
        away = torch.linalg.vector_norm(xy - self._from, dim=-1)
        self._far.copy_(torch.where(counts, torch.maximum(self._far, away), 0.0))
        far = torch.where(self.length >= self._steps, self._far, 0.0)
        torch.maximum(self.best, far, out=self.best)

    def held(self) -> torch.Tensor:
        """Whether it has held so far, shape ``(nworld, objects)``, bool."""
        return self.best >= self._distance

    def report(self, values: Mapping[str, float]) -> list[tuple[str, str]]:
        """See `Rule`."""
        return [
            (
                f"{values[self._value.format(suffix)]:.3f} m {self._doing}",
                f"at least {self._distance:g} m in {self._steps} steps or more{_in(phases)}",
            )
            for suffix, phases in zip(self.suffixes, self._phases, strict=True)
        ]


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
        measure: Callable[[Step], dict[str, torch.Tensor]] = lambda end: {},
        found: Callable[[Mapping[str, float]], str] = lambda values: "",
        wanted: str = "",
    ) -> None:
        """Describes the rule; see `Rule`.

        Args:
            name: Of the rule.
            text: What went wrong.
            condition: If it has several columns, all have to hold.
            window: How many steps.
            measure: Values at the end of the episode, by name with unit.
            found: Those of one world in words.
            wanted: The condition in words.
        """
        super().__init__(name, text)
        self._condition = condition
        self._window = window
        self._measure = measure
        self._found = found
        self._wanted = wanted
        self._value = f"{name.lower()}_steps"

    def start(self, view: TaskView) -> None:
        """Allocates the streak that lasts to the end."""
        self.length = view.zeros()

    def update(self, step: Step) -> None:
        """Extends or ends the streak."""
        holds = self._condition(step)
        self.length.add_(1.0).mul_(holds if holds.dim() == 1 else holds.all(1))

    def held(self) -> torch.Tensor:
        """Whether it has held in the last steps, shape ``(nworld,)``, bool."""
        return self.length >= self._window

    def judge(self, end: Step) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """See `Rule`."""
        return self.held(), {**self._measure(end), self._value: self.length}

    def report(self, values: Mapping[str, float]) -> list[tuple[str, str]]:
        """See `Rule`."""
        found = self._found(values)
        return [
            (
                f"in the last {values[self._value]:.0f} steps{found and '; at the end '}{found}",
                f"in the last {self._window}{self._wanted and ': '}{self._wanted}",
            )
        ]


class AtRest(Rule):
    """Objects are at rest in the last steps of the episode: three rules.

    REST_SPEED: the root mean square of the speed that any point may have. REST_POSITION: the
    largest distance between any two steps. REST_ROTATION: the largest angle between any two steps.
    """

    def __init__(self, window: int, *, speed: float, position: float, rotation_deg: float) -> None:
        """Describes the rules.

        Args:
            window: How many steps.
            speed: [m/s].
            position: [m].
            rotation_deg: [deg].
        """
        super().__init__("REST_SPEED", "{object}")
        self.texts = {
            "REST_SPEED": "object moving",
            "REST_POSITION": "object drifting",
            "REST_ROTATION": "object turning",
        }
        self._window = window
        self._speed = speed
        self._position = position
        self._rotation = math.radians(rotation_deg)

    def start(self, view: TaskView) -> None:
        """Allocates a ring of the last steps."""
        size = len(view.objects)
        # A ring that is not filled fails: NaN compares false with everything.
        self._poses = view.zeros(self._window, size, 7, fill=math.nan)
        self._speeds = view.zeros(self._window, size, fill=math.nan)

    def update(self, step: Step) -> None:
        """Keeps the step in place of the oldest one."""
        slot = step.view.count.remainder(self._window)
        self._poses.index_copy_(1, slot, step.pose[:, None])
        self._speeds.index_copy_(1, slot, step.speed[:, None])

    def judge(self, end: Step) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
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

    def report(self, values: Mapping[str, float]) -> list[tuple[str, str]]:
        """See `Rule`."""
        speed, peak, position, rotation = (
            values[f"{name}"]
            for name in (
                "rest_speed_m_per_s",
                "peak_speed_m_per_s",
                "rest_position_m",
                "rest_rotation_deg",
            )
        )
        return [
            (f"{speed:.3g} m/s RMS, peak {peak:.3g}", f"at most {self._speed:g} m/s RMS"),
            (millimetres(position), f"at most {millimetres(self._position)}"),
            (f"{rotation:.3g} deg", f"at most {math.degrees(self._rotation):g} deg"),
        ]


class RestWindow:
    """Whether objects have been at rest for the last steps, asked in every step; see `AtRest`.

    For the largest distance between any two steps of the window, each step keeps its largest
    distance to the later ones: a new step updates all of them at once, and the one that leaves
    takes its own along. Distances stay squared, and angles stay cosines, until they are judged.
    """

    def __init__(
        self, view: TaskView, window: int, *, speed: float, position: float, rotation_deg: float
    ) -> None:
        """Allocates the ring; arguments as of `AtRest`."""
        size = len(view.objects)
        self._window = window
        self._limits = (
            speed**2,
            position**2,
            1.0 - math.cos(0.5 * math.radians(rotation_deg)),
        )
        # Where the oldest step is, in every world.
        self._slot = torch.zeros(1, dtype=torch.int64, device=view.env.device)
        self._pos = view.zeros(window, size, 3)
        self._quat = view.zeros(window, size, 4)
        self._apart = torch.zeros_like(self._pos)
        self._product = torch.zeros_like(self._quat)
        self._energy = view.zeros(window, size)  # squared speed
        self._far = view.zeros(window, size)  # squared distance to later steps
        self._turned = view.zeros(window, size)  # 1 - |cosine of half the angle| to them

    def append(self, step: Step) -> None:
        """Takes a step in place of the oldest one."""
        pos, quat = step.pose[:, None].split((3, 4), dim=-1)
        self._slot.add_(1).remainder_(self._window)
        self._pos.index_copy_(1, self._slot, pos)
        self._quat.index_copy_(1, self._slot, quat)
        self._energy.index_copy_(1, self._slot, step.speed.square()[:, None])
        for ring in (self._far, self._turned):
            ring.index_fill_(1, self._slot, 0.0)

    def compare(self, step: Step) -> torch.Tensor:
        """Holds the step appended last against the others; shape ``(nworld,)``, bool."""
        pos, quat = step.pose[:, None].split((3, 4), dim=-1)
        torch.sub(self._pos, pos, out=self._apart).square_()
        torch.maximum(self._far, self._apart.sum(-1), out=self._far)
        torch.mul(self._quat, quat, out=self._product)
        torch.maximum(self._turned, 1.0 - self._product.sum(-1).abs(), out=self._turned)
        speed, position, rotation = self._limits
        rest = (self._energy.mean(1) <= speed).all(1)
        rest &= self._far.amax((1, 2)) <= position
        return rest & (self._turned.amax((1, 2)) <= rotation)


def millimetres(metres: float) -> str:
    """A length in words."""
    return f"{1e3 * metres:.3g} mm"


def _in(phases: Sequence[str]) -> str:
    return f" in {' and '.join(phases)}" if phases else ""
