"""The box scene and what a policy needs of the task: geometry, starts, success, rewards."""

import copy
import math
from functools import cache

import mujoco
import numpy as np
import pytest
import torch
from check_cases import limits
from compositions import checked, load_config, make_env, refusal

from mjstack.config.schema import Config
from mjstack.drivers.open_loop import OpenLoopPlanner
from mjstack.envs import Env, build_env
from mjstack.math import quat_to_matrix
from mjstack.mdp.geometry import above_table
from mjstack.mdp.observation import object_to_place
from mjstack.scene import SceneIndex, build_model
from mjstack.scene.index import lowest_height
from mjstack.scene.phases import nominal_xy
from mjstack.tasks.box import BoxSuccess
from mjstack.tasks.check import make_check
from mjstack.tasks.progress import Progress

X0 = {"so101": 0.305, "rebot": 0.47}
RED = "red"
BLUE = "blue"
TOP = {"so101": 0.024, "rebot": 0.212}
PARTS = ("floor", "near", "far", "right", "left")

_composed = cache(lambda robot: load_config(["task=box", f"robot={robot}", "sim=native"]))
_planner = cache(lambda robot: OpenLoopPlanner(_composed(robot)))


def configured(robot: str) -> Config:
    return copy.deepcopy(_composed(robot))


def small_env(*overrides: str, robot: str = "so101", nworld: int = 3) -> Env:
    env = make_env(["task=box", f"robot={robot}", "sim=native", *overrides], nworld=nworld)
    env.reset(seed=0)
    return env


# The scene


def extent(model: mujoco.MjModel, name: str) -> tuple[np.ndarray, np.ndarray]:
    geom = model.geom(name)
    pos = geom.pos + model.body(geom.bodyid[0]).pos
    return pos - geom.size, pos + geom.size


def test_the_scene_is_the_protocols(robot: str) -> None:
    model = build_model(configured(robot))
    x0 = X0[robot]
    top = TOP[robot]
    low, high = extent(model, "table")
    np.testing.assert_allclose([low[:2], high[:2]], [[x0 - 0.18, -0.28], [x0 + 0.18, 0.28]])
    assert high[2] == pytest.approx(top)
    inside = {
        "x": (extent(model, "box_near")[1][0], extent(model, "box_far")[0][0]),
        "y": (extent(model, "box_right")[1][1], extent(model, "box_left")[0][1]),
    }
    assert inside["x"] == pytest.approx((x0 - 0.165, x0 + 0.165))
    assert inside["y"] == pytest.approx((0.015, 0.265))
    low, high = extent(model, "box_floor")
    np.testing.assert_allclose(low, [x0 - 0.165, 0.015, top])
    np.testing.assert_allclose(high, [x0 + 0.165, 0.265, top + 0.006])
    for wall, axis in (("near", 0), ("far", 0), ("right", 1), ("left", 1)):
        low, high = extent(model, f"box_{wall}")
        assert (high - low)[axis] == pytest.approx(0.006)
        assert (low[2], high[2]) == pytest.approx((top, top + 0.055))
        other = 1 - axis  # no gap at a corner
        assert (high - low)[other] >= (0.33, 0.25)[other] - 1e-9
    for part in PARTS:
        geom = model.geom(f"box_{part}")
        assert (model.body(geom.bodyid[0]).name, int(geom.condim[0])) == ("box", 3)
        np.testing.assert_allclose(geom.friction, [0.8, 0.005, 0.0005])
        solref = [-4444.444444, -266.666667] if part == "floor" else [0.01, 1.0]
        np.testing.assert_allclose(geom.solref, solref)
    np.testing.assert_allclose(model.body(RED).pos, [x0 - 0.035, -0.15, top + 0.022])
    np.testing.assert_allclose(model.body(BLUE).pos, [x0 + 0.045, -0.15, top + 0.022])
    assert model.opt.timestep == 0.001


def test_the_motion_is_the_protocols(robot: str) -> None:
    cfg = configured(robot)
    x0 = X0[robot]
    assert cfg.scene.places["red_slot"].xy == pytest.approx([x0 + 0.055, 0.15])
    assert cfg.scene.places["blue_slot"].xy == pytest.approx([x0 - 0.030, 0.15])
    assert cfg.scene.grasp_offset == {"so101": 0.0, "rebot": 0.006}[robot]
    seconds = [phase.seconds for phase in cfg.controller.phases.values()]
    assert seconds == [1.6, 1.6, 2.2, 2.0, 3.0, 2.4, 1.6, 1.4, 1.4] * 2 + [5.6]
    assert _planner(robot).phases[-1].stop == cfg.task.episode_steps == 2000
    t = limits(cfg)
    assert (t.force, t.grasp_steps, t.open_fraction) == (1e-5, 10, 0.8)
    assert (t.lift_height, t.lift_steps, t.carry_steps, t.carry_distance) == (0.010, 25, 10, 0.05)
    assert (t.inside, t.rest_speed, t.window, t.jaw_clearance) == (0.003, 0.04, 50, 0.02)


