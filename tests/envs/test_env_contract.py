"""The promises of an environment on every backend, for both tasks and both robots."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from environments import (
    COUNTS,
    POSES,
    STATE,
    actions,
    assert_rows,
    assert_same_run,
    assert_traces,
    configure,
    mask_of,
    on_new_sim,
    on_shared_sim,
    play,
    returned,
    state_of,
    zeros,
)
from ik_arm import Arm

from mjstack.config.schema import Config
from mjstack.envs import Env
from mjstack.sim import Overflow

SCENES = [("stack", "so101"), ("reach", "rebot")]
N = 4

scenes = pytest.mark.parametrize(("task", "robot"), SCENES)


def randomized(task: str, robot: str, *, steps: int | None = None) -> Config:
    """Everything differs from world to world; episodes end after some steps, if given."""
    cfg = configure(f"task={task}", "reset=randomized", robot=robot)
    cfg.action["arm"].params["scale"] = 0.5  # rad: the clock alone ends an episode in these tests
    if steps is not None:
        cfg.termination["time_out"].params["steps"] = steps
    return cfg


def without_ends(cfg: Config) -> Config:
    cfg.termination.clear()
    return cfg


# Resets


@scenes
def test_a_masked_reset_touches_nobody_else(backend: str, task: str, robot: str) -> None:
    cfg = randomized(task, robot)
    env = on_shared_sim(backend, N, cfg)
    moves = actions(env, 12)
    env.reset(seed=3)
    undisturbed = play(env, moves)

    env.reset(seed=3)
    before_reset = play(env, moves[:6])
    assert_traces(before_reset, undisturbed[:6], slice(None), slice(None), backend)
    others = [0, 2]
    chosen = [1, 3]
    env.sim.sensordata.fill_(1.0)  # as if they had touched something
    before = state_of(env)
    start = returned(env.reset(mask=mask_of(env, *chosen)))
    after = state_of(env)
    for name in before:
        assert torch.equal(after[name][others], before[name][others]), name
    for name, value in start.items():
        assert torch.equal(value[others], before_reset[-1][name][others]), name
    assert after["episode"].tolist() == [0, 1, 0, 1]
    assert after["episode_step"].tolist() == [6, 0, 6, 0]
    assert before["action"][chosen].any()
    cleared = ("action", "previous_action", "sensordata", "qvel", "episode_sums", "success")
    for name in (*cleared, *COUNTS[:1], *COUNTS[2:]):
        assert not after[name][chosen].any(), name
    later = play(env, moves[6:])
    assert_traces(later, undisturbed[6:], others, others, backend)

    fresh = on_new_sim(backend, N, cfg)
    fresh.reset(seed=3)
    fresh_start = returned(fresh.reset())
    assert fresh.episode.tolist() == [1] * N
    assert_rows(start, fresh_start, chosen, chosen, backend, "reset")
    new = state_of(fresh)
    for name in [n for n in after if n in (*STATE, *POSES) or n.startswith("fields.")]:
        assert_same_run(after[name][chosen], new[name][chosen], backend)
    assert_traces(later, play(fresh, moves[6:]), chosen, chosen, backend)


@pytest.mark.full
def test_starts_depend_on_seed_world_and_episode_alone(robot: str) -> None:
    """On how many worlds there are, which of them reset with it, and the backend they do not. The
    configuration's seed is the one of a reset without.
    """
    cfg = randomized("reach", robot)
    cfg.seed = 5
    names = ("qpos", "qvel", "ctrl", "site_xpos")

    def starts(env: Env) -> dict[str, torch.Tensor]:
        state = state_of(env, names).items()
        return {k: v.double().cpu() for k, v in state if k in names or k.startswith("fields.")}

    runs = {}
    for backend, nworld in (("native", N), ("native", 2), ("mjwarp", N)):
        env = on_shared_sim(backend, nworld, cfg)
        env.reset(seed=5 if backend == "mjwarp" else None)
        if nworld == N:
            env.reset(mask=mask_of(env, 1, 3))
            env.step(actions(env, 1)[0])
            env.reset(mask=mask_of(env, 0, 1))
            assert env.episode.tolist() == [1, 2, 0, 1]
        else:
            env.reset()
            env.step(actions(env, 1)[0])
            env.reset(mask=mask_of(env, 0))
            env.reset(mask=mask_of(env, 1))
            assert env.episode.tolist() == [2, 2]
        runs[backend, nworld] = starts(env)
    four, two, warp = runs.values()
    for name in four:
        assert torch.equal(four[name][1], two[name][1]), name
        # float32 holds seven digits: gains up to a thousand, metres and radians of order one.
        torch.testing.assert_close(warp[name][[0, 1]], four[name][[0, 1]], rtol=1e-6, atol=2e-6)
    assert not torch.equal(four["qpos"][0], two["qpos"][0])  # another episode
    env.reset(seed=5)
    before = starts(env)["qpos"]
    env.reset(seed=6)
    assert not env.episode.any()
    assert (starts(env)["qpos"] != before).any(1).all()


@scenes
def test_world_k_of_n_is_world_k_of_one(backend: str, task: str, robot: str) -> None:
    """Over random actions and two automatic resets each."""
    cfg = randomized(task, robot, steps=5)
    many = on_shared_sim(backend, N, cfg)
    many.reset(seed=1)
    many_trace = play(many, actions(many, 13))
    assert many_trace[-1]["episode"].tolist() == [2] * N
    one = on_shared_sim(backend, 1, cfg)
    for k in range(N):
        one.world.fill_(k)
        one.reset(seed=1)
        assert_traces(play(one, actions(one, 13)), many_trace, 0, k, backend)
    rows = many_trace[-1]["qpos"]
    assert len({tuple(row) for row in rows.tolist()}) == N


# Outputs are written anew


@pytest.mark.full
@scenes
def test_outputs_filled_with_nan_change_nothing(backend: str, task: str, robot: str) -> None:
    cfg = randomized(task, robot, steps=4)
    env = on_shared_sim(backend, 3, cfg)
    sim = env.sim
    moves = actions(env, 10)
    model = sim.model
    # Geoms of the world are placed once, when the data is made.
    moving = np.flatnonzero(model.body_weldid[model.geom_bodyid] != 0)

    def poison(_: int = 0) -> None:
        sim.geom_xpos[:, torch.from_numpy(moving).to(env.device)] = math.nan
        rewards = env.reward_manager
        ends = env.termination_manager
        for view in (
            *(sim.xpos[:, 1:], sim.xquat[:, 1:], sim.site_xpos, sim.sensordata, sim.qfrc_actuator),
            *(*env.observation_manager.groups.values(), rewards.reward, rewards.values),
            env.action_manager.previous_action,
        ):
            view.fill_(math.nan)
        for flags in (ends.terminated, ends.truncated, ends.values, env.success):
            flags.fill_(True)
        sim.contact_count.fill_(-1)
        sim.constraint_count.fill_(-1)

    clean_start = returned(env.reset(seed=2))
    clean = play(env, moves)
    poison()
    env.action_manager.action.fill_(math.nan)
    start = returned(env.reset(seed=2))
    dirty = play(env, moves, before=poison)
    assert_rows(start, clean_start, slice(None), slice(None), backend, "reset")
    assert_traces(dirty, clean, slice(None), slice(None), backend)
    for row in (start, *dirty):
        for name, value in row.items():
            assert torch.isfinite(value).all(), name
    assert sum(int(row["truncated"].sum()) for row in clean) == 6


# Terminal observation, history, noise


@scenes
def test_terminal_observation_and_the_one_to_go_on_with(
    backend: str, task: str, robot: str
) -> None:
    env = on_shared_sim(backend, 3, without_ends(randomized(task, robot)))
    moves = actions(env, 9)
    env.reset(seed=4)
    endless = play(env, moves[:5])
    env.reset(seed=4)
    next_start = returned(env.reset())

    env = on_shared_sim(backend, 3, randomized(task, robot, steps=5))
    env.reset(seed=4)
    trace = play(env, moves[:2])
    env.reset(mask=mask_of(env, 1))  # so that world 1 is not done with the others
    trace += play(env, moves[2:])
    assert [row["truncated"].tolist() for row in trace[4:7]] == [
        [True, False, True],
        [False] * 3,
        [False, True, False],
    ]
    done = trace[4]
    for group in env.observation_manager.groups:
        obs = done[f"obs.{group}"]
        final = done[f"final.{group}"]
        assert_same_run(final[[0, 2]], endless[4][f"obs.{group}"][[0, 2]], backend)
        assert_same_run(obs[[0, 2]], next_start[f"obs.{group}"][[0, 2]], backend)
        assert torch.equal(final[1], obs[1])
        assert not torch.equal(final[0], obs[0])
        for row in trace[5:6]:
            assert torch.equal(row[f"obs.{group}"], row[f"final.{group}"])


@pytest.mark.full
def test_returned_tensors_are_the_callers(backend: str) -> None:
    env = on_shared_sim(backend, 3, randomized("stack", "so101", steps=3))
    moves = actions(env, 7)
    # The last one with resets
    kept = [returned(env.reset(seed=0)), *(returned(env.step(move)) for move in moves[:3])]
    copies = [{name: value.clone() for name, value in row.items()} for row in kept]
    play(env, moves[3:])
    env.reset(mask=mask_of(env, 0))
    env.reset(seed=9)
    for row, copied in zip(kept, copies, strict=True):
        for name, value in row.items():
            assert torch.equal(value, copied[name]), name
            value.zero_()  # nor does it matter to the environment what they do with them
    env.reset(seed=0)
    assert_rows(returned(env.step(moves[0])), copies[1], slice(None), slice(None), backend)


class Change:
    """A reward term that keeps a tensor of a step for the next one."""

    def __init__(self, env: Env) -> None:
        """Begin with none."""
        self.before = env.action.clone()

    def __call__(self, env: Env) -> torch.Tensor:
        """How much the first action changes."""
        change = (env.action - self.before)[:, 0]
        self.before = env.action.clone()
        return change

    def reset(self, mask: torch.Tensor) -> None:
        """Forget in place."""
        self.before[mask] = 0.0


def test_a_step_is_without_autograd_and_what_it_returns_is_not() -> None:
    """Terms may write into what they kept, in a later step and in a reset of the caller's; a loss
    may be taken of what a step returns, and a buffer be written outside.
    """
    change = "+reward.change={func: test_env_contract.Change, weight: 1.0}"
    env = on_new_sim("native", 3, configure(change))
    env.reset(seed=0)
    for move in actions(env, 3):
        obs, reward, *_ = env.step(move)
    env.reset(mask=mask_of(env, 1))
    env.step(zeros(env))
    assert env.reward_manager.terms[
        env.reward_manager.names.index("change")
    ].call.before.is_inference()
    layer = torch.nn.Linear(obs["policy"].shape[1], 1)
    (layer(obs["policy"]).sum() * reward.sum()).backward()
    assert layer.weight.grad is not None
    reward.add_(1.0)
    env.reward_manager.weights.mul_(0.5)
    env.step(zeros(env))


def split(env: Env, group: str, obs: torch.Tensor) -> dict[str, torch.Tensor]:
    """A group's terms by name, from the widths that the configuration implies."""
    n = len(env.cfg.robot.home)
    width = dict.fromkeys(("joint_pos", "joint_pos_relative", "joint_vel"), n)
    width |= dict.fromkeys(("grasp_point_pos", "grasp_point_to_object", "object_to_object"), 3)
    width |= {"object_pose": 7, "object_velocity": 6, "jaw_force": 2}
    width["last_action"] = env.action_manager.action_dim
    terms = env.cfg.observation[group].terms
    parts = obs.split([t.history * width[t.func.rpartition(".")[2]] for t in terms.values()], dim=1)
    return dict(zip(terms, parts, strict=True))


