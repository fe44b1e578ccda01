"""Task *box*: objects into a box, one after the other, each to its place."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass

import torch

from mjstack.config.fields import spec
from mjstack.config.schema import BoxCfg, Config
from mjstack.errors import ConfigError, ParameterError, UnknownName
from mjstack.managers.view import EnvView
from mjstack.mdp.geometry import gripper_opening
from mjstack.scene import LowestPoint, table_top
from mjstack.tasks.check import EpisodeCheck, Rule
from mjstack.tasks.parts import Carried, InWindow, Streak, away, in_hand, millimetres
from mjstack.tasks.view import Step, TaskView

ROLES = (
    "approach",
    "descend",
    "close",
    "lift",
    "carry",
    "hold",
    "open",
    "retreat",
    "settle",
)
"""Phases of each object, such as ``lift_red``."""


def scene_box(cfg: Config) -> BoxCfg:
    """The scene's box.

    Raises:
        ConfigError: It has none.
    """
    if cfg.scene.box is None:
        raise ConfigError("scene", cfg.scene.name, "a scene with a box", "Set scene=box")
    return cfg.scene.box


class Inside:
    """The inside of the scene's box, and how objects lie to it."""

    def __init__(self, cfg: Config, tolerance: float) -> None:
        """Reads the box.

        Args:
            cfg: The configuration.
            tolerance: How far a corner may be beyond the inside [m].

        Raises:
            ConfigError: The scene has no box.
        """
        box = scene_box(cfg)
        top = table_top(cfg.scene)
        self.rim = top + box.height
        self._low = [*(box.center[i] - box.half[i] for i in (0, 1)), top + box.floor]
        self._high = [*(box.center[i] + box.half[i] for i in (0, 1)), self.rim]
        self._tolerance = tolerance

    def beyond(self, step: Step) -> torch.Tensor:
        """How far the outermost corner is outside [m], negative inside, shape ``(nworld,
        objects)``.
        """

        def compute() -> torch.Tensor:
            low, high = step.bounds
            outside = step.view.constant(*self._low) - low, high - step.view.constant(*self._high)
            return torch.maximum(*outside).amax(-1)

        return step.once("beyond", compute)

    def holds(self, step: Step) -> torch.Tensor:
        """Whether all corners are in the box, shape ``(nworld, objects)``, bool."""
        return self.beyond(step) <= self._tolerance

    def over(self, step: Step) -> torch.Tensor:
        """Whether all corners are over the inside or in it, shape ``(nworld, objects)``, bool."""
        low, high = step.bounds
        inside = (low >= step.view.constant(*self._low)) & (high <= step.view.constant(*self._high))
        return inside[..., :2].all(-1)


def corner_speed(step: Step) -> torch.Tensor:
    """Speed of the fastest corner [m/s], shape ``(nworld, objects)``."""

    def compute() -> torch.Tensor:
        signs = step.view.constant(*itertools.chain(*itertools.product((-1.0, 1.0), repeat=3)))
        arms = step.view.half[:, None] * signs.view(8, 3)
        # A free joint's linear velocity is the world's, its angular velocity the body's: all of it
        # in the body's frame.
        linear = (step.turn * step.velocity[..., :3, None]).sum(-2)
        spin = step.velocity[..., None, 3:].expand(-1, -1, 8, -1)
        return torch.linalg.vector_norm(
            linear[..., None, :] + torch.linalg.cross(spin, arms.expand_as(spin)), dim=-1
        ).amax(-1)

    return step.once("corner_speed", compute)


