"""Whether the arm reaches what its phases ask of an object, wherever the object may stand."""

import math

import numpy as np

from mjstack.errors import ParameterError
from mjstack.kinematics.reach import PointReach
from mjstack.managers.view import EnvView
from mjstack.scene import table_top
from mjstack.scene.phases import (
    Phase,
    Target,
    nominal_xy,
    object_targets,
    source_names,
    target_xy,
)

_GRID = 0.02  # [m] between the positions whose reach is tried


def reach_distances(
    env: EnvView, name: str, xy: np.ndarray
) -> tuple[np.ndarray, list[tuple[Phase, Target]]]:
    """How far the grasp point stays from where the phases bring it at an object.

    Args:
        env: The environment.
        name: The object.
        xy: Where it stands [m], shape ``(n, 2)``.

    Returns:
        Distance [m], shape ``(n, targets)``, and the phases with their targets.
    """
    robot = env.cfg.robot
    targets = object_targets(env.cfg)[name]
    sources = np.tile(nominal_xy(env.cfg.scene), (len(xy), 1, 1))
    sources[:, source_names(env.cfg.scene).index(name)] = xy
    distances = np.zeros((len(xy), len(targets)))
    for gripper, command in robot.grips.items():
        columns = [k for k, (phase, _) in enumerate(targets) if phase.spec.gripper == gripper]
        if not columns:
            continue
        points = np.empty((len(xy), len(columns), 3))
        for place, k in enumerate(columns):
            _, target = targets[k]
            points[:, place, :2] = target_xy(target, sources)
            points[:, place, 2] = target.z
        reach = PointReach(env.sim.model, robot, command)
        distances[:, columns] = reach.solve(points.reshape(-1, 3)).distance.reshape(len(xy), -1)
    return distances, targets


def require_reach(env: EnvView, name: str, region: tuple[float, float]) -> None:
    """Tries a grid over each object's region, as far as it is on the table.

    Raises:
        ParameterError: The arm cannot follow a phase at an object somewhere there.
    """
    scene = env.cfg.scene
    center = np.array(scene.table_center[:2])
    for thing, spec in scene.free.items():
        room = np.array(scene.table_half[:2]) - spec.footprint  # as `Placement` has it, for any yaw
        lows = np.clip(np.subtract(spec.xy, region), center - room, center + room)
        highs = np.clip(np.add(spec.xy, region), center - room, center + room)
        axes = [
            np.unique(np.linspace(low, high, max(5, 1 + math.ceil((high - low) / _GRID))))
            for low, high in zip(lows, highs, strict=True)
        ]
        xy = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
        if found := out_of_reach(env, thing, xy):
            fix = (
                f"Make the region smaller, or move the object (scene.objects.{thing}.xy);"
                " job=reachability draws a map"
            )
            raise ParameterError(
                name, list(region), f"a region that the arm reaches; {found[1]}", fix
            )


def out_of_reach(env: EnvView, name: str, xy: np.ndarray) -> tuple[int, str] | None:
    """The position of an object that is farthest out of reach, by its row, and a sentence on it;
    None if the arm reaches them all.

    Args:
        env: The environment.
        name: The object.
        xy: Where it may stand [m], shape ``(n, 2)``.
    """
    distances, targets = reach_distances(env, name, xy)
    if (distances <= env.cfg.controller.ik_tolerance).all():
        return None
    row, column = (int(k) for k in np.unravel_index(distances.argmax(), distances.shape))
    x, y = xy[row]
    phase, target = targets[column]
    scene = env.cfg.scene
    height = target.z - table_top(scene) - scene.objects[name].half_height
    where = "at its centre" if abs(height) < 5e-4 else f"{1e3 * height:.0f} mm above its centre"
    return (
        row,
        (
            f"with {name} at ({x:.3f}, {y:.3f}) m the point {where} (phase {phase.name}) is "
            f"{1e3 * distances[row, column]:.1f} mm out of reach"
        ),
    )