@pytest.mark.full
def test_other_scenes_pay_for_no_sensor_of_supports(robot: str) -> None:
    cfg = load_config([f"robot={robot}"])
    model = build_model(cfg)
    assert model.nsensor == 4
    assert SceneIndex(model, cfg.robot, cfg.scene).support_force == {}


def test_sensors_tell_supports_from_jaws(robot: str) -> None:
    """A cube on the table, in the box and on the other cube; and one in the air."""
    cfg = configured(robot)
    model = build_model(cfg)
    index = SceneIndex(model, cfg.robot, cfg.scene)
    data = mujoco.MjData(model)
    top, (red, blue) = TOP[robot], index.object_qpos

    def forces() -> list[list[bool]]:
        data.qpos[index.robot_qpos] = cfg.robot.home
        for _ in range(60):  # until what stands carries its weight
            data.qvel[index.robot_qvel] = 0.0
            mujoco.mj_step(model, data)

        def pressed(addresses: list[int]) -> list[bool]:
            return [np.linalg.norm(data.sensordata[a : a + 3]) > 1e-5 for a in addresses]

        assert not any(pressed([*index.jaw_force[RED], *index.jaw_force[BLUE]]))
        return [pressed(index.support_force[name]) for name in (RED, BLUE)]

    assert forces() == [[True, False, False], [True, False, False]]  # world, cube, box
    mujoco.mj_resetData(model, data)
    data.qpos[red : red + 3] = [*cfg.scene.places["red_slot"].xy, top + 0.006 + 0.022]
    data.qpos[blue + 2] += 0.3
    assert forces() == [[False, False, True], [False, False, False]]
    mujoco.mj_resetData(model, data)
    data.qpos[red : red + 3] = np.add(data.qpos[blue : blue + 3], [0.0, 0.0, 0.044])
    assert forces() == [[False, True, False], [True, True, False]]


# The start


def test_home_is_the_first_approach_and_clear_of_everything(robot: str) -> None:
    cfg = configured(robot)
    first = _planner(robot).plan(nominal_xy(cfg.scene)[None]).knots[0, 0]
    np.testing.assert_allclose(cfg.robot.home, first, atol=2e-6)
    assert cfg.robot.start == cfg.robot.home == cfg.robot.placements["box"].home
    model = build_model(cfg)
    index = SceneIndex(model, cfg.robot, cfg.scene)
    data = mujoco.MjData(model)
    data.qpos[index.robot_qpos] = cfg.robot.home
    mujoco.mj_forward(model, data)
    touching = {model.geom(g).name for c in data.contact for g in c.geom}
    assert touching <= {"table", RED, BLUE}
    at = _planner(robot).ik.grasp_point(np.array(cfg.robot.home))
    assert at == pytest.approx([*cfg.scene.objects["red"].xy, TOP[robot] + 0.19], abs=5e-6)


# Rewards


def put(env: Env, name: str, place: list[float] | np.ndarray, worlds: list[int]) -> None:
    address, velocity = env.index.objects[name]
    for world in worlds:
        pose = torch.tensor([*place, 1.0, 0.0, 0.0, 0.0], dtype=env.sim.qpos.dtype)
        env.sim.qpos[world, address : address + 7] = pose
        env.sim.qvel[world, velocity : velocity + 6] = 0.0


def rests(env: Env) -> dict[str, list[float]]:
    """Where the cubes rest in the box."""
    scene = env.cfg.scene
    z = TOP[env.cfg.robot.name] + 0.006 + 0.022
    return {RED: [*scene.places["red_slot"].xy, z], BLUE: [*scene.places["blue_slot"].xy, z]}


