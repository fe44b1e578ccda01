"""``mjstack list``: what there is to choose from."""

import re

from doc_blocks import ROOT
from environments import Capture, Refused

from mjstack.cli import run
from mjstack.config.session import list_choices


def test_everything_has_a_line(capsys: Capture) -> None:
    """Of a folder of one's own too: its task, and the terms that it names."""
    assert run(["--config-dir", str(ROOT / "examples/push/conf"), "list"]) == 0
    text = capsys.readouterr().out
    parts = dict(re.findall(r"(?m)^(\w+):\n((?:  .+\n)+)", text))
    assert "tasks.parts.offset" not in parts["conditions"]  # a helper, which takes a step
    assert list(parts) == [
        "tasks",
        "robots",
        "terms",
        "conditions",
        "gates",
        "trainers",
        "policies",
    ]
    for kind, group in (("robots", "robot"), ("gates", "gate"), ("trainers", "trainer")):
        assert re.findall(r"(?m)^  (\w+) +\S.+$", parts[kind]) == list_choices()[group], kind
    assert re.findall(r"(?m)^  (\w+) +\S", parts["tasks"]) == ["box", "reach", "stack", "push"]
    assert "  mjstack.mdp.reward.lift Height of an object's lowest point above the table" in text
    assert "  push.near_goal Reward for a puck near the goal" in parts["terms"]
    assert (
        "  mjstack.tasks.parts.on_table An object that stands on the table" in parts["conditions"]
    )
    assert max(map(len, text.splitlines())) < 250


def test_terms_have_parameters(capsys: Capture, refused: Refused) -> None:
    assert run(["list", "terms"]) == 0
    lines = [line.strip() for line in capsys.readouterr().out.splitlines()]
    term = next(n for n, line in enumerate(lines) if line.startswith("mjstack.mdp.reward.reach "))
    assert lines[term + 1 : term + 4] == [
        "object: str. Scene object.",
        "scale: float. Distance over which the reward falls [m].",
        "height: float = 0.0. How far above the object's centre the point is [m].",
    ]
    assert not any("Annotated" in line for line in lines)
    assert "list 'task' does not exist. Did you mean 'tasks'?" in refused("list", "task")
