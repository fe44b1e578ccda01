"""Terms and managers: values against NumPy and MuJoCo, managers without an environment, and how
worlds start.
"""

import inspect
import math
from collections.abc import Callable
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
from box_checker import corners_of
from check_cases import BLUE, RED, limits
from environments import GetStage, StubViews, actions, configure, on_shared_sim, returned, zeros

from mjstack.config.schema import Config
from mjstack.envs import Env
from mjstack.mdp import observation as observation_terms
from mjstack.mdp import reset as reset_terms
from mjstack.mdp import reward as reward_terms
from mjstack.mdp import termination as termination_terms
from mjstack.mdp.geometry import source_xy
from mjstack.tasks.check import make_check
from mjstack.tasks.stack import StackSuccess
from mjstack.tasks.view import Step

CUBES = ("red", "blue")
OBJECT = {"object": "red"}


def table_top(cfg: Config) -> float:
    return cfg.scene.table_center[2] + cfg.scene.table_half[2]


# Every term of mjstack, by what its docstring says. "n": the robot's joints; "a": the action.
OBSERVATIONS = {
    "joint_pos": ({}, "n"),
    "joint_pos_relative": ({}, "n"),
    "joint_vel": ({}, "n"),
    "grasp_point_pos": ({}, 3),
    "grasp_point_to_object": (OBJECT, 3),
    "object_to_object": ({"a": "red", "b": "blue"}, 3),
    "object_pose": (OBJECT, 7),
    "positions": ({}, 6),
    "offsets": ({}, 6),
    "headings": ({}, 4),
    "tilts": ({}, 4),
    "grasped": ({}, 2),
    "goals": ({}, 0),
    "object_velocity": (OBJECT, 6),
    "jaw_force": (OBJECT, 2),
    "last_action": ({}, "a"),
    "joint_zeros": ({}, "n"),
}
REWARDS = {  # whether it is a fraction, from 0 to 1
    "reach": ({**OBJECT, "scale": 0.1}, True),
    "lift": ({**OBJECT, "height": 0.05}, True),
    "success": ({}, True),
    "action_rate": ({}, False),
    "joint_vel": ({}, False),
}
TERMINATIONS = {
    "time_out": {"steps": 3},
    "success": {},
    "ObjectOffTable": {},
    "JointLimit": {"margin": 0.1},
    "non_finite": {},
    "overflow": {},
}
ELSEWHERE = ("object_to_place", "fixture_pos", "fixture_vel")  # in test_objects, test_object_files
RESETS = ("home", "JointNoise", "JointZeros", "JitterObjects", "RandomizeObjects")
RESETS += ("FixtureJoints", "ObjectMass", "ObjectFriction", "ActuatorGains")


def test_no_term_is_left_out() -> None:
    for module, known in (
        (observation_terms, OBSERVATIONS),
        (reward_terms, REWARDS),
        (termination_terms, TERMINATIONS),
        (reset_terms, RESETS),
    ):
        own = [
            name
            for name, value in vars(module).items()
            if callable(value) and inspect.getmodule(value) is module and not name.startswith("_")
        ]
        assert sorted(set(own) - set(ELSEWHERE)) == sorted(known)


def test_every_term_has_its_shape_and_range(backend: str, robot: str) -> None:
    env = on_shared_sim(backend, 3, configure("task=stack", robot=robot))
    env.reset(seed=0)
    for move in actions(env, 4):
        env.step(move)
    widths = {"n": len(env.cfg.robot.home), "a": env.action_manager.action_dim}
    for name, (params, width) in OBSERVATIONS.items():
        value = getattr(observation_terms, name)(env, **params)
        assert value.shape == (3, widths.get(width, width)), name  # type: ignore[call-overload]
        assert value.dtype is env.sim.qpos.dtype, name
        assert torch.isfinite(value).all(), name
    for name, (params, is_fraction) in REWARDS.items():
        value = getattr(reward_terms, name)(env, **params)
        assert value.shape == (3,), name
        assert value.dtype.is_floating_point, name
        assert (value >= 0.0).all(), name
        assert not is_fraction or (value <= 1.0).all(), name
    for name, params in TERMINATIONS.items():
        term = getattr(termination_terms, name)
        value = term(env, **params)(env) if inspect.isclass(term) else term(env, **params)
        assert value.shape == (3,), name
        assert value.dtype is torch.bool, name
        assert value.all() == (name == "time_out"), name