@pytest.mark.full
def test_terms_know_the_box(robot: str) -> None:
    """World 0: both on the table. 1: red in the box. 2: both in it. 3: red over its place, on the
    rim's height and above.
    """
    env = small_env("reset=nominal", robot=robot, nworld=4)
    places = rests(env)
    put(env, RED, places[RED], [1, 2])
    put(env, BLUE, places[BLUE], [2])
    put(env, RED, np.add(places[RED], [0.0, 0.0, 0.1]), [3])
    check = make_check(env.cfg)
    offsets = {
        name: object_to_place(env, object=name, place=check.slots[name], height=0.006)
        for name in (RED, BLUE)
    }
    np.testing.assert_allclose(offsets[RED][1:3], 0.0, atol=1e-6)
    wanted = np.subtract(places[BLUE], env.sim.model.body(BLUE).pos)
    np.testing.assert_allclose(offsets[BLUE][0], wanted, atol=1e-6)
    placed = check.placed(env.state).int().tolist()
    assert placed == [[0, 0], [1, 0], [1, 1], [0, 0]]
    progress = Progress(env)
    grasp_point = 0.5 * sum(env.sim.site_xpos[0, s] for s in env.index.grasp_sites)
    value = progress(env).tolist()
    for world, name, start in ((0, RED, 0.0), (1, BLUE, 0.5)):
        address, _ = env.index.objects[name]
        distance = float((env.sim.qpos[world, address : address + 3] - grasp_point).norm())
        part = (1.0 - math.tanh(distance / 0.2)) / 5.0
        assert value[world] == pytest.approx(start + 0.5 * part, abs=1e-6)
    assert value[2] == pytest.approx(1.0)  # the gripper is open at home
    assert value[3] == pytest.approx(0.5 * (3.0 + 1.0 - math.tanh(0.1 / 0.2)) / 5.0, abs=1e-6)
    for address in env.index.jaw_force[RED]:
        env.sim.sensordata[1, address] = 1.0
    # Held in the box, red is not let go of: nothing of blue counts.
    assert float(progress(env)[1]) == pytest.approx(0.5 * 5.0 / 5.0, abs=1e-6)
    between = grasp_point.numpy()
    put(env, RED, between, [1])
    low = float(above_table(env, RED)[1])
    across = np.linalg.norm(places[RED][:2] - between[:2])
    part = 1.0 + low / 0.04 if low < 0.04 else 3.0 - math.tanh(across / 0.2)
    assert float(progress(env)[1]) == pytest.approx(0.5 * part / 5.0, abs=1e-6)
    put(env, RED, between - [0.0, 0.0, 0.026], [1])
    assert float(progress(env)[1]) < 0.1  # closed jaws on its top are no grasp
    env.close()


def test_success_needs_rest_in_the_box_an_open_gripper_and_the_whole_window(robot: str) -> None:
    """World 0 has all of it. In 1 blue is on the table, in 2 the gripper is closed, in 3 red moves
    now and then, in 4 a jaw touches blue in the first step, in 5 a corner of red is above the
    rim.
    """
    env = small_env("reset=nominal", robot=robot, nworld=6)
    success = BoxSuccess(env)
    places = rests(env)
    window = limits(env.cfg).window
    put(env, RED, places[RED], [0, 1, 2, 3, 4])
    put(env, BLUE, places[BLUE], [0, 2, 3, 4, 5])
    put(env, RED, np.add(places[RED], [0.0, 0.0, 0.0085]), [5])
    closed = torch.tensor(env.cfg.robot.gripper_closed, dtype=env.sim.qpos.dtype)
    env.sim.qpos[2, list(env.index.robot_qpos[env.index.n_arm :])] = closed
    env.sim.sensordata.zero_()
    _, velocity = env.index.objects[RED]
    seen = []
    for step in range(window + 1):
        env.sim.qvel[3, velocity] = 0.05 if step % 20 == 10 else 0.0
        env.sim.sensordata[4, env.index.jaw_force[BLUE][0]] = 1.0 if step == 0 else 0.0
        seen.append(success(env).tolist())
    assert not any(any(row) for row in seen[: window - 1])
    assert seen[window - 1] == [True, False, False, False, False, False]
    assert seen[window] == [True, False, False, False, True, False]
    success.reset(torch.tensor([True, False, False, False, False, False]))
    assert success(env).tolist() == [False, False, False, False, True, False]
    env.close()


# Geometry


