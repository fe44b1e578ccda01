"""Mistakes that were made once: each of these failed before it was mended."""

import signal
import threading
import time

import mujoco
import pytest
import torch
from compositions import make_env
from environments import GetStage, Patch, zeros

import mjstack
from mjstack.config.schema import ObservationTermCfg, TermCfg
from mjstack.envs import Env, build_env
from mjstack.errors import ArgumentError, FaultError, MjstackError, TermError

pytestmark = pytest.mark.full


def native(*overrides: str, nworld: int = 2) -> Env:
    return make_env(["sim=native", *overrides], nworld=nworld)


def test_an_action_with_a_gradient_leaves_none_behind() -> None:
    env = native()
    env.reset(seed=0)
    weight = torch.full_like(zeros(env), 0.1, requires_grad=True)
    env.step(2.0 * weight)
    _, reward, *_ = env.step(zeros(env))
    for tensor in (reward, env.action, env.sim.ctrl, env.sim.qpos):
        assert not tensor.requires_grad


class Counter:
    """Counts its calls per world: a memory."""

    def __init__(self, env: Env) -> None:
        self.count = torch.zeros(env.nworld)

    def __call__(self, env: Env) -> torch.Tensor:
        self.count += 1.0
        return self.count

    def reset(self, mask: torch.Tensor) -> None:
        self.count.masked_fill_(mask, 0.0)


def test_an_observation_with_a_memory_is_refused() -> None:
    cfg = mjstack.load_config(["sim=native"])
    cfg.observation["policy"].terms["counter"] = ObservationTermCfg(func=f"{__name__}.Counter")
    words = r"observation\.policy\.terms\.counter: has a reset\(mask\).*use history"
    with pytest.raises(TermError, match=words):
        build_env(cfg, nworld=1)


def test_an_overflow_names_the_size_that_is_in_force() -> None:
    sizes = ["sim=mjwarp", "sim.device=cpu", "batch.nconmax=40", "reset=randomized"]
    env = make_env(sizes, nworld=2)
    env.reset(seed=0)
    env.sim.overflow.fill_(8)  # NARROWPHASE; latched as if a step had raised it
    env.faults._overflow |= 8
    env.sim.peak_pool.fill_(77)
    words = r"Raise batch\.nconmax \(nconmax=40; all worlds together needed 77"
    with pytest.raises(FaultError, match=words):
        env.faults.raise_first()


def test_ctrl_c_leaves_no_thread_at_work(get_stage: GetStage, monkeypatch: Patch) -> None:
    from mjstack.sim import native

    monkeypatch.setattr(native, "available_cores", lambda: 2)
    sim = native.NativeSimulation(get_stage("so101").model, 64)
    timer = threading.Timer(0.2, lambda: signal.raise_signal(signal.SIGINT))
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        timer.start()
        with pytest.raises(KeyboardInterrupt):
            sim.step(2000)
        held = sim.qpos.clone()
        time.sleep(0.3)
        assert torch.equal(sim.qpos, held)
    finally:
        timer.join()
        signal.signal(signal.SIGINT, before)
    sim.close()


def test_torch_has_its_threads_back_after_a_step(monkeypatch: Patch) -> None:
    env = native()
    env.reset(seed=0)
    inside = []
    step = env.sim.step

    def watched(n: int = 1, *, kinematics: bool = False) -> None:
        inside.append(torch.get_num_threads())
        step(n, kinematics=kinematics)

    monkeypatch.setattr(env.sim, "step", watched)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        env.step(zeros(env))
        with pytest.raises(ArgumentError):
            env.step(zeros(env)[:1])
        assert (inside, torch.get_num_threads()) == ([1], 3)
    finally:
        torch.set_num_threads(before)


def test_drawn_friction_is_that_of_the_contact(robot: str) -> None:
    """MuJoCo combines two geoms' coefficients, so a field alone says little."""
    env = native(
        f"robot={robot}", "reset=randomized", "reset.friction.params.sliding=[0.3,0.5]", nworld=8
    )
    env.reset(seed=0)
    model = env.sim.model
    grips = set()
    data = mujoco.MjData(model)
    table = model.geom("table").id
    for w in range(env.nworld):
        model.geom_friction[:] = env.sim.fields["geom_friction"][w].numpy()
        data.qpos[:] = env.sim.qpos[w].numpy()
        red = env.index.object_qpos[0]
        # One cube in the jaws, the other one on the table.
        grasp_point = 0.5 * env.sim.site_xpos[w, env.index.grasp_sites].sum(0)
        data.qpos[red : red + 3] = grasp_point.numpy()
        mujoco.mj_forward(model, data)
        cubes = {geoms[0]: name for name, geoms in env.index.geoms.items()}
        for contact in data.contact:
            pair = set(contact.geom.tolist())
            cube = next((g for g in pair if g in cubes), None)
            if cube is None:
                continue
            (other,) = pair - {cube}
            if other == table:
                drawn = float(env.sim.fields["geom_friction"][w, cube, 0])
                assert contact.friction[0] == pytest.approx(drawn)
            else:
                grips.add(round(float(contact.friction[0]), 6))
    assert len(grips) > 1 or robot == "rebot"  # the reBot's open fingers do not touch the cube
    assert all(0.3 <= friction <= 0.5 for friction in grips)


def test_action_zero_holds_the_start() -> None:
    env = native(
        "task=stack", "action=joint_relative", "reset=randomized", "~reset.joints", "~reset.gains"
    )
    env.reset(seed=0)
    begin = env.sim.qpos[:, :5].clone()
    for _ in range(50):
        env.step(torch.cat((torch.zeros((2, 5)), torch.ones((2, 1))), dim=1))
    assert (env.sim.qpos[:, :5] - begin).abs().max() < 0.03


def test_two_terms_of_one_class_draw_different_numbers() -> None:
    noise = "{func: mjstack.mdp.reset.JointNoise, params: {arm: 0.01}}"
    once = native("reset=nominal", f"+reset.a={noise}")
    twice = native("reset=nominal", f"+reset.a={noise}", f"+reset.b={noise}")
    plain = native("reset=nominal")
    for env in (once, twice, plain):
        env.reset(seed=0)
    first = once.sim.ctrl - plain.sim.ctrl
    both = twice.sim.ctrl - plain.sim.ctrl
    assert not torch.allclose(both, 2.0 * first, atol=1e-6)


def test_episode_length_is_the_time_out_terms() -> None:
    assert native("termination.time_out.params.steps=50").max_episode_steps == 50
    assert native("~termination.time_out").max_episode_steps == 600


def test_two_actions_on_one_actuator_are_refused() -> None:
    words = r"action\.gripper: drives actuator 5, which action\.arm drives too"
    with pytest.raises(TermError, match=words):
        native("action.arm.params.joints=all")


def test_a_value_function_is_no_reset_term() -> None:
    cfg = mjstack.load_config(["sim=native"])
    cfg.reset["x"] = TermCfg(func="mjstack.mdp.reward.success")
    words = r"reset\.x: success does not take .* expected \(env, mask, \*, \.\.\.\)"
    with pytest.raises(TermError, match=words):
        build_env(cfg, nworld=1)


def test_a_closed_environment_and_a_missing_field_say_so() -> None:
    env = native()
    with pytest.raises(MjstackError, match="uses_fields"):
        env.sim.fields["body_mass"]
    env.close()
    for call in (lambda: env.step(zeros(env)), env.reset):
        with pytest.raises(mjstack.MjstackError, match="close"):
            call()