# Observations against MuJoCo


def mujocos_observations(env: Env, world: int, action: np.ndarray) -> dict[str, np.ndarray]:
    """The terms of conf/observation/stack.yaml and reach.yaml in native MuJoCo, read by names,
    without noise, clip and scale.
    """
    robot = env.cfg.robot
    data = mujoco.MjData(env.sim.model)
    data.qpos[:] = env.sim.qpos[world].double().cpu()
    data.qvel[:] = env.sim.qvel[world].double().cpu()
    mujoco.mj_forward(env.sim.model, data)
    red, blue = (data.body(name).xpos for name in CUBES)
    grasp_point = np.mean([data.site(name).xpos for name in robot.grasp_sites], axis=0)
    joints = [data.joint(name) for name in robot.joints]
    return {
        "joint_pos": np.concatenate([joint.qpos for joint in joints]) - robot.home,
        "joint_vel": np.concatenate([joint.qvel for joint in joints]),
        "grasp_point_to_red": red - grasp_point,
        "grasp_point_to_goal": red + np.array([0.0, 0.0, 0.06]) - grasp_point,
        "red_to_blue": blue - red,
        "red_pose": np.concatenate((red, data.body("red").xquat)),
        "red_velocity": data.joint("red").qvel,
        "blue_pose": np.concatenate((blue, data.body("blue").xquat)),
        "last_action": action,
        "jaw_force": np.zeros(2),  # nobody touches the cube yet
    }


@pytest.mark.parametrize("task", ["stack", "reach"])
def test_observation_groups_hold_what_mujoco_says(backend: str, task: str, robot: str) -> None:
    env = on_shared_sim(backend, 3, configure(f"task={task}", robot=robot))
    env.reset(seed=0)
    for cube in env.index.object_qvel:
        env.sim.qvel[:, cube : cube + 6] += 0.2  # so that no velocity is zero
    moves = actions(env, 6)
    for move in moves:
        obs = env.step(move)[0]
    assert (env.episode_step == 6).all()
    for k in range(3):
        expected = mujocos_observations(env, k, moves[-1][k].double().cpu().numpy())
        for group, cfg in env.cfg.observation.items():
            values = obs[group][k].double().cpu().numpy()
            start = 0
            for name, term in cfg.terms.items():
                value = np.clip(expected[name], *(term.clip or (-np.inf, np.inf)))
                noise = (term.noise * abs(term.scale)) if cfg.noise else 0.0
                start += len(value) * (term.history - 1)  # the newest step of a history
                part = values[start : start + len(value)]
                atol = noise + 2e-5
                label = f"{group} {name}"
                np.testing.assert_allclose(part, term.scale * value, atol=atol, err_msg=label)
                start += len(value)
            assert start == len(values)


# A driven episode, through the environment


def record(env: Env, get_stage: GetStage, steps: int = 600) -> SimpleNamespace:
    """Plays the scripted grasp; per step the state, the returned values and each term's reward."""
    planner = get_stage(env.cfg.robot.name).planner
    env.reset(seed=0)
    tape = planner.plan(source_xy(env).double().cpu().numpy())
    rows: dict[str, list[torch.Tensor]] = {}
    for step in range(steps):
        row = returned(env.step(tape.command(step).float())) | {
            "qpos": env.sim.qpos.clone(),
            "qvel": env.sim.qvel.clone(),
            "ctrl": env.sim.ctrl.clone(),
            "sensordata": env.sim.sensordata.clone(),
            "grasp_point": env.sim.site_xpos[:, env.index.grasp_sites].mean(1),
            "values": env.reward_manager.values.clone(),
            "action": env.action.clone(),
            "episode": env.episode.clone(),
        }
        for name, value in row.items():
            rows.setdefault(name, []).append(value)
    return SimpleNamespace(
        cfg=env.cfg,
        index=env.index,
        phases=planner.phases,
        **{n: torch.stack(v) for n, v in rows.items()},
    )


def scripted_cfg(robot: str) -> Config:
    cfg = configure("task=stack", "action=joint_absolute", "reset=jitter", robot=robot)
    cfg.termination.clear()
    return cfg


@pytest.fixture(scope="module")
def scripted(get_stage: GetStage) -> Callable[[str], SimpleNamespace]:
    """The whole episode in three native worlds, without any termination."""
    made: dict[str, SimpleNamespace] = {}

    def get(robot: str) -> SimpleNamespace:
        if robot not in made:
            env = on_shared_sim("native", 3, scripted_cfg(robot))
            made[robot] = record(env, get_stage)
        return made[robot]

    return get


