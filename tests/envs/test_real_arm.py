"""``experiment=real_arm``: what differs from the model reaches the simulation as its file says, the
expert knows of it, and policies can do without a joint's zero.
"""

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from compositions import load_config, refusal
from policies import make_policy

from mjstack.config.schema import Backend, Config
from mjstack.drivers import feedback
from mjstack.drivers.driver import Assets, find_driver
from mjstack.drivers.servos import ServoInverse
from mjstack.envs import Env, build_env
from mjstack.episodes.batches import BatchPlan, play_batches
from mjstack.episodes.stage import Stage
from mjstack.errors import FolderError, MjstackError
from mjstack.gates.episodes import gate_config
from mjstack.math import norm
from mjstack.mdp import termination
from mjstack.mdp.geometry import robot, zeros
from mjstack.mdp.starts.starts_file import start_arrays
from mjstack.policy import load_policy, save_policy
from mjstack.policy.network import PolicyNetwork
from mjstack.scene.build import build_model
from mjstack.train.clone_network import measured_columns

BACKENDS = ("native", "mjwarp")
ABSOLUTE = "action=joint_absolute"


def real(*names: str, extra: tuple[str, ...] = ()) -> Config:
    """The experiment with some of its differences, without cameras."""
    chosen = f"randomization=[{','.join(names)}]"
    return load_config(["experiment=real_arm", "cameras=[]", ABSOLUTE, chosen, *extra])


def started(backend: str, *names: str, nworld: int = 12, extra: tuple[str, ...] = ()) -> Env:
    cfg = real(*names, extra=extra)
    env = build_env(cfg, nworld=nworld, backend=Backend(backend), device="cpu")
    env.reset(seed=0)
    return env


def test_what_is_left_out_is_as_in_the_model() -> None:
    none = real("none")
    assert list(none.reset) == ["home", "joints", "cubes", "mass", "friction", "gains"]
    assert (none.timing.random_delay, none.robot.backlash) == (0, 0.0)
    every = load_config(["experiment=real_arm"])
    assert {*every.reset} > {"servos", "zeros", "grip", "size", "base", "light", "camera_poses"}
    assert (every.timing.random_delay, every.robot.backlash) == (3, 0.0087)
    assert "zeros" not in load_config(["experiment=real_arm", "~reset.zeros"]).reset


def test_ranges_become_wider_about_their_middle() -> None:
    wide = real("zeros", "grip", "backlash", "wide")
    assert wide.reset["zeros"].params["arm"] == pytest.approx([0.249, 0.504, 0.5895, 0.3315, 0.09])
    assert wide.reset["grip"].params["effort"] == pytest.approx([0.625, 1.675])
    assert wide.robot.backlash == pytest.approx(0.01305)


@pytest.mark.parametrize("backend", BACKENDS)
def test_servos_are_one_model_each_and_off_from_it_joint_by_joint(backend: str) -> None:
    env = started(backend, "servos", nworld=24)
    names = ("gtc_berlin", "workshop")
    models = [build_model(load_config([f"actuator={name}"])) for name in names]
    dofs = env.index.robot_qvel
    drawn = set()
    for world in range(env.nworld):
        field = {
            name: values[world].double().cpu().numpy() for name, values in env.sim.fields.items()
        }
        fits = [np.allclose(field["dof_armature"], m.dof_armature, rtol=1e-6) for m in models]
        drawn.add(fits.index(True))
        model = models[fits.index(True)]
        gain = field["actuator_gainprm"][:, 0] / model.actuator_gainprm[:, 0]
        damping = field["actuator_biasprm"][:, 2] / model.actuator_biasprm[:, 2]
        dry = field["dof_frictionloss"][dofs] / model.dof_frictionloss[dofs]
        assert np.allclose(gain, damping, rtol=1e-5)
        assert np.allclose(-field["actuator_biasprm"][:, 1], field["actuator_gainprm"][:, 0])
        for factors in (gain, dry):
            assert factors.min() >= 0.8 - 1e-6
            assert factors.max() <= 1.25 + 1e-6
            assert np.ptp(factors) > 0.02
        assert not np.allclose(gain, dry, atol=0.01)
    assert drawn == {0, 1}
    starts = start_arrays(env)  # which gate success writes
    assert not any(name.endswith("_mass") for name in starts)
    assert starts["gain_gripper"].min() < 0.1
    env.close()


