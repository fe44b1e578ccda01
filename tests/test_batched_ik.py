"""Batched inverse kinematics against native MuJoCo's forward kinematics, and against mink."""

from __future__ import annotations

import gc
from collections.abc import Callable
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
import warp as wp

from mjstack.config.schema import RobotCfg
from mjstack.errors import ArgumentError, MjstackError, UnknownName
from mjstack.gates.gate import GateContext
from mjstack.kinematics.batched_ik import BatchedIk
from mjstack.kinematics.mink_ik import ApertureIk
from mjstack.robots import robot_spec
from mjstack.sim.streams import torch_stream_scope

Stage = Callable[[str], GateContext]

CUDA = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")]
DEVICES = ["cpu", pytest.param("cuda:0", marks=CUDA)]
TOLERANCE = 0.0005  # m, as the scripted controller's


@pytest.fixture(params=DEVICES)
def device(request: pytest.FixtureRequest) -> str:
    return request.param


class Arm:
    """A robot in a model, with kinematics of its own by native MuJoCo."""

    def __init__(self, model: mujoco.MjModel, robot: RobotCfg) -> None:
        self.model, self.robot = model, robot
        self.names = [*robot.arm_joints, *robot.gripper_joints]
        self.low, self.high = np.array([model.joint(name).range for name in self.names]).T
        self.moved = [self.names.index(name) for name in robot.ik_joints]
        self.home = np.array(robot.home)
        for name, value in robot.locked.items():
            self.home[self.names.index(name)] = value
        self.home[len(robot.arm_joints) :] = robot.gripper_open

    def aperture(self, commands: np.ndarray) -> np.ndarray:
        data, out = mujoco.MjData(self.model), []
        for command in np.asarray(commands, dtype=float):
            for name, value in zip(self.names, command, strict=True):
                data.joint(name).qpos[0] = value
            mujoco.mj_kinematics(self.model, data)
            out.append(np.mean([data.site(name).xpos for name in self.robot.aperture_sites], axis=0))
        return np.array(out)

    def solver(self, nworld: int, device: str = "cpu", **settings: float) -> BatchedIk:
        return BatchedIk(self.model, self.robot, nworld, device, **settings)

    def at_home(self, nworld: int) -> np.ndarray:
        return np.tile(self.home, (nworld, 1))

    def at_limits(self, nworld: int, seed: int) -> np.ndarray:
        """As `anywhere`, with about half of those joints at a limit, 1e-5 rad inside."""
        commands, rng = self.anywhere(nworld, seed), np.random.default_rng(seed + 1000)
        low, high = self.low + 1e-5, self.high - 1e-5
        ends = np.where(rng.random(commands.shape) < 0.5, low, high)
        chosen = rng.random(commands.shape) < 0.5
        commands[:, self.moved] = np.where(chosen, ends, np.clip(commands, low, high))[:, self.moved]
        return commands

    def anywhere(self, nworld: int, seed: int) -> np.ndarray:
        """Random positions of the joints that inverse kinematics moves; the others at home, gripper open."""
        commands = self.at_home(nworld)
        moved = self.moved
        commands[:, moved] = np.random.default_rng(seed).uniform(self.low[moved], self.high[moved], (nworld, len(moved)))
        return commands


