"""Images of both backends from equal states, compared for gate *parity*."""

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
import torch

from mjstack.config.schema import OUTPUTS, Backend, Config, ParityCfg
from mjstack.episodes.context import RunContext
from mjstack.errors import MjstackError, RunError
from mjstack.files import reading, write_npz
from mjstack.report.gl import require_offscreen
from mjstack.report.picture import save_images
from mjstack.report.record import GateResult
from mjstack.report.table import Table
from mjstack.report.write import safely_write
from mjstack.sim import StateRenderer

FILE = "parity_images.npz"
PICTURE = "parity_images.png"

_AMPLIFIED = 8  # differences in the picture

Images = dict[str, np.ndarray]


@dataclass(frozen=True, kw_only=True, slots=True)
class Agreement:
    """How far the images of a camera agree, over all states.

    Attributes:
        same: Share of the pixels in which both show the same thing.
        iou: Intersection over union of each thing that is large enough, by name.
        left_out: Names of the things that are too small to compare.
        color: Mean difference of the colours in those pixels, of 255.
        depth: Median difference of the depths there [m].
        worst: State with the fewest such pixels.
    """

    same: float
    iou: dict[str, float]
    left_out: list[str]
    color: float
    depth: float
    worst: int


def compare_images(context: RunContext, result: GateResult) -> list[str]:
    """Draw states of the reference episode with MJWarp and with native MuJoCo, and compare them.

    MJWarp's images and the states are kept in the run's folder. Where native MuJoCo cannot draw,
    another machine compares them with its own.

    Returns:
        The problems.
    """
    cfg = with_all_outputs(context.cfg)
    limits = cfg.gate.parity
    if limits.images is None:
        path = context.nominal.world.qpos
        path = path[np.isfinite(path).all(axis=1)]
        steps = np.linspace(0, len(path) - 1, limits.image_states).round().astype(int)
        qpos = path[steps]
        mjwarp, _ = _draw_states(context, cfg, qpos, Backend.mjwarp, context.backend[1])
        if context.folder is not None:
            write_npz(
                context.folder / FILE, {"qpos": qpos, "about": json.dumps(_about(cfg)), **mjwarp}
            )
    else:
        qpos, mjwarp = load_images(cfg)
    try:
        require_offscreen(context.model)
    except MjstackError as error:
        result.notes["images"] = (
            f"not compared: {error} On a machine that draws, gate.parity.images=.../{FILE} compares"
            " them"
        )
        return []
    native, labels = _draw_states(context, cfg, qpos, Backend.native, "cpu")
    found = {
        name: agree(name, native, mjwarp, labels, limits.image_pixels) for name in cfg.scene.cameras
    }
    _report(context, result, found)
    _draw(context, found, native, mjwarp)
    result.thresholds |= {
        "images.same_thing": limits.image_same,
        "images.iou": limits.image_iou,
        "images.color_of_255": limits.image_color,
        "images.depth_m": limits.image_depth,
    }
    return _problems(found, limits, _background(context.model))


def _problems(found: dict[str, Agreement], limits: ParityCfg, background: set[str]) -> list[str]:
    """Say where images differ too much, and which cameras compared nothing but the background."""
    problems = []
    for name, one in found.items():
        if not one.iou.keys() - background:
            problems.append(
                f"camera {name}: nothing but the background has gate.parity.image_pixels="
                f"{limits.image_pixels} pixels, so nothing was compared; raise"
                f" scene.cameras.{name}.size"
            )
        for thing, iou in one.iou.items():
            if not iou >= limits.image_iou:
                problems.append(f"camera {name}: IoU of {thing} is {iou:.4f}")
        if not one.same >= limits.image_same:
            problems.append(
                f"camera {name}: {100 * one.same:.2f} % of the pixels show the same thing"
            )
        if not one.color <= limits.image_color:
            problems.append(f"camera {name}: colours differ by {one.color:.2f} of 255")
        if not one.depth <= limits.image_depth:
            problems.append(f"camera {name}: depths differ by {one.depth:.2g} m")
    return problems


def agree(
    camera: str, native: Images, mjwarp: Images, labels: list[str], least_pixels: int
) -> Agreement:
    """How far images of a camera agree.

    Args:
        camera: Its name.
        native: Images of native MuJoCo by output and camera, one of each state.
        mjwarp: Images of MJWarp.
        labels: Names of the things in the segmentation.
        least_pixels: Things with fewer pixels, of both backends' images together, are left out.
    """
    a = native[f"segmentation.{camera}"]
    b = mjwarp[f"segmentation.{camera}"]
    same = a == b
    names = dict(enumerate(labels)) | {-1: "nothing"}
    iou = {}
    left_out = []
    for number in np.union1d(a, b).tolist():
        union = int(((a == number) | (b == number)).sum())
        name = names.get(number, f"number {number}")
        if union >= least_pixels:
            iou[name] = float((same & (a == number)).sum() / union)
        else:
            left_out.append(name)
    colors = [images[f"images.{camera}"].astype(float) for images in (native, mjwarp)]
    depths = [images[f"depth.{camera}"][..., 0] for images in (native, mjwarp)]
    both = bool(same.any())
    return Agreement(
        same=float(same.mean()),
        iou=iou,
        left_out=left_out,
        color=float(np.abs(colors[0] - colors[1])[same].mean()) if both else np.inf,
        depth=float(np.median(np.abs(depths[0] - depths[1])[same])) if both else np.inf,
        worst=int(same.mean(axis=(1, 2)).argmin()),
    )


