"""Checks of the examples against episodes that are written by hand: what a rule's name says is what
it asks for, and the success of a step asks for the same.
"""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from altered import Altered, judge_held, raised, turned
from environments import REBOT_LATER

from mjstack.managers.view import EnvView
from mjstack.mdp.geometry import place_xy, pose_w

X = (1.0, 0.0, 0.0)
Y = (0.0, 1.0, 0.0)
Z = (0.0, 0.0, 1.0)
DIAGONAL = (0.6, 0.8, 0.0)
PEG = (0.016, 0.042)  # m: radius and half length
PUCK = (0.034, 0.015)
WALL = 0.02  # m: height of the slot's walls
ROBOTS = ("so101", "rebot")
# Rules about how the object came there, which no single step can see
OF_AN_EPISODE = {"REST_SPEED", "REST_POSITION", "REST_ROTATION", "SLID"}


def standing(
    shape: tuple[float, float], axis: tuple[float, float, float]
) -> Callable[..., Altered]:
    """Episodes of a shape on the table, so far from the anchor, leaning about an axis."""

    def make(
        kind: str,
        off: float | tuple[float, float],
        breaks: str = "",
        lean: float = 0.0,
        axis: tuple[float, float, float] = axis,
        aside: float = 0.0,
        up: float = 0.0,
        **others: Any,
    ) -> Altered:
        xy = off if isinstance(off, tuple) else (off, aside)
        quat = others.pop("quat", turned(lean, *axis))
        at = (*xy, raised(*shape, lean) + up)
        return Altered(kind, at, set(breaks.split()), quat=quat, **others)

    return make


peg = standing(PEG, Y)  # so far behind the slot's mouth, leaning over the back wall
puck = standing(PUCK, X)
square = standing((0.015, 0.035), X)  # so far from the middle of the hole along x
SLOT = [
    *(
        peg("upright", d, quat=turned(yaw, *Z))
        for d in (0.0205, 0.024, 0.028, 0.032, 0.0355)
        for yaw in (0.0, 70.0)
    ),
    *(
        peg("upside down", d, quat=turned(180.0, *axis))
        for d, axis in ((0.025, X), (0.03, DIAGONAL))
    ),
    *(peg("upright", 0.03, lean=2.0, axis=axis) for axis in (X, Y)),
    *(peg("leaning back", 0.026, "STANDS", lean=5.0 * k) for k in range(1, 17)),
    *(
        peg("leaning aside", 0.026, "STANDS", lean=k, axis=DIAGONAL)
        for k in (5.0, 10.0, 25.0, 40.0)
    ),
    *(peg("leaning aside", 0.026, "STANDS", lean=k, axis=X) for k in (6.0, 30.0, 75.0)),
    *(peg("outside", d, "DEPTH") for d in (-0.03, 0.0, 0.015, 0.0375, 0.06, 0.08, 0.135)),
    *(peg("outside", 0.028, "DEPTH", aside=y) for y in (0.004, -0.01, 0.05)),
    peg("on the rim", 0.026, "STANDS", lean=90.0),
    peg("on the rim", 0.026, "STANDS", lean=90.0, up=WALL),
    peg("on the rim", 0.03, "STANDS", up=WALL),
    *(peg("in the air", 0.03, "STANDS", up=up) for up in (0.003, 0.01, 0.1)),
    peg("through the table", 0.03, "STANDS", up=-0.004),
    peg("moving", 0.03, "REST_SPEED", velocity=(0.2, 0.0, 0.0, 0.0, 0.0, 0.0)),
    peg("moving", 0.03, "REST_SPEED", velocity=(0.0, 0.0, 0.0, 0.0, 0.0, 5.0)),
    peg("moving", 0.0215, "REST_POSITION", drift=0.00012),
    peg("moving", 0.03, "DEPTH REST_POSITION", leaves=100),
    peg("in the hand", 0.03, "RELEASED", touched=True),
    peg("in the hand", 0.03, "RELEASED", closed=True),
]
ACROSS = ((0.0, 0.0), (0.019, 0.0), (-0.019, 0.0), (0.0, 0.019), (0.0, -0.019), (0.013, 0.013))
BESIDE = (
    (0.021, 0.0),
    (-0.021, 0.0),
    (0.0, 0.021),
    (0.015, 0.015),
    (-0.08, 0.0),
    (0.05, 0.0),
    (0.0, 0.15),
    (0.0, -0.05),
)
PUSH = [
    *(puck("flat", off) for off in ACROSS),
    *(puck("upside down", (0.0, 0.0), quat=turned(180.0, *axis)) for axis in (X, Y, DIAGONAL)),
    *(puck("flat", (0.01, 0.0), quat=turned(yaw, *Z)) for yaw in (30.0, 100.0, 170.0)),
    puck("flat", (0.0, 0.0), lean=2.0),
    *(puck("leaning", (0.0, 0.0), "FLAT", lean=5.0 * k) for k in range(1, 6)),
    *(puck("leaning", (0.0, 0.0), "FLAT SLID", lean=5.0 * k) for k in range(7, 17)),
    *(puck("leaning", (0.0, 0.01), "FLAT", lean=k, axis=Y) for k in (5.0, 12.0, 20.0, 28.0)),
    *(
        puck("leaning", (0.0, 0.01), "FLAT SLID", lean=k, axis=DIAGONAL)
        for k in (40.0, 55.0, 70.0, 80.0)
    ),
    *(puck("outside", off, "AT_GOAL") for off in BESIDE),
    *(
        puck("on the rim", (0.0, 0.0), "FLAT SLID", lean=90.0, axis=axis)
        for axis in (X, Y, DIAGONAL)
    ),
    *(puck("in the air", (0.0, 0.0), "FLAT SLID", up=up) for up in (0.006, 0.02, 0.1)),
    puck("through the table", (0.0, 0.0), "FLAT SLID", up=-0.006),
    puck("moving", (0.0, 0.0), "REST_SPEED", velocity=(0.0, 0.1, 0.0, 0.0, 0.0, 0.0)),
    puck("moving", (0.0, 0.0), "REST_SPEED", velocity=(0.0, 0.0, 0.0, 0.0, 0.0, 3.0)),
    puck("moving", (-0.007, 0.0), "REST_POSITION", drift=0.00012),
    puck("moving", (0.0, 0.0), "AT_GOAL REST_POSITION", leaves=100),
    puck("in the hand", (0.0, 0.0), "LEFT_ALONE", touched=True),
    puck("alone, the jaws closed", (0.0, 0.0), closed=True),
    puck("lifted before", (0.0, 0.0), "SLID", earlier=(-0.1, 0.0, 0.04)),
    puck(
        "tipped before",
        (0.0, 0.0),
        "SLID",
        earlier=(-0.1, 0.0, 0.034),
        earlier_quat=turned(90.0, *X),
    ),
    puck("pushed before", (0.0, 0.0), earlier=(-0.1, 0.0, 0.015)),
]

