"""Every configuration file composes, holds the task's figures, and every bad value is refused in
one line.
"""

import runpy
from collections.abc import Iterator
from dataclasses import Field, fields, is_dataclass, replace
from itertools import zip_longest
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

import compositions
import pytest
from check_cases import limits
from compositions import checked, refusal
from doc_blocks import ROOT
from environments import Patch, few
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

import mjstack
from mjstack.config import fields as config_fields
from mjstack.config import load_config, schema
from mjstack.config.check import validate
from mjstack.config.fingerprint import config_content
from mjstack.config.help import list_keys
from mjstack.config.load import compose
from mjstack.config.schema import Backend, CloneJobCfg, Config
from mjstack.config.session import CONFIG_FOLDER, hydra_session, search_path
from mjstack.errors import ConfigError
from mjstack.jobs.gates import check_machine
from mjstack.tasks.check import make_check


def choices() -> list[str]:
    """``group=choice`` for every file in the configuration groups."""
    alone = ("gate", "trainer", ".")  # a list of all its files; keys of job=train; config.yaml
    files = [path.relative_to(CONFIG_FOLDER) for path in sorted(CONFIG_FOLDER.rglob("*.yaml"))]
    groups = [(path.parent.as_posix(), path.stem) for path in files]
    return [f"{g}={name}" for g, name in groups if g not in alone and not g.startswith("hydra")]


def rounds() -> list[list[str]]:
    """Every choice once: the first of every group together, then the second ones. Experiments are
    alone: they choose jobs too.
    """
    groups: dict[str, list[str]] = {}
    for choice in choices():
        groups.setdefault(choice.partition("=")[0], []).append(choice)
    alone = [[choice] for choice in groups.pop("experiment")]
    return [*(list(filter(None, row)) for row in zip_longest(*groups.values())), *alone]


@pytest.mark.full
def test_every_file_composes() -> None:
    assert len(choices()) > 40
    for chosen in rounds():
        assert isinstance(compositions.load_config(chosen), Config)
    for path in (CONFIG_FOLDER / "trainer").glob("*.yaml"):
        assert compositions.load_config(["job=train", f"trainer={path.stem}"]).job.trainer
    gates = {path.stem for path in (CONFIG_FOLDER / "gate").glob("*.yaml")}
    assert gates == load_config().gate.functions().keys()


def test_defaults(so101_cfg: Config) -> None:
    cfg = so101_cfg
    assert cfg.robot.name == "so101"
    assert cfg.model.source == "builtin"
    assert cfg.sim.backend is Backend.auto
    assert cfg.nworld == 256
    assert cfg.seed == 0
    assert cfg.gates == ["baseline", "parity", "capacity", "batch", "throughput"]
    assert (cfg.timing.physics_dt, cfg.timing.decimation) == (0.002, 10)
    assert cfg.timing.step_dt == pytest.approx(0.02)
    solver = cfg.solver
    quality = (solver.iterations, solver.ls_iterations, solver.impratio, solver.tolerance)
    assert quality == (100, 50, 100.0, 1e-6)
    assert cfg.reset["cubes"].params == {"xy": 0.002, "yaw": 0.05}


def test_overrides_arrive() -> None:
    values = ["timing=fine", "nworld=7", "gates=[capacity]", "task.check.xy_err=0.01"]
    cfg = load_config([*values, "batch.njmax=90"])
    assert (cfg.timing.physics_dt, cfg.timing.decimation) == (0.001, 20)
    assert cfg.timing.step_dt == pytest.approx(0.02)
    assert (cfg.nworld, cfg.gates, cfg.batch.njmax) == (7, ["capacity"], 90)
    assert limits(cfg).xy_err == 0.01


def test_experiment_is_what_it_changes() -> None:
    assert compositions.load_config(["experiment=fine"]).timing.decimation == 20
    assert compositions.load_config(["experiment=clip"]).job.name == "play"
    assert compositions.load_config(["experiment=asset_solver"]).solver.iterations is None


