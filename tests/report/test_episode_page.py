"""The 3-D page of a run's worlds: geometry and poses are MuJoCo's, and a browser shows them."""

import csv
import io
import re
import urllib.parse
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path

import matplotlib.image
import mujoco
import numpy as np
import pytest
import torch
from browser import EXECUTABLE, Tab, browse, messages
from compositions import load_config
from environments import Capture, GetStage, MakeSim, Patch, configure
from torch import Tensor

import mjstack.report.web as web
from mjstack.cli import run
from mjstack.config.schema import TermCfg
from mjstack.episodes.motion import motion_recorder, moving_worlds
from mjstack.episodes.rollout import Hook
from mjstack.episodes.stage import Stage
from mjstack.managers import EnvView, random_uniform, uses_fields
from mjstack.math import quat_to_matrix
from mjstack.report.geometry import Shapes, with_fields
from mjstack.report.page import World, frame_stride
from mjstack.report.web import choose_worlds, not_shown, save_episode

PRIMITIVES = """
<mujoco>
  <asset>
    <mesh name="tetra" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1"/>
    <material name="green" rgba="0 1 0 1"/>
  </asset>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body pos="1 2 3" euler="10 20 30">
      <freejoint/>
      <geom type="box" size=".1 .2 .3" pos=".1 0 0" euler="0 0 45" rgba="1 0 0 1"/>
      <geom type="cylinder" size=".1 .3" rgba="0 0 1 1"/>
      <geom type="capsule" size=".1 .3" rgba="0 1 1 1"/>
      <geom type="sphere" size=".2" rgba="1 1 0 1"/>
      <geom type="ellipsoid" size=".1 .2 .3" rgba="1 0 1 1"/>
      <geom type="mesh" mesh="tetra" material="green"/>
      <geom type="box" size="9 9 9" group="3"/>
      <geom type="box" size="9 9 9" rgba="0 0 0 0"/>
      <body pos="0 0 1"><geom type="box" size=".01 .01 .01" rgba=".5 .5 .5 1"/></body>
    </body>
  </worldbody>
</mujoco>
"""


def outside(path: Path) -> list[str]:
    """Addresses that a page's tags load from."""
    text = re.sub(r'__VISER_EMBED_DATA__="[^"]+"', "", path.read_text())
    tags = re.findall(r"<(?:script|link|img|iframe)\b[^>]*\b(?:src|href)=[\"']?([^\"'> ]+)", text)
    return [tag for tag in tags if not tag.startswith("data:")]


def test_shapes_are_mujocos() -> None:
    """Vertices lie on the surfaces, in the frame of the body that moves them."""
    model = mujoco.MjModel.from_xml_string(PRIMITIVES)
    shapes = Shapes(model)
    colors = [tuple(shape.rgba[0, :3].tolist()) for shape in shapes.meshes]
    found = {
        rgba: shape.mesh[0]
        for rgba, shape in zip(colors, shapes.meshes, strict=True)
        if shape.pose == 1
    }
    assert len(found) == 7  # neither the hidden nor the invisible one
    box = (
        (found[1, 0, 0] - [0.1, 0.0, 0.0])
        @ np.array([[1, -1, 0], [1, 1, 0], [0, 0, 2**0.5]])
        / 2**0.5
    )
    assert np.allclose(np.ptp(box, 0), [0.2, 0.4, 0.6])
    assert np.allclose(np.abs(box / [0.1, 0.2, 0.3]).max(1), 1.0)
    cylinder = found[0, 0, 1]
    assert np.allclose(np.abs(cylinder[:, 2]), 0.3)
    assert np.linalg.norm(cylinder[:, :2], axis=1).max() == pytest.approx(0.1)
    capsule = found[0, 1, 1]
    to_axis = capsule - np.clip(capsule[:, 2], -0.3, 0.3)[:, None] * [0, 0, 1]
    assert np.allclose(np.linalg.norm(to_axis, axis=1), 0.1, atol=1e-6)
    assert np.ptp(capsule[:, 2]) == pytest.approx(0.8)
    assert np.allclose(np.linalg.norm(found[1, 1, 0], axis=1), 0.2)
    assert np.allclose(np.linalg.norm(found[1, 0, 1] / [0.1, 0.2, 0.3], axis=1), 1.0)
    assert np.allclose(np.ptp(found[0, 1, 0], 0), 0.1, atol=2e-3)
    places, turns = shapes.poses(model.qpos0[None])
    # A body without joints is part of the one that holds it.
    assert np.allclose(places[0], [[0, 0, 0], [1, 2, 3]])
    assert np.allclose(turns[0, 1], model.qpos0[3:])


