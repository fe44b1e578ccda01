"""How worlds start: on the table, within the ranges of their terms, each on its own."""

import hashlib
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from box_checker import corners_of
from environments import configure, on_shared_sim

import mjstack
from mjstack.config.schema import Backend, Config
from mjstack.envs import Env, build_env
from mjstack.errors import ParameterError
from mjstack.mdp.starts.placement import Placement, may_meet
from mjstack.mdp.starts.randomization import bounds

MANY = 200
EXAMPLES = Path(__file__).parents[2] / "examples"


def start_of(cfg: Config, seed: int = 0) -> Env:
    env = on_shared_sim("native", MANY, cfg)
    env.reset(seed=seed)
    return env


def corners(pose: np.ndarray, half: float) -> np.ndarray:
    return corners_of(pose[None], np.zeros((1, 6)), half)[0][0]


# Half-widths of a region in which cubes overlap, leave the table or hit the arm unless each is
# placed with care.
WIDE = {"so101": [0.12, 0.15], "rebot": [0.10, 0.20]}


@pytest.mark.full
@pytest.mark.parametrize("reset", ["nominal", "jitter", "randomized", "wide"])
def test_cubes_start_on_the_table_and_touch_nothing_else(robot: str, reset: str) -> None:
    cfg = configure(f"reset={'randomized' if reset == 'wide' else reset}", robot=robot)
    if reset == "wide":
        cfg.reset["cubes"].params.update(xy=WIDE[robot], candidates=32)
        cfg.controller.ik_tolerance = 1.0  # the arm does not get to all of it
    env = start_of(cfg)
    m = env.sim.model
    scene = env.cfg.scene
    data = mujoco.MjData(m)
    table = m.geom("table").id
    cubes = [m.geom(name).id for name in ("red", "blue")]
    gap = math.inf
    for k in range(1 if reset == "nominal" else MANY):
        data.qpos[:] = env.sim.qpos[k]
        mujoco.mj_forward(m, data)
        for a in env.index.object_qpos:
            at = corners(data.qpos[a : a + 7], scene.objects["red"].half_height)
            assert at[:, 2].min() == pytest.approx(env.cfg.scene.table_top, abs=1e-9)
            assert np.ptp(at[:, 2]) == pytest.approx(2.0 * scene.objects["red"].half_height)
            assert (np.abs(at[:, :2] - scene.table_center[:2]) <= scene.table_half[:2]).all()
        touching = {tuple(sorted(contact.geom)) for contact in data.contact}
        if reset in ("nominal", "jitter"):  # at home the arm is folded
            touching = {pair for pair in touching if set(pair) & {*cubes}}
        assert touching <= {tuple(sorted((table, cube))) for cube in cubes}
        gap = min(gap, mujoco.mj_geomDistance(m, data, *cubes, 1.0, None))
        np.testing.assert_array_equal(env.sim.qvel[k], 0.0)
    assert gap > (0.01 if reset in ("randomized", "wide") else 0.0)