FIGURES = {
    "so101": {
        "home": [0, 0, 0.473, 1.177, 1.584, 0.7],
        "gripper_open": [0.7],
        "gripper_closed": [0.30],
        "locked": {"wrist_roll": 1.584},
        "ik_joints": ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex"],
        "arm_force_limit": 30.0,
        "approach_height": 0.09,
        "table": ([0.35, -0.04, 0.012], [0.16, 0.26, 0.012]),
        "cubes": ([0.33, -0.13], [0.33, 0.06]),
        "sizes": (128, 300),
    },
    "rebot": {
        "home": [0, -0.7, -1.1, 0, 0, 0, 0.04, 0.04],
        "gripper_open": [0.04, 0.04],
        "gripper_closed": [0.018, 0.018],
        "locked": {"joint6": 0.0},
        "ik_joints": ["joint1", "joint2", "joint3", "joint4", "joint5"],
        "arm_force_limit": None,
        "approach_height": 0.12,
        "table": ([0.48, 0, 0.200], [0.16, 0.30, 0.012]),
        "cubes": ([0.48, -0.14], [0.48, 0.14]),
        "sizes": (256, 500),
    },
}


def test_task_figures_of_each_robot(robot: str) -> None:
    cfg = compositions.load_config([f"robot={robot}"])
    want = FIGURES[robot].copy()
    assert (cfg.scene.table_center, cfg.scene.table_half) == want.pop("table")
    assert (cfg.scene.objects["red"].xy, cfg.scene.objects["blue"].xy) == want.pop("cubes")
    placements = cfg.robot.placements["stack"]
    assert (placements.nconmax, placements.njmax) == want.pop("sizes")
    assert {key: getattr(cfg.robot, key) for key in want} == want
    for cube in cfg.scene.objects.values():
        assert (cube.shape, cube.size, cube.mass) == ("box", [0.022] * 3, 0.08)
        assert cube.friction == [1.2, 0.005, 0.0005]
    assert cfg.scene.table_friction == [1.0, 0.005, 0.0005]


def test_acceptance_figures(so101_cfg: Config) -> None:
    t = limits(so101_cfg)
    assert (t.xy_err, t.dz_min, t.dz_max) == (0.015, 0.035, 0.055)
    assert (t.airborne_height, t.lift_steps, t.carry_steps) == (0.010, 10, 10)
    assert t.carry_distance == 0.05
    assert (t.window, t.support_gap) == (50, 0.005)
    assert (t.rest_speed, t.rest_position, t.rest_rotation_deg) == (0.05, 0.005, 3.0)
    assert (t.lift_phases, t.carry_phase) == (["lift_red", "above_blue"], "above_blue")
    seconds = [phase.seconds for phase in so101_cfg.controller.phases.values()]
    assert seconds == [1.2, 1.4, 1.6, 1.4, 1.6, 1.4, 1.0, 1.0, 1.4]
    assert so101_cfg.controller.ik_tolerance == 0.0005