def test_history_starts_full_and_slides(backend: str) -> None:
    cfg = randomized("reach", "so101", steps=4)
    terms = cfg.observation["policy"].terms
    terms["joint_pos"].history = 3
    env = on_shared_sim(backend, 3, cfg)

    def read(obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        parts = split(env, "policy", obs)
        return parts["joint_pos"].reshape(3, 3, -1), parts["grasp_point_to_goal"].reshape(3, 2, -1)

    trace = [returned(env.reset(seed=0)), *(returned(env.step(move)) for move in actions(env, 6))]
    steps = [read(row["obs.policy"]) for row in trace]
    for t in (0, 4):  # the first step, also of the second episode
        for part in steps[t]:
            assert (part == part[:, :1]).all()
    for t in (1, 2, 3, 5, 6):
        for new, old in zip(steps[t], steps[t - 1], strict=True):
            assert torch.equal(new[:, :-1], old[:, 1:])
            assert not torch.equal(new[:, -1], old[:, -1])
    # The terminal observation slides too: it is the old episode's.
    for final, old in zip(read(trace[4]["final.policy"]), steps[3], strict=True):
        assert torch.equal(final[:, :-1], old[:, 1:])
    # A masked reset fills the history of its worlds alone.
    old = steps[-1]
    new = read(env.reset(mask=mask_of(env, 1))[0]["policy"])
    for a, b in zip(new, old, strict=True):
        assert (a[1] == a[1, :1]).all()
        assert not (b[1] == b[1, :1]).all()
        assert torch.equal(a[[0, 2]], b[[0, 2]])


def test_a_slide_has_less_noise_than_a_hinge() -> None:
    """A tenth as many metres as the others have radians."""
    env = on_new_sim("native", 64, configure("task=reach", "reset=nominal", robot="rebot"))
    obs, _ = env.reset(seed=0)
    seen, clean = (split(env, name, obs[name])["joint_pos"] for name in ("policy", "privileged"))
    width = env.cfg.observation["policy"].terms["joint_pos"].noise
    largest = (seen - clean).abs().amax(0)
    assert (largest[:6] > 0.8 * width).all()
    assert ((largest[6:] > 0.08 * width) & (largest[6:] < 0.1001 * width)).all()


def test_noise_is_keyed_and_within_its_width() -> None:
    base = randomized("reach", "so101", steps=5)
    env = on_shared_sim("native", 3, base)
    moves = actions(env, 8)

    def noises(env: Env, seed: int, worlds: list[int] | None = None) -> torch.Tensor:
        if worlds is not None:
            env.world.copy_(torch.tensor(worlds))
        env.reset(seed=seed)
        out = []
        for move in moves:
            obs = env.step(move)[0]
            pos = split(env, "policy", obs["policy"])["joint_pos"]
            clean = split(env, "privileged", obs["privileged"])
            out.append(pos - clean["joint_pos"])
        return torch.stack(out)

    noise = noises(env, 0)
    width = base.observation["policy"].terms["joint_pos"].noise
    assert (noise.abs() <= width + 1e-6).all()
    assert 0.8 * width < noise.abs().max()
    assert abs(float(noise.mean())) < 0.25 * width
    # Each step, each world and each episode has its own: step 5 is the start of episode 1, so it
    # differs from step 0's.
    flat = noise.flatten(0, 1)
    assert len({tuple(row) for row in (flat * 1e4).round().int().tolist()}) == len(flat)
    torch.testing.assert_close(noises(env, 0), noise, rtol=0, atol=0)
    assert not torch.isclose(noises(env, 1), noise, atol=1e-5, rtol=0).all(-1).any()

    # In worlds that start alike and do alike, the noise is all that differs; a world's number alone
    # decides its own.
    cfg = configure("task=reach", "reset=nominal")
    env = on_shared_sim("native", 3, cfg)
    moves = [move[:1].expand(3, -1) for move in moves]
    a = noises(env, 0)
    b = noises(env, 0, [2, 0, 7])
    torch.testing.assert_close(b[:, 0], a[:, 2], rtol=0, atol=1e-6)
    torch.testing.assert_close(b[:, 1], a[:, 0], rtol=0, atol=1e-6)

    cfg.observation["policy"].noise = False
    env = on_shared_sim("native", 3, cfg)
    assert not noises(env, 0).any()


@pytest.mark.full
def test_noise_then_clip_then_scale(backend: str) -> None:
    cfg = configure("task=stack", "reset=nominal")
    term = cfg.observation["policy"].terms["joint_vel"]
    seen = {}
    for name, term.noise, term.clip, term.scale in (
        ("plain", 0.0, None, 1.0),
        ("noisy", 0.3, None, 1.0),
        ("clipped", 0.3, [-0.5, 0.25], 1.0),
        ("all", 0.3, [-0.5, 0.25], 0.1),
    ):
        env = on_shared_sim(backend, 2, cfg)
        env.reset(seed=0)
        trace = play(env, actions(env, 6))
        rows = [split(env, "policy", row["obs.policy"])["joint_vel"] for row in trace]
        seen[name] = torch.stack(rows)
    added = (seen["noisy"] - seen["plain"]).abs()
    assert (added <= 0.3 + 1e-4).all()
    assert added.max() > 0.2
    assert_same_run(seen["clipped"], seen["noisy"].clamp(-0.5, 0.25), backend)
    assert_same_run(seen["all"], 0.1 * seen["clipped"], backend)
    assert (seen["clipped"] == 0.25).any()
    assert (seen["clipped"] == -0.5).any()


# Every action group


def assert_layout(env: Env, row: dict[str, torch.Tensor]) -> None:
    """Shapes, types and finiteness of what step or reset returned."""
    for name, value in row.items():
        assert value.device == env.device
        assert torch.isfinite(value).all(), name
        if name.startswith(("obs.", "final.")):
            group = name.partition(".")[2]
            assert value.shape == (env.nworld, env.observation_manager.group_dims[group])
            assert value.dtype is torch.float32
            assert all(part.shape[1] for part in split(env, group, value).values())
        else:
            assert value.shape == (env.nworld,)
            assert value.dtype is (torch.float32 if name == "reward" else torch.bool)


@pytest.mark.full
@pytest.mark.parametrize("action", ["joint_relative", "joint_absolute", "joint_delta", "ee_delta"])
def test_every_action_group_steps(backend: str, robot: str, action: str) -> None:
    cfg = without_ends(configure("task=stack", f"action={action}", "reset=jitter", robot=robot))
    env = on_shared_sim(backend, 3, cfg)
    n = len(env.cfg.robot.home)
    n_arm = len(env.cfg.robot.arm_joints)
    scale = cfg.action["arm"].params.get("scale")
    manager = env.action_manager
    assert manager.action_dim == {"joint_absolute": n, "ee_delta": 4}.get(action, n_arm + 1)
    assert manager.low.shape == manager.high.shape == (manager.action_dim,)
    assert (manager.low < manager.high).all()
    assert_layout(env, returned(env.reset(seed=0)))
    ctrl = torch.as_tensor(env.index.ctrl).to(env.device)
    limits = torch.as_tensor(env.index.ctrl_range).to(env.sim.ctrl)
    home = torch.as_tensor(env.cfg.robot.home).to(env.sim.ctrl)
    start = torch.as_tensor(env.cfg.robot.start).to(env.sim.ctrl)
    before = env.sim.ctrl[:, ctrl].clone()
    torch.testing.assert_close(before, home.expand(3, -1))
    rest = zeros(env)
    if action == "joint_absolute":
        rest[:] = home
    env.step(rest)  # the arm's commands stay where they are
    # Relative commands count from the start.
    held = start.expand(3, -1) if action == "joint_relative" else before
    torch.testing.assert_close(env.sim.ctrl[:, ctrl[:n_arm]], held[:, :n_arm], rtol=0, atol=1e-4)
    before = env.sim.ctrl[:, ctrl].clone()
    for move in actions(env, 6):
        assert_layout(env, returned(env.step(move)))
        assert_same_run(env.action, move.to(env.action.dtype), backend)
        command = env.sim.ctrl[:, ctrl]
        assert ((command >= limits[:, 0]) & (command <= limits[:, 1])).all()
        moved = (command - before)[:, :n_arm].abs()
        assert (moved.amax(1) > 1e-4).all()
        if action == "joint_delta":
            assert (moved <= scale + 1e-6).all()
        if action == "joint_relative":
            expected = start[:n_arm] + scale * move[:, :n_arm]
            expected = expected.clamp(limits[:n_arm, 0], limits[:n_arm, 1])
            torch.testing.assert_close(command[:, :n_arm], expected.to(command))
        if action == "joint_absolute":
            torch.testing.assert_close(command, move.to(command))
        else:  # the gripper's fraction of its way from closed to open
            closed = torch.tensor(env.cfg.robot.gripper_closed).to(command)
            opened = torch.tensor(env.cfg.robot.gripper_open).to(command)
            fingers = closed + 0.5 * (move[:, -1:] + 1.0) * (opened - closed)
            torch.testing.assert_close(command[:, n_arm:], fingers.to(command))
        before = command.clone()
    if action != "joint_absolute":  # more than one is one
        commands = []
        for size in (1.0, 3.0):
            env.reset(seed=0)
            env.step(size * torch.ones_like(rest))
            commands.append(env.sim.ctrl.clone())
        assert_same_run(*commands, backend)


@pytest.mark.full
def test_end_effector_delta_moves_the_commanded_grasp_point(backend: str, robot: str) -> None:
    """The command's forward kinematics, by native MuJoCo, moves by 1 cm along each axis in turn."""
    cfg = configure("task=stack", "action=ee_delta", "reset=jitter", robot=robot)
    env = on_shared_sim(backend, 3, cfg)
    env.reset(seed=0)
    arm = Arm(env.sim.model, env.cfg.robot)

    def commanded() -> np.ndarray:
        return arm.grasp_point(env.sim.ctrl[:, env.index.ctrl.tolist()].double().cpu().numpy())

    move = torch.zeros((3, 4), device=env.device)
    move[:, :3] = 0.8 * torch.eye(3, device=env.device)
    move[:, 2] -= 0.2
    # The commands are IK targets with the gripper where it was last: the gripper's own command
    # comes after the arm's.
    env.step(torch.cat((torch.zeros_like(move[:, :3]), torch.ones_like(move[:, 3:])), dim=1))
    move[:, 3] = 1.0
    for _ in range(3):
        before = commanded()
        env.step(move)
        expected = 0.01 * move[:, :3].cpu().numpy()
        np.testing.assert_allclose(commanded() - before, expected, atol=5e-4)


# Ends of episodes


@pytest.fixture
def ended(backend: str, robot: str) -> Env:
    """Three worlds that have just started."""
    env = on_shared_sim(backend, 3, configure("task=stack", robot=robot))
    env.reset(seed=0)
    return env


def assert_ends(env: Env, term: str, worlds: list[int]) -> None:
    """One step ends exactly these worlds, by exactly this term, and all of them go on."""
    before = env.episode.clone()
    obs, reward, terminated, truncated, extras = env.step(zeros(env))
    expected = mask_of(env, *worlds)
    columns = env.termination_manager.values.unbind(1)
    for name, column in zip(env.termination_manager.names, columns, strict=True):
        assert torch.equal(column, expected & (name == term)), name
    assert torch.equal(terminated, expected)
    assert not truncated.any()
    assert torch.equal(env.episode - before, expected.long())
    assert not env.episode_step[expected].any()
    assert torch.isfinite(reward).all()
    assert term != "non_finite" or not reward[expected].any()
    for group in (*obs.values(), *extras["final_obs"].values()):
        assert torch.isfinite(group).all()
    assert not env.step(zeros(env))[2].any()


def _below_the_table(env: Env, world: int) -> None:
    scene = env.cfg.scene
    under = scene.table_center[2] - scene.table_half[2] - 0.03
    env.sim.qpos[world, env.index.object_qpos[0] + 2] = under


def _not_a_number(env: Env, world: int) -> None:
    env.sim.qvel[world, env.index.object_qvel[0]] = math.nan


def _overflow(env: Env, world: int) -> None:
    env.sim.overflow[world] |= int(Overflow.NEFC)


@pytest.mark.parametrize(
    ("term", "world", "spoil"),
    [
        ("object_off_table", 0, _below_the_table),
        ("non_finite", 1, _not_a_number),
        ("overflow", 0, _overflow),
    ],
)
def test_end_by_what_happened(
    ended: Env, term: str, world: int, spoil: Callable[[Env, int], None]
) -> None:
    spoil(ended, world)
    assert_ends(ended, term, [world])


def test_statistics_are_those_of_the_episodes_that_ended(backend: str) -> None:
    cfg = randomized("reach", "so101", steps=4)
    env = on_shared_sim(backend, 3, cfg)
    env.read_statistics()
    env.reset(seed=0)
    moves = actions(env, 9)
    totals = torch.zeros(3)
    returns = []
    lengths = []
    for t, move in enumerate(moves):
        if t == 5:
            env.sim.qpos[0, env.index.object_qpos[0] + 1] += 1.0
        _, reward, terminated, truncated, _ = env.step(move)
        totals += reward.cpu()
        for k in (terminated | truncated).nonzero()[:, 0].tolist():
            returns.append(float(totals[k]))
            totals[k] = 0.0
            lengths.append({3: 4, 5: 2, 7: 4}[t])
    assert sorted(lengths) == [2, 4, 4, 4, 4, 4]
    read = env.read_statistics()
    assert read["episodes"] == 6
    assert read["steps"] == pytest.approx(22 / 6)
    assert read["return"] == pytest.approx(sum(returns) / 6, rel=1e-5)
    parts = [value for name, value in read.items() if name.startswith("reward/")]
    assert len(parts) == len(cfg.reward)
    assert sum(parts) == pytest.approx(read["return"], rel=1e-5)
    assert read["termination/time_out"] == pytest.approx(5 / 6)
    assert read["termination/object_off_table"] == pytest.approx(1 / 6)
    assert read["success"] == 0.0
    assert env.read_statistics() == {"episodes": 0.0}
