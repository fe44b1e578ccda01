"""The closed-loop driver: phases, looks, turns, retries and restarts of every world by itself."""

from collections.abc import Callable, Iterator

import mujoco
import numpy as np
import pytest
import torch
from check_cases import limits
from compositions import load_config, make_env
from environments import GetStage, at_double_speed, on_cuda

from mjstack.drivers.clockless import ClocklessDriver
from mjstack.drivers.closed_loop import ClosedLoopDriver, make_expert
from mjstack.drivers.feedback import FeedbackDriver, _keeps, _places, measure_planar
from mjstack.envs import Env, driven_config
from mjstack.episodes.stage import Stage
from mjstack.errors import ArgumentError
from mjstack.managers.episode import required_fields
from mjstack.math import quat_to_matrix
from mjstack.mdp.geometry import jaw_forces
from mjstack.scene.index import gripper_targets
from mjstack.scene.phases import build_phases
from mjstack.sim import make_simulation

Drive = Callable[..., tuple[Env, ClosedLoopDriver]]


@pytest.fixture
def drive(get_stage: GetStage) -> Iterator[Drive]:
    """Makes worlds that have started, and their driver."""
    made: list[Env] = []

    def build(
        *overrides: str, nworld: int = 3, robot: str = "so101"
    ) -> tuple[Env, ClosedLoopDriver]:
        stage = get_stage(robot)
        options = [f"robot={robot}", "sim=native", f"nworld={nworld}"]
        cfg = driven_config(load_config([*options, *overrides]))
        sim = make_simulation(stage.model, cfg, nworld, fields=required_fields(cfg.reset))
        made.append(Env(sim, stage.index, cfg, check_faults=False))
        made[-1].reset(seed=0)
        return made[-1], ClosedLoopDriver(made[-1], stage.planner.nominal)

    yield build
    for env in made:
        env.close()


def centre(env: Env) -> torch.Tensor:
    """The grasp point [m]."""
    return env.sim.site_xpos[:, env.index.grasp_sites].mean(1)


def test_phases_follow_their_times_and_targets(robot: str, drive: Drive) -> None:
    env, controller = drive(robot=robot)
    red = env.sim.qpos[:, env.index.object_qpos[0] :][:, :3].clone()
    ends = {phase.stop - 1: number for number, phase in enumerate(controller.phases)}
    for step in range(controller.phases[1].stop):
        command = controller.command()
        assert torch.isfinite(command).all()
        phase = next(n for n, p in enumerate(controller.phases) if p.start <= step < p.stop)
        assert controller.phase.tolist() == [phase] * 3
        env.step(command)
        if step in ends:  # commanded to the target; the servos lag by a few millimetres
            target = controller.phases[ends[step]].target
            assert target is not None
            wanted = torch.cat((red[:, :2], torch.full((3, 1), target.z, dtype=red.dtype)), 1)
            reached = controller._ik.forward(command)[0].double()
            assert (reached - wanted).norm(dim=1).max() < env.cfg.controller.ik_tolerance
            assert (centre(env) - wanted).norm(dim=1).max() < 0.012
    assert float(controller.error.max()) < env.cfg.controller.ik_tolerance


@pytest.mark.full
def test_every_world_looks_at_its_own_cube(drive: Drive) -> None:
    """A cube that is moved before the descent is followed; in the other world nothing changes."""
    env, controller = drive(nworld=2)
    address = env.index.object_qpos[0]
    for step in range(controller.phases[1].stop):
        if step == controller.phases[0].stop:
            env.sim.qpos[1, address] += 0.02
        env.step(controller.command())
    grasp_point = controller._ik.forward(controller._command)[0]
    assert (grasp_point[:, :2] - env.sim.qpos[:, address : address + 2]).norm(dim=1).max() < 0.004


def test_jaws_turn_to_a_face(drive: Drive) -> None:
    """SO-101's closing axis ends across two faces of the cube, whatever its yaw; without alignment
    it does not.
    """
    off = {}
    for align in (0.0, 1.0):
        env, controller = drive(f"controller.yaw_alignment={align}", *at_double_speed(), nworld=4)
        address = env.index.object_qpos[0]
        yaw = torch.tensor([0.3, -0.6, 1.1, 2.0], dtype=torch.float64)
        env.sim.qpos[:, address + 3] = torch.cos(yaw / 2)
        env.sim.qpos[:, address + 6] = torch.sin(yaw / 2)
        env.sim.qpos[:, address + 4 : address + 6] = 0.0
        for _ in range(controller.phases[1].stop):
            env.step(controller.command())
        closing = controller._ik.forward(controller._command)[1].double()
        angle = torch.rad2deg(yaw - torch.atan2(closing[:, 1], closing[:, 0]))
        off[align] = (torch.remainder(angle + 45.0, 90.0) - 45.0).abs()
    assert off[1.0].max() < 3.0
    assert off[0.0].max() > 15.0