@pytest.mark.full
def test_home_jitter_and_noise_stay_within_their_widths(robot: str) -> None:
    nominal = start_of(configure("reset=nominal", robot=robot))
    qpos0 = torch.from_numpy(nominal.sim.model.qpos0.copy())
    columns = torch.from_numpy(nominal.index.robot_qpos)
    ctrl = torch.from_numpy(nominal.index.ctrl)
    home = torch.tensor(nominal.cfg.robot.home, dtype=torch.float64)
    expected = qpos0.clone()
    expected[columns] = home
    torch.testing.assert_close(nominal.sim.qpos, expected.expand(MANY, -1), rtol=0, atol=1e-12)
    torch.testing.assert_close(nominal.sim.ctrl[:, ctrl], home.expand(MANY, -1), rtol=0, atol=1e-12)

    jitter = start_of(configure("reset=jitter", robot=robot))
    assert torch.equal(jitter.sim.qpos[:, columns], nominal.sim.qpos[:, columns])
    for a in jitter.index.object_qpos:
        off = jitter.sim.qpos[:, a : a + 3] - qpos0[a : a + 3]
        yaw = 2.0 * torch.atan2(jitter.sim.qpos[:, a + 6], jitter.sim.qpos[:, a + 3])
        for values, width in ((off[:, 0], 0.002), (off[:, 1], 0.002), (yaw, 0.05)):
            assert values.abs().max() <= width
            assert 0.9 * width < values.max()
            assert values.min() < -0.9 * width
            assert abs(float(values.mean())) < 0.15 * width
        assert not off[:, 2].any()

    noisy = start_of(configure("reset=randomized", robot=robot))
    n_arm = noisy.index.n_arm
    start = torch.tensor(noisy.cfg.robot.start, dtype=torch.float64)
    off = noisy.sim.qpos[:, columns] - start
    assert torch.equal(noisy.sim.qpos[:, columns], noisy.sim.ctrl[:, ctrl])
    assert off[:, :n_arm].abs().max() <= 0.02 + 1e-12
    low, high = torch.from_numpy(noisy.index.ctrl_range).T
    assert (noisy.sim.ctrl[:, ctrl] >= low).all()
    assert (noisy.sim.ctrl[:, ctrl] <= high).all()
    assert not off[:, n_arm:].any()
    for j in range(n_arm):  # home may lie on a limit, as the SO-101's does not
        assert len(torch.unique(off[:, j])) > MANY // 3, j
    for a in noisy.index.object_qpos:
        off = noisy.sim.qpos[:, a : a + 2] - qpos0[a : a + 2]
        yaw = 2.0 * torch.atan2(noisy.sim.qpos[:, a + 6], noisy.sim.qpos[:, a + 3])
        half = torch.tensor(noisy.cfg.scene.random_xy, dtype=torch.float64)
        assert (off.abs().amax(0) <= half).all()
        assert (off.amax(0) > 0.7 * half).all()
        assert (off.amin(0) < -0.7 * half).all()  # some places are taken by the arm
        # Whole turns: every quarter of them is taken.
        quarters = torch.histc(torch.remainder(yaw, 2 * math.pi), 4, 0.0, 2 * math.pi)
        assert quarters.min() > MANY // 10


def test_masses_friction_and_gains_are_drawn_anew_from_the_models_own(robot: str) -> None:
    env = start_of(configure("reset=randomized", robot=robot))
    m = env.sim.model
    index = env.index
    bodies = [m.body(name).id for name in ("red", "blue")]
    geoms = [m.geom(name).id for name in ("red", "blue")]
    servos = torch.from_numpy(index.ctrl)
    seen: dict[str, list[torch.Tensor]] = {"mass": [], "friction": [], "gain": []}
    for _ in range(6):
        fields = {name: field.clone() for name, field in env.sim.fields.items()}
        ratio = {name: field / torch.from_numpy(getattr(m, name)) for name, field in fields.items()}
        mass = ratio["body_mass"][:, bodies]
        dofs = [[v + i for i in range(6)] for v in index.object_qvel]
        for other in (
            ratio["body_inertia"][:, bodies],
            ratio["body_subtreemass"][:, bodies, None],
            1.0 / ratio["body_invweight0"][:, bodies],
            1.0 / ratio["dof_invweight0"][:, dofs],
        ):
            torch.testing.assert_close(other, mass[..., None].expand_as(other), rtol=1e-6, atol=0)
        gain = ratio["actuator_gainprm"][:, servos, 0]
        bias = ratio["actuator_biasprm"][:, servos, 1:3]
        finite = torch.isfinite(bias)  # no damping stays no damping
        expected = gain[..., None].expand_as(bias)[finite]
        torch.testing.assert_close(bias[finite], expected, rtol=1e-6, atol=0)
        assert finite[..., 0].all()
        jaws = [m.body(name).id for name in env.cfg.robot.jaw_bodies]
        partners = [m.geom("table").id, *np.flatnonzero(np.isin(m.geom_bodyid, jaws)).tolist()]
        seen["mass"].append(mass)
        seen["friction"].append(fields["geom_friction"][:, geoms, 0])
        seen["gain"].append(gain)
        # Nothing else is touched.
        for name, columns in (
            ("body_mass", bodies),
            ("body_inertia", bodies),
            ("body_invweight0", bodies),
            ("geom_friction", [*geoms, *partners]),
            ("actuator_gainprm", index.ctrl.tolist()),
        ):
            rest = [i for i in range(fields[name].shape[1]) if i not in columns]
            model = torch.from_numpy(getattr(m, name))
            assert (fields[name][:, rest] == model[rest]).all()
        assert (fields["geom_friction"][..., 1:] == torch.from_numpy(m.geom_friction)[:, 1:]).all()
        env.reset()
    for name, (low, high) in (("mass", (0.7, 1.3)), ("friction", (0.8, 1.4)), ("gain", (0.9, 1.1))):
        values = torch.stack(seen[name])  # episodes, worlds, elements
        margin = 0.03 * (high - low)
        assert (values >= low - 1e-9).all()
        assert (values <= high + 1e-9).all()
        # The whole range in every episode: factors upon factors would leave it or close in on
        # something.
        assert (values.amin((1, 2)) < low + margin).all()
        assert (values.amax((1, 2)) > high - margin).all()
        assert len(torch.unique(values[0, :, 0])) == MANY
        assert not (values[0] == values[1]).any()
        assert not (values[0, :, 0] == values[0, :, 1]).any()


