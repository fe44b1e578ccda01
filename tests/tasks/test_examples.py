"""The examples, each from its own folder: the gates pass, and a check fails what it must."""

import json
import os
from functools import cache
from pathlib import Path

import pytest
import torch
from compositions import load_config

from mjstack.cli import run
from mjstack.config.schema import Config
from mjstack.drivers.driver import Driver
from mjstack.episodes.rollout import play_episode
from mjstack.episodes.stage import Stage
from mjstack.mdp.geometry import place_xy

EXAMPLES = Path(__file__).parents[2] / "examples"
FRANKA = Path(os.environ.get("MENAGERIE_ROOT", "/nowhere")) / "franka_emika_panda"
needs_franka = pytest.mark.skipif(
    not FRANKA.is_dir(), reason="MENAGERIE_ROOT has no franka_emika_panda"
)


@cache
def arguments(example: str, robot: str) -> tuple[str, ...]:
    """A command line on native MuJoCo, with phases of half their time; but reBot's servos are too
    slow to meet a slot or a hole in that.
    """
    folder = EXAMPLES / example / "conf"
    task = "stack" if example in ("scara", "panda") else example
    model = "menagerie" if example == "panda" else "builtin"
    chosen = (f"robot={robot}", f"task={task}", f"model={model}")
    cfg = load_config(chosen, config_dir=folder)
    speed = 1 if example in ("slot", "peg") and robot == "rebot" else 2
    return (
        f"--config-dir={folder}",
        *chosen,
        "sim=native",
        f"task.episode_steps={cfg.task.episode_steps // speed}",
        *(
            f"controller.phases.{name}.seconds={phase.seconds / speed}"
            for name, phase in cfg.controller.phases.items()
        ),
    )


def configure(example: str, robot: str, *overrides: str) -> Config:
    flag, *others = arguments(example, robot)
    return load_config([*others, *overrides], config_dir=flag.removeprefix("--config-dir="))


def play_gates(example: str, robot: str, folder: Path, *overrides: str) -> dict[str, dict]:
    """The gates' results by name, all of which must have passed."""
    args = [*arguments(example, robot), "web.episode=false", f"hydra.run.dir={folder}"]
    assert run([*args, *overrides]) == 0
    gates = json.loads((folder / "report.json").read_text())["gates"]
    assert {gate["status"] for gate in gates} == {"pass"}
    return {gate["name"]: gate for gate in gates}


@pytest.mark.parametrize(
    ("example", "robot", "gates"),
    [
        pytest.param("tower", "so101", "batch", marks=pytest.mark.full),
        pytest.param("tower", "rebot", "baseline,parity,batch", marks=pytest.mark.full),
        ("push", "so101", "baseline,batch"),
        pytest.param("push", "rebot", "baseline,parity,batch", marks=pytest.mark.full),
        pytest.param("scara", "scara", "baseline,batch,success", marks=pytest.mark.full),
        pytest.param("slot", "so101", "batch", marks=pytest.mark.full),
        pytest.param("slot", "rebot", "baseline,batch", marks=pytest.mark.full),
        pytest.param("peg", "so101", "batch", marks=pytest.mark.full),
        pytest.param("peg", "rebot", "baseline,batch", marks=pytest.mark.full),
        pytest.param("drawer", "so101", "baseline,batch,success", marks=pytest.mark.full),
        pytest.param("drawer", "rebot", "baseline,parity,batch,success", marks=pytest.mark.full),
        pytest.param("panda", "panda", "baseline,batch", marks=needs_franka),
    ],
)
def test_the_gates_pass(example: str, robot: str, gates: str, tmp_path: Path) -> None:
    results = play_gates(example, robot, tmp_path, "nworld=2", f"gates=[{gates}]")
    assert results["batch"]["metrics"]["succeeded"] == 2
    if "success" in results:
        assert results["success"]["metrics"]["succeeded"] == 2
    if "parity" in results and example == "push":
        metrics = results["parity"]["metrics"]
        compared = {name.partition(".")[0] for name in metrics if ".step1." in name}
        own = {"in_motion", "swung", "twisted"}
        assert compared == {"before_contact", "in_contact", "at_end", *own}
    if "parity" in results and example == "drawer":
        assert 0.0 < results["parity"]["metrics"]["final.cabinet_drawer.position_m"] < 0.002
        assert "drawer ends 0." in results["parity"]["reason"]