ARM = """
<mujoco>
  <asset><material name="green" rgba="0 1 0 1"/></asset>
  <worldbody>
    <body name="base" pos=".1 .2 .3">
      <geom type="capsule" size=".02 .1" rgba="1 0 0 1"/>
      <body name="nested" pos="0 0 .2"><geom type="box" size=".1 .02 .03" material="green"/></body>
      <body name="link" pos=".3 0 0">
        <joint axis="0 0 1" pos=".05 0 0"/>
        <geom type="cylinder" size=".03 .06" pos=".1 0 0" material="green"/>
        <geom type="ellipsoid" size=".03 .06 .02" pos="0 .1 0" rgba="0 0 1 1"/>
      </body>
    </body>
    <body name="ball" pos="0 0 1"><freejoint/><geom size=".05" rgba="1 1 0 1"/></body>
  </worldbody>
</mujoco>
"""


@pytest.mark.parametrize(
    "name",
    [
        *("body_pos", "body_quat", "geom_pos", "geom_quat", "geom_size", "geom_rgba", "mat_rgba"),
        *("jnt_pos", "jnt_axis", "qpos0", "geom_friction"),
    ],
)
def test_shapes_are_where_mujoco_draws_any_model_field(name: str) -> None:
    """The middle, the extent and the colour of every geom of three worlds, in the same state."""
    model = mujoco.MjModel.from_xml_string(ARM)
    rng = np.random.default_rng(1)
    nominal = getattr(model, name)
    worlds = [{name: nominal + rng.uniform(0.0, 0.01, nominal.shape)} for _ in range(2)]
    if name.endswith(("quat", "axis")):
        for fields in worlds:
            fields[name] = nominal + rng.uniform(-0.3, 0.3, nominal.shape)
            fields[name] /= np.linalg.norm(fields[name], axis=1, keepdims=True)
    if name.endswith("rgba"):
        for fields in worlds:
            fields[name] = np.clip(rng.uniform(0.0, 1.0, nominal.shape), 0.1, 1.0)
    qpos = model.qpos0 + 0.4
    qpos[4:] = [1.0, 0.0, 0.0, 0.0]
    shapes = Shapes(model, [*worlds, {}])
    places, turns = shapes.poses(np.tile(qpos, (3, 1)))
    matrices = quat_to_matrix(torch.from_numpy(turns)).numpy()
    for world, fields in enumerate([*worlds, {}]):
        drawn = []
        for shape in shapes.meshes:
            for row in np.flatnonzero(shape.worlds == world):
                place = places[world, shape.pose]
                points = shape.mesh[0] @ matrices[world, shape.pose].T + place
                drawn.append((shape.rgba[row], points))
        scene_model = with_fields(model, fields)
        data = mujoco.MjData(scene_model)
        data.qpos[:] = qpos
        mujoco.mj_forward(scene_model, data)
        scene = mujoco.MjvScene(scene_model, 100)
        camera = mujoco.MjvCamera()
        option = mujoco.MjvOption()
        every = mujoco.mjtCatBit.mjCAT_ALL
        perturb = mujoco.MjvPerturb()
        mujoco.mjv_updateScene(scene_model, data, option, perturb, camera, every, scene)
        geoms = [g for g in scene.geoms[: scene.ngeom] if g.objtype == mujoco.mjtObj.mjOBJ_GEOM]
        assert len(geoms) == model.ngeom
        for geom in geoms:
            near = [points for rgba, points in drawn if np.allclose(rgba, geom.rgba, atol=1e-3)]
            local = np.concatenate([(points - geom.pos) @ geom.mat for points in near])
            number = geom.objid
            half = scene_model.geom_aabb[number, 3:]
            inside = local[(np.abs(local) <= half + 2e-3).all(1)]
            assert np.allclose(inside.max(0), half, atol=2e-3), (world, number)
            assert np.allclose(inside.min(0), -half, atol=2e-3), (world, number)


@uses_fields("body_pos", "body_quat")
def move_wall(env: EnvView, mask: Tensor) -> None:
    """Move and turn the wall, which stands still."""
    body = env.sim.model.body("wall").id
    draw = random_uniform(env, "move", 2)
    env.sim.fields["body_pos"][mask, body, :2] += 0.05 * draw[mask]
    half = 0.5 * draw[mask, 0]
    env.sim.fields["body_quat"][mask, body] = torch.stack(
        (half.cos(), 0.0 * half, 0.0 * half, half.sin()), 1
    )