def above_table(context: GateContext, arm: Arm, n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Random commands, and where they bring the aperture centre: up to 25 cm above the table."""
    center, half = np.array(context.cfg.scene.table_center), np.array(context.cfg.scene.table_half)
    commands: list[np.ndarray] = []
    points: list[np.ndarray] = []
    while sum(map(len, points)) < n:
        tried = arm.anywhere(4000, seed)
        at = arm.aperture(tried)
        height = at[:, 2] - center[2] - half[2]
        inside = (np.abs(at - center)[:, :2] <= half[:2]).all(1) & (height > 0.0) & (height < 0.25)
        commands.append(tried[inside])
        points.append(at[inside])
        seed += 1
    return np.concatenate(commands)[:n], np.concatenate(points)[:n]


def tensors(device: str, *arrays: np.ndarray) -> list[torch.Tensor]:
    return [torch.as_tensor(array, device=device) for array in arrays]


def results(ik: BatchedIk, command: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A solve, copied to the host as float64."""
    new, distance = ik.solve(*tensors(str(ik.device), command, target))
    return new.cpu().numpy().astype(float), distance.cpu().numpy().astype(float)


@pytest.fixture(scope="module")
def get_arm(stage: Stage) -> Callable[[str], Arm]:
    return lambda robot: Arm(stage(robot).model, stage(robot).cfg.robot)


@pytest.fixture
def arm(robot: str, get_arm: Callable[[str], Arm]) -> Arm:
    return get_arm(robot)


@pytest.fixture(scope="module")
def workspace(stage: Stage, get_arm: Callable[[str], Arm]) -> Callable[[str], tuple[np.ndarray, np.ndarray]]:
    made: dict[str, tuple[np.ndarray, np.ndarray]] = {}

    def get(robot: str) -> tuple[np.ndarray, np.ndarray]:
        if robot not in made:
            made[robot] = above_table(stage(robot), get_arm(robot), 1000)
        return made[robot]

    return get


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_aperture_is_native_mujocos(arm: Arm, device: str, dtype: torch.dtype) -> None:
    commands = np.random.default_rng(1).uniform(arm.low, arm.high, (200, len(arm.names)))
    centre = arm.solver(200, device).aperture(torch.as_tensor(commands, dtype=dtype, device=device))
    assert centre.shape == (200, 3)
    assert centre.dtype == torch.float32
    assert np.abs(centre.cpu().numpy() - arm.aperture(commands)).max() <= 1e-6


def test_targets_in_the_workspace_are_reached(robot: str, arm: Arm, device: str, workspace: Callable) -> None:
    _, targets = workspace(robot)
    start = arm.at_home(len(targets))
    command, distance = results(arm.solver(len(targets), device, iterations=40), start, targets)
    miss = np.linalg.norm(arm.aperture(command) - targets, axis=1)
    print(f"{robot}: {(miss <= TOLERANCE).mean():.2%} within 0.5 mm, largest {1e6 * miss.max():.2f} um")
    assert (miss <= 0.00001).all()
    np.testing.assert_allclose(distance, miss, atol=1e-6)


def test_eight_iterations_reach_almost_every_target_from_home(robot: str, arm: Arm, workspace: Callable) -> None:
    _, targets = workspace(robot)
    _, distance = results(arm.solver(len(targets)), arm.at_home(len(targets)), targets)
    assert (distance <= TOLERANCE).mean() >= 0.99


def test_reaches_what_mink_reaches(robot: str, stage: Stage, arm: Arm, workspace: Callable) -> None:
    targets = workspace(robot)[1][:60]
    mink = ApertureIk(arm.robot, stage(robot).cfg.model, tolerance=TOLERANCE, iterations=60)
    gripper = np.array(arm.robot.gripper_open)
    by_mink = np.array([mink.solve(target, gripper, arm.home)[1] for target in targets])
    _, distance = results(arm.solver(60, iterations=40), arm.at_home(60), targets)
    print(f"{robot}: mink {(by_mink <= TOLERANCE).sum()}, batched {(distance <= TOLERANCE).sum()} of 60 within 0.5 mm")
    assert (by_mink <= TOLERANCE).mean() > 0.8
    assert (distance[by_mink <= TOLERANCE] <= TOLERANCE).all()


def test_small_steps_arrive(robot: str, arm: Arm, device: str, workspace: Callable) -> None:
    """Reachable targets some 5 mm away, made by moving the joints a little in a random direction."""
    start, here = workspace(robot)
    nudge = np.zeros_like(start)
    nudge[:, arm.moved] = np.random.default_rng(2).normal(size=(len(start), len(arm.moved)))
    slope = np.linalg.norm(arm.aperture(start + 1e-4 * nudge) - here, axis=1) / 1e-4
    goal = start + nudge * (0.005 / slope)[:, None]
    target = arm.aperture(goal)
    near = np.abs(np.linalg.norm(target - here, axis=1) - 0.005) < 0.0005
    usable = near & ((goal >= arm.low) & (goal <= arm.high)).all(1)
    assert usable.sum() > 800
    command, distance = results(arm.solver(len(start), device, iterations=8), start, target)
    moved = command[:, arm.moved]
    free = ((moved > arm.low[arm.moved] + 1e-3) & (moved < arm.high[arm.moved] - 1e-3)).all(1)
    assert (usable & free).sum() > 700
    print(f"{robot}: {distance[usable & free].max() * 1e6:.2f} um at most, {distance[usable & ~free]} m at limits")
    assert (distance[usable & free] <= 0.0001).all()
    assert np.abs(command - start)[usable].max() < 0.5


def test_limits_hold_and_the_other_joints_stay(arm: Arm, device: str) -> None:
    """Even from commands beyond the limits, and towards targets that pull against them."""
    rng = np.random.default_rng(4)
    start = rng.uniform(arm.low - 0.5, arm.high + 0.5, (500, len(arm.names))).astype(np.float32).astype(float)
    command, distance = results(arm.solver(500, device), start, rng.uniform(-0.6, 0.6, (500, 3)))
    low, high = arm.low.copy(), arm.high.copy()
    for i, name in enumerate(arm.names):
        low[i], high[i] = np.clip(arm.model.actuator(name).ctrlrange, low[i], high[i])
    moved = arm.moved
    assert ((command >= low) & (command <= high))[:, moved].all()
    assert ((command == low.astype(np.float32)) | (command == high.astype(np.float32)))[:, moved].any()
    others = [i for i in range(len(arm.names)) if i not in moved]
    np.testing.assert_array_equal(command[:, others], start[:, others])
    assert np.isfinite(distance).all()


def test_small_steps_arrive_from_limits(robot: str, arm: Arm) -> None:
    """Joints that cannot follow leave the work to the others; solving for all and cutting the step would stall."""
    start = arm.at_limits(2000, 23)
    goal = start.copy()
    goal[:, arm.moved] += np.random.default_rng(24).normal(scale=0.02, size=(2000, len(arm.moved)))
    goal = np.clip(goal, arm.low, arm.high)
    target = arm.aperture(goal)
    near = np.linalg.norm(target - arm.aperture(start), axis=1) < 0.01
    assert near.sum() > 500
    _, distance = results(arm.solver(2000), start, target)
    print(f"{robot}: {(distance[near] <= 0.0001).mean():.2%} of {near.sum()} within 0.1 mm")
    assert (distance[near] <= 0.0001).mean() >= 0.99


@pytest.mark.parametrize("iterations", [1, 8, 40])
def test_never_farther_than_the_start(arm: Arm, device: str, iterations: int) -> None:
    """The cases are those where a single step can overshoot: near a limit, and far away."""
    rng = np.random.default_rng(6)
    start = arm.at_limits(2000, 5)
    at = arm.aperture(start)
    target = np.where(
        np.arange(2000)[:, None] < 1500, at + rng.normal(scale=0.003, size=(2000, 3)), rng.uniform(-0.8, 0.8, (2000, 3))
    )
    command, distance = results(arm.solver(2000, device, iterations=iterations), start, target)
    before, after = (np.linalg.norm(a - target, axis=1) for a in (at, arm.aperture(command)))
    assert (after <= before + 1e-6).all()
    assert (after < before - 1e-4).mean() > 0.5
    np.testing.assert_allclose(distance, after, atol=1e-6)


def test_unreachable_target_shows_in_the_distance(arm: Arm, device: str) -> None:
    target = np.array([[1.5, 0.0, 0.2], [0.0, 0.0, 3.0], [1e6, -1e6, 0.0], [1e30, 0.0, 0.0]])
    command, distance = results(arm.solver(4, device, iterations=40), arm.at_home(4), target)
    assert np.isfinite(command).all()
    assert not np.isnan(distance).any()
    assert (distance > 0.5).all()
    assert distance[0] < 1.2


def test_a_start_at_its_target_stays(arm: Arm, device: str) -> None:
    ik = arm.solver(50, device)
    start = np.clip(arm.anywhere(50, 7), arm.low + 1e-3, arm.high - 1e-3)
    command, distance = results(ik, start, ik.aperture(*tensors(device, start)).cpu().numpy())
    np.testing.assert_allclose(command, start, atol=1e-5)
    assert (distance <= 1e-6).all()


def test_not_finite_input_stays_in_its_world(arm: Arm, device: str) -> None:
    start, target = arm.at_home(8), arm.aperture(arm.anywhere(8, 8))
    ik = arm.solver(8, device)
    clean_command, clean_distance = results(ik, start, target)
    start[1, arm.moved[0]], start[2, -1], start[4, 1] = np.nan, np.nan, np.inf
    target[5, 0], target[6, 2] = np.nan, -np.inf
    bad, good = [1, 2, 4, 5, 6], [0, 3, 7]
    command, distance = results(ik, start, target)
    assert np.isnan(distance[bad]).all()
    np.testing.assert_array_equal(command[good], clean_command[good])
    np.testing.assert_array_equal(distance[good], clean_distance[good])
    assert np.isnan(command[1, arm.moved[0]])
    np.testing.assert_allclose(command[[5, 6]], start[[5, 6]], atol=1e-6)
    start, target = arm.at_home(8), arm.aperture(arm.anywhere(8, 8))
    np.testing.assert_array_equal(results(ik, start, target)[0], clean_command)


def test_world_k_of_n_is_world_k_of_one(robot: str, arm: Arm, workspace: Callable) -> None:
    start, target = arm.anywhere(64, 9), workspace(robot)[1][:64]
    command, distance = results(arm.solver(64), start, target)
    alone = arm.solver(1)
    for k in range(64):
        one, left = results(alone, start[k : k + 1], target[k : k + 1])
        np.testing.assert_array_equal(one[0], command[k])
        assert left[0] == distance[k]


def test_outputs_are_rewritten_in_place(arm: Arm, device: str) -> None:
    """Whatever the last call left, of outputs or of working memory, does not show in the next."""
    start, target = arm.anywhere(20, 10), arm.aperture(arm.anywhere(20, 11))
    ik = arm.solver(20, device)
    tensors_in = tensors(device, start, target)
    centre, (command, distance) = ik.aperture(tensors_in[0]), ik.solve(*tensors_in)
    before = [t.clone() for t in (centre, command, distance)]

    for t in (centre, command, distance):
        t.fill_(torch.nan)
    again_centre, (again_command, again_distance) = ik.aperture(tensors_in[0]), ik.solve(*tensors_in)
    for old, new, expected in zip(
        (centre, command, distance), (again_centre, again_command, again_distance), before, strict=True
    ):
        assert new.data_ptr() == old.data_ptr()
        assert torch.equal(new, expected)


def test_its_own_output_can_be_its_input(arm: Arm) -> None:
    start, target = arm.anywhere(20, 12), arm.aperture(arm.anywhere(20, 13))
    ik = arm.solver(20)
    first, _ = results(ik, start, target)
    second, _ = results(ik, first, target)
    (goal,) = tensors("cpu", target)
    ik.solve(*tensors("cpu", start, target))
    assert (ik.solve(ik._command, goal)[0].numpy() == second).all()


def test_float32_and_float64_agree(arm: Arm) -> None:
    start, target = (a.astype(np.float32) for a in (arm.anywhere(20, 14), arm.aperture(arm.anywhere(20, 15))))
    ik = arm.solver(20)
    single = results(ik, start, target)
    double = results(ik, start.astype(float), target.astype(float))
    for a, b in zip(single, double, strict=True):
        np.testing.assert_array_equal(a, b)


def test_the_robot_alone_is_the_robot_in_its_scene(robot: str, stage: Stage, arm: Arm) -> None:
    alone = Arm(robot_spec(stage(robot).cfg.robot, stage(robot).cfg.model).compile(), arm.robot)
    start, target = arm.anywhere(20, 16), arm.aperture(arm.anywhere(20, 17))
    for a, b in zip(results(alone.solver(20), start, target), results(arm.solver(20), start, target), strict=True):
        np.testing.assert_array_equal(a, b)


ODD = """
<mujoco>
  <worldbody>
    <body pos="0.1 -0.2 0.3" euler="20 30 40">
      <body pos="0.05 0 0.1" euler="0 50 0">
        <joint name="lift" type="slide" axis="0.2 0.1 1" pos="0.3 0 0" ref="0.05" range="-0.2 0.3"/>
        <joint name="turn" axis="0 1 1" pos="0.02 -0.03 0.04" ref="25" range="-100 100"/>
        <geom size="0.01"/>
        <body pos="0.2 0 0" euler="90 0 0">
          <joint name="passive" axis="1 0 0" pos="0 0.1 0" ref="15"/>
          <geom size="0.01"/>
          <body name="palm" pos="0.1 0.1 0.05">
            <joint name="bend" axis="1 0 1" pos="0 0.01 0" range="-150 150"/>
            <geom size="0.01"/>
            <body pos="0 0 0.15">
              <joint name="first_finger" axis="1 0 0" pos="0 0 0.02" ref="-30" range="-90 90"/>
              <geom size="0.01"/>
              <site name="a" pos="0.01 0.12 0.06" euler="10 20 30"/>
            </body>
            <body pos="0 0.02 0.1" euler="0 0 45">
              <joint name="second_finger" type="slide" axis="1 0 0" range="-0.1 0.1"/>
              <geom size="0.01"/>
              <body pos="0.03 0 0.02"><geom size="0.01"/><site name="b" pos="0 0 0.03"/></body>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="lift" joint="lift" ctrlrange="-0.1 0.5"/>
    <position name="turn" joint="turn"/>
    <position name="bend" joint="bend"/>
    <position name="first_finger" joint="first_finger"/>
    <position name="second_finger" joint="second_finger"/>
  </actuator>
</mujoco>
"""


def odd_arm() -> Arm:
    """Slides and hinges beside their body's origin, two in one body, reference angles, one without a command, a fork."""
    robot = RobotCfg(
        arm_joints=["lift", "turn", "bend", "first_finger", "second_finger"],
        gripper_joints=[],
        home=[0.1, 0.2, 0.3, 0.1, 0.0],
        gripper_open=[],
        gripper_closed=[],
        ik_joints=["lift", "turn", "bend", "first_finger", "second_finger"],
        locked={},
        aperture_sites=["a", "b"],
        approach_body="palm",
        approach_axis=[0.0, 0.6, 0.8],
    )
    return Arm(mujoco.MjModel.from_xml_string(ODD), robot)


def test_any_chain_of_hinges_and_slides(device: str) -> None:
    """Its Jacobian is right if a solve from close by converges as fast as Newton's method."""
    arm = odd_arm()
    commands = np.random.default_rng(18).uniform(arm.low, arm.high, (100, 5))
    commands[:, 0] = np.clip(commands[:, 0], -0.09, 0.29)
    ik = arm.solver(100, device, iterations=5)
    (given,) = tensors(device, commands)
    assert np.abs(ik.aperture(given).cpu().numpy() - arm.aperture(commands)).max() <= 1e-6
    near = np.clip(commands + np.random.default_rng(19).normal(scale=0.005, size=commands.shape), arm.low, arm.high)
    near[:, 0] = np.clip(near[:, 0], -0.1, 0.3)
    command, distance = results(ik, commands, arm.aperture(near))
    assert np.quantile(distance, 0.95) <= 1e-6
    assert (command[:, 0] >= -0.1).all()  # its actuator's range is narrower below, the joint's above
    _, distance = results(ik, commands, np.tile([0.0, 0.0, -5.0], (100, 1)))
    assert np.isfinite(distance).all()


def test_the_narrower_of_both_ranges_holds() -> None:
    arm = odd_arm()
    for z, limit in ((5.0, 0.3), (-5.0, -0.1)):
        command, _ = results(arm.solver(1, iterations=60), arm.at_home(1), np.array([[0.0, 0.0, z]]))
        assert command[0, 0] == pytest.approx(limit, abs=1e-6)
        assert -0.1 <= command[0, 0] <= 0.3


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"aperture_sites": ["a", "lost_site"]}, "site 'lost_site'"),
        ({"arm_joints": ["lift", "lost_joint"]}, "joint 'lost_joint'"),
        ({"arm_joints": ["lift", "passive"], "ik_joints": ["passive"]}, "actuator 'passive'"),
        ({"ik_joints": ["lift", "benf"]}, "arm joint 'benf' does not exist. Did you mean 'bend'"),
    ],
)
def test_missing_names_are_named(change: dict[str, list[str]], name: str) -> None:
    arm = odd_arm()
    with pytest.raises(UnknownName, match=name) as caught:
        BatchedIk(arm.model, replace(arm.robot, **change), 2, "cpu")
    assert "\n" not in str(caught.value)


