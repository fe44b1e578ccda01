"""A process that plans worlds for another one; `planning_pool` starts it and ends it."""

from __future__ import annotations

import os
from multiprocessing.connection import Connection

import numpy as np

from mjstack.drivers.open_loop import OpenLoopPlanner
from mjstack.drivers.planning_pool import Plan
from mjstack.errors import Unreachable


def serve(socket: Connection) -> None:
    """Takes a configuration, then chunks of worlds, and answers each; returns when nobody asks any
    more.
    """
    try:
        planner = OpenLoopPlanner(socket.recv())
        socket.send([])
        while True:
            socket.send(_plan(planner, *socket.recv()))
    except (EOFError, ConnectionError):
        return


def _plan(
    planner: OpenLoopPlanner, worlds: list[int], sources_xy: np.ndarray
) -> list[Plan] | Unreachable:
    """The plans of some worlds; or why the first of them that has none has none."""
    try:
        return [
            (world, *planner.plan_world(world, xy))
            for world, xy in zip(worlds, sources_xy, strict=True)
        ]
    except Unreachable as error:
        return error


if __name__ == "__main__":
    serve(Connection(os.dup(0)))