@uses_fields("geom_size")
def resize_wall(env: EnvView, mask: Tensor) -> None:
    """Make the wall higher."""
    factor = 1.5 + 0.4 * random_uniform(env, "size", 1)
    env.sim.fields["geom_size"][mask, env.sim.model.geom("wall").id, 2:] *= factor[mask]


@uses_fields("geom_rgba")
def paint_wall(env: EnvView, mask: Tensor) -> None:
    """Give the wall a colour."""
    draw = random_uniform(env, "paint", 3, 0.0, 1.0)
    env.sim.fields["geom_rgba"][mask, env.sim.model.geom("wall").id, :3] = draw[mask]


TERMS = (move_wall, resize_wall, paint_wall)


def placed_meshes(path: Path) -> list[tuple[list[int], np.ndarray]]:
    """Colour and vertices in the scene of every mesh of a page at its start."""
    placed = []
    for _, message in messages(path):
        if message["type"] == "BatchedMeshesMessage":
            props = message["props"]
            vertices = props["vertices"].reshape(-1, 3)
            quats = props["batched_wxyzs"].reshape(-1, 4)
            colors = np.broadcast_to(props["batched_colors"].reshape(-1, 3), (len(quats), 3))
            turns = quat_to_matrix(torch.from_numpy(quats.copy())).numpy()
            for turn, place, color in zip(
                turns, props["batched_positions"].reshape(-1, 3), colors, strict=True
            ):
                placed.append((color.tolist(), vertices @ turn.T + place))
    return placed


def test_a_page_shows_the_model_fields_of_each_world(tmp_path: Path) -> None:
    """A body that stands still is moved and turned, its geom resized and painted: page and MuJoCo
    agree.
    """
    wall = "+scene.objects.wall={fixed: true, size: [0.01, 0.05, 0.02], xy: [0.2, 0.15]}"
    cfg = configure(wall, "sim=native", "nworld=3")
    terms = {f.__name__: TermCfg(func=f"{__name__}.{f.__name__}") for f in TERMS}
    stage = Stage(replace(cfg, reset=dict(cfg.reset) | terms))
    sim = stage.batch_simulation(3)
    env = stage.start(sim, stage.cfg.reset)
    failed = np.array([0, stage.check.rules["STACKED"], 0], np.int32)
    order = (1, 0, 2)
    worlds = moving_worlds(stage, env, sim.qpos[None], failed, {w: str(w) for w in order})
    assert [world.caption for world in worlds] == ["1: STACKED", "0", "2"]
    visual = stage.assets.visual_model
    assert visual.ngeom > sim.model.ngeom  # so that numbers of geoms differ
    table_size = 2.0 * np.array(stage.cfg.scene.table_half[:2])
    save_episode(tmp_path / "episode.html", visual, worlds, 0.04)
    placed = placed_meshes(tmp_path / "episode.html")
    tables = [
        mesh for color, mesh in placed if np.allclose(np.ptp(mesh, 0)[:2], table_size, atol=1e-3)
    ]
    assert len(tables) == 3
    for world, table in zip(order, tables, strict=True):
        fields = {name: values[world].numpy() for name, values in sim.fields.items()}
        geom = sim.model.geom("wall").id
        color = np.round(255.0 * fields["geom_rgba"][geom, :3]).astype(int).tolist()
        (mesh,) = (mesh for found, mesh in placed if found == color)
        corners = np.array(list(product((-1.0, 1.0), repeat=3))) * fields["geom_size"][geom]
        body = sim.model.body("wall").id
        turn = quat_to_matrix(torch.from_numpy(fields["body_quat"][body])).numpy()
        expected = corners @ turn.T + fields["body_pos"][body]
        offset = table.mean(0)[:2] - stage.cfg.scene.table_center[:2]
        expected[:, :2] += offset
        gaps = np.linalg.norm(mesh[:, None] - expected, axis=2)
        assert gaps.min(1).max() < 1e-3
        assert gaps.min(0).max() < 1e-3
        (xpos,) = mesh.mean(0)[None] - [*offset, 0.0]
        assert np.allclose(xpos, sim.xpos[world, body], atol=1e-3)
    sim.close()


