"""Reach of the arm: against MuJoCo and mink, regions that are refused, obstacles, and the map
of the tool.
"""

import csv
import math
import runpy
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
import reachability
import torch
from compositions import load_config, make_env
from environments import Capture, GetStage, Patch, configure

from mjstack.config.schema import Config
from mjstack.errors import ConfigError, ParameterError
from mjstack.kinematics.batched_ik import find_reach
from mjstack.kinematics.mink_ik import GraspIk
from mjstack.mdp.starts.placement import Placement
from mjstack.scene import SceneIndex, build_model


def points_over(cfg: Config, n: int, seed: int = 0) -> np.ndarray:
    """Random points over the cubes' regions, from the table up to where cubes are carried."""
    rng = np.random.default_rng(seed)
    scene = cfg.scene
    places = np.array([scene.objects["red"].xy, scene.objects["blue"].xy])[rng.integers(2, size=n)]
    xy = places + rng.uniform(-1, 1, (n, 2)) * scene.random_xy
    lowest = scene.table_top + scene.objects["red"].half_height
    return np.column_stack((xy, lowest + rng.uniform(0.0, 0.15, n)))


@pytest.mark.parametrize("grip", ["open", "closed"])
def test_what_mink_reaches_is_reached(get_stage: GetStage, robot: str, grip: str) -> None:
    cfg = get_stage(robot).cfg
    gripper = getattr(cfg.robot, f"gripper_{grip}")
    ik = GraspIk(cfg.robot, cfg.model, tolerance=5e-4)
    points = points_over(cfg, 20)
    solutions, distances = find_reach(get_stage(robot).model, cfg.robot, points, gripper)
    assert distances.shape == (3, 20)
    assert float(distances.amin(0).max()) < 5e-4
    for k, point in enumerate(points):
        q = solutions[distances[:, k].argmin(), k].double().numpy()
        np.testing.assert_allclose(q[-len(gripper) :], gripper, atol=1e-6)
        assert np.linalg.norm(ik.grasp_point(q) - point) < 5e-4
        assert ik.solve(point, np.array([*ik.home[: -len(gripper)], *gripper]))[1] < 5e-4


REGIONS = [
    ("so101", "[0.12,0.05]", "red at (0.450, -0.180) m the point"),
    ("rebot", "[0.3,0.0]", None),  # the whole depth of its table is within reach
    ("so101", "[0.03,0.03]", None),
]


@pytest.mark.full
@pytest.mark.parametrize(("robot", "xy", "says"), REGIONS)
def test_a_region_beyond_the_arm_is_refused(robot: str, xy: str, says: str | None) -> None:
    overrides = [f"robot={robot}", "sim=native", "reset=randomized", f"reset.cubes.params.xy={xy}"]
    overrides.append("+reset.cubes.params.candidates=64")
    if says is None:
        make_env(overrides, nworld=1)
        return
    with pytest.raises(ConfigError) as caught:
        make_env(overrides, nworld=1)
    message = str(caught.value)
    assert message.startswith("reset.cubes.params.xy=[")
    assert says in message
    assert "mm out of reach" in message
    assert "tools/reachability.py" in message
    assert "\n" not in message


@pytest.mark.full
def test_randomized_takes_the_layouts_region_and_the_command_line_another() -> None:
    cfg = load_config(["reset=randomized", "robot.placements.stack.random_xy=[0.02,0.04]"])
    assert cfg.reset["cubes"].params["xy"] == [0.02, 0.04]
    cfg = load_config(["reset=randomized", "reset.cubes.params.xy=[0.03,0.03]"])
    assert cfg.reset["cubes"].params["xy"] == [0.03, 0.03]
    for robot in ("so101", "rebot"):
        cfg = load_config(["reset=randomized", f"robot={robot}"])
        assert min(cfg.reset["cubes"].params["xy"]) >= 0.05
        assert cfg.reset["cubes"].params["gap"] == cfg.robot.finger_room
    with pytest.raises(ConfigError, match=r"scene\.random_xy"):
        load_config(["scene.random_xy=[0.05,-0.01]"])


def touching(
    model: mujoco.MjModel, index: SceneIndex, command: np.ndarray, cube: str, xy: Any, yaw: float
) -> set[str]:
    """Names of the geoms, but for the table's, that a cube on the table touches. The other cube is
    away.
    """
    data = mujoco.MjData(model)
    data.qpos[index.robot_qpos] = command
    for name, at in zip(("red", "blue"), index.object_qpos, strict=True):
        if name == cube:
            data.qpos[at : at + 2] = xy
            data.qpos[at + 3 : at + 7] = math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)
        else:
            data.qpos[at : at + 3] = 5.0
    mujoco.mj_kinematics(model, data)
    mujoco.mj_collision(model, data)
    geom = index.geoms[cube][0]
    pairs = [set(pair) for pair in data.contact.geom[: data.ncon].tolist()]
    others = {other for pair in pairs if geom in pair for other in pair - {geom}}
    return {model.geom(other).name for other in others} - {"table"}