BAD_VALUES = [
    ("nworld=0", "nworld=0"),
    ("seed=-1", "seed=-1"),
    ("robot.locked.wrist_roll=nan", "robot.locked.wrist_roll=nan"),
    ("scene.objects.red.xy=[nan,0]", "scene.objects.red.xy=[nan, 0]"),
    ("scene.table_half=[-1,1,1]", "3 numbers above 0 [m]"),
    ("gate.parity.step1_ranges=nan", "gate.parity.step1_ranges=nan"),
    ("timing.decimation=0", "timing.decimation=0"),
    ("timing.decimation=11", "expected 0.02 s, because task.control_hz=50. Change both together"),
    ("timing.physics_dt=nan", "timing.physics_dt"),
    ("solver.cone=round", "one of elliptic, pyramidal"),
    ("solver.gripper_condim=2", "1, 3, 4, 6"),
    ("gates=[parityy]", "Did you mean 'parity'?"),
    ("gates=[]", "gates"),
    ("sim.device=gpu", "auto, cpu or cuda:N"),
    ("scene.objects.red.xy=[0.9,0.0]", "on the table"),
    ("scene.objects.red.shape=sphere", "expected 1 number: the radius"),
    ("scene.objects.red.mass=null", "scene.objects.red.mass=null: expected a number [kg]"),
    ("scene.objects.red.pos=[0.33,-0.13,0.02]", "a height of at least 0.0460 m"),
    ("scene.objects.red.quat=[0,0,0,0]", "a rotation (w, x, y, z)"),
    ("scene.objects.red.quat=[1,0,0]", "4 numbers"),
    ("scene.frame=robot", "one of world, table"),
    ("scene.objects.red.mass=1e-30", "from 1e-05 to 1000 [kg]"),
    ("scene.objects.red.size=[1e-9,0.1,0.1]", "from 0.0001 to 10 [m]"),
    ("controller.phases.done.seconds=1e308", "above 0 and at most 600 [s]"),
    ("controller.knots=1000000", "from 3 to 1000"),
    ("gate.batch.distinct_fraction=nan", "from 0 to 1"),
    ("task.check.airborne_height=-inf", "task.check.airborne_height=-inf"),
    ("task.check.dz_min=1", "at most dz_max=0.055"),
    ("task.check.carry_phase=above_blu", "Did you mean 'above_blue'?"),
    ("task.check.lift_phases=[lift]", "lift_red"),
    ("gate.parity.states.stacked=don", "Did you mean 'done'?"),
    ("gate.throughput.from_phase=lift", "Did you mean 'lift_red'?"),
    ("task.check.window=1", "task.check.window=1"),
    ("controller.phases.release.seconds=0.013", "multiple of the step"),
    ("controller.phases.release.gripper=ajar", "one of open, closed"),
    ("controller.phases.release.anchor=green", "release.anchor: object or place"),
    ("controller.phases.lift_red.retry=above_red", "lift_red.grasps"),
    ("controller.phases.grasp_red.retry=lift_red", "this phase or one before it"),
    ("controller.step_iterations=2", "controller.step_iterations=2"),
    ("robot.home=[0,0]", "robot.home"),
    ("robot.ik_joints=[elbow]", "elbow_flex"),
    ("robot.approach_axis=[0,0,2]", "a vector of length 1"),
    ("nworld=99999999999", "expected an integer from 1 to 2147483647 [worlds]"),
    (f"seed={1 << 32}", f"seed={1 << 32}"),
    ("gate.capacity.margin=inf", "gate.capacity.margin="),
    ("gate.success.rate=1.01", "gate.success.rate=1.01: expected a number from 0 to 1"),
    ("gate.success.seeds=0", "gate.success.seeds=0: expected an integer from 1 to 100000"),
    ("gate.success.rate=-0.01", "gate.success.rate"),
]


@pytest.mark.parametrize(("override", "words"), BAD_VALUES)
def test_a_bad_value_is_one_line(override: str, words: str) -> None:
    refusal(lambda: checked(override), words)


