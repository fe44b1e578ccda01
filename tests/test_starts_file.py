"""Starts files: the same worlds again, on both backends, and one line for whatever is wrong with a
file.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from environments import at_double_speed, configure, mask_of, on_shared_sim

from mjstack.cli import run
from mjstack.config.schema import Config
from mjstack.envs import Env
from mjstack.errors import ArgumentError, ConfigError
from mjstack.mdp.starts.starts_file import _yaw, write_starts

N = 4
Rows = list[dict[str, str]]


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


def rows_of(path: Path) -> Rows:
    with path.open() as file:
        return list(csv.DictReader(file))


def write_rows(path: Path, rows: Rows) -> Path:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return path


def plain_rows(cfg: Config, n: int = N) -> Rows:
    """Worlds with the cubes near their places, as a person would write them."""
    (red_x, red_y), (blue_x, blue_y) = cfg.scene.objects["red"].xy, cfg.scene.objects["blue"].xy
    return [
        {
            "world": str(w),
            "red_x_m": str(red_x),
            "red_y_m": f"{red_y + 0.001 * w:.3f}",
            "red_yaw_rad": "0",
            "blue_x_m": str(blue_x),
            "blue_y_m": str(blue_y),
            "blue_yaw_rad": "-2.5",
        }
        for w in range(n)
    ]


@pytest.mark.full
@pytest.mark.parametrize("reset", ["randomized", "jitter"])
def test_what_was_written_starts_alike_to_the_last_float32_digit(
    backend: str, robot: str, reset: str, tmp_path: Path
) -> None:
    for seed in range(2):
        env = started(backend, configure(f"reset={reset}", robot=robot), seed)
        before = state(env)
        write_starts(env, tmp_path / "worlds.csv")
        env = started(backend, from_file(tmp_path / "worlds.csv", robot=robot), seed=99)
        after = state(env)
        for name in before:
            assert torch.equal(before[name], after[name]), (seed, name)
        assert not torch.equal(before["qpos"][0], before["qpos"][1])
        if backend != "native":  # whose float64 angle may differ in the last of 16 digits
            write_starts(env, tmp_path / "again.csv")
            assert (tmp_path / "again.csv").read_text() == (tmp_path / "worlds.csv").read_text()


def test_one_file_gives_both_backends_the_same_worlds(robot: str, tmp_path: Path) -> None:
    write_starts(
        started("mjwarp", configure("reset=randomized", robot=robot)), tmp_path / "worlds.csv"
    )
    cfg = from_file(tmp_path / "worlds.csv", robot=robot)
    native = state(started("native", cfg))
    warp = state(started("mjwarp", cfg))
    for name in native:
        torch.testing.assert_close(native[name], warp[name], rtol=3e-7, atol=0.0, msg=name)


def test_the_columns_say_what_is_in_the_worlds(robot: str, tmp_path: Path) -> None:
    env = started("native", configure("reset=randomized", robot=robot))
    write_starts(env, tmp_path / "worlds.csv")
    rows = rows_of(tmp_path / "worlds.csv")
    m = env.sim.model
    assert [row["world"] for row in rows] == ["0", "1", "2", "3"]
    assert ("grip_friction" in rows[0]) is (
        robot == "so101"
    )  # the reBot's pads have the cubes' priority
    for w, row in enumerate(rows):
        value = {name: float(text) for name, text in row.items()}
        for cube in ("red", "blue"):
            address = int(m.joint(f"{cube}").qposadr[0])
            pose = env.sim.qpos[w, address : address + 7].numpy()
            np.testing.assert_array_equal(pose[:2], [value[f"{cube}_x_m"], value[f"{cube}_y_m"]])
            turned = np.empty(4)
            mujoco.mju_axisAngle2Quat(turned, np.array([0.0, 0.0, 1.0]), value[f"{cube}_yaw_rad"])
            np.testing.assert_allclose(pose[3:], turned, atol=1e-12)
            assert env.sim.fields["body_mass"][w, m.body(f"{cube}").id] == value[f"{cube}_mass_kg"]
            assert (
                env.sim.fields["geom_friction"][w, m.geom(f"{cube}").id, 0]
                == value[f"{cube}_friction"]
            )
        for name in (*env.cfg.robot.arm_joints, *env.cfg.robot.gripper_joints):
            assert env.sim.qpos[w, m.joint(name).qposadr[0]] == value[f"joint_{name}"]
            gain = (
                env.sim.fields["actuator_gainprm"][w, m.actuator(name).id, 0]
                / m.actuator(name).gainprm[0]
            )
            assert gain == pytest.approx(value[f"gain_{name}"], rel=1e-15)


@pytest.mark.full
def test_absent_columns_leave_the_models_own(backend: str, robot: str, tmp_path: Path) -> None:
    cfg = from_file(tmp_path / "worlds.csv", robot=robot)
    rows = plain_rows(cfg)
    write_rows(tmp_path / "worlds.csv", rows)
    env = started(backend, cfg)
    for name, field in env.sim.fields.items():
        assert torch.equal(
            field, torch.from_numpy(getattr(env.sim.model, name)).to(field).expand_as(field)
        ), name
    start = torch.tensor(cfg.robot.start, dtype=torch.float64).to(env.sim.qpos)
    assert (env.sim.qpos[:, env.index.robot_qpos.tolist()] == start).all()
    assert (env.sim.ctrl[:, env.index.ctrl.tolist()] == start).all()
    for w in range(N):  # the world's own row, in whatever order they stand
        assert float(env.sim.qpos[w, env.index.object_qpos[0] + 1]) == pytest.approx(
            float(rows[w]["red_y_m"]), rel=1e-6
        )
    backwards = started(
        backend, from_file(write_rows(tmp_path / "b.csv", rows[::-1]), robot=robot)
    ).sim.qpos.clone()
    assert torch.equal(backwards, started(backend, cfg).sim.qpos)


def test_some_columns_of_a_kind_are_enough(backend: str, tmp_path: Path) -> None:
    cfg = from_file(tmp_path / "worlds.csv")
    rows = [
        row | {"red_mass_kg": "0.1", "gain_gripper": "1.05", "joint_gripper": "0.5"}
        for row in plain_rows(cfg)
    ]
    write_rows(tmp_path / "worlds.csv", rows)
    env = started(backend, cfg)
    m = env.sim.model
    red, blue = (m.body(name).id for name in ("red", "blue"))
    assert env.sim.fields["body_mass"][:, [red, blue]].cpu().numpy() == pytest.approx(
        np.tile([0.1, 0.08], (N, 1))
    )
    inertia = env.sim.fields["body_inertia"][0, red].cpu().numpy()
    assert inertia == pytest.approx(m.body_inertia[red] * 0.1 / 0.08, rel=1e-6)
    gains = env.sim.fields["actuator_gainprm"][0, :, 0].cpu().numpy() / m.actuator_gainprm[:, 0]
    assert gains == pytest.approx([1.0] * 5 + [1.05], rel=1e-6)
    assert (env.sim.qpos[:, int(m.joint("gripper").qposadr[0])] == 0.5).all()


def test_a_masked_reset_writes_its_worlds_alone(backend: str, tmp_path: Path) -> None:
    write_starts(started(backend, configure("reset=randomized")), tmp_path / "worlds.csv")
    env = started(backend, from_file(tmp_path / "worlds.csv"))
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
@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")
def test_a_captured_step_starts_worlds_from_the_file(tmp_path: Path) -> None:
    write_starts(started("mjwarp-cuda", configure("reset=randomized")), tmp_path / "worlds.csv")
    cfg = from_file(tmp_path / "worlds.csv", "task=reach", "action=joint_delta", "graph=require")
    cfg.termination["time_out"].params["steps"] = 3
    env = started("mjwarp-cuda", cfg)
    first = state(env)
    for _ in range(6):  # two episodes, the second one's end within a replayed graph
        env.step(torch.zeros((N, env.action_manager.action_dim), device=env.device))
    assert env.graph.captured
    for name, value in state(env).items():
        assert torch.equal(value, first[name]), name


def test_an_angle_is_found_for_every_float32_rotation() -> None:
    for scale in (1e-7, 1e-3, 0.05, 3.14159):
        yaw = (
            scale * (2.0 * torch.rand(2000, generator=torch.Generator().manual_seed(1)) - 1.0)
        ).double()
        w, z = (f(0.5 * yaw).float().numpy() for f in (torch.cos, torch.sin))
        found = _yaw(w, z)
        np.testing.assert_array_equal(np.cos(0.5 * found).astype(np.float32), w)
        np.testing.assert_array_equal(np.sin(0.5 * found).astype(np.float32), z)


def test_writing_is_refused_where_worlds_have_moved_on(tmp_path: Path) -> None:
    env = on_shared_sim("native", N, configure("reset=randomized"))
    with pytest.raises(ArgumentError, match="reset"):
        write_starts(env, tmp_path / "worlds.csv")
    env.reset(seed=0)
    with pytest.raises(FileNotFoundError, match="/no/"):
        write_starts(env, tmp_path / "no" / "worlds.csv")
    env.sim.qpos[1, env.index.object_qpos[0] + 2] += 0.1
    with pytest.raises(ArgumentError, match="red of world 1 off the table"):
        write_starts(env, tmp_path / "worlds.csv")
    env.reset(seed=0)
    env.step(torch.zeros((N, env.action_manager.action_dim)))
    with pytest.raises(ArgumentError, match="moved on"):
        write_starts(env, tmp_path / "worlds.csv")
    assert not list(tmp_path.iterdir())


def change(row_number: int, **cells: str) -> Callable[[Rows], Rows]:
    def edit(rows: Rows) -> Rows:
        return [row | (cells if w == row_number else {}) for w, row in enumerate(rows)]

    return edit


def column(name: str, value: str) -> Callable[[Rows], Rows]:
    return lambda rows: [row | {name: value} for row in rows]


BAD: dict[str, tuple[Callable[[Rows], Rows], str]] = {
    "missing column": (
        lambda rows: [{k: v for k, v in row.items() if k != "blue_y_m"} for row in rows],
        (
            ", line 1: expected columns world, red_x_m, red_y_m, red_yaw_rad, blue_x_m, blue_y_m,"
            " blue_yaw_rad; blue_y_m missing."
        ),
    ),
    "unknown column": (
        column("red_friktion", "1"),
        (
            ", line 1: expected columns separated by commas, each once; 'red_friktion' is wrong."
            " Did you mean 'red_friction'?"
        ),
    ),
    "nameless column": (
        column("", "1"),
        ", line 1: expected columns separated by commas, each once; '' is wrong.",
    ),
    "no number": (
        change(1, red_x_m="left"),
        ", line 3, column red_x_m: expected a finite number, 'left' is none.",
    ),
    "two lines in a cell": (
        change(1, red_x_m="le\nft"),
        ", line 4, column red_x_m: expected a finite number, 'le\\nft' is none.",
    ),
    "decimal comma": (
        change(1, red_x_m="0,33"),
        ", line 3, column red_x_m: expected a finite number, '0,33' is none.",
    ),
    "empty cell": (
        change(1, red_x_m=""),
        ", line 3, column red_x_m: expected a finite number, '' is none.",
    ),
    "not finite": (
        change(2, red_yaw_rad="nan"),
        ", line 4, column red_yaw_rad: expected a finite number, 'nan' is none.",
    ),
    "world twice": (
        change(2, world="1"),
        ", column world: expected worlds numbered from 0, a row each; 2 is missing.",
    ),
    "world missing": (
        change(3, world="7"),
        ", column world: expected worlds numbered from 0, a row each; 3 is missing.",
    ),
    "half a world": (
        change(3, world="0.5"),
        ", column world: expected worlds numbered from 0, a row each; 3 is missing.",
    ),
    "too few": (
        lambda rows: rows[:3],
        ": expected at least 4 worlds, it has 3. Add rows, or set nworld=3.",
    ),
    "none": (
        lambda rows: [],
        ", column world: expected worlds numbered from 0, a row each; 0 is missing.",
    ),
    "off the table": (
        change(1, red_x_m="0.2", red_yaw_rad="0.785"),
        ", line 3, column red_x_m: expected all of red above the table, 21.1 mm are not. Move it.",
    ),
    "over the edge": (
        change(0, blue_y_m="0.3"),
        ", line 2, column blue_y_m: expected all of blue above the table, 110.8 mm are not.",
    ),
    "touching": (
        change(3, blue_x_m="0.33", blue_y_m="-0.09", blue_yaw_rad="0.8"),
        (
            ", line 5, columns red_x_m, red_y_m, blue_x_m, blue_y_m: expected objects that touch"
            " nothing but the table; red and blue touch in world 3. Move them apart."
        ),
    ),
    "in the arm": (
        change(2, red_x_m="0.215", red_y_m="0"),
        ", line 4, columns red_x_m, red_y_m: expected objects that touch nothing but the table; ",
    ),
    "out of reach": (
        change(1, red_x_m="0.47", red_y_m="-0.2"),
        (
            ", line 3, columns red_x_m, red_y_m: expected a place that the arm reaches; with"
            " red at (0.470, -0.200) m"
        ),
    ),
    "too light": (
        column("red_mass_kg", "0.05"),
        ", line 2, column red_mass_kg: expected 0.056 to 0.104, it is 0.05.",
    ),
    "too slippery": (
        column("blue_friction", "0.7"),
        ", line 2, column blue_friction: expected 0.8 to 1.4, it is 0.7.",
    ),
    "too strong": (
        column("gain_elbow_flex", "1.2"),
        ", line 2, column gain_elbow_flex: expected 0.9 to 1.1, it is 1.2.",
    ),
    "beyond a joint": (
        column("joint_elbow_flex", "1.8"),
        ", line 2, column joint_elbow_flex: expected -1.69 to 1.69, it is 1.8.",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_file_is_refused_in_one_line(name: str, tmp_path: Path) -> None:
    edit, says = BAD[name]
    cfg = from_file(tmp_path / "worlds.csv")
    if name == "in the arm":  # with the jaw low over the table
        cfg.reset["starts"].params["pose"] = "home"
    good = plain_rows(cfg)
    write_rows(tmp_path / "worlds.csv", edit(good) or good[:1])
    if name == "none":
        text = (tmp_path / "worlds.csv").read_text()
        (tmp_path / "worlds.csv").write_text(text.splitlines()[0] + "\n\n")
    with pytest.raises(ConfigError) as caught:
        on_shared_sim("native", N, cfg)
    message = str(caught.value)
    assert message.startswith(f"starts={tmp_path}/worlds.csv{says}")
    assert "\n" not in message
    assert re.search(r"\. [A-Z].*\.$", message)  # what to do
    assert caught.value.exit_code == 2


HEADER = "world,red_x_m,red_y_m,red_yaw_rad,blue_x_m,blue_y_m,blue_yaw_rad\n"


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (
            b"",
            f", line 1: expected columns {', '.join(HEADER.strip().split(','))}; world, red_x_m,",
        ),
        (b"\xff\xfe\x00", "it cannot be read ('utf-8' codec can't decode"),
        (b"world,red_x_m,red_x_m\n", ", line 1: expected columns separated by commas, each once; "),
        (f"{HEADER}0,1\n".encode(), ", line 2: expected 7 cells as in the header, it has 2."),
        (
            f"{HEADER}0,0,33,-0,13,0,0,33,0,06,0\n".encode(),
            ", line 2: expected 7 cells as in the header, it has 11. Correct it; the decimal mark",
        ),
        (f'{HEADER}0,"1\n1,1\n'.encode(), ", line 3: expected 7 cells as in the header"),
        (HEADER.replace(",", ";").encode(), "columns separated by commas, each once; 'world;red_"),
        (
            HEADER.replace(",", "\t").encode(),
            "columns separated by commas, each once; 'world\\tred",
        ),
        (b"0,0.33,-0.13,0,0.33,0.06,0\n", "columns separated by commas, each once; '0' is wrong."),
        (None, "it cannot be read (No such file or directory). Name a file: starts=worlds.csv"),
    ],
)
def test_no_layout_file_at_all(content: bytes | None, says: str, tmp_path: Path) -> None:
    path = tmp_path / "worlds.csv"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ConfigError) as caught:
        on_shared_sim("native", N, from_file(path))
    message = str(caught.value)
    assert message.startswith(f"starts={path}")
    assert says in message
    assert "\n" not in message


def test_a_file_that_the_term_alone_names_is_called_by_its_key(tmp_path: Path) -> None:
    cfg = from_file(tmp_path / "worlds.csv")
    cfg.starts = None
    with pytest.raises(
        ConfigError, match=r"^reset\.starts\.params\.path=.*/worlds\.csv: expected a CSV file"
    ):
        on_shared_sim("native", N, cfg)


def test_values_within_the_configured_ranges_alone(tmp_path: Path) -> None:
    cfg = from_file(tmp_path / "worlds.csv")
    write_rows(tmp_path / "worlds.csv", column("red_mass_kg", "0.05")(plain_rows(cfg)))
    cfg.reset["starts"].params["mass"] = [0.5, 1.5]
    env = started("native", cfg)
    assert float(env.sim.fields["body_mass"][0, env.index.bodies["red"]]) == 0.05


@pytest.mark.full
@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["starts=worlds.csv"], "Add reset=starts_file"),
        (["reset=starts_file"], "starts=null: expected a file with one row per world"),
        (
            ["reset=starts_file", "starts=worlds.csv", "nworld=5"],
            "at least 5 worlds, it has 4. Add rows, or set nworld=4",
        ),
    ],
)
def test_the_command_line_refuses_before_anything_is_written(
    args: list[str],
    says: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    write_rows(tmp_path / "worlds.csv", plain_rows(configure()))
    assert run([*args, "gates=[batch]", "sim=native"]) == 2
    err = capsys.readouterr().err
    assert says in err
    assert len(err.strip().splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["worlds.csv"]


@pytest.mark.full
def test_a_batch_plays_the_worlds_of_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write_rows(tmp_path / "worlds.csv", plain_rows(configure()))
    args = [
        "reset=starts_file",
        "starts=worlds.csv",
        "nworld=4",
        "sim=native",
        "gates=[batch]",
        *at_double_speed(),
        "hydra.run.dir=out",
    ]
    assert run(args) == 0
    assert "4 of 4 worlds succeeded" in capsys.readouterr().out
    record = np.load(next((tmp_path / "out").glob("worlds_seed0.npz")))
    assert len(np.unique(record["qpos"], axis=0)) == N