def test_finger_room_is_what_the_open_jaws_need(get_stage: GetStage, robot: str) -> None:
    """Jaws around red, blue beside it at the smallest distance, any yaw. Only the SO-101 hits,
    towards its base.
    """
    cfg = get_stage(robot).cfg
    model = get_stage(robot).model
    index = get_stage(robot).index
    scene = cfg.scene
    distance = 2.0 * math.sqrt(2.0) * scene.objects["red"].half_height + cfg.robot.finger_room
    ik = GraspIk(cfg.robot, cfg.model, tolerance=5e-4)
    start = np.array([*ik.home[: len(cfg.robot.arm_joints)], *cfg.robot.gripper_open])
    z = scene.table_top + scene.objects["red"].half_height

    def touched(
        command: np.ndarray, at: np.ndarray, away: float, yaw: float, apart: float
    ) -> set[str]:
        beside = at[:2] + apart * np.array([math.cos(away), math.sin(away)])
        return touching(model, index, command, "blue", beside, yaw)

    closer = blocked = False
    for corner in ((-1, -1), (0, 0), (1, 1)):
        red = np.array(scene.objects["red"].xy)
        at = np.array([*(red + np.array(corner) * scene.random_xy), z])
        command, left = ik.solve(at, start)
        assert left < 5e-4
        for away in np.arange(0.0, 2.0 * math.pi, math.radians(10.0)):
            for yaw in np.arange(0.0, 0.5 * math.pi, 0.25):
                base = math.cos(away - math.atan2(-at[1], -at[0]))
                hit = touched(command, at, away, yaw, distance)
                assert not hit or (robot == "so101" and base > 0.2), (hit, math.degrees(away))
                blocked = blocked or bool(hit)
                closer = closer or (
                    base < 0.0 and bool(touched(command, at, away, yaw, distance - 0.01))
                )
    assert closer  # a centimetre less would not do
    assert blocked is (robot == "so101")


def placement_of(cfg: Config, model: mujoco.MjModel | None = None, **options: Any) -> Placement:
    """A placement in the scene, by default within 50 mm and 10 mm apart from the start pose."""
    model = model or build_model(cfg)
    index = SceneIndex(model, cfg.robot, cfg.scene)
    env: Any = SimpleNamespace(cfg=cfg, sim=SimpleNamespace(model=model), index=index)
    defaults = {"region": (0.05, 0.05), "gap": 0.01, "pose": cfg.robot.start}
    return Placement(env, **(defaults | options))


def random_draws() -> torch.Tensor:
    """64 trials of each of two cubes in 500 worlds, from -1 to 1."""
    generator = torch.Generator().manual_seed(0)
    return 2.0 * torch.rand((500, 2, 64, 2), generator=generator, dtype=torch.float64) - 1.0


def with_wall(
    cfg: Config, xy: tuple[float, float], half: tuple[float, float], euler: float = 0.0
) -> mujoco.MjModel:
    """The scene with one more geom that is fixed to the world."""
    from mjstack.robots import robot_spec
    from mjstack.scene.build import build_scene

    spec = robot_spec(cfg.robot, cfg.model)
    z = cfg.scene.table_top + 0.0275
    quat = [math.cos(0.5 * euler), 0.0, 0.0, math.sin(0.5 * euler)]
    spec.worldbody.add_geom(
        name="wall", type=mujoco.mjtGeom.mjGEOM_BOX, pos=[*xy, z], size=[*half, 0.0275], quat=quat
    )
    return build_scene(spec, cfg)


@pytest.mark.full
@pytest.mark.parametrize("euler", [0.0, 0.6])
def test_nothing_starts_in_a_wall(robot: str, euler: float) -> None:
    cfg = configure("reset=randomized", robot=robot)
    red_x, red_y = cfg.scene.objects["red"].xy
    model = with_wall(cfg, (red_x, red_y + 0.06), (0.05, 0.003), euler)
    index = SceneIndex(model, cfg.robot, cfg.scene)
    wall = model.geom("wall").id
    offsets, free = placement_of(cfg, model).choose(random_draws())
    assert free.all()
    cube = model.geom("red").id
    data = mujoco.MjData(model)
    nearest = math.inf
    for number, (dx, dy) in enumerate(offsets[:, 0].tolist()):
        at = index.object_qpos[0]
        half_yaw = 0.05 * number
        pose = (math.cos(half_yaw), 0.0, 0.0, math.sin(half_yaw))
        data.qpos[at : at + 7] = red_x + dx, red_y + dy, model.qpos0[at + 2], *pose
        mujoco.mj_kinematics(model, data)
        nearest = min(nearest, mujoco.mj_geomDistance(model, data, cube, wall, 1.0, None))
    assert nearest >= 0.01 - 1e-6
    without_wall, _ = placement_of(cfg).choose(random_draws())
    assert float(without_wall[:, 0, 1].max()) > float(offsets[:, 0, 1].max()) + 0.01


