"""Starts files: the same worlds again, on both backends, and one line for whatever is wrong with a
file.
"""

import re
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from compositions import refusal
from environments import configure, mask_of, on_cuda, on_shared_sim, quats, stack_starts

from mjstack.config.schema import Config
from mjstack.envs import Env
from mjstack.errors import ArgumentError, ConfigError
from mjstack.mdp.starts.starts_file import write_starts

N = 4
Starts = dict[str, np.ndarray]


def started(backend: str, cfg: Config, seed: int = 0) -> Env:
    env = on_shared_sim(backend, N, cfg)
    env.reset(seed=seed)
    return env


def state(env: Env) -> dict[str, torch.Tensor]:
    """Everything that a start consists of, as float32."""
    out = {name: getattr(env.sim, name) for name in ("qpos", "qvel", "ctrl")}
    out |= {f"fields.{name}": field for name, field in env.sim.fields.items()}
    return {name: value.cpu().float().clone() for name, value in out.items()}


def from_file(path: Path, *overrides: str, robot: str = "so101") -> Config:
    cfg = configure("reset=starts_file", *overrides, robot=robot)
    cfg.nworld = N
    cfg.starts = str(path)
    cfg.reset["starts"].params["path"] = str(path)
    return cfg


def plain_starts(cfg: Config, **others: np.ndarray) -> Starts:
    """Worlds with the cubes near their places, as a person would write them."""
    (red_x, red_y), (blue_x, blue_y) = cfg.scene.objects["red"].xy, cfg.scene.objects["blue"].xy
    red = [(red_x, red_y + 0.001 * w, 0.0) for w in range(N)]
    return stack_starts(red, [(blue_x, blue_y, -2.5)] * N, **others)


@pytest.mark.full
@pytest.mark.parametrize("reset", ["randomized", "jitter"])
def test_what_was_written_starts_alike_to_the_last_float32_digit(
    backend: str, robot: str, reset: str, tmp_path: Path
) -> None:
    for seed in range(2):
        env = started(backend, configure(f"reset={reset}", robot=robot), seed)
        before = state(env)
        write_starts(env, tmp_path / "worlds.npz")
        env = started(backend, from_file(tmp_path / "worlds.npz", robot=robot), seed=99)
        after = state(env)
        for name in before:
            assert torch.equal(before[name], after[name]), (seed, name)
        assert not torch.equal(before["qpos"][0], before["qpos"][1])
        write_starts(env, tmp_path / "again.npz")
        assert (tmp_path / "again.npz").read_bytes() == (tmp_path / "worlds.npz").read_bytes()


def test_one_file_gives_both_backends_the_same_worlds(robot: str, tmp_path: Path) -> None:
    env = started("mjwarp", configure("reset=randomized", robot=robot))
    write_starts(env, tmp_path / "worlds.npz")
    cfg = from_file(tmp_path / "worlds.npz", robot=robot)
    native = state(started("native", cfg))
    warp = state(started("mjwarp", cfg))
    for name in native:
        torch.testing.assert_close(native[name], warp[name], rtol=3e-7, atol=0.0, msg=name)


def test_the_arrays_have_what_is_in_the_worlds(robot: str, tmp_path: Path) -> None:
    env = started("native", configure("reset=randomized", robot=robot))
    write_starts(env, tmp_path / "worlds.npz")
    with np.load(tmp_path / "worlds.npz") as file:
        starts = dict(file)
    m = env.sim.model
    fields = {name: field.numpy() for name, field in env.sim.fields.items()}
    assert {array.dtype for array in starts.values()} == {np.dtype(np.float64)}
    # the reBot's pads have the cubes' priority
    assert ("grip_friction" in starts) is (robot == "so101")
    for cube in ("red", "blue"):
        address = int(m.joint(cube).qposadr[0])
        pose = env.sim.qpos[:, address : address + 7].numpy()
        np.testing.assert_array_equal(starts[f"{cube}_xy"], pose[:, :2])
        np.testing.assert_array_equal(starts[f"{cube}_quat"], pose[:, 3:])
        mass = fields["body_mass"][:, m.body(cube).id]
        np.testing.assert_array_equal(starts[f"{cube}_mass_kg"], mass)
        friction = fields["geom_friction"][:, m.geom(cube).id, 0]
        np.testing.assert_array_equal(starts[f"{cube}_friction"], friction)
    for name in env.cfg.robot.joints:
        joint = env.sim.qpos[:, m.joint(name).qposadr[0]].numpy()
        np.testing.assert_array_equal(starts[f"joint_{name}"], joint)
        servo = m.actuator(name)
        gain = fields["actuator_gainprm"][:, servo.id, 0] / servo.gainprm[0]
        np.testing.assert_allclose(starts[f"gain_{name}"], gain, rtol=1e-15)


