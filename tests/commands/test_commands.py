"""Commands that mjstack prints: a shell and Hydra read back what was meant."""

import html
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from environments import Capture, Patch
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

import mjstack
from mjstack.cli import run
from mjstack.config.explain import assign, command
from mjstack.config.load import compose
from mjstack.config.session import hydra_session, search_path

NASTY = (
    r"""
Copy (1)|epoch=3, v2|zoë|it's|say "hi"|both ' and "|a b|a  b|x,y|back\slash|end\|two\\|mix\"q|mix\'q
$HOME|${seed}|\${seed}|\\${seed}|{a: 1}|{a|[x]|]|(|~|#1|3|1e3|true|null| lead|trail |a:b|100%|!x|&
;|<t>|*|?|日本|🤖|x=y|@b|+a|-b|--config-dir|`id`|$(id)|\n|''|""|"|'|\|.hidden|a\ b|${oc.env:HOME}
""".strip()
    .replace("\n", "|")
    .split("|")
)


def read_back(line: str) -> dict[str, object]:
    """The values that a shell, Hydra and OmegaConf make of the overrides of a line."""
    words = shlex.split(line)
    assert words[0] == "mjstack"
    while words[1:2] == ["--config-dir"]:
        del words[1:3]
    parsed = map(OverridesParser.create().parse_override, words[1:])
    return dict(OmegaConf.create({o.key_or_group: o.value() for o in parsed} | {"seed": 5}))


@pytest.mark.parametrize("name", [*NASTY, "tab\there"])
def test_a_folder_is_read_back(name: str) -> None:
    for folder in (name, f"/tmp/{name}", f"/tmp/{name}/outputs/1"):
        line = command("job=replay", assign("run", folder), assign("world", "success:3:17"))
        assert "\n" not in line
        values = read_back(line)
        assert values == {"job": "replay", "run": folder, "world": "success:3:17", "seed": 5}


def test_a_plain_folder_has_no_quotes() -> None:
    line = command("job=replay", assign("run", "/a/outputs/2026-11-28/10-14-22"))
    assert line == "mjstack job=replay run=/a/outputs/2026-11-28/10-14-22"


@pytest.mark.parametrize("name", ["Copy (1)", "a\\b", "${seed}", 'it\'s, "zoë"\\'])
def test_a_composition_has_the_folder(name: str, tmp_path: Path) -> None:
    (tmp_path / name / "task").mkdir(parents=True)
    with search_path([tmp_path / name]), hydra_session():
        words = shlex.split(command("job=replay", assign("run", f"/tmp/{name}")))
        assert words[1:3] == ["--config-dir", str(tmp_path / name)]
        assert compose(words[3:]).run == f"/tmp/{name}"


def test_the_printed_replay_runs(tmp_path: Path, monkeypatch: Patch, capsys: Capture) -> None:
    """Pasted into a shell, in a project's folder with an odd name; the page has it too."""
    project = tmp_path / "epoch=3,  'v2' \"zoë\" [b]$HOME\\"
    (project / "conf" / "experiment").mkdir(parents=True)
    strict = "# @package _global_\ntask:\n  check:\n    xy_err: 0.0001\n"
    (project / "conf" / "experiment" / "strict.yaml").write_text(strict)
    monkeypatch.chdir(project)
    args = ["experiment=strict", "sim=native", "nworld=2", "gates=[batch]", "web.episode=false"]
    assert run(["--config-dir", "conf", *args]) == 1
    (line,) = re.findall(
        r"(?m)^fail batch .*To look at one: (mjstack .*)$", capsys.readouterr().out
    )
    (report,) = project.glob("outputs/*/*/report.html")
    page = report.read_text()
    assert f"To look at one: {html.escape(line)}" in page
    again = shlex.join(["mjstack", "--config-dir", str(project / "conf"), *args])
    assert f"<p>{html.escape(again)}</p>" in page

    root = Path(mjstack.__file__).parents[1]
    shell = f'mjstack() {{ {shlex.quote(sys.executable)} -m mjstack "$@"; }}\n{line}'
    done = subprocess.run(
        ["bash", "-c", shell],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(root)},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 1, done.stdout + done.stderr
    assert "as recorded, and it ends bit for bit where it did" in done.stdout