class BoxCheck(EpisodeCheck):
    """Each object has been grasped, lifted, carried over the box, let go of there, and is at rest
    in the box.

    An object is loaded while all jaws press on it, and airborne while it is loaded, up from the
    table and touches no support.

    With phases (`ROLES`), worlds may be in different ones. An object's first phase, its approach,
    forgets what was found before: a world that goes back to it to grasp anew is judged from its
    last attempt.

    Without phases, an object is grasped, lifted and carried in that order at any time before the
    settled window. A load that is lost after the lift while the object is not over the box is a
    drop. It is released once no jaw touches it and the gripper is open after the carry, and has to
    be at rest in the box for the window at some time after that.
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
        force: float = spec(unit="N", gt=0.0)
        """A jaw, or a support, that presses with more than this touches."""
        grasp_steps: int = spec(unit="steps", ge=1)
        """Consecutive steps, while closing, in which both jaws press."""
        lift_height: float = spec(unit="m", gt=0.0)
        """Height of the lowest corner above the table."""
        lift_steps: int = spec(unit="steps", ge=1)
        """Consecutive steps with both jaws pressing and no support touched."""
        carry_steps: int = spec(unit="steps", ge=1)
        """Least number of such steps in a row of a carry."""
        carry_distance: float = spec(unit="m", gt=0.0)
        """Horizontal distance from where those steps began."""
        open_fraction: float = spec(gt=0.0, le=1.0)
        """Share of the gripper's opening, as measured, once released."""
        inside: float = spec(unit="m", ge=0.0)
        """How far a corner may be beyond the inside of the box."""
        rest_speed: float = spec(unit="m/s", gt=0.0)
        """Speed of the fastest corner."""
        window: int = spec(unit="steps", ge=1)
        """Last steps without contact to a jaw, in which an object must be inside and slow."""
        jaw_clearance: float = spec(unit="m", gt=0.0)
        """Lowest jaw geometry above the box's rim at the end."""

    t: Thresholds

    def build(self) -> list[Rule]:
        """See `EpisodeCheck`."""
        t = self.t
        self.objects = list(t.objects)
        self.inside = Inside(self.cfg, t.inside)
        if len(t.places) != len(t.objects):
            raise ConfigError("task.check.places", t.places, "a place for each object")
        self.slots = dict(zip(t.objects, t.places, strict=True))
        self._check_places()
        phases = self.cfg.controller.phases
        for name in itertools.chain(*self.during(*ROLES)) if phases else ():
            if name not in phases:
                raise UnknownName("task.check: phase", name, phases)
        self.summaries = {
            **{f"slot_err_{each}_max_m": (f"slot_err_{each}_m", "max") for each in self.objects},
            "beyond_max_m": ("beyond_m", "max"),
            "corner_speed_max_m_per_s": ("corner_speed_m_per_s", "max"),
            "jaw_clearance_min_m": ("jaw_clearance_m", "min"),
            **{f"grasp_steps_{each}_min": (f"grasp_steps_{each}", "min") for each in self.objects},
            **{
                f"settled_steps_{each}_min": (f"settled_steps_{each}", "min")
                for each in self.objects
            },
        }
        grasp = _Grasp(self)
        lift = Streak(
            "LIFT",
            "{object} not lifted",
            self.objects,
            self.airborne,
            t.lift_steps,
            phases=self.during("lift", "carry"),
            doing="loaded in the air",
            after=grasp,
        )
        carry = _CarriedOver(self, lift)
        release = _Release(self, carry)
        return [
            grasp,
            lift,
            carry,
            _Drop(self, grasp, lift, carry),
            release,
            _Settled(self, release),
            _Order(self, release),
            InWindow(
                "INSIDE",
                "an object not at rest in the box at the end",
                self.resting,
                t.window,
                measure=self.trace,
                found=lambda values: (
                    f"outermost corner {millimetres(values['beyond_m'])} outside, fastest"
                    f" {values['corner_speed_m_per_s']:.2g} m/s"
                ),
                wanted=f"out of the jaws, at most {millimetres(t.inside)} outside, corners below"
                f" {t.rest_speed:g} m/s",
            ),
            _JawClear(self),
        ]

    def _check_places(self) -> None:
        """Raises unless every object fits into the box at its place."""
        box = scene_box(self.cfg)
        places = self.cfg.scene.places
        for name, slot in self.slots.items():
            if slot not in places:
                raise UnknownName("task.check.places: place", slot, places)
            if name not in self.cfg.scene.objects:
                continue  # the base class reports it
            xy = places[slot].xy
            half = self.cfg.scene.objects[name].half
            if not all(abs(xy[i] - box.center[i]) <= box.half[i] - half[i] for i in (0, 1)):
                raise ConfigError(f"scene.places.{slot}.xy", xy, f"a place in the box for {name}")

    def during(self, *roles: str) -> list[list[str]]:
        """Names of each object's phases of some roles."""
        return [[f"{role}_{each}" for role in roles] for each in self.t.objects]

    def airborne(self, step: Step) -> torch.Tensor:
        """Whether each object is held in the air, shape ``(nworld, objects)``, bool."""

        def compute() -> torch.Tensor:
            up = step.bounds[0][..., 2] - step.view.top >= self.t.lift_height
            return step.in_hand & up & ~step.supported

        return step.once("airborne", compute)

    def resting(self, step: Step) -> torch.Tensor:
        """Whether each object is out of the jaws, inside and slow, shape ``(nworld, objects)``,
        bool.
        """

        def compute() -> torch.Tensor:
            slow = corner_speed(step) < self.t.rest_speed
            return step.untouched & self.inside.holds(step) & slow

        return step.once("resting", compute)

    def placed(self, step: Step) -> torch.Tensor:
        """Whether each object is in the box."""
        return self.inside.holds(step)

    def trace(self, step: Step) -> dict[str, torch.Tensor]:
        """See `EpisodeCheck`."""
        return {
            **{f"slot_err_{each}_m": away(step, each, self.slots[each]) for each in self.objects},
            "beyond_m": self.inside.beyond(step).amax(1),
            "corner_speed_m_per_s": corner_speed(step).amax(1),
        }

    def headline(self, values: Mapping[str, float]) -> str:
        """How well the objects are placed."""
        off = [f"{each} {1e3 * values[f'slot_err_{each}_m']:.1f} mm" for each in self.objects]
        clearance = 1e3 * values["jaw_clearance_m"]
        return f"{', '.join(off)} off their places, jaws {clearance:.0f} mm above the rim"