@pytest.mark.full
def test_absent_arrays_leave_the_models_own(backend: str, robot: str, tmp_path: Path) -> None:
    cfg = from_file(tmp_path / "worlds.npz", robot=robot)
    starts = plain_starts(cfg)
    np.savez(tmp_path / "worlds.npz", **starts)
    env = started(backend, cfg)
    for name, field in env.sim.fields.items():
        nominal = torch.from_numpy(getattr(env.sim.model, name)).to(field)
        assert torch.equal(field, nominal.expand_as(field)), name
    start = torch.tensor(cfg.robot.start, dtype=torch.float64).to(env.sim.qpos)
    assert (env.sim.qpos[:, env.index.robot_qpos.tolist()] == start).all()
    assert (env.sim.ctrl[:, env.index.ctrl.tolist()] == start).all()
    y = env.sim.qpos[:, env.index.object_qpos[0] + 1].cpu().numpy()
    assert y == pytest.approx(starts["red_xy"][:, 1], rel=1e-6)  # each world's own row


def test_some_arrays_of_a_kind_are_enough(backend: str, tmp_path: Path) -> None:
    cfg = from_file(tmp_path / "worlds.npz")
    values = {"red_mass_kg": 0.1, "gain_gripper": 1.05, "joint_gripper": 0.5}
    others = {name: np.full(N, value, np.float32) for name, value in values.items()}
    np.savez(tmp_path / "worlds.npz", **plain_starts(cfg, **others))
    env = started(backend, cfg)
    m = env.sim.model
    red, blue = (m.body(name).id for name in ("red", "blue"))
    mass = env.sim.fields["body_mass"][:, [red, blue]].cpu().numpy()
    assert mass == pytest.approx(np.tile([0.1, 0.08], (N, 1)))
    inertia = env.sim.fields["body_inertia"][0, red].cpu().numpy()
    assert inertia == pytest.approx(m.body_inertia[red] * 0.1 / 0.08, rel=1e-6)
    gains = env.sim.fields["actuator_gainprm"][0, :, 0].cpu().numpy() / m.actuator_gainprm[:, 0]
    assert gains == pytest.approx([1.0] * 5 + [1.05], rel=1e-6)
    assert (env.sim.qpos[:, int(m.joint("gripper").qposadr[0])] == 0.5).all()


def test_a_masked_reset_writes_its_worlds_alone(backend: str, tmp_path: Path) -> None:
    write_starts(started(backend, configure("reset=randomized")), tmp_path / "worlds.npz")
    env = started(backend, from_file(tmp_path / "worlds.npz"))
    first = state(env)
    for view in (*env.sim.fields.values(), env.sim.qpos, env.sim.ctrl):
        view *= 1.01
    moved = state(env)
    env.reset(mask=mask_of(env, 2))
    now = state(env)
    for name in now:
        assert torch.equal(now[name][[0, 1, 3]], moved[name][[0, 1, 3]]), name
    for name in ("qpos", "ctrl", "fields.actuator_biasprm"):
        assert torch.equal(now[name][2], first[name][2]), name


@pytest.mark.full
@on_cuda
def test_a_captured_step_starts_worlds_from_the_file(tmp_path: Path) -> None:
    write_starts(started("mjwarp-cuda", configure("reset=randomized")), tmp_path / "worlds.npz")
    cfg = from_file(tmp_path / "worlds.npz", "task=reach", "action=joint_delta", "graph=require")
    cfg.termination["time_out"].params["steps"] = 3
    env = started("mjwarp-cuda", cfg)
    first = state(env)
    for _ in range(6):  # two episodes, the second one's end within a replayed graph
        env.step(torch.zeros((N, env.action_manager.action_dim), device=env.device))
    assert env.graph.captured
    for name, value in state(env).items():
        assert torch.equal(value, first[name]), name


def test_writing_is_refused_where_worlds_have_moved_on(tmp_path: Path) -> None:
    env = on_shared_sim("native", N, configure("reset=randomized"))
    with pytest.raises(ArgumentError, match="reset"):
        write_starts(env, tmp_path / "worlds.npz")
    env.reset(seed=0)
    with pytest.raises(FileNotFoundError, match="/no/"):
        write_starts(env, tmp_path / "no" / "worlds.npz")
    env.sim.qpos[1, env.index.object_qpos[0] + 2] += 0.1
    with pytest.raises(ArgumentError, match="red of world 1 off the table"):
        write_starts(env, tmp_path / "worlds.npz")
    env.reset(seed=0)
    env.step(torch.zeros((N, env.action_manager.action_dim)))
    with pytest.raises(ArgumentError, match="moved on"):
        write_starts(env, tmp_path / "worlds.npz")
    assert not list(tmp_path.iterdir())


