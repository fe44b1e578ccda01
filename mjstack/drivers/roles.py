"""Roles of the configured phases in moving objects, for the state-based expert."""

import math
from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

from mjstack.config.schema import Config
from mjstack.errors import ConfigError
from mjstack.scene.phases import Phase, source_names

_LATE = 0.1001  # s: by so much commands may be late
_FIX = "Set controller=closed_loop, or trainer=clone to train a policy"


class Role(IntEnum):
    """The part of a phase in bringing an object to its goal."""

    over = 0
    down = 1
    close = 2
    carry = 3
    place = 4
    open = 5
    retreat = 6


class ObjectRoles(NamedTuple):
    """An object that the phases move, and the phases that do it.

    Attributes:
        name: The object.
        way: ``grasp``: the jaws grasp it; ``push``: they push it while they are closed;
            ``approach``: the grasp point only goes there.
        phases: Number of the phase that plays each `Role`. One that nothing follows, such as the
            lift of an object that is kept, plays those after it too.
    """

    name: str
    way: str
    phases: list[int]


def find_roles(cfg: Config, phases: Sequence[Phase]) -> list[ObjectRoles]:
    """The objects that a configuration's phases move, in the order in which they do; a ConfigError
    if they do nothing that a state tells, or commands are too late: a state does not have those
    that are still to come.
    """
    most = math.floor(_LATE / cfg.timing.step_dt)
    if cfg.timing.command_delay + cfg.timing.random_delay > most:
        late = "command_delay" if cfg.timing.command_delay else "random_delay"
        expected = f"at most {most}, both delays together, with controller={cfg.controller.name}"
        raise ConfigError(f"timing.{late}", getattr(cfg.timing, late), expected, _FIX)
    names = source_names(cfg.scene)
    moves = [k for k, phase in enumerate(phases) if phase.target is not None]
    moved: dict[str, ObjectRoles] = {}
    for close, phase in enumerate(phases):
        later = [k for k in moves if k > close]
        if phase.grasped >= 0:
            name = names[phase.grasped]
            if close == 0:
                raise _refusal(cfg, f"grasp {name} without a phase before that leads to it")
            way = "grasp"
            down = close - 1
            places = [k for k in later if phases[k].carried == phase.grasped] or [close]
        elif later and _pushes(phase, phases[later[0]]) and phase.spec.anchor in cfg.scene.free:
            name = str(phase.spec.anchor)
            way = "push"
            down = close
            places = later[:1]
        else:
            continue
        last, retreat = _find_release(phases, places[-1])
        if last != places[-1] and phases[places[-1]].spec.anchor in (name, None):
            raise _refusal(cfg, f"let go of {name} where it is, which no state tells from before")
        over = down
        while over > 0 and phases[over - 1].spec.anchor == name:
            over -= 1
        row = [over, down, close, places[-2:][0], places[-1], last, retreat]
        moved[name] = ObjectRoles(name, way, row)
    if not moved:
        anchor = str(phases[moves[0]].spec.anchor) if moves else ""
        targets = {(phase.spec.anchor or anchor, phase.spec.gripper) for phase in phases}
        if len(targets) != 1 or anchor not in cfg.scene.objects:
            why = "neither grasp an object, nor push one with closed jaws, nor keep to a single one"
            raise _refusal(cfg, why)
        row = [moves[0]] + [moves[-1]] * (len(Role) - 1)
        moved[anchor] = ObjectRoles(anchor, "approach", row)
    return list(moved.values())


def _pushes(phase: Phase, later: Phase) -> bool:
    """Whether closed jaws go from beside an object to another anchor, and push it there."""
    closed = phase.spec.gripper == later.spec.gripper == "closed"
    free = max(phase.grasped, phase.carried, later.grasped, later.carried) < 0
    return closed and free and phase.target is not None and phase.spec.anchor != later.spec.anchor


def _find_release(phases: Sequence[Phase], place: int) -> tuple[int, int]:
    """Numbers of the phase that lets go of what was placed, and of the next that leads away: the
    same one, if the gripper opens in none before it.
    """
    after = range(place + 1, len(phases))
    last = next((k for k in after if phases[k].target or phases[k].spec.gripper == "open"), place)
    return last, next((k for k in after if k > last and phases[k].target), last)


def _refusal(cfg: Config, why: str) -> ConfigError:
    expected = f"another controller, because the phases of task {cfg.task.name} {why}"
    return ConfigError("controller", cfg.controller.name, expected, _FIX)