def cubes_of(
    rec: SimpleNamespace, qpos: torch.Tensor, qvel: torch.Tensor
) -> tuple[np.ndarray, np.ndarray]:
    """Poses and velocities of both cubes, shape ``(..., 2, 7)`` and ``(..., 2, 6)``."""
    pose = [qpos[..., a : a + 7] for a in rec.index.object_qpos]
    velocity = [qvel[..., a : a + 6] for a in rec.index.object_qvel]
    return torch.stack(pose, -2).numpy(), torch.stack(velocity, -2).numpy()


def jaw_forces_of(rec: SimpleNamespace, sensordata: torch.Tensor) -> np.ndarray:
    """Force of each jaw on red [N], shape ``(..., jaws)``."""
    forces = [sensordata[..., a : a + 3].numpy() for a in rec.index.jaw_force["red"]]
    return np.linalg.norm(np.stack(forces, axis=-2), axis=-1)


def progress_of(rec: SimpleNamespace, pose: np.ndarray, low: np.ndarray) -> np.ndarray:
    """The stages of one object in plain loops, from the reward's docstring."""
    cfg = rec.cfg
    half = cfg.scene.objects["red"].half_height
    t = limits(cfg)
    closed, opened = (np.array(v) for v in (cfg.robot.gripper_closed, cfg.robot.gripper_open))
    out = np.zeros(low.shape)
    for step, world in np.ndindex(*low.shape):
        red, blue = pose[step, world, :, :3]
        fingers = rec.qpos[step, world].numpy()[rec.index.robot_qpos[rec.index.n_arm :]]
        opening = ((fingers - closed) / (opened - closed)).min()
        away = np.linalg.norm(rec.grasp_point[step, world].numpy() - red)
        offset = blue + np.array([0.0, 0.0, 2.0 * half]) - red
        across = np.linalg.norm(offset[:2])
        forces = jaw_forces_of(rec, rec.sensordata[step, world])
        held = (forces > 1e-5).all() and away <= 0.02
        dz = red[2] - blue[2]
        if np.linalg.norm(red[:2] - blue[:2]) <= t.xy_err and t.dz_min <= dz <= t.dz_max:
            stage, part = 4, opening / 0.8
        elif across <= 0.03 and offset[2] <= 0.005:
            stage, part = 3, 1.0 - math.tanh(abs(offset[2]) / 0.2)
        elif held and low[step, world] >= 0.04:
            stage, part = 2, 1.0 - math.tanh(across / 0.2)
        elif held:
            stage, part = 1, low[step, world] / 0.04
        else:
            stage, part = 0, 1.0 - math.tanh(away / 0.2)
        out[step, world] = (stage + np.clip(part, 0.0, 1.0)) / 5.0
    return out


@pytest.mark.full
def test_rewards_of_a_scripted_episode(
    robot: str, scripted: Callable[[str], SimpleNamespace]
) -> None:
    rec = scripted(robot)
    cfg = rec.cfg
    dt = rec.cfg.timing.step_dt
    names = list(cfg.reward)
    got = {
        name: rec.values[..., i].double().numpy() / (cfg.reward[name].weight * dt)
        for i, name in enumerate(names)
    }
    pose, velocity = cubes_of(rec, rec.qpos, rec.qvel)
    half = cfg.scene.objects["red"].half_height
    red = pose[:, :, RED], velocity[:, :, RED]
    corners = [corners_of(*(part[:, world] for part in red), half)[0] for world in range(3)]
    low = np.stack([points[..., 2].min(1) for points in corners], axis=1) - table_top(cfg)
    action = rec.action.double().numpy()
    change = np.diff(action, axis=0, prepend=np.zeros_like(action[:1]))
    qvel = rec.qvel[..., torch.from_numpy(rec.index.robot_qvel)].numpy()
    expected = {
        "progress": progress_of(rec, pose, low),
        "success": rec.success.numpy(),
        "action_rate": np.square(change).sum(-1),
        "joint_vel": np.square(qvel).sum(-1),
    }
    assert set(expected) == set(names)
    for name, value in expected.items():
        np.testing.assert_allclose(got[name], value, rtol=1e-4, atol=1e-5, err_msg=name)
    np.testing.assert_allclose(rec.reward.numpy(), rec.values.sum(-1).numpy(), rtol=1e-5, atol=1e-7)

    span = {p.name: slice(p.start, p.stop) for p in rec.phases}
    stage = np.floor(5.0 * got["progress"] + 1e-4)
    assert (stage[span["above_red"]] == 0.0).all()
    assert (stage[span["lift_red"].stop - 1] == 2.0).all()
    assert (stage[span["above_blue"].stop - 1] == 3.0).all()
    assert (stage[span["release"].start] == 4.0).all()
    assert (stage[span["done"]] == 5.0).all()
    assert got["success"][-1].min() == pytest.approx(1.0, rel=1e-5)


