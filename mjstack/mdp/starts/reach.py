"""Whether the arm reaches what its phases ask of an object, wherever the object may stand."""

import math
from collections.abc import Sequence

import numpy as np

from mjstack.errors import ParameterError
from mjstack.kinematics.reach import PointReach
from mjstack.managers.view import EnvView
from mjstack.scene.index import gripper_targets
from mjstack.scene.phases import nominal_xy, object_targets, source_names, target_xy

_GRID = 0.02  # [m] between the positions whose reach is tried


def require_reach(env: EnvView, region: Sequence[float]) -> None:
    """Try a grid over each object's region, as far as it is on the table.

    Raises:
        ParameterError: The arm cannot follow a phase at an object somewhere there.
    """
    scene = env.cfg.scene
    center = np.array(scene.table_center[:2])
    for thing, spec in scene.free.items():
        room = np.array(scene.table_half[:2]) - spec.footprint  # as `Placement` has it, for any yaw
        ends = np.array(spec.xy) + np.outer((-1.0, 1.0), region)
        axes = [
            np.unique(np.linspace(low, high, max(5, 1 + math.ceil((high - low) / _GRID))))
            for low, high in np.clip(ends, center - room, center + room).T
        ]
        xy = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
        if failure := out_of_reach(env, thing, xy):
            expected = f"a region that the arm reaches; {failure[1]}"
            fix = f"Make the region smaller, or move the object (scene.objects.{thing}.xy)"
            raise ParameterError(
                "xy", region, expected, f"{fix}; tools/reachability.py draws a map"
            )


def out_of_reach(env: EnvView, name: str, xy: np.ndarray) -> tuple[int, str] | None:
    """The position of an object that is farthest out of reach, by its row, and a sentence on it;
    None if the arm reaches them all.

    Args:
        env: The environment.
        name: The object.
        xy: Where it may stand [m], shape ``(n, 2)``.
    """
    # How far the grasp point stays from each target at each position
    scene = env.cfg.scene
    targets = object_targets(env.cfg)[name]
    sources = np.tile(nominal_xy(scene), (len(xy), 1, 1))
    sources[:, source_names(scene).index(name)] = xy
    points = np.empty((len(xy), len(targets), 3))
    for column, (_, target) in enumerate(targets):
        points[:, column, :2] = target_xy(target, sources)
        points[:, column, 2] = target.z
    distances = np.zeros(points.shape[:2])
    for width in {phase.width for phase, _ in targets}:
        (gripper,) = gripper_targets(env.sim.model, env.cfg.robot, [width])
        reach = PointReach(env.sim.model, env.cfg.robot, gripper.tolist())
        columns = [phase.width == width for phase, _ in targets]
        left = reach.solve(points[:, columns].reshape(-1, 3))[1]
        distances[:, columns] = left.reshape(len(xy), -1)
    if (distances <= env.cfg.controller.ik_tolerance).all():
        return None

    # The farthest in words
    row, column = (int(k) for k in np.unravel_index(distances.argmax(), distances.shape))
    x, y = xy[row]
    phase, target = targets[column]
    height = target.z - scene.table_top - scene.objects[name].half_height
    where = "at its centre" if abs(height) < 5e-4 else f"{1e3 * height:.0f} mm above its centre"
    point = f"with {name} at ({x:.3f}, {y:.3f}) m the point {where} (phase {phase.name})"
    return row, f"{point} is {1e3 * distances[row, column]:.1f} mm out of reach"