def test_zeros_leave_stops_where_they_are() -> None:
    """A command of the whole range, as the servo counts it, brings the arm to its true stop."""
    env = started("native", "zeros", nworld=8)
    off = zeros(env)
    assert off is not None
    half = torch.tensor([0.166, 0.336, 0.393, 0.221, 0.06, 0.035], dtype=off.dtype)
    assert (off.abs() <= half).all()
    assert (off.abs().amax(0) > 0.5 * half).all()
    limits = torch.from_numpy(env.index.ctrl_range)
    env.action_manager.process(torch.full_like(env.sim.ctrl, 10.0))
    env.action_manager.apply()
    assert torch.allclose(robot(env).ctrl.read(env.sim.ctrl) + off, limits[:, 1].expand_as(off))
    for name, at in (("jnt_range", env.sim.model.actuator_trnid[env.index.ctrl, 0]),):
        ends = env.sim.fields[name][:, at] + off[..., None]
        assert torch.allclose(ends, torch.from_numpy(env.sim.model.jnt_range[at]).expand_as(ends))
    env.close()


@pytest.mark.parametrize("backend", BACKENDS)
def test_backlash_holds_a_command_until_it_has_come_so_far(backend: str) -> None:
    """The same as without backlash under commands that a joint's play has shortened by hand; the
    gripper has none.
    """
    play = 0.05
    steps = 12
    loose = started(backend, "none", nworld=2, extra=(f"robot.backlash={play}",))
    tight = started(backend, "none", nworld=2)
    first = robot(loose).ctrl.read(loose.sim.ctrl).float()
    moved = first.clone()
    for step in range(steps):
        command = first + 0.12 * np.sin(step)
        moved[:, :5] = torch.minimum(torch.maximum(moved, command - play), command + play)[:, :5]
        moved[:, 5:] = command[:, 5:]
        loose.step(command)
        tight.step(moved)
        assert torch.allclose(loose.sim.ctrl, command.to(loose.sim.ctrl))  # as terms read it
    assert torch.allclose(loose.sim.qpos, tight.sim.qpos, atol=1e-6)
    loose.close()
    tight.close()


@pytest.mark.parametrize("backend", BACKENDS)
def test_grip_cubes_and_base_differ_as_said(backend: str) -> None:
    env = started(backend, "grip", "objects", "table")
    m, field = env.sim.model, env.sim.fields
    *arm, jaw = env.index.ctrl.tolist()
    effort = field["actuator_forcerange"][:, jaw, 1]
    assert ((effort >= 0.8) & (effort <= 1.5)).all()
    assert effort.std() > 0.1
    assert torch.equal(field["actuator_forcerange"][:, jaw, 0], -effort)
    limits = torch.from_numpy(m.actuator_forcerange[arm]).to(effort)
    assert torch.equal(field["actuator_forcerange"][:, arm], limits.expand(env.nworld, -1, -1))

    geom = env.index.geoms["red"][0]
    size = field["geom_size"][:, geom]
    change = size - 0.022
    assert (change.abs() <= 0.0005 + 1e-9).all()
    assert torch.allclose(change, change[:, :1].expand_as(change), atol=1e-8)
    assert change.std() > 1e-4
    assert torch.allclose(field["geom_rbound"][:, geom], norm(size))
    assert torch.allclose(field["geom_aabb"][:, geom].reshape(-1, 6)[:, 3:], size)
    z = env.index.objects["red"][0] + 2
    hold = robot(env).ctrl.read(env.sim.ctrl).float()
    for _ in range(20):  # cubes of each size come to rest on the table
        env.step(hold)
    height = env.sim.qpos[:, z] - env.cfg.scene.table_top
    assert torch.allclose(height, size[:, 2].to(height), atol=2e-4)

    body = m.body("base").id
    rise = field["body_pos"][:, body, 2] - m.body_pos[body, 2]
    assert (rise.abs() <= 0.005).all()
    assert rise.std() > 0.001
    data = mujoco.MjData(m)
    data.qpos[:] = env.sim.qpos[0].double().cpu().numpy()
    mujoco.mj_kinematics(m, data)
    tip = env.index.grasp_sites[0]
    lifted = float(env.sim.site_xpos[0, tip, 2]) - data.site_xpos[tip, 2]
    assert lifted == pytest.approx(float(rise[0]), abs=1e-5)
    env.close()


def test_the_servos_inverse_holds_the_arm_up() -> None:
    """Its torques are those of MuJoCo's gravity, in every pose."""
    env = started("native", "servos", "zeros", "backlash", nworld=4)
    driver = find_driver(env.cfg).build(env, env.cfg, Assets(env.cfg))
    torques = ServoInverse(env)._hold(driver._measure())
    m = env.sim.model
    data = mujoco.MjData(m)
    for world in range(env.nworld):
        data.qpos[:] = env.sim.qpos[world]
        data.qpos[env.index.robot_qpos] += zeros(env)[world].numpy()
        mujoco.mj_forward(m, data)
        bias = data.qfrc_bias[env.index.robot_qvel]
        assert np.allclose(torques[world], bias, atol=2e-3), world
    env.close()