def test_one_looks_at_the_first_failing_world(get_stage: GetStage, tmp_path: Path) -> None:
    model = get_stage("so101").assets.visual_model
    looks = []
    for failing in ((), (4,), (4, 7)):
        worlds = [
            replace(w, rules=["LOST"] * (int(w.label) in failing)) for w in motion(get_stage, 9, 2)
        ]
        save_episode(tmp_path / "e.html", model, worlds, 0.04)
        sent = [message for _, message in messages(tmp_path / "e.html")]
        (look,) = [m for m in sent if m["type"] == "SetCameraLookAtMessage"]
        looks.append(look["look_at"][:2])
        (first,) = [m for m in sent if "props" in m and m.get("name") == "/0"]
        places = first["props"]["batched_positions"]
    offsets = places.reshape(-1, 3)[:, :2]
    apart = np.linalg.norm(offsets[0] - offsets[1])
    assert np.linalg.norm(offsets[4] + [0.15, 0.0] - looks[1]) < 0.5 * apart
    assert np.allclose(looks[1], looks[2])
    assert not np.allclose(looks[0], looks[1])


def test_a_page_says_what_it_does_not_show(get_stage: GetStage) -> None:
    model = get_stage("so101").assets.visual_model
    (world,) = motion(get_stage, 1, 2)
    floor = model.geom_rgba.copy()
    floor[model.geom("floor").id] = [1.0, 0.0, 0.0, 1.0]
    same = {"light_pos": model.light_pos, "geom_rgba": model.geom_rgba}
    other = {"light_pos": model.light_pos + 1.0, "geom_rgba": floor}
    assert not_shown(model, [replace(world, fields=same)] * 2) == []
    worlds = [replace(world, fields=fields) for fields in (same, other)]
    line = "episode.html does not show how worlds differ in light_pos, floor"
    assert not_shown(model, worlds) == [line]


@pytest.mark.full
def test_drawn_places_are_in_every_file(tmp_path: Path) -> None:
    """The goal of examples/push: tables, map and 3-D page."""
    conf = str(Path(__file__).parents[2] / "examples" / "push" / "conf")
    cfg = load_config(["task=push"], config_dir=conf)
    quick = [f"controller.phases.{name}.seconds=0.1" for name in cfg.controller.phases]
    args = ["--config-dir", conf, "task=push", "sim=native", "gates=[success]", "nworld=3", *quick]
    args += ["task.check.window=5", "task.success.params.steps=5"]
    out = tmp_path / "out"
    assert run([*args, f"hydra.run.dir={out}"]) == 1
    goals = np.load(out / "success_starts_seed0.npz")["goal_xy"]
    assert np.ptp(goals, 0).min() > 1e-4
    with (out / "success_failing.csv").open() as file:
        rows = list(csv.DictReader(file))
    cells = [[float(row["goal_x_m"]), float(row["goal_y_m"])] for row in rows]
    assert np.allclose(cells, goals, atol=1e-5)
    assert "goal_yaw_rad" not in rows[0]
    text = (out / "report.html").read_text()
    (figure,) = re.findall(r"<figure><figcaption>goal</figcaption>.*?</figure>", text)
    assert figure.count("<path class=x") == 3
    assert "no sign before the result: " in text  # and the rules that broke
    placed = placed_meshes(out / "episode.html")
    table = 2.0 * np.array(cfg.scene.table_half[:2])
    tables = [m for _, m in placed if np.allclose(np.ptp(m, 0)[:2], table, atol=1e-3)]
    discs = [m for color, m in placed if color == [51, 51, 51]]
    for goal, disc, mesh in zip(goals, discs, tables, strict=True):
        offset = 0.5 * (mesh.max(0) + mesh.min(0))[:2] - cfg.scene.table_center[:2]
        assert np.allclose(disc.mean(0)[:2] - offset, goal, atol=1e-3)


def motion(get_stage: GetStage, worlds: int, frames: int) -> list[World]:
    """Worlds whose first cube rises and whose arm turns."""
    model = get_stage("so101").assets.visual_model
    qpos = np.repeat(model.qpos0[None], frames, 0)
    at = get_stage("so101").index.object_qpos[0]
    qpos[:, at + 2] += np.linspace(0.0, 0.2, frames)
    qpos[:, get_stage("so101").index.robot_qpos[0]] += np.linspace(0.0, 1.0, frames)
    return [World(label=str(w), qpos=qpos.copy(), rules=["LOST"] * (w == 0)) for w in range(worlds)]


