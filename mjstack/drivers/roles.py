"""Roles of the configured phases in bringing objects to their goals, for the state-based expert."""

from collections.abc import Sequence
from enum import IntEnum

from mjstack.config.schema import Config
from mjstack.errors import ConfigError
from mjstack.scene.phases import Phase, source_names


class Role(IntEnum):
    """The part of a phase in bringing an object to its goal."""

    over = 0
    down = 1
    close = 2
    carry = 3
    place = 4
    open = 5
    retreat = 6


def find_roles(
    cfg: Config, phases: Sequence[Phase], goals: Sequence[str]
) -> tuple[list[str], list[list[int]]]:
    """The objects of a task, and for each the number of the phase that plays each `Role`.

    Args:
        cfg: The configuration.
        phases: Its phases.
        goals: Objects with goals.

    Raises:
        ConfigError: The phases do not bring an object to its goal, or there is none and the phases
            have more than one target.
    """
    things = cfg.scene.objects
    if not goals:
        moves = [k for k, phase in enumerate(phases) if phase.target is not None]
        anchor = str(phases[moves[0]].spec.anchor) if moves else ""
        targets = {(phase.spec.anchor or anchor, phase.spec.gripper) for phase in phases}
        if len(targets) != 1 or anchor not in things:
            raise _refusal(cfg, "has no goals")
        return [anchor], [[moves[0]] + [moves[-1]] * (len(Role) - 1)]
    sources = source_names(cfg.scene)
    rows = []
    for name in goals:
        number = sources.index(name)
        closes = [k for k, phase in enumerate(phases) if phase.grasped == number]
        carries = [k for k, phase in enumerate(phases) if phase.carried == number]
        if not closes or not carries or closes[0] == 0:
            raise _refusal(cfg, f"does not bring {name} to its goal in its phases")
        close = closes[-1]
        over = close - 1
        while over > 0 and phases[over - 1].spec.anchor == name:
            over -= 1
        place = carries[-1]
        carry = carries[-2] if len(carries) > 1 else place
        after = [k for k in range(place + 1, len(phases)) if phases[k].target is not None]
        last = after[0] if after else place
        retreat = after[1] if len(after) > 1 else last
        rows.append([over, close - 1, close, carry, place, last, retreat])
    return list(goals), rows


def _refusal(cfg: Config, why: str) -> ConfigError:
    expected = f"another controller, because task {cfg.task.name} {why}"
    return ConfigError("controller", cfg.controller.name, expected, "Set controller=closed_loop")


def follows_anchor(phase: Phase, things: Sequence[str]) -> bool:
    """Whether the height of a phase's target follows its anchor: an object, but not the one that is
    carried.
    """
    spec = phase.spec
    if phase.target is None or spec.level == "table" or spec.anchor not in things:
        return False
    return things.index(spec.anchor) != phase.carried