@pytest.mark.parametrize("known", [True, False])
def test_the_expert_knows_where_the_arm_is(known: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """It stacks under all differences at once, and fails where it takes a joint's reading for
    true.
    """
    if not known:
        monkeypatch.setattr(feedback, "zeros", lambda _: None)
    names = ("servos", "zeros", "delay", "backlash", "grip", "objects", "table")
    stage = Stage(
        replace(real(*names, extra=("sim=native", "nworld=8", "seed=7000")), gates=["success"])
    )
    stage = stage.with_config(gate_config(stage.cfg, "success"))
    (batch,) = play_batches(stage, [BatchPlan(7000, range(8))])
    assert int(batch.succeeded.sum()) == 8 if known else int(batch.succeeded.sum()) <= 4


def test_relative_targets_move_with_what_is_read(tmp_path: Path) -> None:
    """A joint that reads otherwise moves its targets as far; a policy's folder keeps that."""
    cfg = load_config(["observation=real", ABSOLUTE])
    policy = make_policy(cfg)
    absolute = policy.network
    n = absolute.width
    inputs = len(absolute.observation_mean)
    network = PolicyNetwork(inputs, n, absolute.chunk, absolute.hidden, relative=range(n))
    network.origin.copy_(torch.tensor(cfg.robot.home))
    seen = torch.rand(4, inputs) * 0.1
    scaled = network.normalized(seen)
    expected = scaled + (seen[:, :n] + torch.tensor(cfg.robot.home))[:, None]
    assert torch.allclose(network(seen), expected)
    policy.network = network
    save_policy(tmp_path / "p", policy)
    assert torch.equal(load_policy(tmp_path / "p").network(seen), network(seen))
    facts = (tmp_path / "p" / "policy.json").read_text()
    (tmp_path / "p" / "policy.json").write_text(
        facts.replace('"relative": [\n   0,', '"relative": [\n   99,')
    )
    with pytest.raises(FolderError, match="relative"):
        load_policy(tmp_path / "p")


def test_relative_targets_need_joints_that_are_seen() -> None:
    cfg = load_config(["job=train", "sim=native", "observation@job.observation=real"])
    cfg = replace(cfg, observation=cfg.job.observation)
    widths = dict.fromkeys(cfg.observation["policy"].terms, 6)
    assert measured_columns(cfg, widths) == ([0, 1, 2, 3, 4, 5], cfg.robot.home)
    cfg.observation["policy"].terms["joint_pos"].scale = 2.0
    message = refusal(lambda: measured_columns(cfg, widths))
    assert message.startswith("job.relative=true: expected false, because the policy sees no")


def test_servos_leave_the_weights_of_objects_to_other_terms() -> None:
    """A heavier cube has a smaller inverse weight, whichever term comes first."""
    for names in (("servos", "objects"), ("objects", "servos")):
        with closing(build_env(real(*names), nworld=4, backend=Backend.native)) as env:
            env.reset()
            fields, model = env.sim.fields, env.sim.model
            body = env.index.bodies["red"]
            mass = fields["body_mass"][:, body] / model.body_mass[body]
            weight = fields["body_invweight0"][:, body, 0] / model.body_invweight0[body, 0]
            assert not torch.allclose(mass, torch.ones_like(mass))
            torch.testing.assert_close(mass * weight, torch.ones_like(mass))


def test_a_joint_at_its_true_stop_is_within_its_limits() -> None:
    with closing(build_env(real("zeros"), nworld=16, backend=Backend.native)) as env:
        env.reset()
        off = zeros(env)
        assert off is not None
        at_stop = robot(env).range[:, 1] - off
        env.sim.qpos[:, env.index.robot_qpos] = at_stop.to(env.sim.qpos)
        limit = termination.JointLimit(env, margin=0.02)
        assert not limit(env).any()
        env.sim.qpos[:, env.index.robot_qpos] += 0.5
        assert limit(env).all()


def test_what_would_not_act_is_refused() -> None:
    for chosen, extra, words in (
        (("grip", "servos"), (), "GripForce stands before Servos"),
        (("objects",), ("reset.size.params.edge=0.06",), "less than 0.044 m"),
    ):
        cfg = real(*chosen, extra=extra)
        with pytest.raises(MjstackError, match=words):
            build_env(cfg, nworld=1, backend=Backend.native)