BAD = [
    (["scene.objects.red.xy=[0.33]"], "a list of 2 numbers [m], or scene.objects.red.pos with 3"),
    (["scene.objects.red.file=none.xml"], "none.xml: expected an MJCF file; there is no such"),
    (["gate.seeds=3"], "'seeds'"),
    (["hydra.searchpath=[pkg://mine.conf]"], "pkg:/mine.conf: there is no such folder"),
    (["job=collect", "job.episode=3"], "Did you mean 'job.episodes'?"),
    (["job.episodes=3"], "configuration key 'job.episodes' does not exist. "),
    (["trainer=ppo", "job.chunk=3"], "configuration key 'job.chunk' does not exist. "),
    (["=3"], "=3: "),
    (["nworld"], "override 'nworld' cannot be read: expected key=value"),
    (["lst"], "expected key=value, or a command. Did you mean 'list'?"),
    (
        ["~reward.progres"],
        "~reward.progres: there is none to leave out. Did you mean 'reward.progress'?",
    ),
    (["robot=so100"], "Did you mean 'so101'?"),
    (["robots=so101"], "Did you mean 'robot'?"),
    (["phase=stack"], "Did you mean 'phases'?"),
    (["gate=batch"], "gates=[...]"),
    (
        ["job=play_schema"],
        "Did you mean 'play'? Available: collect, export, gates, play, replay, train.",
    ),
    (["nworlds=3"], "nworld'?"),
    (["reward.porgress.weight=3"], "Did you mean 'reward.progress'?"),
    (["reward.progress.params.force=1"], "To add it, write +reward.progress.params.force=..."),
    (["termination.time_out.params.step=3"], "steps'?"),
    (["gate.success.reset.cubes.parms.yaw=1"], "parms"),
    (["batch=automatic"], "Did you mean 'auto'?"),
    (["batch.naconmax=8"], "'batch.naconmax' does not exist. Did you mean 'batch.nconmax'?"),
    (
        ["scene.objects.red.fixed=true", "scene.objects.blue.fixed=true"],
        "expected at least one object that is not fixed",
    ),
    (
        ["controller=closed_loop", "controller.phases.above_blue.observe=false"],
        "above_blue.observe=false",
    ),
    (["nworld =3"], "'nworld =3' cannot be read: expected key=value"),
    (["robot=so101\n"], "cannot be read"),
    (["video=yep"], "video=yep: expected true or false."),
    (["graph=yes"], "graph=yes: expected one of auto, require, off."),
    (["nworld=null"], "nworld=null: expected an integer from 1"),
    (["sim.device=[a]"], "sim.device=[a]: expected text."),
    (["gates={a:1}"], "gates={a:1}: expected a list of names."),
    (["gates=batch"], "gates=batch: expected a list of names."),
    (["job=[gates,play]"], "job=[gates,play]: expected one choice, no list."),
    (["robot={homes:[1]}"], "Did you mean 'robot.home'?"),
    (["nworld=range(1,4)"], "'nworld=range(1,4)': several values are a sweep. Add -m"),
    (["robot=so101,rebot"], "'robot=so101,rebot': several values are a sweep. Add -m"),
    (["gate.batch=[1]"], "gate.batch=[1]: expected keys and values."),
    (["reset@gate.success.reset=null"], "Config group override must be a string"),
    (["nworld=int(a)"], "cannot be read: expected key=value"),
    (
        ["policy=run(1"],
        "one of = , : ; # & ! < > ^ ~ ` needs double quotes inside of single ones:"
        " 'policy=\"run (1)\"'.",
    ),
    (["+nworld=4"], "An item is already at 'nworld'."),
    (["~nworld"], "~nworld: expected a term of"),
    (["~gate.batch.seeds"], "~gate.batch.seeds: expected an integer from 1 to 100000 [seeds]."),
]


@pytest.mark.full
@pytest.mark.parametrize(("overrides", "words"), BAD, ids=[" ".join(o) for o, _ in BAD])
def test_bad_input_is_one_line(overrides: list[str], words: str) -> None:
    refusal(lambda: make_check(load_config(overrides)), words)


STARTS = [
    ([], "randomized", []),
    (["reset@gate.success.reset=jitter"], "jitter", []),
    (["gates=[success]", "reset=jitter"], "randomized", ["reset=jitter"]),
    (["gates=[batch,success]", "cameras=front", "looks=randomized"], "randomized", ["looks=rand"]),
    (
        ["gates=[success]", "cameras=front", "+looks@gate.success.reset=randomized"],
        "randomized looks=randomized",
        [],
    ),
]