@pytest.mark.full
def test_an_empty_grasp_is_tried_once_more_in_time(drive: Drive) -> None:
    """World 1 loses its cube to the side as the jaws close. It goes back, looks again, hurries, and
    stacks all the same.
    """
    env, controller = drive(nworld=2)
    names = [phase.name for phase in controller.phases]
    grasp = names.index("grasp_red")
    address = env.index.object_qpos[0]
    velocity = env.index.object_qvel[0]
    place = env.sim.qpos[1, address : address + 7].clone()
    place[0] += 0.03
    visited: list[int] = []
    for step in range(controller.steps):
        if step == controller.phases[grasp].stop - 1:
            # Where the open jaws do not reach it, and from where they can take it.
            env.sim.qpos[1, address : address + 7] = place
            env.sim.qpos[1, address + 1] -= 0.08
            env.sim.qvel[1, velocity : velocity + 6] = 0.0
        env.step(controller.command())
        visited.append(int(controller.phase[1]))
    assert controller.retries.tolist() == [0, 1]
    back = controller.phases[grasp].stop
    assert visited[back - 1] == grasp
    assert visited[back] == names.index("above_red")
    # The rest at rate 1 would need 530 steps; it was over before the window in which cubes must
    # rest.
    rest = limits(env.cfg).window
    assert visited[-rest:] == [len(names) - 1] * rest
    red, blue = (env.sim.qpos[:, a : a + 3] for a in env.index.object_qpos)
    apart = red - blue
    assert (apart[:, :2].norm(dim=1) < limits(env.cfg).xy_err).all()
    assert ((apart[:, 2] > 0.035) & (apart[:, 2] < 0.055)).all()


@pytest.mark.full
def test_a_cube_arrives_as_it_stood() -> None:
    """From near the base, where the gripper could point down, to far from it, where it must lean;
    and the other way round.
    """
    env = make_env(["task=stack", "action=joint_absolute", "sim=native"], nworld=2)
    env.reset(seed=0)
    red, blue = env.index.object_qpos
    for world, (near, far) in enumerate([(red, blue), (blue, red)]):
        for address, x in ((near, 0.29), (far, 0.375)):
            env.sim.qpos[world, address] = x
    expert = make_expert(env)
    ends = {phase.stop - 1: phase.name for phase in expert.phases}
    lean = {}
    tilt = {}
    for step in range(expert.steps):
        env.step(expert.command())
        if name := ends.get(step):
            lean[name] = torch.rad2deg(torch.acos(-expert._ik.forward(expert._command)[2][:, 2]))
            x, y = env.sim.qpos[:, red + 4 : red + 6].unbind(1)
            tilt[name] = torch.rad2deg(torch.acos(1.0 - 2.0 * (x * x + y * y)))
    # If it pointed down wherever it can: 23 degrees both, and cubes tilted by 23 and 22.
    assert (lean["place_stack"] - lean["grasp_red"]).abs().max() < 6.0
    assert tilt["place_stack"].max() < 10.0
    assert tilt["retreat"].max() < 1.0
    env.close()


@pytest.mark.full
def test_tilt_follows_the_phases() -> None:
    """In the box task red's tilt is kept until blue is observed; a place without an anchor is
    where the target was before.
    """
    cfg = load_config(["task=box"])
    phases = cfg.controller.phases
    names = list(phases)
    built = build_phases(cfg)
    kept = [name for name, keeps in zip(names, _keeps(built), strict=True) if keeps]
    roles = ("lift", "carry", "hold", "open", "retreat", "settle")
    assert kept == [f"{role}_{cube}" for cube in ("red", "blue") for role in roles] + ["done"]
    assert [names[place] for place in _places(build_phases(cfg))] == ["hold_red"] * 6 + [
        "hold_blue"
    ] * 13
    phases["hold_red"].anchor = None
    assert [names[place] for place in _places(build_phases(cfg))][:7] == ["carry_red"] * 6 + [
        "hold_blue"
    ]
    for spec in phases.values():
        spec.grasps = None
    assert [names[place] for place in _places(build_phases(cfg))] == ["retreat_blue"] * 19


