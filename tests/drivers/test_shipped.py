"""Policies that come with mjstack: their names, cards and rates, and the demonstration."""

import json
import re
import runpy
import shutil
import sys
from pathlib import Path

import pytest
import torch
from doc_blocks import ROOT
from environments import Capture, Patch, Refused, report_of
from policies import write_policy
from safetensors.torch import load_file

import mjstack
from mjstack.cli import run
from mjstack.config.fingerprint import SHIPPED, policy_folder, shipped_policies
from mjstack.config.load import load_config
from mjstack.policy import load_policy, save_policy

NAMES = ["rebot_stack", "so101_stack"]
SOME_OF_THEM = ["nworld=2", "gate.success.rate=0.0", "task.episode_seconds=1.0"]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: Patch) -> Path:
    """The working folder, empty."""
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    return here


def test_a_name_is_a_shipped_policy_unless_there_is_such_a_folder(folder: Path) -> None:
    assert list(shipped_policies()) == NAMES
    assert policy_folder("so101_stack") == SHIPPED / "so101_stack"
    cfg = load_config(["controller=policy", "policy=so101_stack"])
    assert (cfg.robot.name, cfg.task.name) == ("so101", "stack")
    assert load_policy(Path("so101_stack")).folder == SHIPPED / "so101_stack"
    reach = load_config(["task=reach"])
    write_policy(Path("so101_stack"), reach)
    assert policy_folder("so101_stack") == Path("so101_stack")
    assert load_policy(Path("so101_stack")).config["task"]["name"] == "reach"
    for name in ("..", "", "so101_stack/../so101_stack", str(SHIPPED.parent), "so101_stac"):
        assert policy_folder(name) == Path(name)


def test_an_unknown_name_says_which_there_are(refused: Refused) -> None:
    text = refused("controller=policy", "policy=so101_stak")
    assert f"such as outputs/mine/last, or {', or '.join(NAMES)}, or LeRobot's: controller" in text


def test_each_card_has_its_rate() -> None:
    rate = r"[\w -]+, task \w+: \d+ of \d+ episodes succeeded \(.+ interval .+\)"
    for name in NAMES:
        assert re.match(rate, (SHIPPED / name / "card.md").read_text().splitlines()[2])


def test_files_are_small_and_name_no_place(folder: Path) -> None:
    files = [path for path in SHIPPED.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < 3_000_000
    assert len(files) == 3 * len(NAMES)  # policy.json, weights, card.md
    for path in files:
        assert not re.search(rb"/(tmp|root|home|work)/", path.read_bytes()), path
    for name in NAMES:
        (path,) = (SHIPPED / name).glob("*.safetensors")
        kinds = {key: value.dtype for key, value in load_file(path).items()}
        half = {key for key, kind in kinds.items() if kind is torch.float16}
        assert half == {key for key in kinds if key.startswith("layers.")}
        network = load_policy(SHIPPED / name).network
        assert {value.dtype for value in network.state_dict().values()} == {torch.float32}


@pytest.mark.parametrize("name", NAMES)
def test_a_card_says_what_the_policy_is(name: str) -> None:
    card = (SHIPPED / name / "card.md").read_text()
    policy = load_policy(SHIPPED / name)
    assert f"robot={policy.config['robot']['name']}" in card
    for word in ("random starts", "an episode fails by", "interval", "seeds", "commit", "limits"):
        assert f"{word} " in card
    successes, episodes = map(int, re.search(r"(\d+) of (\d+) episodes", card).groups())  # type: ignore[union-attr]
    assert episodes >= 1024
    assert successes >= 0.99 * episodes
    assert "these random starts reach" in card


@pytest.mark.full
@pytest.mark.parametrize("name", NAMES)
def test_a_shipped_policy_succeeds(name: str) -> None:
    """From 64 starts that no card has."""
    policy = ["controller=policy", f"policy={name}", "sim=native", "gates=[success]"]
    found = mjstack.verify(
        [*policy, "nworld=64", "seed=3000000", "gate.success.rate=0.98"]  # at most one failure
    )
    assert found.status == "pass", found.messages
    assert found.gates["success"].metrics["distinct_starts"] == 64


@pytest.mark.full
def test_the_tool_writes_folder_and_card(folder: Path, monkeypatch: Patch, capsys: Capture) -> None:
    """Of a shipped policy again, whose training's folder it makes up: the weights stay bit for bit.
    A policy that fails is not kept, and the earlier one stays.
    """
    training = Path("training")
    provenance = {
        "git_commit": "0123456789",
        "date": "2026-11-27 00:00:00 UTC",
        "device": "cpu",
        "versions": {"torch": "2.13.0"},
    }
    shutil.copytree(SHIPPED / "so101_stack", training / "last")
    (training / ".hydra").mkdir()
    overrides = "- job=train\n- job.folder=/somewhere\n- 'job.hidden=[8]'\n"
    (training / ".hydra" / "overrides.yaml").write_text(overrides)
    (training / "report.json").write_text(json.dumps({"provenance": provenance}))
    tool = str(ROOT / "tools" / "ship_policy.py")
    options = ["training", "again", "--seeds=1", "--nworld=1", "--to=policies"]
    monkeypatch.setattr(sys, "argv", [tool, *options])
    runpy.run_path(tool, run_name="__main__")
    written = Path("policies/again")
    (before,) = (SHIPPED / "so101_stack").glob("*.safetensors")
    (after,) = written.glob("*.safetensors")
    assert after.read_bytes() == before.read_bytes()
    card = (written / "card.md").read_text()
    assert "`mjstack job=train 'job.hidden=[8]' job.folder=outputs/mine`, seed 1, its last" in card
    assert "commit 0123456, 2026-11-27" in card
    assert card in capsys.readouterr().out

    policy = load_policy(training / "last")
    policy.network.set_scale("action", policy.network.action_mean + 1.0, policy.network.action_std)
    save_policy(training / "last", policy)
    with pytest.raises(SystemExit) as stopped:
        runpy.run_path(tool, run_name="__main__")
    assert stopped.value.code == 1
    assert [path.name for path in written.glob("*.safetensors")] == [after.name]


def test_the_demonstration_leaves_its_page(folder: Path, refused: Refused) -> None:
    assert "Write experiment=demo." in refused("demo", *SOME_OF_THEM)
    assert run(["experiment=demo", *SOME_OF_THEM]) == 0
    (out,) = Path("outputs").glob("*/*")
    assert (out / "episode.html").is_file()
    assert report_of(out)["gates"][0]["metrics"]["episodes"] == 2