HOLE = [
    *(square("upright", off) for off in (0.0, 0.001, -0.001)),
    square("upside down", 0.0, quat=turned(180.0, *X)),
    *(square("leaning", 0.0, "BOTTOM", lean=k, axis=axis) for k in (10.0, 45.0) for axis in (X, Y)),
    square("lying", 0.0, "BOTTOM", lean=90.0),
    *(square("outside", off, "IN_HOLE") for off in (0.002, -0.04)),
    square("on the rim", 0.0, "BOTTOM", up=0.016, quat=turned(45.0, *Z)),
    square("in the air", 0.0, "BOTTOM", up=0.05),
    square("in the hand", 0.0, "RELEASED", touched=True),
]


def slot(env: EnvView) -> torch.Tensor:
    """The slot's mouth, on the table."""
    at = pose_w(env, "slot")[:, :3].clone()
    at[:, 2] = env.cfg.scene.table_top
    return at


def goal(env: EnvView) -> torch.Tensor:
    """The goal, on the table."""
    xy = place_xy(env, "goal")
    return torch.cat((xy, torch.full_like(xy[:, :1], env.cfg.scene.table_top)), dim=1)


def hole(env: EnvView) -> torch.Tensor:
    """The middle of the hole, on the table."""
    at = pose_w(env, "hole")[:, :3].clone()
    at[:, 2] = env.cfg.scene.table_top
    return at


TASKS = {"slot": ("peg", slot, SLOT), "push": ("puck", goal, PUSH), "peg": ("peg", hole, HOLE)}


@REBOT_LATER
@pytest.mark.parametrize("task", TASKS)
def test_a_state_is_judged_by_what_the_rules_are_called(task: str, robot: str) -> None:
    """60 episodes of slot and push. A step is a success where no rule of the window is broken."""
    name, anchor, worlds = TASKS[task]
    judged = judge_held(task, robot, name, anchor, worlds)
    expected = [(world.breaks, world.breaks <= OF_AN_EPISODE) for world in worlds]
    wrong = [pair for pair in zip(worlds, judged, expected, strict=True) if pair[1] != pair[2]]
    assert not wrong