def test_other_joint_types_are_refused() -> None:
    hinge = '<joint name="bend" axis="1 0 1" pos="0 0.01 0" range="-150 150"/>'
    assert hinge in ODD
    model = mujoco.MjModel.from_xml_string(ODD.replace(hinge, '<joint name="bend" type="ball"/>'))
    with pytest.raises(MjstackError, match="joint 'bend' is of type ball, expected hinge or slide"):
        BatchedIk(model, odd_arm().robot, 2, "cpu")


@pytest.mark.parametrize(
    "settings", [{"iterations": 0}, {"nworld": 0}, {"damping": 0.0}, {"damping": float("nan")}, {"max_step": -1.0}]
)
def test_settings_out_of_range_are_refused(settings: dict[str, float]) -> None:
    arm = odd_arm()
    with pytest.raises(ArgumentError, match=next(iter(settings))):
        BatchedIk(arm.model, arm.robot, **{"nworld": 2, "device": "cpu", **settings})


def test_shapes_are_not_broadcast() -> None:
    ik = odd_arm().solver(3)
    with pytest.raises(ArgumentError, match=r"command: found shape \(1, 5\), expected shape \(3, 5\)"):
        ik.solve(torch.zeros(1, 5), torch.zeros(3, 3))
    with pytest.raises(ArgumentError, match=r"target: found shape \(3,\), expected shape \(3, 3\)"):
        ik.solve(torch.zeros(3, 5), torch.zeros(3))
    with pytest.raises(ArgumentError, match="command: found shape"):
        ik.aperture(torch.zeros(3, 4))