# SHA-256 of joints and positions at commit 29170ca; of the box at 28ea565, where cubes can meet.
BEFORE = {
    ("stack", "so101"): "71b3963283ae4dcd",
    ("stack", "rebot"): "d40c72cee9a06859",
    ("push", "so101"): "d8eca037dd76d04c",
    ("push", "rebot"): "dbd123628d60e32b",
    ("tower", "so101"): "b767ec02bd38ed74",
    ("tower", "rebot"): "2b6dab0809db45a8",
    ("box", "so101"): "0f9fa97b10ad2294",
    ("box", "rebot"): "1423bd26c324bf40",
}


@pytest.mark.full
@pytest.mark.parametrize(("task", "robot"), BEFORE)
def test_random_starts_are_those_of_before(task: str, robot: str) -> None:
    """Cubes of the reBot's tower could meet, and do in no world of this seed."""
    folder = None if task in ("stack", "box") else EXAMPLES / task / "conf"
    chosen = [f"task={task}", f"robot={robot}", "reset=randomized", "sim=native"]
    env = mjstack.make_env(chosen, config_dir=folder, nworld=256)
    env.reset(seed=1)
    columns = [*env.index.robot_qpos, *(a + i for a in env.index.object_qpos for i in range(2))]
    start = env.sim.qpos[:, columns].numpy()
    assert hashlib.sha256(start.tobytes()).hexdigest()[:16] == BEFORE[task, robot]
    region = env.cfg.scene.random_xy
    meeting = may_meet(env.cfg.scene, region, env.cfg.robot.finger_room)
    assert meeting is (task == "box" or (task, robot) == ("tower", "rebot"))
    env.close()


def chi_square_tail(counts: Sequence[np.ndarray]) -> float:
    """The probability that two samples of one distribution differ more than these counts."""
    sizes = [each.sum() for each in counts]
    weights = [math.sqrt(sizes[1] / sizes[0]), math.sqrt(sizes[0] / sizes[1])]
    parts = (weights[0] * counts[0] - weights[1] * counts[1]) ** 2 / (counts[0] + counts[1])
    half = torch.tensor([(len(parts) - 1) / 2, parts.sum() / 2], dtype=torch.float64)
    return float(torch.special.gammaincc(*half))