class _PerObject(Rule):
    """A rule of the box task for each object."""

    def __init__(self, name: str, text: str, check: BoxCheck) -> None:
        super().__init__(name, text, check.objects)
        self.check = check
        self.t = check.t


class _Grasp(Streak):
    """GRASP: both jaws press; it begins with forgetting what was found before the approach."""

    def __init__(self, check: BoxCheck) -> None:
        super().__init__(
            "GRASP",
            "{object} not grasped",
            check.objects,
            in_hand(*check.objects),
            check.t.grasp_steps,
            phases=check.during("close"),
            doing="between both jaws",
        )
        self._approaches = check.during("approach")

    def start(self, view: TaskView) -> None:
        super().start(view)
        self._approach = view.during(self._approaches)

    def update(self, step: Step) -> None:
        if step.view.phased:
            step.view.forget(step.judged(self._approach))
        super().update(step)


class _CarriedOver(Carried):
    """CARRY: carried, and over the box when it is let go of."""

    def __init__(self, check: BoxCheck, lift: Streak) -> None:
        super().__init__(
            "CARRY",
            "{object} not carried over the box",
            check.objects,
            check.airborne,
            check.t.carry_steps,
            distance=check.t.carry_distance,
            phases=check.during("carry"),
            doing="loaded in the air",
            after=lift,
        )
        self._check = check

    def start(self, view: TaskView) -> None:
        super().start(view)
        self._hold = view.during(self._check.during("hold"))
        self.over = view.counter(len(self.objects))  # in the last step of the hold, or of any load

    def update(self, step: Step) -> None:
        super().update(step)
        hold = step.judged(self._hold) if step.view.phased else step.in_hand
        self.over.copy_(torch.where(hold, self._check.inside.over(step), self.over))

    def judge(self, end: Step) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        held, values = super().judge(end)
        return held & (self.over > 0.0), values | self.by_object("over_box{}", self.over)

    def report(self, values: Mapping[str, float]) -> list[tuple[str, str]]:
        ending = ", not over the box when it was let go of"
        return [
            (
                found if values[f"over_box{suffix}"] else found + ending,
                f"{wanted}, then over the box",
            )
            for suffix, (found, wanted) in zip(self.suffixes, super().report(values), strict=True)
        ]


