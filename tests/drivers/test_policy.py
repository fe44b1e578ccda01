"""A policy's folder and its driver: what is saved comes back, what does not fit is refused in one
line, and every gate takes a policy.
"""

import importlib.metadata
import json
import os
import shutil
from collections.abc import Callable
from functools import reduce
from hashlib import sha256
from operator import getitem
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from compositions import load_config, refusal
from environments import Patch, configure, on_new_sim, one_second_episode
from policies import hold_above_red, make_policy, report, write_policy
from safetensors.torch import load, save

import mjstack
import mjstack.jobs.showing as showing
from mjstack.cli import run
from mjstack.config.load import extended_search_path
from mjstack.config.schema import ObservationTermCfg
from mjstack.drivers.policy import PolicyDriver
from mjstack.envs import Env, driven_config
from mjstack.episodes.recorder import Channels, Recorder, read_commands
from mjstack.episodes.rollout import rollout
from mjstack.errors import FolderError, MjstackError
from mjstack.jobs.gates import check_machine
from mjstack.policy import load_policy, save_policy
from mjstack.report.page import World

SHORT = one_second_episode()


def driven(nworld: int, *overrides: str, backend: str = "native") -> Env:
    """Started worlds of a driven episode."""
    cfg = driven_config(configure("reset=randomized", *overrides))
    env = on_new_sim(backend, nworld, cfg)
    env.reset(seed=3)
    return env


def play(env: Env, driver: PolicyDriver, steps: int) -> torch.Tensor:
    """The driver's commands, shape ``(steps, nworld, nu)``."""
    commands = []
    for _ in range(steps):
        command = driver.command()
        commands.append(command.clone())
        env.action_manager.process(command)
        env.advance()
    return torch.stack(commands)


def test_a_saved_policy_gives_the_same_bits(tmp_path: Path) -> None:
    policy = make_policy(configure())
    save_policy(tmp_path / "one", policy)
    loaded = load_policy(tmp_path / "one")
    seen = torch.randn(5, sum(policy.widths.values()))
    assert torch.equal(policy.network(seen), loaded.network(seen))
    for name in ("group", "observation", "widths", "execute", "config", "training"):
        assert getattr(loaded, name) == getattr(policy, name), name
    assert loaded.network.hidden == policy.network.hidden
    assert loaded.joints == configure().robot.joints
    assert {"mjstack", "mujoco", "torch"} == set(loaded.versions)


def test_a_checkout_that_is_not_installed_saves(tmp_path: Path, monkeypatch: Patch) -> None:
    def nothing(name: str) -> str:
        raise importlib.metadata.PackageNotFoundError(name)

    policy = make_policy(configure())
    monkeypatch.setattr(importlib.metadata, "distribution", nothing)
    save_policy(tmp_path, policy)
    assert load_policy(tmp_path).versions["mjstack"] == mjstack.__version__


def test_a_second_policy_replaces_the_first_at_once(tmp_path: Path, monkeypatch: Patch) -> None:
    """Whatever write fails, the folder still has the first policy."""
    import mjstack.policy.checkpoint as module

    first = make_policy(configure(), seed=1)
    save_policy(tmp_path, first)
    real = module.write_atomic
    for failing in (".safetensors", ".json"):

        def full(path: Path, content: bytes, failing: str = failing) -> None:
            if path.suffix == failing:
                raise OSError(28, "No space left on device")
            real(path, content)

        monkeypatch.setattr(module, "write_atomic", full)
        with pytest.raises(MjstackError, match=r"cannot be written \(No space left on device\)"):
            save_policy(tmp_path, make_policy(configure(), seed=2))
        assert len(list(tmp_path.iterdir())) == 2
        kept = load_policy(tmp_path).network.state_dict()
        assert all(torch.equal(kept[k], v) for k, v in first.network.state_dict().items())
    monkeypatch.setattr(module, "write_atomic", real)
    save_policy(tmp_path, make_policy(configure(), seed=2))
    assert len(list(tmp_path.iterdir())) == 2  # the first one's weights are gone