@pytest.mark.full
def test_nothing_starts_at_the_arm_wherever_noise_puts_it() -> None:
    """Around the jaws of a SO-101 that has come down to the table."""
    cfg = configure(
        "reset=randomized", "scene.objects.red.xy=[0.26,-0.03]", "scene.objects.blue.xy=[0.42,0.05]"
    )
    model = build_model(cfg)
    noise = 0.02
    index = SceneIndex(model, cfg.robot, cfg.scene)
    pose = np.array(cfg.robot.start)
    pose[1] += 0.15  # the shoulder, so that the jaws are among the cubes
    placement = placement_of(cfg, model, region=(0.07, 0.07), pose=pose.tolist(), noise=noise)
    rng = np.random.default_rng(0)
    places = rng.uniform(-1.0, 1.0, (600, 2))
    draws = torch.zeros(600, 2, 1, 2, dtype=torch.float64)
    draws[:, 0, 0] = torch.from_numpy(places)
    free = placement.choose(draws)[1].numpy()
    assert 0.1 < free.mean() < 0.9
    hit = np.zeros(600, dtype=bool)
    for k, place in enumerate(places * 0.07 + cfg.scene.objects["red"].xy):
        for _ in range(8):
            command = pose.copy()
            command[: index.n_arm] += noise * rng.choice([-1.0, 1.0], index.n_arm)
            yaw = rng.uniform(0.0, math.pi)
            hit[k] |= bool(touching(model, index, command, "red", place, yaw))
    assert not (hit & free).any()
    assert hit.sum() > 30


@pytest.mark.full
def test_all_of_the_region_is_drawn_from(robot: str, get_stage: GetStage) -> None:
    """Nothing but the other cube keeps one from any place of it."""
    for task in ("stack", "box"):
        cfg = configure("reset=randomized", f"task={task}", robot=robot)
        region = tuple(cfg.scene.random_xy)
        placement = placement_of(cfg, region=region, gap=cfg.robot.finger_room, noise=0.02)
        placement._apart = [[0.0] * 2] * 2  # the other cube aside
        grid = torch.linspace(-1.0, 1.0, 41, dtype=torch.float64)
        places = torch.cartesian_prod(grid, grid)
        for cube in (0, 1):
            draws = torch.zeros(len(places), 2, 1, 2, dtype=torch.float64)
            draws[:, cube, 0] = places
            assert bool(placement.choose(draws)[1].all()), (task, cube)


def test_a_region_with_room_is_tried_once_and_one_without_each_time(monkeypatch: Patch) -> None:
    tried = []
    monkeypatch.setattr("mjstack.mdp.starts.placement._ROOMY", set())
    choose = Placement.choose
    monkeypatch.setattr(
        Placement, "choose", lambda self, draws: tried.append(1) or choose(self, draws)
    )
    cfg = configure("reset=randomized")
    xy = (0.03, 0.02)

    def tries(scene: Config, model: mujoco.MjModel | None = None, *, gap: float = 0.0) -> int:
        tried.clear()
        placement_of(scene, model, region=xy, gap=gap).require_room(xy, 16)
        return len(tried)

    assert tries(cfg) > 0
    assert tries(cfg) == 0
    assert tries(cfg, gap=0.005) > 0
    wall = with_wall(cfg, tuple(cfg.scene.objects["red"].xy), (0.1, 0.1))
    for _ in range(2):
        with pytest.raises(ParameterError, match="found none in"):
            tries(cfg, wall)
    assert tries(cfg) == 0


@pytest.mark.full
def test_the_tool_maps_the_table(tmp_path: Path, capsys: Capture, monkeypatch: Patch) -> None:
    options = ["scene.random_xy=[0.12,0.05]", "--step=0.04", f"--folder={tmp_path}"]
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr(sys, "argv", ["reachability", *options])
    runpy.run_path(str(Path(reachability.__file__)), run_name="__main__")
    out = capsys.readouterr().out
    assert "largest square" in out
    (red,) = (line for line in out.splitlines() if line.startswith("│ red "))
    assert "not reached" in red
    assert (tmp_path / "reachability.png").stat().st_size > 10_000

    # Heights are the driver's
    cfg = load_config()
    approach = pytest.approx(cfg.robot.approach_height + 0.022)
    carry = pytest.approx(cfg.robot.approach_height + 0.022 + 0.09)
    levels = {"grasp": (pytest.approx(0.022), "open"), "approach": (approach, "open")}
    assert reachability.find_levels(cfg) == levels | {"carry": (carry, "open")}

    # Points are as solved one by one
    with (tmp_path / "reachability.csv").open() as file:
        rows = list(csv.DictReader(file))
    model = build_model(cfg)
    for row in rows[:: len(rows) // 7]:
        z = cfg.scene.table_top + cfg.scene.objects["red"].half_height
        point = np.array([[float(row["x_m"]), float(row["y_m"]), z]])
        distance = float(find_reach(model, cfg.robot, point, cfg.robot.gripper_open)[1].min())
        assert (row["grasp_reached"] == "1") is (distance <= 5e-4)
        assert float(row["grasp_residual_m"]) == pytest.approx(distance, rel=0.01, abs=2e-6)
        assert (row["grasp_tilt_deg"] != "nan") is (row["grasp_reached"] == "1")
    assert {row["grasp_reached"] for row in rows} == {"0", "1"}