class _Drop(_PerObject):
    """DROP: no step without load between the last grasp and the release."""

    def __init__(self, check: BoxCheck, grasp: Streak, lift: Streak, carry: _CarriedOver) -> None:
        super().__init__("DROP", "{object} dropped", check)
        self._grasp = grasp
        self._lift = lift
        self._carry = carry

    def start(self, view: TaskView) -> None:
        self._close = view.during(self.check.during("close"))
        self._held = view.during(self.check.during("close", "lift", "carry", "hold"))
        self._unloaded = view.counter(len(self.objects))

    def update(self, step: Step) -> None:
        if step.view.phased:
            # A grasp that slips while the jaws still close is made anew; the last one counts.
            grasped = self._grasp.length == self.t.grasp_steps
            self._unloaded.masked_fill_(step.judged(self._close) & grasped, 0.0)
            lost = self._grasp.held() & step.judged(self._held)
        else:
            lost = self._lift.held() & (self._carry.over == 0.0)
        self._unloaded.add_(lost & ~step.in_hand)

    def judge(self, end: Step) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        return self._unloaded == 0.0, self.by_object("unloaded_steps{}", self._unloaded)

    def report(self, values: Mapping[str, float]) -> list[tuple[str, str]]:
        return [
            (
                f"{values[f'unloaded_steps{suffix}']:.0f} steps without both jaws between grasp and"
                " release",
                "none",
            )
            for suffix in self.suffixes
        ]


class _Release(_PerObject):
    """RELEASE: out of the jaws, the gripper open."""

    def __init__(self, check: BoxCheck, carry: Carried) -> None:
        super().__init__("RELEASE", "{object} not released", check)
        self._carry = carry

    def start(self, view: TaskView) -> None:
        self._opens = view.during(self.check.during("open", "retreat", "settle"))
        self.opening = view.counter(len(self.objects))  # widest without contact

    def update(self, step: Step) -> None:
        opens = step.judged(self._opens) if step.view.phased else self._carry.held()
        opening = gripper_opening(step.view.env).amin(1).float()[:, None]
        wide = torch.where(opens & step.untouched, opening, 0.0)
        torch.maximum(self.opening, wide, out=self.opening)

    def held(self) -> torch.Tensor:
        """Whether each object has been released, shape ``(nworld, objects)``, bool."""
        return self.opening >= self.t.open_fraction

    def judge(self, end: Step) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        return self.held(), self.by_object("opening{}", self.opening)

    def report(self, values: Mapping[str, float]) -> list[tuple[str, str]]:
        return [
            (
                f"opened {100.0 * values[f'opening{suffix}']:.0f} % without contact to a jaw",
                f"at least {100.0 * self.t.open_fraction:g} %",
            )
            for suffix in self.suffixes
        ]


