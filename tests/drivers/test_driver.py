"""Drivers of one's own: in gates, replays and jobs, and what is refused before anything runs."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from compositions import refusal
from environments import Patch, few

import mjstack
from mjstack.cli import run
from mjstack.config.load import load_saved
from mjstack.config.session import search_path
from mjstack.drivers.driver import find_driver
from mjstack.errors import MjstackError

MODULE = """
from mjstack.drivers.closed_loop import ClosedLoopDriver
from mjstack.drivers.driver import Driver
from mjstack.mdp.geometry import robot


class Hold(Driver):
    def __init__(self, env, *, offset: float = 0.0):
        super().__init__(env.nworld, env.cfg.task.episode_steps, env.device)
        self.env = env
        self.target = robot(env).home.float().expand(env.nworld, -1) + offset

    def command(self):
        return self.target


class NoDriver:
    pass


class NoCommand(Driver):
    pass


class Narrow(Hold):
    def command(self):
        return self.target[:, 1:]


class OneWorld(Hold):
    def command(self):
        return self.target[:1]


class NotFinite(Hold):
    def command(self):
        return self.target * float("nan")


class Bare(Hold):
    def __init__(self, env):
        self.env = env


class Brief(Hold):
    def __init__(self, env):
        super().__init__(env)
        self.steps = 5


class Unsized(Hold):
    def __init__(self, env):
        super().__init__(env)
        self.error = self.error[:1]


class Phased(Hold):
    phased = True


class Failing(Hold):
    def command(self):
        raise RuntimeError("no server")


class Slow(ClosedLoopDriver):
    def __init__(self, env, nominal, *, label: str):
        super().__init__(env, nominal)
"""
ANYWHERE = ["task=reach", "sim=native", "nworld=2", "task.check.distance=10.0"]
HOLD = [*ANYWHERE, "controller=custom", "controller.func=holding.Hold"]


@pytest.fixture
def conf(tmp_path: Path, monkeypatch: Patch) -> Iterator[Path]:
    """A folder of configuration, and beside it the module of the drivers."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    folder = tmp_path / "lab" / "conf"
    (folder / "controller").mkdir(parents=True)
    (folder / "controller" / "hold.yaml").write_text(
        "defaults: [open_loop, _self_]\nname: hold\nfunc: holding.Hold\nparams: {offset: 0.01}\n"
    )
    (folder.parent / "holding.py").write_text(MODULE)
    yield folder
    sys.modules.pop("holding", None)


def test_it_plays_the_gates_of_episodes(conf: Path) -> None:
    gates = "gates=[baseline,batch,success]"
    found = mjstack.verify([*HOLD, gates, "gate.success.rate=0.0"], config_dir=conf)
    assert found.status == "pass", found.messages
    assert found.gates["success"].metrics["success_rate"] == 1.0
    assert "reached_and_lost" in found.gates["success"].metrics  # as of a policy
    strict = [*HOLD, "task.check.distance=1e-6", "gates=[baseline]"]
    assert mjstack.verify(strict, config_dir=conf).status == "fail"


def test_a_file_of_its_name_chooses_it(conf: Path) -> None:
    overrides = [*ANYWHERE, "controller=hold", "gates=[batch]"]
    assert mjstack.verify(overrides, config_dir=conf).status == "pass"
    assert mjstack.load_config(overrides, config_dir=conf).controller.params == {"offset": 0.01}


@pytest.mark.full
def test_its_worlds_are_replayed_on_the_users_search_path_alone(conf: Path) -> None:
    flags = ["--config-dir", str(conf)]
    assert run([*flags, *HOLD, "gates=[batch]", "web.episode=false", "hydra.run.dir=run"]) == 0
    replay = ["job=replay", "run=run", "world=1", "web.episode=false", "hydra.run.dir=again"]
    assert run([*flags, *replay]) == 0
    saved = Path("run/.hydra/config.yaml")
    sys.modules.pop("holding", None)
    line = refusal(lambda: load_saved(saved))
    assert "controller.func=holding.Hold: expected one of the drivers of mjstack" in line
    assert f"add --config-dir {conf}." in line
    assert "holding" not in sys.modules
    # A module beside the run's own folder is not the user's.
    saved.write_text(saved.read_text().replace("holding.Hold", "shutil.rmtree"))
    with search_path([conf]):
        assert "controller.func=shutil.rmtree" in refusal(lambda: load_saved(saved))


REFUSED = {
    "NoDriver": "func=holding.NoDriver: expected a subclass of mjstack.drivers.driver.Driver",
    "NoCommand": "func=holding.NoCommand: expected a class with command()",
    "Missing": "'Missing' does not exist.",
    "Narrow": "of shape (2, 5) on cpu, expected a float32 or float64 tensor of shape (2, 6)",
    "OneWorld": "of shape (1, 6) on cpu, expected a float32 or float64 tensor of shape (2, 6)",
    "NotFinite": "in world 0, expected finite numbers",
    "Bare": "raised AttributeError: 'Bare' object has no attribute 'phases'",
    "Brief": "steps: found 5, expected 150",
    "Unsized": "error: found a torch.float32 tensor of shape (1,) on cpu, expected shape (2,)",
    "Phased": "phases: found none, expected phases if, and only if, its class has phased=True",
    "Failing": "raised RuntimeError: no server",
    "Slow": "parameter 'label' is missing: set controller.params.label",
}


@pytest.mark.parametrize("name", few(REFUSED, 3))
def test_a_wrong_one_is_refused_before_anything_is_written(
    name: str, conf: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    chosen = ["controller=custom", f"controller.func=holding.{name}", "gates=[batch]"]
    assert run(["--config-dir", str(conf), *ANYWHERE, *chosen, "hydra.run.dir=out"]) == 2
    line = capsys.readouterr().err
    assert line.startswith("mjstack: controller: ")
    assert line.count("\n") == 1
    assert REFUSED[name] in line
    assert not Path("out").exists()


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        (["+controller.params.ofset=1.0"], "parameter 'ofset' does not exist"),
        (["+controller.params.offset=far"], "controller.params.offset=far: expected a number"),
        (["controller.func=Hold"], "expected a dotted name"),
    ],
)
def test_its_parameters_are_checked(overrides: list[str], expected: str, conf: Path) -> None:
    with pytest.raises(MjstackError) as caught:
        mjstack.verify([*HOLD, "gates=[batch]", *overrides], config_dir=conf)
    assert expected in str(caught.value)


def test_a_driver_of_mjstack_takes_no_parameter_of_another() -> None:
    with pytest.raises(MjstackError, match="controller: parameter 'offset' does not exist"):
        mjstack.verify([*ANYWHERE, "gates=[baseline]", "+controller.params.offset=1.0"])


def test_controllers_say_what_they_can_do() -> None:
    marks = ("needs_phases", "phased", "planned", "stateless", "plays_policy")
    expected = {
        "open_loop": {"needs_phases", "phased", "planned"},
        "closed_loop": {"needs_phases", "phased"},
        "closed_loop controller.clock=false": {"needs_phases", "stateless"},
        "policy": {"plays_policy"},
    }
    for name, wanted in expected.items():
        driver = find_driver(mjstack.load_config(f"controller={name}".split()))
        assert {mark for mark in marks if getattr(driver, mark)} == wanted