@pytest.mark.parametrize(("overrides", "starts", "unused"), few(STARTS, 2))
def test_how_the_success_gate_starts(overrides: list[str], starts: str, unused: list[str]) -> None:
    """By its own choice, which a line names where another was made."""
    cfg = mjstack.load_config(overrides)
    alone = [o for o in overrides if o.startswith("cameras")]
    expected = compositions.load_config([*f"reset={starts}".split(), *alone]).reset
    assert cfg.gate.success.reset == expected
    assert len(cfg.unused_terms) == len(unused)
    for line, choice in zip(cfg.unused_terms, unused, strict=True):
        assert line.startswith(choice)
        assert f"@gate.success.reset={choice.partition('=')[2]}" in line
        fix = line.split(": ")[1].split()[0]
        assert not mjstack.load_config([*overrides, fix]).unused_terms


@pytest.mark.parametrize("choice", ["gate.success.reset=jitter", "job.observation=state"])
def test_a_choice_by_key_is_told_how(choice: str) -> None:
    line = refusal(lambda: mjstack.load_config(["job=train", choice]))
    assert line.endswith(f" Write {choice.partition('=')[0].rpartition('.')[2]}@{choice}.")
    mjstack.load_config(["job=train", line.split(" Write ")[1].rstrip(".")])


@pytest.mark.parametrize(
    ("task", "folder", "seconds"),
    [
        ("stack", None, 12.0),
        ("box", None, 40.0),
        ("reach", None, 3.0),
        pytest.param("push", "examples/push/conf", 8.0, marks=pytest.mark.full),
        pytest.param("tower", "examples/tower/conf", 25.0, marks=pytest.mark.full),
        pytest.param("drawer", "examples/drawer/conf", 8.4, marks=pytest.mark.full),
    ],
)
def test_a_task_has_any_rate(task: str, folder: str | None, seconds: float) -> None:
    for timing, hz in (("fine", 50.0), ("hz30", 30.0)):
        chosen = [f"task={task}", f"timing={timing}"]
        cfg = compositions.load_config(chosen, folder and ROOT / folder)
        assert cfg.task.control_hz == hz
        assert cfg.task.episode_steps == round(seconds * hz)
        assert cfg.task.check
        assert cfg.task.check["window"] == round(hz)  # one second


REFUSED_BY_THE_CHECK = [
    (["robot.jaw_bodies=[nope]"], "robot.jaw_bodies: body 'nope' does not exist."),
    (["robot.approach_body=nope"], "robot.approach_body: body 'nope' does not exist."),
    (["robot.approach_body=base", "controller=closed_loop"], "that carries both grasp sites"),
    (["task.episode_steps=10"], "task.episode_steps=10: expected at least"),
    (["task.check.func=nope"], "task.check: func=nope: expected a dotted name"),
    (["task.check.func=os.system"], "expected a subclass of mjstack.tasks.check.EpisodeCheck"),
    (["task.check.func=mjstack.tasks.check.EpisodeCheck"], "method 'build' is missing"),
    (["task.success.func=nope"], "task.success: "),
    (["controller.action.arm.func=nope"], "controller.action.arm: "),
    (["gate.success.reset.cubes.func=nope", "gates=[success]"], "gate.success.reset.cubes: "),
    (["sim=mjwarp", "sim.device=cuda:77"], "cuda:77"),
    (["sim=native", "sim.device=cuda:0"], "sim.device=cuda:0"),
    (["model=menagerie"], "MENAGERIE_ROOT"),
]


@pytest.mark.full
@pytest.mark.parametrize(
    ("overrides", "words"), REFUSED_BY_THE_CHECK, ids=[" ".join(o) for o, _ in REFUSED_BY_THE_CHECK]
)
def test_the_whole_job_is_checked_before_its_folder_exists(
    overrides: list[str], words: str, monkeypatch: Patch, tmp_path: Path
) -> None:
    monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path))
    refusal(lambda: check_machine(load_config(["gates=[baseline]", *overrides])), words)