@pytest.mark.full
def test_a_dataset_and_a_replay(tmp_path: Path) -> None:
    flags = arguments("push", "so101")
    out = tmp_path / "out"
    command = [*flags, "job=collect", "job.episodes=2", "nworld=2", f"job.folder={tmp_path / 'd'}"]
    assert run([*command, f"hydra.run.dir={tmp_path / 'collect'}"]) == 0
    info = json.loads((tmp_path / "d" / "dataset" / "meta" / "info.json").read_text())
    assert info["total_episodes"] == 2
    play_gates("push", "so101", out, "nworld=2", "gates=[batch]")
    replay = [flags[0], "job=replay", f"run={out}", "world=1"]
    assert run([*replay, f"hydra.run.dir={tmp_path / 'replay'}"]) == 0


@pytest.mark.parametrize(
    ("example", "threshold", "rules"),
    [
        ("push", "within=1e-6", ["AT_GOAL"]),
        pytest.param("drawer", "open=0.08", ["OPEN"], marks=pytest.mark.full),
        pytest.param("drawer", "stop=0.05", ["ON_RAIL"], marks=pytest.mark.full),
        pytest.param("tower", "xy_err=1e-6", ["RED", "GREEN"], marks=pytest.mark.full),
        pytest.param("slot", "depth=0.05", ["DEPTH"], marks=pytest.mark.full),
        pytest.param("peg", "within=1e-6", ["IN_HOLE"], marks=pytest.mark.full),
    ],
)
def test_what_nothing_can_meet_fails_by_its_own_rule(
    example: str, threshold: str, rules: list[str]
) -> None:
    cfg = configure(example, "rebot", "nworld=2", f"task.check.{threshold}")
    stage = Stage(cfg)
    played = stage.play(stage.batch_simulation(2), cfg.reset)
    failing = stage.check.rules.failing(played.result.failed.numpy())
    assert failing == {name: [0, 1] for name in rules}


class Still(Driver):
    """Holds the arm where it starts."""

    def __init__(self, cfg: Config) -> None:
        super().__init__(cfg.nworld, cfg.task.episode_steps, torch.device("cpu"))
        self._command = torch.tensor(cfg.robot.start).expand(cfg.nworld, -1)

    def command(self) -> torch.Tensor:
        return self._command


@pytest.mark.parametrize(
    ("example", "rules"),
    [
        ("drawer", ["OPEN"]),
        pytest.param("tower", ["RED", "GREEN"], marks=pytest.mark.full),
        pytest.param("push", ["AT_GOAL"], marks=pytest.mark.full),
        pytest.param("slot", ["DEPTH"], marks=pytest.mark.full),
    ],
)
def test_worlds_that_are_not_driven_fail(example: str, rules: list[str]) -> None:
    cfg = configure(example, "so101", "nworld=2", "reset=randomized")
    stage = Stage(cfg)
    env = stage.start(stage.batch_simulation(2), cfg.reset)
    played = play_episode(env, Still(cfg))
    failing = stage.check.rules.failing(played.result.failed.numpy())
    assert failing == {name: [0, 1] for name in rules}


@pytest.mark.parametrize(
    ("example", "most"),
    [
        ("push", 120),
        ("tower", 80),
        ("scara", 40),
        ("panda", 40),
        ("slot", 110),
        ("peg", 130),
        ("drawer", 190),
    ],
)
def test_an_example_is_short(example: str, most: int) -> None:
    folder = EXAMPLES / example
    files = [*folder.rglob("*.yaml"), *folder.rglob("*.py")]
    assert 0 < sum(len(file.read_text().splitlines()) for file in files) <= most
    assert len((folder / "README.md").read_text().splitlines()) <= 12
    assert (folder / f"{example}.png").stat().st_size < 150_000


def test_the_cabinet_stands_where_the_handle_is_drawn_and_its_cube_stays_in_it() -> None:
    """In every world and episode. A drawer that starts open passes, a cube elsewhere does not."""
    cfg = configure("drawer", "so101", "nworld=4", "reset=randomized")
    stage = Stage(cfg)
    env = stage.start(stage.batch_simulation(4), cfg.reset)
    handle = env.sim.xpos[:, env.sim.model.body("cabinet_handle").id, :2]
    assert torch.allclose(handle, place_xy(env, "handle").to(handle), atol=1e-6)
    assert len(handle.unique(dim=0)) == 4
    cube = env.index.objects["cube"][0]
    env.sim.qpos[1, cube] -= 0.2
    env.sim.qpos[2, cube] -= 0.06
    env.sim.qpos[2, env.sim.model.joint("cabinet_drawer").qposadr[0]] = 0.06
    played = play_episode(env, Still(cfg))
    failing = stage.check.rules.failing(played.result.failed.numpy())
    assert failing == {"OPEN": [0, 1, 3], "INSIDE": [1]}
