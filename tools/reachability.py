"""Map what the arm reaches on the table, at which tilt of the gripper, and how far from their
positions the objects may stand: a choice of a robot's ``placements.<scene>.random_xy``.

    python tools/reachability.py robot=so101 --folder outputs/reachability

Heights are those at which the driver grasps, approaches and carries. Collisions are not looked at.
The folder gets reachability.csv, a row per point of the map, and reachability.png. Regions are
half-widths, reached at every level with the margin all round, of objects of any yaw on the table.
"""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from common import make_parser, run
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from mjstack.config.schema import Config
from mjstack.envs.buffers import Advance
from mjstack.errors import ConfigError
from mjstack.kinematics.batched_ik import BatchedIk, find_reach
from mjstack.report.table import Table
from mjstack.scene import build_model
from mjstack.scene.phases import object_targets

FINE = 0.001  # [m] to which regions are given
SOLVES = 16  # that turn the gripper upright, one after the other


def solve_upright(
    model: mujoco.MjModel, cfg: Config, gripper: str, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distances that are left to points of shape ``(n, 3)`` [m], and the smallest tilts of the
    gripper [deg], NaN where the distance is not within tolerance.
    """
    command = getattr(cfg.robot, f"gripper_{gripper}")
    q, distance = find_reach(model, cfg.robot, points, command)
    q, targets = q.flatten(0, 1), torch.from_numpy(np.tile(points, (len(q), 1)))
    ik = BatchedIk(model, cfg.robot, len(q), "cpu", iterations=40, approach_gain=0.5)
    for _ in range(SOLVES):
        q = ik.solve(q, targets)[0].clone()
    down = -ik.forward(q)[2][:, 2].view(distance.shape)
    reached = distance <= cfg.controller.ik_tolerance
    tilt = down.clamp(-1.0, 1.0).arccos().rad2deg().where(reached, torch.inf).amin(0)
    return distance.amin(0).numpy(), tilt.where(reached.any(0), torch.nan).numpy()


def find_levels(cfg: Config) -> dict[str, tuple[float, str]]:
    """Heights above the table [m] at which the task needs the grasp point, and the gripper's
    command there.
    """
    targets = [target for targets in object_targets(cfg).values() for target in targets]
    if not targets:
        expected = "a phase with an object as its anchor"
        raise ConfigError("controller.phases", list(cfg.controller.phases), expected)
    low, high = (end(targets, key=lambda pair: pair[1].z) for end in (min, max))
    # The jaws close where they grasp, but come there open, which reaches less far where one jaw
    # stays.
    levels = {"grasp": (low, "open"), "approach": (targets[0], ""), "carry": (high, "")}
    return {
        name: (target.z - cfg.scene.table_top, gripper or phase.spec.gripper)
        for name, ((phase, target), gripper) in levels.items()
    }


def find_region(
    cfg: Config, points: np.ndarray, reached: np.ndarray, name: str, step: float, margin: float
) -> tuple[bool, float, tuple[float, float]]:
    """Whether the region of ``reset=randomized`` around an object's position is reached with the
    margin; half-widths of the largest square and of the largest rectangle [m], 0 where none is.
    Between two points of the map the worse one counts.
    """
    scene = cfg.scene
    place = np.array(scene.objects[name].xy)
    away = np.abs(points[~reached] - place) - step - margin
    edges = np.minimum(place - points[0], points[-1] - place) - margin
    region = np.array(scene.random_xy) - 1e-9
    fits = (edges >= region).all() and not (away < region).all(axis=1).any()
    room = np.array(scene.table_half[:2]) - scene.objects[name].footprint
    most = np.maximum(np.minimum(edges, room - np.abs(place - scene.table_center[:2])), 0.0)
    half_x = np.arange(0.0, most[0] + 1e-9, FINE)
    half_y = [away[away[:, 0] <= half, 1].min(initial=most[1]) for half in half_x]
    half_y = FINE * np.floor(np.maximum(half_y, 0.0) / FINE + 1e-9)
    best = (half_x * half_y).argmax()
    return bool(fits), half_x[half_y >= half_x - 1e-9].max(), (half_x[best], half_y[best])


def save_map(
    path: Path, cfg: Config, x: np.ndarray, y: np.ndarray, tilts: dict, largest: dict
) -> None:
    """A panel per level: the tilt as colour, table, objects and regions."""
    scene = cfg.scene
    half = np.array((x[-1] - x[0], y[-1] - y[0])) / 2
    title = (
        f"{cfg.robot.title}, task {cfg.task.name}: what the arm reaches\nhatched: not reached;"
        " squares: objects; solid: configured region; dotted: largest with margin"
    )
    size = ((3.6 * max(0.6, half[0] / half[1]) + 1.0) * len(tilts) + 1.2, 5.6)
    drawing = Figure(size, layout="constrained")
    panels = drawing.subplots(1, len(tilts), squeeze=False)[0]
    top = np.nanmax(list(tilts.values()), initial=1.0)
    for panel, (label, tilt) in zip(panels, tilts.items(), strict=True):
        panel.set(title=label, xlabel="x [m]", ylabel="y [m]", aspect="equal", facecolor="0.92")
        middle = (x[len(x) // 2], y[len(y) // 2])
        panel.add_patch(outline(middle, half, hatch="////", ec="0.6", lw=0))
        colors = tilt.reshape(len(y), len(x))
        image = panel.pcolormesh(x, y, colors, vmin=0.0, vmax=top, shading="nearest")
        panel.add_patch(outline(scene.table_center, scene.table_half, ec="k", lw=1.5))
        for name, region in largest.items():
            color = scene.objects[name].color
            place = scene.objects[name].xy
            panel.plot(*place, "s", color=color, markersize=7, markeredgecolor="w")
            panel.add_patch(outline(place, scene.random_xy, ec=color, lw=1.8))
            panel.add_patch(outline(place, region, ec=color, lw=1.2, ls=":"))
    drawing.colorbar(image, ax=panels, label="smallest tilt of the gripper from vertical [deg]")
    drawing.suptitle(title, wrap=True)
    drawing.savefig(path, dpi=100)


def outline(center: Sequence[float], half: Sequence[float], **style: Any) -> Rectangle:
    """A rectangle around a point, of which the border is drawn."""
    corner = (center[0] - half[0], center[1] - half[1])
    return Rectangle(corner, 2.0 * half[0], 2.0 * half[1], fill=False, **style)


def draw_map(args: argparse.Namespace, cfg: Config, advance: Advance) -> Iterator[Table]:
    """Write the map, and give the largest regions around the objects."""
    model, scene = build_model(cfg), cfg.scene
    counts = [int(half / args.step + 1e-9) for half in scene.table_half[:2]]
    x, y = (scene.table_center[k] + args.step * np.arange(-n, n + 1) for k, n in enumerate(counts))
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    columns = {"x_m": points[:, 0], "y_m": points[:, 1]}
    tilts = {}
    for name, (height, gripper) in find_levels(cfg).items():
        places = np.insert(points, 2, scene.table_top + height, axis=1)
        distance, tilt = solve_upright(model, cfg, gripper, places)
        advance(f"{name}: points", len(places), len(places))
        columns |= {f"{name}_reached": np.isfinite(tilt), f"{name}_residual_m": distance}
        columns[f"{name}_tilt_deg"] = tilts[f"{name}: {height:.3f} m above, {gripper}"] = tilt
    args.folder.mkdir(parents=True, exist_ok=True)
    table, header = np.stack(list(columns.values()), axis=1), ",".join(columns)
    np.savetxt(args.folder / "reachability.csv", table, "%.6g", ",", header=header, comments="")
    reached = np.isfinite(list(tilts.values())).all(axis=0)
    regions = {
        name: find_region(cfg, points, reached, name, args.step, args.margin) for name in scene.free
    }
    largest = {name: region[2] for name, region in regions.items()}
    save_map(args.folder / "reachability.png", cfg, x, y, tilts, largest)
    wide, deep = scene.random_xy
    yield Table(
        title=f"{cfg.robot.title}, task {cfg.task.name}: regions that the arm reaches, half-widths"
        f" [m], with {1e3 * args.margin:g} mm to spare",
        header=["object", f"random_xy {wide:g} x {deep:g}", "largest square", "largest rectangle"],
        rows=[
            [name, "reached" if fits else "not reached", f"{square:.3f}", f"{a:.3f} x {b:.3f}"]
            for name, (fits, square, (a, b)) in regions.items()
        ],
    )


def positive(text: str) -> float:
    """The value of an option that is a length above 0."""
    if not 0.0 < (value := float(text)) < np.inf:
        raise argparse.ArgumentTypeError(f"{text}: expected a length above 0")
    return value


if __name__ == "__main__":
    parser = make_parser(__doc__)
    parser.add_argument("--step", type=positive, default=0.005, help="of the map [m]")
    parser.add_argument("--margin", type=float, default=0.010, help="all round a region [m]")
    parser.add_argument("--folder", type=Path, default=Path("outputs/reachability"))
    run(parser, draw_map)
