"""Objects that the configured phases move, for an expert without a clock."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from mjstack.config.schema import Config
from mjstack.errors import ConfigError
from mjstack.scene.phases import Phase, source_names

_LATE = 0.1001  # s: by so much commands may be late
_FIX = "Set controller.clock=true, or trainer=clone to train a policy"


class Move(NamedTuple):
    """An object that the phases bring somewhere, and the phases that do it, by their numbers.

    Attributes:
        name: The object.
        way: ``grasp``: the jaws grasp it; ``push``: they push it while they are closed;
            ``approach``: the grasp point only goes there.
        reach: Phases whose targets lead to it, the last one to where the jaws close.
        close: The phase in which they close, or are closed.
        carry: Phases whose targets lead on with it; of an object that is kept, the last one alone.
        open: The phase that lets go of it; of an object that is kept, the last of ``carry``.
        retreat: The phase that leads away then.
        lifts: The phases that carry it: ``carry``, and those that lift it before.
    """

    name: str
    way: str
    reach: list[int]
    close: int
    carry: list[int]
    open: int
    retreat: int
    lifts: list[int]


def find_moves(cfg: Config, phases: Sequence[Phase]) -> list[Move]:
    """The moves of a configuration's phases, in their order; a ConfigError if they do nothing that
    a state tells, or commands are too late: a state does not have those still to come.
    """
    most = math.floor(_LATE / cfg.timing.step_dt)
    if cfg.timing.command_delay + cfg.timing.random_delay > most:
        late = "command_delay" if cfg.timing.command_delay else "random_delay"
        expected = f"at most {most}, both delays together, with controller.clock=false"
        raise ConfigError(f"timing.{late}", getattr(cfg.timing, late), expected, _FIX)
    names = source_names(cfg.scene)
    leads = [k for k, phase in enumerate(phases) if phase.target is not None]
    moves: dict[str, Move] = {}
    for close, phase in enumerate(phases):
        later = [k for k in leads if k > close]
        down = close
        if phase.grasped >= 0:
            name = names[phase.grasped]
            if close == 0:
                raise _refusal(cfg, f"grasp {name} without a phase before that leads to it")
            way = "grasp"
            down = close - 1
            lifts = [k for k in later if phases[k].carried == phase.grasped] or [close]
        elif later and _pushes(phase, phases[later[0]]) and phase.spec.anchor in cfg.scene.free:
            name = str(phase.spec.anchor)
            way = "push"
            lifts = later[:1]
        else:
            continue
        last, retreat = _find_release(phases, lifts[-1])
        if last != lifts[-1] and phases[lifts[-1]].spec.anchor in (name, None):
            raise _refusal(cfg, f"let go of {name} where it is, which no state tells from before")
        over = down
        while over > 0 and phases[over - 1].spec.anchor == name:
            over -= 1
        carry = [k for k in lifts if phases[k].spec.anchor != name] or lifts[-1:]
        carry = [  # of those to the same target the last one
            k for k in carry if k == carry[-1] or phases[k].target != phases[k + 1].target
        ]
        reach = [*range(over, down + 1)]
        if name in moves:
            raise _refusal(cfg, f"move {name} twice, which no state tells apart")
        moves[name] = Move(name, way, reach, close, carry, last, retreat, lifts)
    if not moves:
        anchor = str(phases[leads[0]].spec.anchor) if leads else ""
        targets = {(phase.spec.anchor or anchor, phase.spec.gripper) for phase in phases}
        if len(targets) != 1 or anchor not in cfg.scene.objects:
            why = "neither grasp an object, nor push one with closed jaws, nor keep to a single one"
            raise _refusal(cfg, why)
        last = leads[-1]
        moves[anchor] = Move(anchor, "approach", leads, last, [last], last, last, [last])
    return list(moves.values())


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
    expected = f"true, because the phases of task {cfg.task.name} {why}"
    return ConfigError("controller.clock", "false", expected, _FIX)