@pytest.mark.full
def test_no_retry_without_time(drive: Drive) -> None:
    env, controller = drive("controller.speed_limit=1.2", nworld=1)
    grasp = [phase.name for phase in controller.phases].index("grasp_red")
    for step in range(controller.phases[grasp + 1].start + 5):
        if step == controller.phases[grasp].stop - 1:
            env.sim.qpos[0, env.index.object_qpos[0]] += 0.2
        env.step(controller.command())
    assert controller.retries.tolist() == [0]
    assert int(controller.phase[0]) == grasp + 1


@pytest.mark.full
def test_worlds_start_over_by_themselves() -> None:
    """A world that ends in the middle of a phase is in its first phase in the step after, the
    others go on.
    """
    overrides = ["task=stack", "action=joint_absolute", "sim=native", "reset=jitter"]
    overrides += at_double_speed()
    env = make_env(overrides, nworld=3)
    env.reset(seed=3)
    expert = make_expert(env)
    for _ in range(75):
        env.step(expert.command())
    first = expert.command().clone()
    env.step(first)
    env.reset(mask=torch.tensor([False, True, False]))
    command = expert.command()
    assert expert.phase.tolist() == [2, 0, 2]
    assert (command[1] - first[1]).abs().max() > 0.05
    again = make_env(overrides, nworld=3)
    again.reset(seed=3)
    again.reset()  # episode 1 of every world
    np.testing.assert_allclose(
        make_expert(again).command()[1].numpy(), command[1].numpy(), atol=1e-6
    )
    env.close()
    again.close()


@pytest.mark.full
def test_out_of_reach_is_flagged_in_its_world(drive: Drive) -> None:
    env, controller = drive(nworld=2)
    env.sim.qpos[1, env.index.object_qpos[0]] = 0.9
    for _ in range(controller.phases[0].stop):
        env.step(controller.command())
    tolerance = env.cfg.controller.ik_tolerance
    assert float(controller.error[1]) > 0.1 > tolerance > float(controller.error[0])


@pytest.mark.full
def test_other_actions_are_refused() -> None:
    env = make_env(["task=stack", "sim=native"], nworld=1)
    with pytest.raises(ArgumentError, match=r"action=joint_absolute"):
        make_expert(env)
    env.close()


@pytest.mark.full
@on_cuda
def test_captured_commands_are_the_eager_ones() -> None:
    """Steps with the controller in them replay as one graph, and it reads nothing from
    the device.
    """
    commands = {}
    for graph in ("require", "off"):
        env = make_env(
            ["task=stack", "action=joint_absolute", "reset=randomized", f"graph={graph}"],
            nworld=64,
            device="cuda:0",
        )
        env.reset(seed=0)
        expert = make_expert(env)

        def work(env: Env = env, expert: ClosedLoopDriver = expert) -> None:
            env.action_manager.process(expert.command())
            env.advance()

        play = env.captured(work, "a step with its controller")
        for _ in range(100):
            play()
        assert play.captured == (graph == "require")
        commands[graph] = expert._command.clone()
        play.drop()
        env.close()
    torch.testing.assert_close(commands["require"], commands["off"], rtol=0.0, atol=1e-4)


@pytest.mark.parametrize("shape", ["box", "cylinder"])
@pytest.mark.parametrize("expert", [ClosedLoopDriver, ClocklessDriver])
def test_jaws_turn_to_an_object_that_has_faces(
    expert: type[FeedbackDriver], shape: str, drive: Drive, get_stage: GetStage
) -> None:
    size = "[0.022,0.022]" if shape == "cylinder" else "[0.022,0.022,0.022]"
    options = [f"scene.objects.red.shape={shape}", f"scene.objects.red.size={size}"]
    env, _ = drive(*options, nworld=2)
    first = env.index.object_qpos[0]
    env.sim.qpos[1] = env.sim.qpos[0]
    env.sim.qpos[1, first + 3 : first + 7] = torch.tensor([np.cos(0.3), 0.0, 0.0, np.sin(0.3)])
    env.sim.forward()
    controller = expert(env, get_stage("so101").planner.nominal)
    apart = 0.0
    for _ in range(20):  # before the jaws meet it
        command = controller.command()
        apart = max(apart, float((command[0] - command[1]).abs().max()))
        env.step(command)
    assert (apart > 0.05) == (shape == "box"), apart