def test_a_page_holds_every_frame(get_stage: GetStage, tmp_path: Path) -> None:
    path = tmp_path / "episode.html"
    worlds = motion(get_stage, 3, 5)
    worlds[2].qpos[3:] = np.nan  # it diverged
    model = get_stage("so101").assets.visual_model
    save_episode(path, model, worlds, 0.04)
    assert outside(path) == []
    assert path.stat().st_size < 2e6
    shapes = Shapes(model)
    heights = shapes.poses(worlds[0].qpos)[0][:, :, 2]
    rising = int(np.ptp(heights, 0).argmax())
    assert "<title>Episode</title>" in path.read_text()
    sent = messages(path)
    names = {
        message["name"]: message["props"]
        for _, message in sent
        if message["type"] == "BatchedMeshesMessage"
    }
    assert len(names) == len(shapes.meshes)
    numbers = [shape.pose for shape in shapes.meshes]
    name = f"/{numbers.index(rising)}"
    updates = [
        (time, message["updates"]["batched_positions"])
        for time, message in sent
        if message.get("name") == name and "batched_positions" in message.get("updates", {})
    ]
    assert [time for time, _ in updates] == pytest.approx([0.04, 0.08, 0.12, 0.16])
    for (_, held), height, last in zip(
        updates, heights[1:, rising], heights[[1, 2, 2, 2], rising], strict=True
    ):
        places = held.reshape(3, 3)
        assert np.allclose(places[:, 2], [height, height, last], atol=1e-4)
        assert len(np.unique(places[:, :2], axis=0)) == 3  # side by side
    tables = [
        message["props"]["batched_colors"].reshape(3, 3)
        for _, message in sent
        if message.get("name") == "/0" and message["type"] == "BatchedMeshesMessage"
    ]
    assert tables[0][0].tolist() != tables[0][1].tolist() == tables[0][2].tolist()


def test_sixty_four_worlds_are_shared_by_the_gates() -> None:
    def some(name: str, count: int) -> list[World]:
        return [World(label=f"{name}{n}", qpos=np.zeros((1, 1))) for n in range(count)]

    chosen = choose_worlds(
        {"baseline": some("a", 1), "batch": some("b", 64), "success": some("c", 9)}
    )
    labels = [world.label for world in chosen]
    assert labels == [*(f"b{n}" for n in range(31)), *(f"c{n}" for n in range(9)), "a0"]
    assert len(choose_worlds({"batch": some("b", 64)})) == 64
    assert choose_worlds({}) == []


def test_the_recorder_takes_frames_from_the_start_on(
    get_stage: GetStage, make_sim: MakeSim
) -> None:
    stage = get_stage("so101")
    sim = make_sim("native", 3)
    all_steps: list[np.ndarray] = []
    recorder = motion_recorder(stage.cfg.timing.step_dt)
    hook = Hook(lambda step, sim: all_steps.append(sim.qpos.numpy().copy()))
    episode = stage.play(sim, stage.cfg.reset, [recorder, hook])
    recorded = recorder.rows["qpos"].swapaxes(0, 1).numpy()
    stride = frame_stride(stage.cfg.timing.step_dt)
    assert np.array_equal(recorded[:, 0], episode.start)
    ends = np.stack(all_steps, 1)[:, stride - 1 :: stride]
    assert np.array_equal(recorded[:, 1:], ends)


@pytest.mark.full
def test_without_viser_a_run_says_how_to_have_the_page(
    tmp_path: Path, monkeypatch: Patch, capsys: Capture
) -> None:
    monkeypatch.setattr(web, "find_spec", lambda name: None)
    out = tmp_path / "out"
    assert run(["gates=[baseline]", f"hydra.run.dir={out}"]) == 0
    line = "episode.html needs viser, which is not installed: run pip install 'mjstack[web]'."
    assert line in " ".join(capsys.readouterr().out.split())
    assert not (out / "episode.html").exists()
    assert "mjstack[web]" in (out / "report.html").read_text()


def labels_of(path: Path, rule: str = "") -> list[str]:
    """Texts of the worlds of a page, or of those of a rule."""
    return [m["props"]["text"] for _, m in messages(path, rule) if m["type"] == "LabelMessage"]


RED, AMBER = (219, 89, 82), (217, 154, 43)