def test_a_replaced_function_is_told_which_parameters_are_not_its_own() -> None:
    """A line names what leaves one out, or how a file does."""
    swap = ["task=reach", "reward.reach.func=mjstack.mdp.reward.action_rate", "sim=native"]
    line = refusal(lambda: mjstack.make_env(swap))
    assert line.startswith("reward.reach: parameter 'object' does not exist.")
    fixes = line.rstrip(".").split("add ")[1].split()
    assert fixes[0] == "~reward.reach.params.object"
    mjstack.make_env([*swap, *fixes]).close()


def write_yaml(path: Path, values: dict[str, Any]) -> None:
    """A file of a group whose keys are those of the whole configuration."""
    nested = OmegaConf.create()
    for key, value in values.items():
        OmegaConf.update(nested, key, value, force_add=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"# @package _global_\n{OmegaConf.to_yaml(nested)}")


def test_the_next_composition_is_not_touched(tmp_path: Path) -> None:
    """In one session each composition has its own files."""
    write_yaml(tmp_path / "conf/experiment/swap.yaml", {"action.arm.func": "lab.mine"})
    with search_path([tmp_path / "conf"]), hydra_session():
        swapped, plain = ["experiment=swap"], ["nworld=3"]
        seen = [compose(o).action.arm.func for o in (swapped, plain, swapped, plain)]
    assert seen[0] == seen[2] == "lab.mine"
    assert seen[1] == seen[3] == "mjstack.mdp.action.JointPosition"


RESULTS = ("report", "training", "episodes", "policy", "images")  # as of `fields.CHANGES`
EFFECTS = {
    "web.port=9000": "",
    "graph=off": "report",
    "gate.batch.seeds=2": "report",
    "job.test_seed=7": "report",
    "sim.device=cpu": "report",
    "nworld=3": "training",
    "job.length=0.5": "training",
    "seed=1": "episodes",
    "scene.cameras.front.rate=10": "episodes",
    "robot.home=[0,0,0.5,1.1,1.5,0.7]": "episodes policy",
    "scene.objects.red.size=[0.02,0.02,0.02]": "episodes policy",
    "scene.cameras.front.fovy=50": "episodes policy images",
}


@pytest.mark.parametrize("override", EFFECTS)
def test_which_results_depend_on_a_key(override: str) -> None:
    args = ["job=train", "cameras=front", "sim=native"]
    before, after = (compositions.load_config([*args, *more]) for more in ([], [override]))
    changed = [r for r in RESULTS if config_content(before, r) != config_content(after, r)]
    assert changed == EFFECTS[override].split()
    assert (config_content(before) != config_content(after)) == bool(changed)


def test_a_name_may_have_dots() -> None:
    cfg = load_config()
    cfg.scene.objects["a.b"] = replace(cfg.scene.objects["red"], mass=None)
    refusal(lambda: validate(cfg), "scene.objects.a.b.mass=null: expected a number [kg]")


@pytest.mark.full
def test_every_field_says_what_it_means() -> None:
    keys = list(list_keys(load_config()))
    assert len(keys) > 150
    bare = [key.name for key in keys if not key.meaning]
    assert bare == []
    rate = next(key for key in keys if key.name == "gate.success.rate")
    assert (rate.value, rate.accepts) == ("0.99", "a number from 0 to 1")


@pytest.mark.full
def test_the_reference_has_every_group_and_job() -> None:
    hooks = CONFIG_FOLDER.parent / "docs" / "hooks.py"
    text = runpy.run_path(str(hooks))["reference_markdown"]()
    for key in ("nworld", "gate.batch.seeds", "controller.phases.NAME.gripper", "job.folder"):
        assert f"| `{key}` |" in text, key
    assert "| a number above 0 and at most 1 [s] | Duration of one physics step. |" in text