UPRIGHT = "expected w, 0, 0, z of length 1, a rotation about z, it is"
TOUCH = "expected objects that touch nothing but the table;"
# The message, by arrays or rows that take the place of good ones
BAD: dict[str, dict[str, Any]] = {
    ": expected arrays red_xy, red_quat, blue_xy, blue_quat; blue_xy missing. Add the missing": {
        "blue_xy": None
    },
    ": expected known names of arrays; 'red_friktion' is none. Did you mean 'red_friction'?": {
        "red_friktion": np.ones(N)
    },
    ", red_xy: expected numbers of shape (4, 2), not float64 of shape (4, 3).": {
        "red_xy": np.zeros((N, 3))
    },
    ", world 2, red_xy: expected 0.19 to 0.51, it is nan. Correct it;": {"red_xy": {2: np.nan}},
    f", world 1, red_quat: {UPRIGHT} [0.8 0.6": {"red_quat": {1: [0.8, 0.6, 0.0, 0.0]}},
    ", world 1, red_xy: expected all of red above the table, 21.1 mm are not. Move it.": {
        "red_xy": {1: [0.2, -0.13]},
        "red_quat": {1: quats(np.array(0.785))},
    },
    f", world 3, red_xy, blue_xy: {TOUCH} red and blue touch. Move them apart.": {
        "blue_xy": {3: [0.33, -0.11]}
    },
    # With the jaw low over the table
    f", world 2, red_xy: {TOUCH} ": {"red_xy": {2: [0.215, 0.0]}, "pose": "home"},
    ", world 1, red_xy: expected a place that the arm reaches; with red at (0.470, -0.200) m": {
        "red_xy": {1: [0.47, -0.2]}
    },
    ", world 1, red_mass_kg: expected 0.056 to 0.104, it is 0.05.": {
        "red_mass_kg": [0.08, 0.05, 0.08, 0.08]
    },
}


def refusal_of(cfg: Config) -> str:
    """The one line that an environment is refused with."""
    message = refusal(lambda: on_shared_sim("native", N, cfg), kind=ConfigError)
    assert re.search(r"\. [A-Z].*[.?]$", message)  # what to do
    return message


@pytest.mark.parametrize("message", BAD)
def test_a_bad_file_is_refused_in_one_line(message: str) -> None:
    with tempfile.TemporaryDirectory() as folder:  # its path is short enough for a line
        check_bad_file(message, Path(folder) / "worlds.npz")


def check_bad_file(message: str, path: Path) -> None:
    cfg = from_file(path)
    changes = dict(BAD[message])
    cfg.reset["starts"].params["pose"] = changes.pop("pose", "start")
    starts = plain_starts(cfg)
    for name, values in changes.items():
        if isinstance(values, dict):
            for world, row in values.items():
                starts[name][world] = row
        else:
            starts[name] = values
    np.savez(path, **{name: values for name, values in starts.items() if values is not None})
    assert refusal_of(cfg).startswith(f"starts={path}{message}")


@pytest.mark.parametrize("rows", [0, 3])
def test_a_file_with_too_few_rows_is_refused(rows: int, tmp_path: Path) -> None:
    path = tmp_path / "worlds.npz"
    cfg = from_file(path)
    np.savez(path, **{name: values[:rows] for name, values in plain_starts(cfg).items()})
    fix = "Add rows, or set nworld=3." if rows else "Add rows."
    assert refusal_of(cfg) == f"starts={path}: expected at least 4 worlds, it has {rows}. {fix}"


def test_no_starts_file_at_all(tmp_path: Path) -> None:
    """Damaged, of another format, without numbers, missing, or of version 0.1."""
    path = tmp_path / "worlds.npz"
    cfg = from_file(path)
    missing = "it cannot be read (No such file or directory). Name a file: starts=worlds.npz"
    assert missing in refusal_of(cfg)
    np.savez(path, **plain_starts(cfg, red_mass_kg=np.array([{}] * N)))  # a pickle inside
    whole = path.read_bytes()
    for content in (whole, whole[:200], b"", b"world,red_x_m\n"):
        path.write_bytes(content)
        assert "it cannot be read (damaged, or of another format)" in refusal_of(cfg)
    np.savez(path)
    assert ": expected arrays red_xy, " in refusal_of(cfg)
    cfg = from_file(tmp_path / "starts_seed0.csv")
    assert refusal_of(cfg).endswith(
        "expected an npz file; CSV is of version 0.1 and is not read any more. Make a new one with"
        " write_starts or numpy.savez."
    )


def test_a_file_that_the_term_alone_names_is_called_by_its_key(tmp_path: Path) -> None:
    cfg = from_file(tmp_path / "worlds.npz")
    cfg.starts = None
    key = "reset.starts.params.path"
    assert refusal_of(cfg).startswith(f"{key}={tmp_path}/worlds.npz: expected an npz file")


def test_values_within_the_configured_ranges_alone(tmp_path: Path) -> None:
    cfg = from_file(tmp_path / "worlds.npz")
    np.savez(tmp_path / "worlds.npz", **plain_starts(cfg, red_mass_kg=np.full(N, 0.05)))
    cfg.reset["starts"].params["mass"] = [0.5, 1.5]
    env = started("native", cfg)
    assert float(env.sim.fields["body_mass"][0, env.index.bodies["red"]]) == 0.05