def test_a_page_filters_and_colours_by_rule(get_stage: GetStage, tmp_path: Path) -> None:
    path = tmp_path / "episode.html"
    broken = (["A"], ["B", "A"], [], ["B"])
    moving = zip(motion(get_stage, 4, 3), broken, strict=True)
    worlds = [replace(world, rules=rules) for world, rules in moving]
    save_episode(path, get_stage("so101").assets.visual_model, worlds, 0.04)
    assert labels_of(path) == ["0: A", "1: B A", "2", "3: B"]
    assert labels_of(path, "A") == ["0: A", "1: B A"]
    assert labels_of(path, "B") == ["1: B A", "3: B"]
    for rule, first, second in (("", RED, AMBER), ("A", RED, AMBER), ("B", AMBER, AMBER)):
        sent = [m["props"] for _, m in messages(path, rule) if "props" in m]
        colors = np.concatenate([p["batched_colors"] for p in sent if "batched_colors" in p])
        tables = {tuple(color) for color in colors.reshape(-1, 3).tolist()}
        assert {first, second} <= tables
    assert max(time for time, _ in messages(path, "A")) == max(t for t, _ in messages(path))


@pytest.fixture(scope="module")
def failing(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run on MJWarp with worlds that fail."""
    out = tmp_path_factory.mktemp("run") / "out"
    args = ["gates=[baseline,batch]", "nworld=6", "sim=mjwarp", "sim.device=cpu"]
    args += ["reset=randomized", "task.check.xy_err=0.0025", f"hydra.run.dir={out}"]
    assert run(args) == 1
    return out


@pytest.mark.full
def test_pages_stay_small(tmp_path: Path) -> None:
    """One world within 2 MB, and 16 that start at random within a quarter of 15 MB: 64, which have
    the rest of the page once, within 15 MB.
    """
    for gates, nworld, most in (("baseline", 1, 2e6), ("batch", 16, 15e6 / 4)):
        out = tmp_path / gates
        args = [f"gates=[{gates}]", f"nworld={nworld}", "reset=randomized", "sim=native"]
        run([*args, f"hydra.run.dir={out}"])
        assert 1e5 < (out / "episode.html").stat().st_size < most


@pytest.fixture
def tab() -> Iterator[Tab]:
    """A tab of a real browser."""
    if EXECUTABLE is None:
        pytest.skip("no Chromium is installed here")
    with browse(1000, 700) as opened:
        yield opened


def colored(tab: Tab) -> dict[str, int]:
    """How many pixels are of the arm's and of the cubes' colours."""
    image = matplotlib.image.imread(io.BytesIO(tab.picture()), format="png")
    r, g, b = (image[60:-60, :, k] for k in range(3))
    return {
        "arm": int(((r > 0.4) & (g > 0.35) & (b < 0.6 * g)).sum()),
        "red": int(((r > 0.55) & (g < 0.4) & (b < 0.4)).sum()),
        "blue": int(((b > 0.5) & (r < 0.4) & (g < 0.55)).sum()),
    }


@pytest.mark.full
def test_a_browser_plays_the_episode(get_stage: GetStage, tmp_path: Path, tab: Tab) -> None:
    """It loads without an error, asks for nothing else, and shows the arm and the cubes."""
    path = tmp_path / "episode.html"
    save_episode(path, get_stage("so101").assets.visual_model, motion(get_stage, 2, 250), 0.04)
    address = f"file://{urllib.parse.quote(str(path))}"
    tab.open(address)
    tab.wait("document.querySelector('canvas') !== null")
    clock = "parseFloat([...document.querySelectorAll('input')].map(i => i.value)[0])"
    tab.wait(f"{clock} > 0.5")  # it plays
    tab.wait("document.querySelector('#rules').options.length === 2")
    seen = colored(tab)
    assert seen["arm"] > 500
    assert seen["red"] > 40
    assert seen["blue"] > 40
    assert tab.problems == []
    assert tab.requests == [address]


@pytest.mark.full
def test_a_browser_opens_the_report_in_a_second(failing: Path, tab: Tab) -> None:
    address = f"file://{urllib.parse.quote(str(failing / 'report.html'))}"
    assert tab.open(address) < 1.0
    assert tab.problems == []
    assert tab.requests == [address]
    assert tab.run("document.querySelectorAll('table').length") >= 5
    assert tab.run("document.querySelectorAll('svg').length") >= 5
    assert tab.run("[...document.images].every(i => i.naturalWidth > 100)")
    assert tab.run("document.documentElement.scrollWidth <= innerWidth")
