"""Whether the arm reaches what its phases ask of a cube, wherever the cube may stand."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from mjstack.errors import ParameterError
from mjstack.kinematics.reach import PointReach
from mjstack.managers.base import EnvView
from mjstack.scene import table_top
from mjstack.scene.phases import CubeTarget, cube_targets

_GRID = 0.02  # [m] between the places whose reach is tried


def reach_distances(env: EnvView, cube: int, xy: np.ndarray) -> tuple[np.ndarray, list[CubeTarget]]:
    """How far the grasp point stays from a cube, from above it, and from where the phases bring it
    above it.

    Args:
        env: The environment.
        cube: Number of the cube.
        xy: Where it stands [m], shape ``(n, 2)``.

    Returns:
        Distance [m], shape ``(n, targets)``, and the targets.
    """
    robot = env.cfg.robot
    scene = env.cfg.scene
    # Whatever the phases do: other tasks and controllers take either cube.
    own = [
        CubeTarget("", scene.grasp_offset, "open"),
        CubeTarget("", robot.approach_height, "open"),
    ]
    asked = {
        (round(target.height, 6), target.gripper): target
        for target in [*own, *cube_targets(env.cfg)[cube]]
    }
    targets = list(asked.values())
    center = table_top(scene) + scene.cube_half
    distances = np.zeros((len(xy), len(targets)))
    for gripper, command in (("open", robot.gripper_open), ("closed", robot.gripper_closed)):
        columns = [k for k, target in enumerate(targets) if target.gripper == gripper]
        points = np.array([[x, y, center + targets[k].height] for x, y in xy for k in columns])
        if len(points):
            reach = PointReach(env.sim.model, robot, command)
            distances[:, columns] = reach.solve(points).distance.reshape(len(xy), -1)
    return distances, targets


def require_reach(env: EnvView, name: str, region: tuple[float, float]) -> None:
    """Tries a grid over each cube's region, as far as it is on the table.

    Raises:
        ParameterError: The arm cannot follow a phase above a cube somewhere there.
    """
    scene = env.cfg.scene
    for cube, at in enumerate((scene.red_xy, scene.blue_xy)):
        axes = []
        for k in (0, 1):
            room = (
                scene.table_half[k] - math.sqrt(2.0) * scene.cube_half
            )  # as `Placement` keeps them, for any yaw
            low, high = (
                np.clip(
                    at[k] + s * region[k],
                    scene.table_center[k] - room,
                    scene.table_center[k] + room,
                )
                for s in (-1, 1)
            )
            axes.append(
                np.unique(np.linspace(low, high, max(5, 1 + math.ceil((high - low) / _GRID))))
            )
        xy = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
        if found := out_of_reach(env, cube, xy):
            fix = (
                "Make the region smaller, or move the cubes (scene.red_xy, scene.blue_xy);"
                " job=reachability draws a map"
            )
            raise ParameterError(
                name, list(region), f"a region that the arm reaches; {found[1]}", fix
            )


def out_of_reach(
    env: EnvView, cube: int, xy: Sequence[Sequence[float]] | np.ndarray
) -> tuple[int, str] | None:
    """The place of a cube that is farthest out of reach, and what to say of it; None if the arm
    reaches them all.

    Args:
        env: The environment.
        cube: Number of the cube.
        xy: Where it may stand [m], shape ``(n, 2)``.
    """
    places = np.asarray(xy, dtype=float).reshape(-1, 2)
    distances, targets = reach_distances(env, cube, places)
    if (distances <= env.cfg.controller.ik_tolerance).all():
        return None
    row, column = (int(k) for k in np.unravel_index(distances.argmax(), distances.shape))
    x, y = places[row]
    target = targets[column]
    where = (
        "at its centre"
        if abs(target.height) < 5e-4
        else f"{1e3 * target.height:.0f} mm above its centre"
    )
    where += f" (phase {target.phase})" if target.phase else ""
    return (
        row,
        (
            f"with {list(env.index.objects)[cube]} at ({x:.3f}, {y:.3f}) m the point {where} is "
            f"{1e3 * distances[row, column]:.1f} mm out of reach"
        ),
    )