@pytest.mark.full
def test_jaw_force_is_mujocos_contact_force(
    robot: str, backend: str, scripted: Callable[[str], SimpleNamespace]
) -> None:
    """Nothing before the grasp; in a steady grasp what mj_contactForce adds up to, jaw by jaw."""
    rec = scripted(robot)
    cfg = configure("task=stack", "action=joint_absolute", "reset=jitter", robot=robot)
    env = on_shared_sim(backend, 3, cfg)
    phases = {p.name: p for p in rec.phases}
    for step, grasped in ((phases["above_red"].stop, False), (phases["lift_red"].stop - 20, True)):
        env.reset(seed=0)
        for name in ("qpos", "qvel", "ctrl"):
            getattr(env.sim, name).copy_(getattr(rec, name)[step])
        for t in range(1, 4):
            obs = env.step(rec.action[step + t].to(env.device).float())[0]["privileged"]
        column = sum(width for width in (*[len(cfg.robot.home)] * 2, 3, 3, 7, 6, 7))
        force = 10.0 * obs[:, column : column + 2].double().cpu().numpy()  # its scale is 0.1
        stage = env.reward_manager.values[:, 0] / env.reward_manager.weights[0] * 5.0
        assert (stage >= 1.0).tolist() == [grasped] * 3
        for k in range(3):
            expected = jaw_forces(env, k)
            if not grasped:
                assert expected == [0.0, 0.0]
                assert not force[k].any()
            else:
                assert min(expected) > 0.5
                np.testing.assert_allclose(force[k], expected, rtol=0.05)


@pytest.mark.full
def test_jaw_force_has_a_column_for_each_jaw(robot: str) -> None:
    env = on_shared_sim("native", 3, configure(robot=robot))
    for cube in CUBES:
        for column, jaw in enumerate(env.cfg.robot.jaw_bodies):
            env.sim.sensordata.zero_()
            start = int(env.sim.model.sensor(f"{jaw}/{cube}").adr[0])
            env.sim.sensordata[1, start : start + 3] = torch.tensor([3.0, -4.0, 12.0]).double()
            for other in CUBES:
                expected = torch.zeros(3, 2).double()
                expected[1, column] = 13.0 * (other == cube)
                assert torch.equal(observation_terms.jaw_force(env, object=other), expected)


def jaw_forces(env: Env, world: int) -> list[float]:
    """Contact force of each jaw on the red cube [N], added up from MuJoCo's contacts."""
    m = env.sim.model
    data = mujoco.MjData(m)
    data.qpos[:], data.qvel[:], data.ctrl[:] = (
        v[world].double().cpu() for v in (env.sim.qpos, env.sim.qvel, env.sim.ctrl)
    )
    mujoco.mj_forward(m, data)
    cube = m.body("red").id
    out = []
    for name in env.cfg.robot.jaw_bodies:
        jaw = m.body(name).id
        total = np.zeros(3)
        for i, contact in enumerate(data.contact):
            bodies = [m.geom_bodyid[g] for g in contact.geom]
            if sorted(bodies) == sorted((jaw, cube)):
                force = np.zeros(6)
                mujoco.mj_contactForce(m, data, i, force)
                world = contact.frame.reshape(3, 3).T @ force[:3]  # on the second geom
                total += world if bodies[1] == cube else -world
        out.append(float(np.linalg.norm(total)))
    return out