@pytest.mark.parametrize(
    ("overrides", "episodes", "leave_out"),
    [
        (["sim=native"], 64, ["joint_vel?"]),
        (["sim=mjwarp", "sim.device=cpu"], 64, ["joint_vel?"]),
        (["sim=mjwarp", "sim.device=cuda:0"], 2048, ["joint_vel?"]),
        (["sim=mjwarp", "sim.device=cuda:0", "trainer=clone"], 16384, ["tilts?", "grasped?"]),
        (["sim=native", "job.episodes=5"], 5, ["joint_vel?"]),
    ],
)
def test_sizes_of_a_training_follow_the_device(
    overrides: list[str], episodes: int, leave_out: list[str]
) -> None:
    job = compositions.load_config(["job=train", *overrides]).job
    assert isinstance(job, CloneJobCfg)
    assert (job.episodes, job.leave_out) == (episodes, leave_out)


def schema_floats() -> Iterator[tuple[type, Field, Any]]:
    """Every field of the schema that is a float or holds floats, with its type."""
    for owner in vars(schema).values():
        for item in fields(owner) if is_dataclass(owner) else ():
            hint = get_type_hints(owner)[item.name]
            if config_fields.field_range(item).vectors:
                hint = dict[str, list[float]]
            if "float" in str(hint):
                yield owner, item, hint  # type: ignore[misc]


def filled(hint: Any, value: object, length: int) -> Any:
    """A value of a type, filled with one number."""
    kinds = get_args(hint)
    if get_origin(hint) is list:
        return [filled(kinds[0], value, length)] * length
    if get_origin(hint) is dict:
        return {"x": filled(kinds[1], value, length)}
    return filled(kinds[0], value, length) if kinds else value


def taken(owner: type, item: Field, value: object) -> Any:
    """The value of a field of a class as a configuration has it."""
    merged = OmegaConf.merge(OmegaConf.structured(owner), {item.name: value})
    plain = OmegaConf.to_container(merged)[item.name]  # type: ignore[call-overload,index]
    config_fields._check(item.name, plain, owner, item)
    return plain


FLOATS = list(schema_floats())


@pytest.mark.parametrize(
    ("owner", "item", "hint"),
    FLOATS,
    ids=[f"{owner.__name__}.{item.name}" for owner, item, _ in FLOATS],
)
def test_a_whole_number_is_a_float(owner: type, item: Field, hint: Any) -> None:
    """Also inside of lists and mappings, and of those in each other. A bool is none."""
    limits = config_fields.field_range(item)
    value = next(n for n in (0, 1, 5) if limits.holds(n))
    got = taken(owner, item, filled(hint, value, limits.length or 2))
    assert got == filled(hint, value, limits.length or 2)
    assert "." in repr(got)
    with pytest.raises((OmegaConfBaseException, ConfigError)):
        taken(owner, item, filled(hint, True, limits.length or 2))


@pytest.mark.parametrize("value", ["[0,0,true]", "[0,1]", "up"])
def test_a_place_that_is_no_list_of_numbers(value: str) -> None:
    given = f"+robot.grasp_pos={{x: {value}}}"
    assert "expected a list of 3 numbers [m]" in refusal(lambda: load_config([given]))
    given = f"robot.placements.stack.objects.red={'[0.3]' if value == '[0,1]' else value}"
    line = refusal(lambda: load_config([given]))
    assert line.startswith("robot.placements.stack.objects.red=")
    assert "expected a list of 2 numbers [m]" in line


def test_places_of_whole_numbers() -> None:
    cfg = load_config(["+robot.grasp_pos={x: [0, 0, -1]}", "scene.objects.red.mass=1"])
    assert repr(cfg.robot.grasp_pos) == "{'x': [0.0, 0.0, -1.0]}"
    cfg = load_config(["robot.placements.stack.objects.red=[0.3, 0]"])
    assert repr(cfg.scene.objects["red"].xy) == "[0.3, 0.0]"