def test_jaws_close_as_far_as_an_object_is_wide(robot: str, get_stage: GetStage) -> None:
    stage = get_stage(robot)
    profile = stage.cfg.robot
    widths = (None, 0.044, 0.032, 0.050)
    opened, cube, peg, wide = gripper_targets(stage.model, profile, widths)
    assert opened.tolist() == profile.gripper_open
    assert cube.tolist() == profile.gripper_closed  # a cube of 44 mm: exactly as before
    apart = []
    joints = [stage.model.joint(name).qposadr[0] for name in profile.gripper_joints]
    data = mujoco.MjData(stage.model)
    for target in (peg, cube, wide):
        data.qpos[joints] = target
        mujoco.mj_kinematics(stage.model, data)
        apart.append(float(np.linalg.norm(np.subtract(*data.site_xpos[stage.index.grasp_sites]))))
    np.testing.assert_allclose(np.diff(apart), [0.012, 0.006], rtol=0.0, atol=2e-5)


@pytest.mark.full
@pytest.mark.parametrize(
    ("robot", "expert", "half"),
    [
        ("so101", "closed_loop", 0.016),
        ("rebot", "open_loop", 0.012),
    ],
)
def test_a_narrow_peg_is_lifted(robot: str, expert: str, half: float) -> None:
    peg = f"scene.objects.red.size=[{half},{half},0.022]"
    options = [f"robot={robot}", f"controller={expert}", "sim=native", "nworld=1", peg]
    lifted = []
    for width in (0.044, 2.0 * half):  # the second: jaws that close as they do around a cube
        cfg = load_config([*options, f"robot.closed_width={width}", *at_double_speed()])
        stage = Stage(cfg)
        failed = stage.play(stage.batch_simulation(1), cfg.reset).result.failed.numpy()
        lifted.append("LIFT" not in stage.check.rules.failing(failed))
    assert lifted == [True, False]


def test_a_phase_has_a_width_of_its_own() -> None:
    cfg = load_config(["controller.phases.lift_red.width=0.03", "scene.objects.red.size.0=0.02"])
    widths = {phase.name: phase.width for phase in build_phases(cfg)}
    assert widths["above_red"] is None
    assert (widths["grasp_red"], widths["lift_red"], widths["above_blue"]) == (0.04, 0.03, 0.04)


@pytest.mark.full
def test_an_object_that_lies_askew_in_the_hand_is_aligned(drive: Drive) -> None:
    """Red is grasped 8 mm off its middle, and blue is turned: with ``align`` red arrives all the
    same.
    """
    phases = "controller.phases"
    askew = [f"{phases}.{name}.offset=[0.008,0,0]" for name in ("descend_red", "grasp_red")]
    left = {}
    for align in (False, True):
        options = [f"{phases}.{name}.align={align}" for name in ("above_blue", "place_stack")]
        env, controller = drive(*askew, *options, nworld=2)
        red, blue = env.index.object_qpos
        yaw = torch.tensor([0.3, -0.3], dtype=torch.float64)
        env.sim.qpos[:, blue + 3] = torch.cos(yaw / 2)
        env.sim.qpos[:, blue + 6] = torch.sin(yaw / 2)
        for _ in range(controller.phases[5].stop):
            env.step(controller.command())
        off = env.sim.qpos[:, red : red + 2] - env.sim.qpos[:, blue : blue + 2]
        poses = [measure_planar(env, name)[:, 2] for name in ("red", "blue")]
        turn = torch.rad2deg(poses[0] - poses[1])
        turn = (torch.remainder(turn + 45.0, 90.0) - 45.0).abs()
        left[align] = (off.norm(dim=1).max(), turn.max())
    assert left[False][0] > 0.005
    assert left[False][1] > 8.0
    assert left[True][0] < 0.002, left
    assert left[True][1] < 3.0, left