@pytest.mark.parametrize(("chunk", "execute"), [(6, 4), (2, 5), (1, 1)])
def test_answers_are_played_in_chunks(chunk: int, execute: int) -> None:
    """Against the network asked by hand, every ``execute`` steps; the last target of a shorter
    chunk holds.
    """
    env = driven(3)
    policy = make_policy(configure(), chunk=chunk, execute=execute)
    commands = play(env, PolicyDriver(env, policy), 11)

    again = on_new_sim("native", 3, driven_config(configure("reset=randomized")))
    again.reset(seed=3)
    probe = PolicyDriver(again, policy)
    for step in range(11):
        if step % execute == 0:
            observed = probe._observations.compute()["policy"]
            answer = policy.network(observed)
        wanted = answer[:, min(step % execute, chunk - 1)]
        torch.testing.assert_close(commands[step], wanted, rtol=0.0, atol=2e-6)
        again.action_manager.process(commands[step])
        again.advance()
    assert commands.std(0).max() > 1e-4  # it does something


def test_a_world_asks_anew_at_its_own_reset() -> None:
    env = driven(3)
    driver = PolicyDriver(env, make_policy(configure(), chunk=4, execute=4))
    first = play(env, driver, 6)
    mask = torch.tensor([False, True, False])
    env.episode.masked_fill_(mask, -1)
    env.reset(mask=mask)
    again = play(env, driver, 4)
    assert torch.equal(again[:4, 1], first[:4, 1])
    assert not torch.equal(again[:4, 0], first[:4, 0])


def test_a_history_is_that_of_the_environment() -> None:
    """Terms with a history: the driver's columns are those of an environment with the group."""
    cfg = configure("task=reach", "action=joint_absolute", "reset=randomized")
    env = on_new_sim("native", 4, cfg)
    env.reset(seed=1)
    policy = make_policy(cfg, execute=3)
    assert any(term.history > 1 for term in policy.observation.terms.values())
    driver = PolicyDriver(env, policy)
    for step in range(12):
        command = driver.command()
        assert torch.equal(driver._observed, env.observation_manager.groups["policy"]), step
        env.step(command.clone())
        if step == 5:
            env.reset(mask=torch.tensor([True, False, False, False]))


@pytest.mark.parametrize("nworld", [1, 7, 33])
def test_a_world_alone_gets_what_it_got_in_a_batch(nworld: int) -> None:
    """Bit for bit: job=replay plays one world of a batch."""
    policy = make_policy(configure())
    batch = driven(nworld)
    alone = on_new_sim("native", 1, driven_config(configure("reset=randomized")))
    alone.world.fill_(nworld - 1)
    alone.reset(seed=3)
    many = play(batch, PolicyDriver(batch, policy), 10)
    one = play(alone, PolicyDriver(alone, policy), 10)
    assert torch.equal(many[:, -1], one[:, 0])


def test_other_actions_are_refused() -> None:
    env = on_new_sim("native", 1, configure())
    with pytest.raises(MjstackError, match="action=joint_absolute"):
        PolicyDriver(env, make_policy(configure()))


MISFITS = [
    (["robot=rebot"], "here it is rebot: expected the same. Name a policy"),
    (["robot=rebot"], "was trained for this, or give robot=so101."),
    (["task=box"], "was trained with task.name=stack, and here it is box"),
    (["robot.home=[0,0,0.4,1.2,1.6,0.7]"], "was trained with robot.home=[0.0, 0.0, 0.473"),
    (["timing.command_delay=5"], "was trained with timing.command_delay=0"),
    (["timing.decimation=20", "task.control_hz=25"], "was trained with task.control_hz=50.0"),
    (["scene.objects.red.size=[0.021,0.021,0.021]"], "scene.objects.red.size=[0.022"),
]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_policy(tmp_path_factory.mktemp("whole") / "policy", configure())


@pytest.fixture
def folder(whole: Path, tmp_path: Path) -> Path:
    """A copy of a policy."""
    return Path(shutil.copytree(whole, tmp_path / "mine"))


def test_robot_task_and_cameras_follow_the_policy(tmp_path: Path) -> None:
    """They are those of its training, unless the command line chooses others."""
    seen = ["cameras=[wrist,front]", "robot=rebot", "task=reach"]
    cfg = configure(*seen, "observation=reach")
    policy = str(write_policy(tmp_path / "it=s [mine]", cfg))
    named = ["controller=policy", f"policy='{policy}'"]
    found = mjstack.load_config(named)
    assert (found.robot.name, found.task.name) == ("rebot", "reach")
    assert list(found.scene.cameras) == []  # this policy sees none

    path = Path(policy) / "policy.json"
    facts = json.loads(path.read_text())
    facts["observation"]["images"] = {"wrist": [8, 8], "front": [8, 8]}
    path.write_text(json.dumps(facts))
    assert list(mjstack.load_config(named).scene.cameras) == ["wrist", "front"]
    other = mjstack.load_config([*named, "cameras=top", "robot=so101", "task=stack"])
    assert list(other.scene.cameras) == ["top"]
    assert (other.robot.name, other.task.name) == ("so101", "stack")

    # What is no choice here, or no policy, chooses nothing: the check of the policy says so.
    for damage in ('{"config": [], "observation": {}}', "[" * 100_000, "", "\0"):
        path.write_text(damage)
        with extended_search_path(named, []) as composed:
            assert composed == named
    facts["config"]["task"]["name"] = "../task/reach"
    path.write_text(json.dumps(facts))
    found = mjstack.load_config(named)
    assert (found.robot.name, found.task.name) == ("rebot", "stack")