class _Settled(_PerObject):
    """SETTLED: at rest in the box after the release."""

    def __init__(self, check: BoxCheck, release: _Release) -> None:
        super().__init__("SETTLED", "{object} not at rest in the box after its release", check)
        self._release = release

    def start(self, view: TaskView) -> None:
        size = len(self.objects)
        self._settle = view.during(self.check.during("settle"))
        self._rest = view.zeros(size)  # steps at rest in a row
        self._settled = view.counter(size)  # as of the settling's last step, or the most

    def update(self, step: Step) -> None:
        self._rest.add_(1.0).mul_(self.check.resting(step))
        if step.view.phased:
            settled = torch.where(step.judged(self._settle), self._rest, self._settled)
        else:
            settled = torch.maximum(self._settled, self._rest * self._release.held())
        self._settled.copy_(settled)

    def judge(self, end: Step) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        held = self._settled >= self.t.window
        return held, self.by_object("settled_steps{}", self._settled)

    def report(self, values: Mapping[str, float]) -> list[tuple[str, str]]:
        return [
            (
                f"{values[f'settled_steps{suffix}']:.0f} steps at rest in the box after release",
                f"at least {self.t.window}",
            )
            for suffix in self.suffixes
        ]


class _Order(Rule):
    """ORDER: no object is grasped before the one before it is released."""

    def __init__(self, check: BoxCheck, release: _Release) -> None:
        first, *others = check.objects
        pairs = zip(check.objects, others, strict=False)
        text = " or ".join(f"{later} grasped before {each} was released" for each, later in pairs)
        super().__init__("ORDER", text or f"{first} grasped too early")
        self._release = release

    def start(self, view: TaskView) -> None:
        self._early = torch.zeros(view.env.nworld, dtype=torch.bool, device=view.env.device)

    def update(self, step: Step) -> None:
        early = step.in_hand[:, 1:] & ~self._release.held()[:, :-1]
        self._early |= early.any(1)

    def judge(self, end: Step) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        return ~self._early, {"too_early": self._early.float()}

    def report(self, values: Mapping[str, float]) -> list[tuple[str, str]]:
        (text,) = self.texts.values()
        return [(text if values["too_early"] else "in order", "each released before the next")]


class _JawClear(Rule):
    """JAW_CLEAR: the jaws are above the box at the end."""

    at_end = True

    def __init__(self, check: BoxCheck) -> None:
        super().__init__("JAW_CLEAR", "gripper too low at the end")
        self._check = check

    def judge(self, end: Step) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        sim = end.view.env.sim
        sim.kinematics()
        jaws = LowestPoint(sim.model, self._check.cfg.robot.jaw_bodies, sim.device)
        # The rim is above the table.
        clearance = jaws.height(sim.xpos, sim.xquat) - self._check.inside.rim
        return clearance >= self._check.t.jaw_clearance, {"jaw_clearance_m": clearance}

    def report(self, values: Mapping[str, float]) -> list[tuple[str, str]]:
        return [
            (
                f"lowest jaw geometry {millimetres(values['jaw_clearance_m'])} above the rim",
                f"at least {millimetres(self._check.t.jaw_clearance)}",
            )
        ]


class BoxSuccess:
    """Achieved while all objects have been at rest in the box, out of the jaws, for the whole
    window, and the gripper is open. It shares the thresholds of the task's check.
    """

    def __init__(self, env: EnvView, *, open_fraction: float) -> None:
        """Allocates the counter.

        Args:
            env: The environment, its task's check a `BoxCheck`.
            open_fraction: How far the gripper must be open, from 0 (closed) to 1 (open), as
                measured.

        Raises:
            MjstackError: The fraction is out of range, or the task has another check.
        """
        if not 0.0 <= open_fraction <= 1.0:
            raise ParameterError("open_fraction", open_fraction, "a number from 0 to 1")
        self._open = open_fraction
        check = BoxCheck(env.cfg)
        self._view = check.view(env)
        self._rest = InWindow("REST", "", check.resting, check.t.window)
        self._rest.start(self._view)

    def __call__(self, env: EnvView) -> torch.Tensor:
        """Processes a step; shape ``(nworld,)``, bool."""
        self._rest.update(self._view.step())
        return self._rest.held() & (gripper_opening(env) >= self._open).all(1)

    def reset(self, mask: torch.Tensor) -> None:
        """Forgets the masked worlds."""
        self._rest.length.masked_fill_(mask, 0.0)