def _background(model: mujoco.MjModel) -> set[str]:
    """Names of the things that are fixed to the world, and of what is behind them."""
    fixed = np.flatnonzero(model.geom_bodyid == 0)
    return {"nothing", *(model.geom(number).name or "world" for number in fixed)}


def _draw_states(
    context: RunContext, cfg: Config, qpos: np.ndarray, backend: Backend, device: str
) -> tuple[Images, list[str]]:
    """Images of states, shape ``(n, nq)``, and the names of things."""
    renderer = StateRenderer(context.model, cfg, len(qpos), backend=backend, device=device)
    drawn = renderer.draw(torch.from_numpy(qpos))
    images = {name: image.cpu().numpy() for name, image in drawn.items()}
    renderer.close()
    return images, renderer.labels


def with_all_outputs(cfg: Config) -> Config:
    """The configuration with every output of every camera."""
    cameras = {
        name: replace(camera, outputs=list(OUTPUTS), terminal=False)
        for name, camera in cfg.scene.cameras.items()
    }
    return replace(cfg, scene=replace(cfg.scene, cameras=cameras))


def load_images(cfg: Config) -> tuple[np.ndarray, Images]:
    """States, shape ``(n, nq)``, and MJWarp's images of them from ``gate.parity.images``.

    Raises:
        RunError: The file cannot be read, or is of another scene or other cameras.
    """
    path = Path(str(cfg.gate.parity.images))
    with reading(path, RunError, f"Name the {FILE} of a run of gate parity"):
        with np.load(path, allow_pickle=False) as saved:
            images = {name: saved[name] for name in saved.files}
        about = json.loads(str(images.pop("about")))
        qpos = images.pop("qpos")
        mine = _about(with_all_outputs(cfg))
        for key in mine:
            if about.get(key) != mine[key]:
                raise RunError(
                    f"{path} was drawn with {key}={about.get(key)}, expected {mine[key]}",
                    "Give the robot, the scene and the cameras of that run",
                )
        for name, camera in cfg.scene.cameras.items():
            for prefix in ("images", "depth", "segmentation"):
                if images[f"{prefix}.{name}"].shape[:3] != (len(qpos), *camera.size):
                    raise ValueError(f"{prefix}.{name} has another shape")
    return qpos, images


def _about(cfg: Config) -> dict[str, object]:
    """The part of the configuration on which images depend, by key."""
    scene = cfg.scene
    about: dict[str, object] = {
        "robot.name": cfg.robot.name,
        "model.source": cfg.model.source,
        "scene.name": scene.name,
        "cameras": list(scene.cameras),
    }
    for name, camera in scene.cameras.items():
        for key in ("size", "fovy", "pose"):
            about[f"scene.cameras.{name}.{key}"] = asdict(camera)[key]
    return about


def _report(context: RunContext, result: GateResult, found: dict[str, Agreement]) -> None:
    """Add figures and a table."""
    things = list(dict.fromkeys(thing for one in found.values() for thing in one.iou))
    rows = []
    for name, one in found.items():
        result.metrics |= {
            f"images.{name}.same_thing": one.same,
            f"images.{name}.color_of_255": one.color,
            f"images.{name}.depth_m": one.depth,
            **{f"images.{name}.iou.{thing}": iou for thing, iou in one.iou.items()},
        }
        worst = min(one.iou.values(), default=1.0)
        context.print_line(
            f"camera {name}: the same thing in {100 * one.same:.2f} % of the pixels, IoU at least"
            f" {worst:.4f}, colours within {one.color:.2f} of 255"
        )
        if one.left_out:
            few = f"fewer than gate.parity.image_pixels={context.cfg.gate.parity.image_pixels}"
            left_out = ", ".join(one.left_out)
            result.details.append(f"camera {name}: not compared, with {few} pixels: {left_out}")
    for thing in things:
        cells = [one.iou.get(thing) for one in found.values()]
        rows.append([thing, *("-" if iou is None else f"{iou:.4f}" for iou in cells)])
    title = "Images of both backends: intersection over union of each thing"
    result.tables.append(Table(header=["thing", *found], rows=rows, title=title))


def _draw(context: RunContext, found: dict[str, Agreement], native: Images, mjwarp: Images) -> None:
    """Save the state of each camera that differs most, side by side."""
    if context.folder is None:
        return
    rows = {}
    for name, one in found.items():
        a, b = (images[f"images.{name}"][one.worst] for images in (native, mjwarp))
        apart = np.abs(a.astype(int) - b) * _AMPLIFIED
        rows[f"{name}, state {one.worst}"] = [a, b, apart.clip(0, 255).astype(np.uint8)]
    columns = ["native MuJoCo", "MJWarp", f"difference x {_AMPLIFIED}"]
    path = context.folder / PICTURE
    if problem := safely_write(path, save_images, rows, columns):
        context.print_line(problem)
    else:
        context.page.pictures.append(PICTURE)