@pytest.mark.parametrize(
    ("overrides", "says"), MISFITS, ids=[" ".join(overrides) for overrides, _ in MISFITS]
)
def test_a_policy_of_something_else_is_refused(
    folder: Path, overrides: list[str], says: str
) -> None:
    assert_refused([*overrides], folder, says)


def assert_refused(overrides: list[str], folder: Path, says: str) -> None:
    """One line, before anything is written."""
    gates = ["controller=policy", f"policy={folder}", "gates=[baseline]"]
    refusal(lambda: check_machine(load_config([*gates, *overrides])), says)


def edit(update: Callable[[dict], object]) -> Callable[[Path], object]:
    """Change policy.json."""

    def apply(folder: Path) -> None:
        path = folder / "policy.json"
        facts = json.loads(path.read_text())
        update(facts)
        path.write_text(json.dumps(facts))

    return apply


def weights(folder: Path) -> Path:
    (path,) = folder.glob("*.safetensors")
    return path


def change(*keys: str, value: object) -> Callable[[Path], object]:
    """Give a value of policy.json another one."""
    return edit(lambda facts: reduce(getitem, keys[:-1], facts).update({keys[-1]: value}))


GRIPPER = "mjstack.mdp.action.Gripper"
TERM = ("observation", "terms", "joint_pos")
DAMAGED: dict[str, tuple[Callable[[Path], object], str]] = {
    "no file": (lambda f: (f / "policy.json").unlink(), "has no policy.json"),
    "no weights": (lambda f: weights(f).unlink(), "cannot be read (No such file or directory)"),
    "truncated weights": (
        lambda f: weights(f).write_bytes(weights(f).read_bytes()[:-100]),
        "its content is not that of policy.json",
    ),
    "truncated json": (
        lambda f: (f / "policy.json").write_text((f / "policy.json").read_text()[:200]),
        "cannot be read (JSONDecodeError",
    ),
    "another format": (change("format", value=7), "has format 7, expected 5, which mjstack"),
    "another network": (change("network", "hidden", value=[16]), "cannot be read"),
    "a key less": (edit(lambda d: d["config"]["robot"].pop("home")), "with robot.home=missing"),
    "a function that is gone": (
        change(*TERM, "func", value="mjstack.mdp.observation.nope"),
        "'nope' does not exist",
    ),
    "another action": (
        change("action", "terms", value={"grip": {"func": GRIPPER}}),
        "was trained with action.width=6, and here it is 1",
    ),
    "another object": (
        change("observation", "terms", "red_to_blue", "params", "a", value="green"),
        "its observation cannot be computed here: observation.policy.terms.red_to_blue",
    ),
    "another width": (
        change(*TERM, "func", value="mjstack.mdp.observation.grasp_point_pos"),
        "observation.policy.terms.joint_pos.width=6, and here it is 3",
    ),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_a_damaged_policy_is_refused(folder: Path, case: str) -> None:
    damage, says = DAMAGED[case]
    damage(folder)
    assert_refused([], folder, says)


def put_weights(content: bytes | Callable[[bytes], bytes]) -> Callable[[Path], None]:
    """Other weights, with a policy.json that names them."""

    def apply(folder: Path) -> None:
        path = weights(folder)
        other = content(path.read_bytes()) if callable(content) else content
        digest = sha256(other).hexdigest()
        path.unlink()
        (folder / f"weights-{digest[:12]}.safetensors").write_bytes(other)
        change("weights_sha256", value=digest)(folder)

    return apply


def change_tensors(change: Callable[[torch.Tensor], torch.Tensor]) -> Callable[[Path], None]:
    return put_weights(lambda b: save({k: change(v) for k, v in load(b).items()}))


def lead_out(name: str) -> Callable[[Path], None]:
    """Move a file of the folder beside it, and leave a link."""

    def apply(folder: Path) -> None:
        (path,) = folder.glob(name)
        outside = folder.parent / path.name
        path.rename(outside)
        path.symlink_to(outside)

    return apply


def test_a_term_without_numbers(tmp_path: Path) -> None:
    """The scene has no places, for example."""
    cfg = configure()
    func = "mjstack.mdp.observation.goals"
    cfg.observation["policy"].terms["goals"] = ObservationTermCfg(func)
    assert load_policy(write_policy(tmp_path / "mine", cfg)).widths["goals"] == 0


def sparse(folder: Path) -> None:
    """A terabyte of weights that takes no room."""
    os.truncate(weights(folder), 2**40)


HUGE = [1_000_000] * 8
STRANGE: dict[str, tuple[Callable[[Path], object], str]] = {
    "deep": (lambda f: (f / "policy.json").write_text("[" * 100_000), "(RecursionError"),
    "large": (lambda f: os.truncate(f / "policy.json", 2**40), "more than 4194304"),
    "a fraction": (change("action", "execute", value=4.0), "execute is 4.0, not"),
    "huge": (change("network", "hidden", value=HUGE), "cannot be read (Runtime"),
    "many layers": (change("network", "hidden", value=[1] * 9999), "more than 5000 values"),
    "a width": (
        change("observation", "widths", "joint_pos", value=True),
        "cannot be read (RuntimeError",
    ),
    "other terms": (
        change("observation", "widths", value={"x": 24}),
        "observation, action and config do not fit together",
    ),
    "a path": (change("weights_sha256", value="/../x"), "is no SHA-256"),
    "long header": (put_weights(b"\xff" * 7 + b"\x7f{}"), "its header has more than"),
    "cut": (put_weights(lambda b: b[:-4]), "cannot be read (SafetensorError"),
    "not finite": (change_tensors(lambda v: v / 0.0), "than finite ones in float32"),
    "other shapes": (change_tensors(lambda v: v[..., :1].clone()), "cannot be read (RuntimeError"),
    "sparse": (sparse, "has 1099511627776 bytes, more than"),
    "link": (lead_out("policy.json"), "it is a link that leads out of the folder"),
    "linked weights": (lead_out("*.safetensors"), "it is a link that leads out of the folder"),
}


@pytest.mark.parametrize("case", STRANGE)
def test_a_strangers_policy_is_refused_in_one_line(folder: Path, case: str) -> None:
    """Before its sizes take memory."""
    damage, says = STRANGE[case]
    damage(folder)
    refusal(lambda: load_policy(folder), says, kind=FolderError)


def test_a_policy_needs_its_controller(folder: Path) -> None:
    with pytest.raises(MjstackError, match="Add controller=policy"):
        load_config([f"policy={folder}"])
    with pytest.raises(MjstackError, match="policy=null: expected the folder of a trained policy"):
        check_machine(load_config(["controller=policy", "gates=[baseline]"]))


@pytest.fixture(scope="module")
def played(whole: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The folders of a run of the gates, and of its policy, which fails. The last test of them
    writes the policy anew.
    """
    home = tmp_path_factory.mktemp("played")
    policy = Path(shutil.copytree(whole, home / "policy"))
    driven = ["controller=policy", f"policy={policy}", "sim=native", "nworld=5"]
    gates = ["gates=[baseline,batch,throughput,success]", "gate.success.seeds=1"]
    gates.append("gate.throughput.measurements=[physics,episode]")
    short = [*SHORT, "task.episode_steps=60", "web.episode=false"]
    assert run([*short, *driven, *gates, f"hydra.run.dir={home}/run"]) == 1
    return home / "run", policy


@pytest.mark.full
def test_every_gate_takes_a_policy(played: tuple[Path, Path], tmp_path: Path) -> None:
    """A policy that fails is judged in every world, and a replay ends bit for bit where it did."""
    out, _ = played
    gates = report(out)
    assert {"baseline", "batch", "throughput", "success"} <= set(gates)
    assert "not lifted" in gates["baseline"]["reason"]
    assert "waypoint_error_m" not in gates["baseline"]["metrics"]
    for gate in ("batch", "success"):
        assert gates[gate]["metrics"]["episodes"] == 5
        assert gates[gate]["metrics"]["failed.LIFT"] == 5
    assert "no figure" in gates["throughput"]["reason"]  # an episode that fails has no speed
    assert np.load(out / "success_seed0.npz")["phase_names"].size == 0
    again = tmp_path / "replay"
    assert run(["job=replay", f"run={out}", "world=success:2", f"hydra.run.dir={again}"]) == 1
    assert "bit for bit where it did" in report(again)["replay_native"]["reason"]


@pytest.mark.full
def test_a_policy_that_succeeds_is_timed_and_shown(tmp_path: Path, monkeypatch: Patch) -> None:
    """The episode has a figure, and the video shows the policy's world of *baseline*."""
    shown: list[np.ndarray] = []

    def save(path: Path, model: mujoco.MjModel, worlds: list[World], step_dt: float) -> None:
        path.touch()
        shown.append(np.stack([world.qpos for world in worlds]))

    monkeypatch.setattr(showing.picture, "save_video", save)
    policy = hold_above_red(tmp_path / "policy")
    out = tmp_path / "run"
    drive = ["task=reach", "reset=jitter", "controller=policy", f"policy={policy}"]
    gates = ["gates=[baseline,batch,throughput]", "gate.throughput.measurements=[episode]"]
    where = ["sim=native", "nworld=2", "web.episode=false", f"hydra.run.dir={out}"]
    assert run([*drive, *gates, *where, "gate.throughput.episodes=2", "video=true"]) == 0
    found = report(out)
    assert {found[gate]["status"] for gate in ("baseline", "batch", "throughput")} == {"pass"}
    figures = found["throughput"]["metrics"]
    assert figures["episode.succeeded"] == 2
    assert figures["episode.seconds.median"] > 0.0
    assert "episode: " in found["throughput"]["reason"]
    assert (out / "episode.mp4").exists()
    (qpos,) = shown
    assert qpos.shape[:2] == (1, configure("task=reach").task.episode_steps)
    apart = np.abs(qpos[0, -1, :6] - load_policy(policy).network.action_mean.numpy())
    assert apart.max() < 0.05


@pytest.mark.full
def test_mjwarp_plays_a_policy_as_native_does(folder: Path, tmp_path: Path) -> None:
    """From states of its own episode, which has no phases; and its buffers are sized."""
    out = tmp_path / "run"
    policy = ["controller=policy", f"policy={folder}", "gates=[parity,capacity]"]
    short = ["task.episode_steps=60", "task.check.window=5", "gate.capacity.random_steps=20"]
    mjwarp = ["sim=mjwarp", "sim.device=cpu", "nworld=2", f"hydra.run.dir={out}"]
    assert run([*policy, *short, *mjwarp]) == 1
    gates = report(out)
    assert gates["capacity"]["status"] == "pass"
    compared = {name.partition(".")[0] for name in gates["parity"]["metrics"] if ".step50." in name}
    assert compared == {"third_1", "third_2", "third_3"}
    carried = "red not carried (carry_m 0 of 0.05, carry_steps 0 of 10)"
    words = f"failed: red not lifted, {carried}, not stacked (xy_err 0 of 5, dz 0 of 5)"
    assert gates["parity"]["reason"] == words


@pytest.mark.full
def test_a_replay_names_a_policy_that_was_written_anew(
    played: tuple[Path, Path], tmp_path: Path
) -> None:
    out, policy = played
    write_policy(policy, configure(), seed=9)
    run(["job=replay", f"run={out}", "world=batch:3", f"hydra.run.dir={tmp_path}/again"])
    assert any(
        "the policy was " in line for line in report(tmp_path / "again")["replay_native"]["details"]
    )


@pytest.mark.full
def test_a_policy_collects(folder: Path, tmp_path: Path) -> None:
    """Its episodes become a dataset; without a success they are kept on request."""
    pytest.importorskip("pyarrow")
    out = tmp_path / "data"
    collect = ["job=collect", "controller=policy", f"policy={folder}", "job.episodes=2"]
    options = ["task.episode_steps=60", "sim=native", "nworld=2", "job.keep_failures=true"]
    assert run([*SHORT, *collect, *options, f"hydra.run.dir={out}"]) == 0
    assert "the policy succeeded in 0 of 2" in report(out)["collect"]["reason"]


def test_the_rollout_plays_a_policy(backend: str) -> None:
    """Its targets are native's as long as the states are: here in the first steps. On CUDA they
    come from the captured step.
    """
    policy = make_policy(configure(), chunk=4, execute=3)
    native = driven(3)
    wanted = play(native, PolicyDriver(native, policy), 8)
    env = driven(3, "graph=require", backend=backend)
    recorder = Recorder(Channels(read_commands))
    timing = rollout(env, PolicyDriver(env, policy), [recorder], steps=8)
    torch.testing.assert_close(recorder.rows["ctrl"][:8].cpu(), wanted, rtol=0.0, atol=1e-4)
    assert timing.captured == (backend == "mjwarp-cuda")