@pytest.mark.full
def test_starts_in_the_box_scene_are_uniform_over_the_pairs_that_fit(robot: str) -> None:
    """Against pairs drawn in NumPy until one fits. Placing red first gives less than 1e-100."""
    cfg = configure("task=box", "reset=randomized", robot=robot)
    cfg.nworld = 1000
    env = mjstack.envs.build_env(cfg, device="cpu")
    region = np.array(cfg.scene.random_xy)
    gap = cfg.robot.finger_room
    nominal = np.array([cube.xy for cube in cfg.scene.free.values()])
    drawn = []
    for seed in range(6):
        env.reset(seed=seed)
        drawn += [env.sim.qpos[:, [[a, a + 1] for a in env.index.object_qpos]].numpy().copy()]
    placed = np.concatenate(drawn) - nominal

    # Both on the table and clear of arm and walls, each by itself; and far enough apart
    alone = Placement(env, region=region, gap=gap, pose=cfg.robot.start, noise=0.02)
    alone._apart = [[0.0, 0.0], [0.0, 0.0]]
    tried = np.random.default_rng(0).uniform(-1.0, 1.0, (200_000, 2, 1, 2))
    free = alone.choose(torch.from_numpy(tried))[1].numpy()
    offsets = tried[:, :, 0] * region
    apart = np.linalg.norm((nominal[0] + offsets[:, 0]) - (nominal[1] + offsets[:, 1]), axis=1)
    footprints = [cube.footprint for cube in cfg.scene.free.values()]
    fitting = offsets[free & (apart >= sum(footprints) + gap)]

    edges = [np.linspace(-half, half, 5) for half in (*region, *region)]
    counts = [np.histogramdd(each.reshape(-1, 4), edges)[0].ravel() for each in (placed, fitting)]
    possible = counts[1] >= 25
    assert counts[0][~possible].sum() < 0.01 * len(placed)
    assert chi_square_tail([each[possible] for each in counts]) > 1e-3
    env.close()


def test_joint_zeros_move_the_arm_and_no_measured_joint() -> None:
    """The arm stands as the model does with each joint moved by its world's amount, in every world
    another one; both backends have the same.
    """
    width = 0.17
    term = f"+reset.zeros={{func: mjstack.mdp.reset.JointZeros, params: {{arm: {width}}}}}"
    cfg = configure(term, "reset=randomized", "action=joint_absolute")
    zeros_of = []
    for backend in (Backend.native, Backend.mjwarp):
        env = build_env(cfg, nworld=16, backend=backend, device="cpu")
        env.reset(seed=0)
        zeros_of.append(env.sim.fields["qpos0"].float().clone())
        if backend is Backend.native:
            check_zeros(env, width)
        env.close()
    assert torch.equal(*zeros_of)


def check_zeros(env: Env, width: float) -> None:
    m = env.sim.model
    data = mujoco.MjData(m)
    without = configure("reset=randomized")
    plain = build_env(without, nworld=16, backend=Backend.native, device="cpu")
    plain.reset(seed=0)
    assert torch.equal(
        plain.sim.qpos[:, env.index.robot_qpos], env.sim.qpos[:, env.index.robot_qpos]
    )
    plain.close()
    env.sim.forward()
    tips = []
    for world in range(env.nworld):
        data.qpos[:] = env.sim.qpos[world]
        for name in env.cfg.robot.joints:
            joint = m.joint(name)
            address = joint.qposadr[0]
            angle = m.qpos0[address] - float(env.sim.fields["qpos0"][world, address])
            assert abs(angle) <= (width if name in env.cfg.robot.arm_joints else 0.0) + 1e-9
            data.qpos[address] += angle
        mujoco.mj_kinematics(m, data)
        np.testing.assert_allclose(env.sim.site_xpos[world], data.site_xpos, rtol=0, atol=1e-9)
        tips.append(data.site_xpos[env.index.grasp_sites[0]].copy())
    assert np.ptp(tips, axis=0).min() > 0.02


@pytest.mark.parametrize("values", [3, "ab", [1.0], [2.0, 1.0], [0.0, 1.0], {1: 2, 3: 4}, None])
def test_two_numbers_are_two_numbers(values: Any) -> None:
    with pytest.raises(ParameterError, match=r"^scale=.*: expected two positive numbers"):
        bounds("scale", values)