@pytest.mark.full
def test_what_is_oblong_is_aligned_by_half_turns(drive: Drive) -> None:
    """A brick at any yaw is turned to blue's heading, not across it, within the joint's range."""
    phases = "controller.phases"
    aligned = [f"{phases}.{name}.align=true" for name in ("above_blue", "place_stack")]
    env, controller = drive("scene.objects.red.size=[0.014,0.035,0.02]", *aligned, nworld=6)
    yaw = torch.linspace(-1.4, 1.4, 6, dtype=torch.float64)
    start = env.index.object_qpos[0] + 3
    env.sim.qpos[:, start] = torch.cos(yaw / 2)
    env.sim.qpos[:, start + 3] = torch.sin(yaw / 2)
    for _ in range(controller.phases[5].stop):
        env.step(controller.command())
    red, blue = (measure_planar(env, name)[:, 2] for name in ("red", "blue"))
    off = torch.remainder(red - blue + torch.pi / 2, torch.pi) - torch.pi / 2
    assert torch.rad2deg(off.abs().max()) < 4.0, torch.rad2deg(off)


BRICK = ["size=[0.035,0.014,0.02]"]
TURNED = ["size=[0.014,0.035,0.02]"]
LYING = ["shape=cylinder", "size=[0.014,0.035]", "quat=[0.7071068,0.7071068,0,0]"]


@pytest.mark.parametrize(
    ("expert", "shape"),
    [
        (ClosedLoopDriver, LYING),
        (ClocklessDriver, TURNED),
        *(pytest.param(ClosedLoopDriver, s, marks=pytest.mark.full) for s in (BRICK, TURNED)),
        *(pytest.param(ClocklessDriver, s, marks=pytest.mark.full) for s in (BRICK, LYING)),
    ],
)
def test_jaws_close_across_what_is_oblong(
    expert: type[FeedbackDriver], shape: list[str], drive: Drive, get_stage: GetStage
) -> None:
    """Across the narrower side, at any yaw, and by half a turn at most, within the joint's
    range.
    """
    red = [f"scene.objects.red.{text}" for text in shape]
    env, _ = drive(*red, "controller.yaw_alignment=0", nworld=6)
    start = env.index.object_qpos[0] + 3
    nominal = np.array(env.cfg.scene.objects["red"].turned)  # of the model's cube, too
    for world, yaw in enumerate(np.linspace(-1.5, 1.5, 6)):
        turned = np.empty(4)
        mujoco.mju_mulQuat(turned, np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]), nominal)
        env.sim.qpos[world, start : start + 4] = torch.from_numpy(turned)
    env.sim.forward()
    controller = expert(env, get_stage("so101").planner.nominal)
    for _ in range(60):  # before the jaws meet it
        env.step(controller.command())
    state = controller._measure()
    across = measure_planar(env, "red")[:, 2]
    off = torch.atan2(state.closing[:, 1], state.closing[:, 0]) - across
    off = torch.rad2deg((torch.remainder(off + torch.pi / 2, torch.pi) - torch.pi / 2).abs())
    limit = 6.0 if expert is ClosedLoopDriver else 16.0  # deg: SO-101's roll may end before
    assert off.max() < limit, off
    size = env.cfg.scene.objects["red"].size
    axes = quat_to_matrix(env.sim.qpos[:, start : start + 4])
    long = axes[:, :2, 2 if len(size) == 2 else int(np.argmax(size))].float()
    apart = (long * state.closing[:, :2]).sum(1).abs()  # of the long axis along the closing one
    assert apart.max() < np.sin(np.radians(limit))


def test_a_phase_ends_on_its_condition_or_after_its_time(drive: Drive) -> None:
    """Near its target, or when the jaws press; a condition that nothing meets changes nothing."""
    met = ["above_red.until_within=0.01", "grasp_red.until_force=3"]
    never = ["above_red.until_within=1e-6", "grasp_red.until_force=1000"]
    entered = []
    for conditions in ([], met, never):
        env, controller = drive(*(f"controller.phases.{text}" for text in conditions), nworld=2)
        steps = torch.full((2, 4), -1)
        for step in range(controller.phases[2].stop + 1):
            command = controller.command()
            fresh = (steps.gather(1, controller.phase[:, None].clamp(max=3)) < 0)[:, 0]
            steps[fresh, controller.phase[fresh].clamp(max=3)] = step
            if bool(fresh.any()) and conditions is met and int(controller.phase.min()) == 3:
                force = jaw_forces(env.index, env.sim, "red")
                assert ((force > 3.0) & (force < 30.0)).all()
            env.step(command)
        entered.append(steps)
    free, early, late = entered
    assert torch.equal(free, late)
    grasp = controller.phases[2].stop - controller.phases[2].start
    assert (early[:, 1] < free[:, 1] - 5).all()
    took = early[:, 3] - early[:, 2]
    assert ((took > 5) & (took < grasp - 5)).all()
