"""Images of both backends from equal states, compared for gate *parity*."""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
import torch

from mjstack.config.fingerprint import config_content, differences
from mjstack.config.schema import OUTPUTS, Backend, Config
from mjstack.episodes.run import Run
from mjstack.episodes.stage import Stage
from mjstack.errors import FolderError, MjstackError
from mjstack.files import read_npz, reading, write_npz
from mjstack.report.figure import Figure
from mjstack.report.gl import require_offscreen
from mjstack.report.picture import save_images
from mjstack.report.record import GateResult
from mjstack.sim import StateRenderer
from mjstack.sim.cameras import thing_of, with_outputs

FILE = "parity_images.npz"
PICTURE = "parity_images.png"

_AMPLIFIED = 8  # differences in the picture

Images = dict[str, np.ndarray]


@dataclass(frozen=True, kw_only=True, slots=True)
class _Agreement:
    """How far the images of a camera agree, over all states."""

    same: float  # share of the pixels in which both show the same thing
    iou: dict[str, float]  # intersection over union of each thing that is large enough, by name
    left_out: list[str]  # names of the things that are too small to compare
    color: float  # mean difference of the colours in the same pixels, of 255
    depth: float  # median difference of the depths there [m]
    worst: int  # state with the fewest such pixels


def compare_images(run: Run, result: GateResult) -> list[str]:
    """Render states of the reference episode with MJWarp and with native MuJoCo, and compare them.

    MJWarp's images and the states are kept in the run's folder. Where native MuJoCo cannot render,
    another machine compares them with its own. The result gets figures and notes.

    Returns:
        The problems.
    """
    stage = run.stage
    scene = stage.cfg.scene
    cfg = replace(stage.cfg, scene=replace(scene, cameras=with_outputs(scene.cameras, OUTPUTS)))
    limits = cfg.gate.parity
    if limits.images is None:
        path = run.nominal.world.qpos
        path = path[np.isfinite(path).all(axis=1)]
        steps = np.linspace(0, len(path) - 1, limits.image_states).round().astype(int)
        qpos = path[steps]
        mjwarp, _ = _draw_states(stage.model, cfg, qpos, Backend.mjwarp, stage.backend[1])
        if run.folder is not None:
            about = json.dumps(config_content(cfg, "images"))
            write_npz(run.folder / FILE, {"qpos": qpos, "about": about, **mjwarp})
    else:
        qpos, mjwarp = load_images(cfg)
    try:
        require_offscreen(stage.model)
    except MjstackError as error:
        result.notes["images"] = (
            f"not compared: {error} On a machine that draws, gate.parity.images=.../{FILE} compares"
            " them"
        )
        return []
    native, labels = _draw_states(stage.model, cfg, qpos, Backend.native, "cpu")
    agreements = {
        name: agree(name, native, mjwarp, labels, limits.image_pixels) for name in scene.cameras
    }
    # The state of each camera that differs most, side by side
    rows = {}
    for name, camera in agreements.items():
        a, b = (images[f"images.{name}"][camera.worst].astype(int) for images in (native, mjwarp))
        difference = np.minimum(np.abs(a - b) * _AMPLIFIED, 255)
        rows[f"{name}, state {camera.worst}"] = [a, b, difference]
    columns = ["native MuJoCo", "MJWarp", f"difference x {_AMPLIFIED}"]
    run.draw(PICTURE, save_images, rows, columns)
    return _report(stage, result, agreements)


def _report(stage: Stage, result: GateResult, agreements: dict[str, _Agreement]) -> list[str]:
    """Add figures; return where images differ too much, and which cameras compared
    nothing but the background.
    """
    limits = stage.cfg.gate.parity
    fixed = np.flatnonzero(stage.model.geom_bodyid == 0).tolist()
    background = {"nothing", *(thing_of(stage.model, number) for number in fixed)}
    least = f"gate.parity.image_pixels={limits.image_pixels}"
    problems = []
    for name, camera in agreements.items():
        group = f"images.{name}"
        figures = [
            Figure(object_name, iou, group=f"{group}.iou", low=limits.image_iou, limit="images.iou")
            for object_name, iou in camera.iou.items()
        ]
        same = Figure("same_thing", camera.same, low=limits.image_same)
        color = Figure("color_of_255", camera.color, high=limits.image_color)
        depth = Figure("depth", camera.depth, "m", high=limits.image_depth)
        figures += [
            replace(figure, group=group, limit=f"images.{figure.key}")
            for figure in (same, color, depth)
        ]
        result.figures += figures
        stage.progress.print_line(
            f"camera {name}: the same thing in {100 * camera.same:.2f} % of the pixels, IoU at"
            f" least {min(camera.iou.values(), default=1.0):.4f}, colours within"
            f" {camera.color:.2f} of 255"
        )
        if camera.left_out:
            result.details.append(
                f"camera {name}: not compared, with fewer than {least} pixels:"
                f" {', '.join(camera.left_out)}"
            )
        if not camera.iou.keys() - background:
            problems.append(
                f"camera {name}: nothing but the background has {least} pixels, so nothing was"
                f" compared; raise scene.cameras.{name}.size"
            )
        problems += [
            f"{figure.label} is {figure.text(figure.value)}, expected {figure.allowed}"
            for figure in figures
            if not figure.holds(figure.value)
        ]
    return problems


def agree(
    camera: str, native: Images, mjwarp: Images, labels: list[str], least_pixels: int
) -> _Agreement:
    """How far images of a camera agree, by output and camera, one of each state. Of the things in
    the segmentation, whose names are ``labels``, those with fewer pixels in both backends' images
    together than ``least_pixels`` are left out.
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

    def difference(prefix: str, mean: Callable[[np.ndarray], float]) -> float:
        a, b = (images[f"{prefix}.{camera}"][same].astype(float) for images in (native, mjwarp))
        return float(mean(np.abs(a - b))) if same.any() else np.inf

    return _Agreement(
        same=float(same.mean()),
        iou=iou,
        left_out=left_out,
        color=difference("images", np.mean),
        depth=difference("depth", np.median),
        worst=int(same.mean(axis=(1, 2)).argmin()),
    )


def _draw_states(
    model: mujoco.MjModel, cfg: Config, qpos: np.ndarray, backend: Backend, device: str
) -> tuple[Images, list[str]]:
    """Images of states, shape ``(n, nq)``, and the names of things."""
    renderer = StateRenderer(model, cfg, len(qpos), backend=backend, device=device)
    rendered = renderer.draw(torch.from_numpy(qpos))
    images = {name: image.cpu().numpy() for name, image in rendered.items()}
    renderer.close()
    return images, renderer.labels


def load_images(cfg: Config) -> tuple[np.ndarray, Images]:
    """States, shape ``(n, nq)``, and MJWarp's images of them from ``gate.parity.images``.

    Raises:
        FolderError: The file cannot be read, or is of another scene or other cameras.
    """
    path = Path(str(cfg.gate.parity.images))
    with reading(path, f"Name the {FILE} of a run of gate parity"):
        images: Images = read_npz(path)
        about = json.loads(str(images.pop("about")))
        qpos = images.pop("qpos")
        if changes := differences(about, config_content(cfg, "images")):
            fix = "Give the robot, the scene and the cameras of that run"
            raise FolderError(f"{path} was drawn with {changes}", fix)
    return qpos, images