@pytest.mark.parametrize("cuda", [pytest.param("cuda:0", marks=CUDA)])
def test_a_cuda_graph_holds_it(arm: Arm, cuda: str) -> None:
    """Replays follow their inputs, among torch's own operations, as eager calls do."""
    ik = arm.solver(256, cuda)
    command, goal = tensors(cuda, arm.at_home(256), arm.aperture(arm.anywhere(256, 20)))
    out = torch.zeros_like(ik.solve(command, goal)[0])
    stream, graph = torch.cuda.Stream(), torch.cuda.CUDAGraph()

    def follow_goal() -> None:
        here = ik.aperture(command)
        new, _ = ik.solve(command, here + 0.5 * (goal - here))
        out.copy_(new)
        command.copy_(new)

    start = command.clone()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        follow_goal()
    torch.cuda.synchronize()
    gc.disable()
    try:
        with torch.cuda.graph(graph, stream=stream):
            scope = torch_stream_scope(wp.get_device(cuda))
            with scope, wp.ScopedCapture(stream=wp.get_stream(cuda), external=True):
                follow_goal()
    finally:
        gc.enable()
    for seed in (21, 22):
        goal.copy_(tensors(cuda, arm.aperture(arm.anywhere(256, seed)))[0])
        command.copy_(start)
        for _ in range(3):
            graph.replay()
        replayed = out.clone()
        command.copy_(start)
        for _ in range(3):
            follow_goal()
        torch.cuda.synchronize()
        assert torch.isfinite(replayed).all()
        assert torch.equal(out, replayed)