def test_matrix_of_a_quaternion() -> None:
    draw = torch.randn((50, 4), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    quat = torch.nn.functional.normalize(draw, dim=1)
    for q, matrix in zip(quat.numpy(), quat_to_matrix(quat).numpy(), strict=True):
        wanted = np.empty(9)
        mujoco.mju_quat2Mat(wanted, q)
        np.testing.assert_allclose(matrix.ravel(), wanted, atol=1e-12)


@pytest.mark.parametrize("kind", ["cylinder", "mesh"])
def test_lowest_point_of_a_turned_geom(kind: str) -> None:
    """By MuJoCo's distance from a plane; of a mesh it is never too high."""
    spec = mujoco.MjSpec()
    stone = np.random.default_rng(1).normal(size=(40, 3)) * [0.03, 0.05, 0.02]
    spec.add_mesh(name="stone", uservert=stone.ravel())
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1])
    body = spec.worldbody.add_body(name="jaw")
    body.add_freejoint()
    shape = {"meshname": "stone"} if kind == "mesh" else {"size": [0.02, 0.05, 0.0]}
    shape["type"] = getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}")
    body.add_geom(pos=[0.01, 0.1, 0.0], **shape)
    touches_nothing = {"contype": 0, "conaffinity": 0}
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.5] * 3, **touches_nothing)
    model = spec.compile()
    data = mujoco.MjData(model)
    for quat in np.random.default_rng(2).normal(size=(20, 4)):
        data.qpos[:] = [0.0, 0.0, 0.5, *quat]
        mujoco.mj_kinematics(model, data)
        pose = (torch.tensor(data.xpos)[None], torch.tensor(data.xquat)[None])
        lowest = float(lowest_height(model, ["jaw"], *pose)[0])
        expected = mujoco.mj_geomDistance(model, data, 0, 1, 2.0, None)
        too_low = 0.1 if kind == "mesh" else 1e-6  # less than the mesh is wide
        assert expected - too_low <= lowest <= expected + 1e-6


# Bad input


@pytest.mark.parametrize(
    ("override", "parts"),
    [
        ("task.check.into=red", ["task.check.into=red", "a part floor"]),
        ("task.check.into=tray", ["tray", "blue, box, red"]),
        ("scene.objects.box.yaw=0.1", ["task.check.into=box", "not turned"]),
        ("scene.objects.box.parts.near.solref=[1]", ["near.solref", "2 numbers"]),
        ("scene.places.red_slot.xy=[0.46,0.26]", ["red_slot.xy", "a place in the box"]),
        ("scene.random_xy=[0.1]", ["scene.random_xy", "2 numbers"]),
        ("scene.random_xy=[0.1,-0.1]", ["scene.random_xy", "at least 0"]),
        ("task.check.places=[red_slot]", ["task.check.places", "each object"]),
        ("task.check.places=[red_slot,lid]", ["task.check.places", "lid"]),
        ("task.check.window=0", ["task.check.window=0", "from 1 to"]),
        ("task.check.window=2001", ["task.check.window=2001", "2000"]),
        ("task.check.open_fraction=1.2", ["task.check.open_fraction=1.2", "at most 1"]),
        ("task.check.force=0", ["task.check.force=0", "above 0"]),
        ("task.check.inside=-0.001", ["task.check.inside=-0.001", "at least 0"]),
        ("task.check.lift_steps=0", ["task.check.lift_steps=0", "from 1 to"]),
        ("task.check.rest_sped=1", ["rest_sped", "rest_speed"]),
    ],
)
def test_a_bad_value_is_one_line(override: str, parts: list[str]) -> None:
    refusal(lambda: checked(override, task="box"), *parts)


@pytest.mark.full
@pytest.mark.parametrize(
    ("overrides", "parts"),
    [
        ("scene=stack", ["red_slot", "object or place"]),
        ("phases=stack", ["gate.parity.states", "approach_red"]),
        ("~controller.phases.settle_blue", ["task.check", "settle_blue"]),
        ("scene.places.red_slot.xy=null", ["red_slot"]),
        ("timing=default timing.decimation=11", ["task.control_hz=50"]),
        ("observation.policy.terms.red_to_slot.params.object=red_cub", ["red_to_slot", "red_cub"]),
        ("reward.progress.params.scale=0", ["reward.progress.params.scale=0", "above 0"]),
        ("task=stack observation=box", ["red_to_slot", "place 'red_slot' does not exist"]),
    ],
)
def test_bad_input_is_one_line(overrides: str, parts: list[str]) -> None:
    def build() -> None:
        task = [] if "task=" in overrides else ["task=box"]
        cfg = load_config([*task, "sim=native", "nworld=1", *overrides.split()])
        make_check(cfg)
        build_env(cfg).close()

    refusal(build, *parts)