@pytest.mark.full
def test_success_ends_a_scripted_episode(
    get_stage: GetStage, scripted: Callable[[str], SimpleNamespace]
) -> None:
    """In the step in which it is first achieved, and not before the cubes have rested for a whole
    window.
    """
    rec = scripted("so101")
    first = rec.success.int().argmax(0).tolist()
    window = limits(rec.cfg).window
    placed = next(p for p in rec.phases if p.name == "place_stack").stop
    assert all(step >= placed + window // 2 for step in first)
    assert rec.success[-1].all()
    cfg = configure("task=stack", "action=joint_absolute", "reset=jitter")
    env = on_shared_sim("native", 3, cfg)
    run = record(env, get_stage, max(first) + 1)
    for k, step in enumerate(first):
        assert not run.terminated[:step, k].any()
        assert run.terminated[step, k]
        assert run.success[step, k]
        assert run.episode[step, k] == 1
        assert torch.equal(run.qpos[:step, k], rec.qpos[:step, k])
        for group in cfg.observation:
            final = getattr(run, f"final.{group}")[step, k]
            assert torch.equal(final, getattr(rec, f"obs.{group}")[step, k])
    assert not run.truncated.any()


# Success of the stack task against its check


def rested(rec: SimpleNamespace, *views: torch.Tensor, since: np.ndarray) -> np.ndarray:
    """Rules 4 to 6 of the check over the window that ends at each step, shape ``(steps,)``.

    Args:
        rec: Configuration and addresses.
        views: qpos, qvel and sensordata, each ``(steps, n)``.
        since: First step of the episode that each step belongs to, shape ``(steps,)``.
    """
    window = limits(rec.cfg).window
    windows = len(views[0]) - window + 1
    env = env_of(rec, windows)  # world w has the window that begins with step w
    env.sim.step_count = env.sim.overflow = torch.zeros(windows, dtype=torch.int32)
    env.sim.qpos, env.sim.qvel, env.sim.sensordata = (view[:windows] for view in views)
    check = make_check(rec.cfg)
    check.start(env, window)
    for step in range(window):
        at = slice(step, step + windows)
        env.sim.qpos, env.sim.qvel, env.sim.sensordata = (view[at] for view in views)
        check.update()
    rules = {name: bit for name, bit in check.rules.items() if bit > check.rules["CARRY"]}
    assert list(rules) == [
        *("STACKED", "SUPPORTED", "REST_SPEED", "REST_POSITION", "REST_ROTATION", "RELEASED")
    ]
    out = np.zeros(len(since), dtype=bool)
    out[window - 1 :] = (check.result().failed.numpy() & sum(rules.values())) == 0
    return out & (np.arange(len(since)) - window + 1 >= since)


def env_of(rec: SimpleNamespace, nworld: int) -> SimpleNamespace:
    views = {"cfg": rec.cfg, "index": rec.index, "sim": StubViews(), "check": make_check(rec.cfg)}
    env = SimpleNamespace(nworld=nworld, device=torch.device("cpu"), **views)
    env.state = Step(env, env.check.objects)
    return env


FROM = 115  # where trajectories are altered: the world has been successful for a while


def turned(quats: np.ndarray) -> np.ndarray:
    """Rotations and another 4 degrees about z."""
    half = math.radians(4.0) / 2.0
    out = np.zeros_like(quats)
    for turn, quat in zip(out, quats, strict=True):
        mujoco.mju_mulQuat(turn, np.array([math.cos(half), 0.0, 0.0, math.sin(half)]), quat)
    return out


Part = tuple[int | slice, ...]
Alter = tuple[str, Part, Callable[[np.ndarray], object]]


def add(array: str, part: Part, by: object) -> Alter:
    return array, part, lambda values: values + by


def put(array: str, part: Part, value: float) -> Alter:
    return array, part, lambda values: value


# What is done to pose, velocity and opening, and whether the world is successful again at the end.
# In worlds whose name has "anew" the episode ends at FROM.
VARIANTS: dict[str, tuple[list[Alter], bool]] = {
    "untouched": ([], True),
    "red_shifted": ([add("pose", np.s_[FROM:, RED, 0], 0.006)], True),
    "both_shifted": ([add("pose", np.s_[FROM:, :, 1], 0.006)], True),
    "red_rotated": ([("pose", np.s_[FROM:, RED, 3:], turned)], True),
    "other_sign": ([("pose", np.s_[FROM:, RED, 3:], np.negative)], True),  # the same orientation
    "red_shifted_for_one_step": ([add("pose", np.s_[FROM, RED, 2], 0.0065)], True),
    # Not stacked in this step, though it would pass as at rest
    "at_the_edge_and_beyond_for_one_step": (
        [
            ("pose", np.s_[:, :, :2], lambda xy: xy[:, [BLUE, BLUE]]),
            add("pose", np.s_[:, RED, 0], 0.0135),
            add("pose", np.s_[FROM, RED, 0], 0.003),
        ],
        True,
    ),
    "blue_hops": ([add("pose", np.s_[FROM : FROM + 2, :, 2], 0.02)], True),
    "drifting": (
        [("pose", np.s_[FROM:, :, 0], lambda x: x + 0.00013 * np.arange(len(x))[:, None])],
        False,
    ),
    "moving": ([put("velocity", np.s_[FROM:, RED, 0], 0.06)], False),
    "spinning": ([put("velocity", np.s_[FROM:, BLUE, 5], 1.5)], False),
    "kicked": ([put("velocity", np.s_[FROM, RED, :3], 0.4)], True),
    # Far above the threshold for one step, below it as RMS over the window
    "kicked_gently": ([put("velocity", np.s_[FROM, RED, :3], 0.15)], True),
    "closing_and_opening": ([put("opening", np.s_[FROM : FROM + 10, -1], 0.7)], True),
    "touched_for_one_step": ([], True),  # a jaw presses on red at FROM
    "swapped": ([("pose", np.s_[FROM:], lambda poses: poses[:, ::-1].copy())], False),
    "fallen_off": ([add("pose", np.s_[FROM:, RED, 1], 0.02)], False),
    "started_anew": ([], True),
    "broken_and_started_anew": (
        [
            put("pose", np.s_[FROM - 1, RED, 1], math.nan),
            put("velocity", np.s_[FROM - 1, BLUE, 1], math.inf),
        ],
        True,
    ),
}


def assert_success(
    rec: SimpleNamespace, worlds: list[tuple[str, *tuple[torch.Tensor, ...]]], expected: np.ndarray
) -> None:
    """The term says what is expected, shape ``(worlds, steps)``; some worlds start anew when their
    trajectory is altered.
    """
    names, *views = zip(*worlds, strict=True)
    state = [torch.stack(view, 1) for view in views]
    env = env_of(rec, len(names))
    env.sim.qpos, env.sim.qvel, env.sim.sensordata = (view[0] for view in state)
    term = StackSuccess(env)
    anew = torch.tensor(["anew" in name for name in names])
    for step, want in enumerate(expected.T.tolist()):
        if step == FROM:
            term.reset(anew)
        env.sim.qpos, env.sim.qvel, env.sim.sensordata = (view[step] for view in state)
        got = term(env).tolist()
        wrong = [name for name, a, b in zip(names, got, want, strict=True) if a != b]
        assert not wrong, f"step {step}"


@pytest.mark.full
def test_stack_success_is_rules_four_to_six(scripted: Callable[[str], SimpleNamespace]) -> None:
    """Step by step, over the recorded episodes and altered ends of the first, some of whose worlds
    start anew in between.
    """
    rec = scripted("rebot")
    ends = (rec.cfg.robot.gripper_closed, rec.cfg.robot.gripper_open)
    closed, opened = map(np.array, ends)
    gripper = torch.from_numpy(rec.index.robot_qpos[rec.index.n_arm :])

    whole = []
    expected = []
    for k in range(3):
        qpos = rec.qpos[:, k]
        qvel = rec.qvel[:, k]
        force = rec.sensordata[:, k]
        whole.append((f"world {k}", qpos, qvel, force))
        expected.append(rested(rec, qpos, qvel, force, since=np.zeros(len(qpos))))
        assert expected[-1][-1]
        assert not expected[-1][:480].any()
        assert rec.success[:, k].tolist() == expected[-1].tolist()  # what the environment said
    assert_success(rec, whole, np.array(expected))

    # The last 170 steps, and then the cubes just stand there for another 75.
    qpos = torch.cat((rec.qpos[430:, 0], rec.qpos[-1:, 0].expand(75, -1)))
    qvel = torch.cat((rec.qvel[430:, 0], torch.zeros_like(rec.qvel[-1:, 0]).expand(75, -1)))
    force = torch.cat((rec.sensordata[430:, 0], rec.sensordata[-1:, 0].expand(75, -1)))
    altered = []
    expected = []
    for name, (alterations, recovers) in VARIANTS.items():
        q = qpos.clone()
        v = qvel.clone()
        fingers = (qpos[:, gripper].numpy() - closed) / (opened - closed)
        pose, velocity = cubes_of(rec, q, v)
        arrays = {"pose": pose, "velocity": velocity, "opening": fingers}
        for array, part, alter in alterations:
            arrays[array][part] = alter(arrays[array][part])
        for i, (a, b) in enumerate(zip(rec.index.object_qpos, rec.index.object_qvel, strict=True)):
            q[:, a : a + 7] = torch.from_numpy(pose[:, i])
            v[:, b : b + 6] = torch.from_numpy(velocity[:, i])
        q[:, gripper] = torch.from_numpy(closed + fingers * (opened - closed))
        since = np.where(np.arange(len(q)) >= FROM, FROM, 0) if "anew" in name else np.zeros(len(q))
        pressed = force.clone()
        if name == "touched_for_one_step":
            pressed[FROM, rec.index.jaw_force["red"][1]] = 1.0
        want = rested(rec, q, v, pressed, since=since)
        unharmed = name in ("untouched", "other_sign", "kicked_gently")
        assert want[FROM - 2], name
        assert want[FROM + 44 : FROM + 48].tolist() == [unharmed] * 4, name
        assert want[-1] == recovers, name
        altered.append((name, q, v, pressed))
        expected.append(want)
    assert_success(rec, altered, np.array(expected))
    # Alone, a world that is not stacked now and then has the same success
    alone = ("blue_hops", "at_the_edge_and_beyond_for_one_step", "broken_and_started_anew")
    for world, want in zip(altered, expected, strict=True):
        if world[0] in alone:
            assert_success(rec, [world], want[None])


# Success


def test_reaching_ends_the_episode_after_ten_steps_in_a_row(backend: str) -> None:
    """The goal is carried to the grasp_point: in world 1 all the time, in world 2 with an
    interruption.
    """
    cfg = configure("task=reach", "reset=nominal")
    cfg.termination.pop("object_off_table")
    env = on_shared_sim(backend, 3, cfg)
    env.reset(seed=0)
    q, v = env.index.objects["red"]
    hold = zeros(env)
    for step in range(1, 17):
        grasp_point = env.sim.site_xpos[:, env.index.grasp_sites].mean(1)
        above = torch.tensor([0.0, 0.0, cfg.task.params["goal_height"]], device=env.device)
        env.sim.qpos[1:, q : q + 3] = grasp_point[1:] - above
        env.sim.qvel[1:, v : v + 6] = 0.0
        if step == 6:
            env.sim.qpos[2, q] += 0.03
        _, _, terminated, truncated, extras = env.step(hold)
        expected = [False, step == 10, step == 16]
        assert terminated.tolist() == expected, step
        assert extras["success"].tolist() == expected
        assert not truncated.any()
        success = env.reward_manager.values[:, list(cfg.reward).index("success")]
        assert (success > 0).tolist() == expected
        assert not env.success.any()  # the worlds that achieved it have started anew


# Terminations at their thresholds


def test_joint_limit_at_its_threshold(robot: str) -> None:
    env = on_shared_sim("native", 3, configure(robot=robot))
    term = termination_terms.JointLimit(env, margin=0.1)
    for j, (low, high) in enumerate(env.index.robot_range):
        for sign, end in ((-1, low), (1, high)):
            for part, out in ((0.09, False), (0.11, True)):
                env.sim.reset()
                home = torch.tensor(env.cfg.robot.home).double()
                env.sim.qpos[:, torch.from_numpy(env.index.robot_qpos)] = home
                env.sim.qpos[1, env.index.robot_qpos[j]] = end + sign * part * (high - low)
                assert term(env).tolist() == [False, out, False]


def test_object_off_table_at_its_threshold(robot: str) -> None:
    env = on_shared_sim("native", 3, configure(robot=robot))
    term = termination_terms.ObjectOffTable(env)
    scene = env.cfg.scene
    for a in env.index.object_qpos:
        for axis in (0, 1):
            for sign in (-1, 1):
                for by, out in ((-0.001, False), (0.001, True)):
                    env.sim.reset()
                    off = sign * (scene.table_half[axis] + by)
                    env.sim.qpos[2, a + axis] = scene.table_center[axis] + off
                    assert term(env).tolist() == [False, False, out]
        for by, out in ((0.001, False), (-0.001, True)):
            env.sim.reset()
            env.sim.qpos[0, a + 2] = table_top(env.cfg) + by
            assert term(env).tolist() == [out, False, False]
