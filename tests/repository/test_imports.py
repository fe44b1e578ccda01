"""Who may import whom: packages in layers, and one home for each third-party package."""

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest
from environments import at_double_speed

import mjstack

ROOT = Path(mjstack.__file__).parent
# A module may import from its own layer and from earlier ones.
LAYERS = [
    {"errors", "math", "rng", "files", "interrupt", "process", "distributed", "version"},
    {"config"},
    {"robots"},
    {"sim"},
    {"scene"},
    {"kinematics"},
    {"managers"},
    {"mdp"},
    {"tasks"},
    {"envs"},
    {"policy"},
    {"drivers"},
    {"episodes", "bench"},
    {"adapters", "datasets", "gates", "train"},
    {"jobs"},
    {"cli_sweep"},
    {"cli"},
    {"__main__"},
]
LEAVES = {
    "report": {"errors", "files", "interrupt", "report", "version"}
}  # anything may import it, and it imports only these
HOMES = {
    "mujoco_warp": ("sim/",),
    "warp": ("sim/", "kinematics/"),
    "mink": ("kinematics/mink_ik.py",),
    "mujoco_menagerie": ("robots/source.py",),
    "hydra": ("config/", "cli.py", "cli_sweep.py"),
    "omegaconf": ("config/", "cli.py", "cli_sweep.py", "jobs/"),
    "matplotlib": ("report/",),
    "PIL": ("report/",),
    "imageio_ffmpeg": ("report/picture.py", "datasets/video.py"),
    "pynvml": ("bench/timing.py",),
    "gymnasium": ("adapters/",),
    "rsl_rl": ("adapters/",),
    "tensordict": ("adapters/",),
    "lerobot": ("adapters/lerobot/", "policy/lerobot.py"),
    "pyarrow": ("datasets/",),
    "safetensors": ("policy/",),
    "trimesh": ("report/geometry.py",),
    "viser": ("report/web.py",),
    "onnx": ("policy/onnx.py",),
    "rich": ("jobs/", "cli.py", "report/table.py", "managers/term.py"),
}


def imports(path: Path, *, typing: bool = True) -> set[str]:
    """Every module that a file imports, lazily or not; unless ``typing``, not for type checkers
    alone.
    """
    tree = ast.parse(path.read_text())
    blocks = [node for node in ast.walk(tree) if isinstance(node, ast.If) and not typing]
    skipped = {
        node
        for block in blocks
        if ast.unparse(block.test) == "TYPE_CHECKING"
        for node in ast.walk(block)
    }
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import) and node not in skipped:
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node not in skipped:
            assert node.level == 0, f"{path}: relative import"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            paths = {name: ROOT.parent / name.replace(".", "/") for name in names}
            found |= {
                name if path.is_dir() or path.with_suffix(".py").exists() else str(node.module)
                for name, path in paths.items()
            }
    return found


FILES = {str(path.relative_to(ROOT)): imports(path) for path in sorted(ROOT.rglob("*.py"))}


def package(file: str) -> str:
    return file.removesuffix(".py").split("/")[0]


def test_the_tree_is_all_in_a_layer() -> None:
    known = set().union(*LAYERS, LEAVES) | {"__init__"}
    assert {package(file) for file in FILES} <= known


def test_layers_import_downwards_only() -> None:
    level = {name: i for i, layer in enumerate(LAYERS) for name in layer}
    wrong = []
    for file, names in FILES.items():
        here = package(file)
        for name in names:
            parts = name.split(".")
            if parts[0] != "mjstack" or len(parts) < 2 or here == "__init__":
                continue
            there = parts[1]
            allowed = (
                LEAVES[here]
                if here in LEAVES
                else LEAVES.keys() | {n for n in level if level[n] <= level[here]}
            )
            if there not in allowed:
                wrong.append(f"{file} imports {name}")
    assert not wrong


def test_no_module_imports_the_face_of_the_package() -> None:
    assert [file for file, names in FILES.items() if "mjstack" in names] == []


def test_no_circle_of_modules() -> None:
    """At run time, lazily or not: `graphlib.CycleError` names them."""
    names = {file: f"mjstack.{file[:-3].replace('/', '.')}" for file in FILES}
    graph = {
        name.removesuffix(".__init__"): imports(ROOT / file, typing=False)
        for file, name in names.items()
    }
    TopologicalSorter({name: found & graph.keys() for name, found in graph.items()}).prepare()


# Found by name: `controller.func`, `job.func`, `job.source` and `job.formats`
PLUG_INS = re.compile(
    r"(datasets/|adapters/lerobot/|jobs/collect|(policy|drivers)/lerobot\.py|train/dataset\.py"
    r"|jobs/export_lerobot\.py).*"
)


def test_the_core_finds_datasets_and_lerobot_by_name() -> None:
    """No module beside these imports one of them, lazily or not."""
    modules = {f"mjstack.{f[:-3].replace('/', '.')}" for f in FILES if PLUG_INS.fullmatch(f)}
    modules |= {name.removesuffix(".__init__") for name in modules}
    assert len(modules) > 20
    wrong = [
        f"{file} imports {name}"
        for file, names in FILES.items()
        if not PLUG_INS.fullmatch(file)
        for name in names & modules
    ]
    assert not wrong


def test_trainers_and_benchmarks_take_a_stage() -> None:
    """Folder, records and page are the run's: gates and jobs alone know it."""
    users = {file for file, names in FILES.items() if "mjstack.episodes.run" in names}
    assert {package(file) for file in users} <= {"episodes", "gates", "jobs"}
    assert len(users) <= 15


# A name says what a thing is: it is none of these, nor one with an underscore, digit or ending.
PRONOUNS = re.compile(
    "_*(found|held|ones?|each|own|then|good|every|theirs|ours|mine|hers|his|told|asks|says|wanted"
    "|drawn|looking|shown|given|taken|kept|others?|another|such|both|either|neither|some|few|many)"
    "(s|es|_|[0-9])*",
    re.IGNORECASE,
)


def bound_names(path: Path) -> Iterator[tuple[str, int]]:
    """Names that a file binds: variables, parameters, attributes, functions and classes."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield getattr(node, "id", None) or node.attr, node.lineno  # type: ignore[attr-defined]
        elif isinstance(node, ast.arg):
            yield node.arg, node.lineno
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name, node.lineno


def test_no_name_is_a_pronoun() -> None:
    wrong = [
        f"{path.relative_to(ROOT)}:{line}: {name}"
        for path in sorted(ROOT.rglob("*.py"))
        for name, line in bound_names(path)
        if PRONOUNS.fullmatch(name)
    ]
    assert not wrong


LOOSE_NAMES = """
before after now there here off over apart wrong due alike beside early late twice once again away
ahead behind between beyond along around across below above still yet already never always back down
up out aside together alone of on to by with without thing things part parts place places words word
facts fact way ways stuff matter look looks
"""
LEANING = re.compile(
    r"# (It|Its|They|Their|Them|That|Those|This|These|What|Others?|Else|Ones|Such|Both)\b"
)
MOST = {
    "vague names": 490,
    "comments that begin with a pronoun": 17,
    "docstrings that begin with What": 1,
    "lines": 35_002,
}


def is_loose(name: str, path: Path) -> bool:
    """Whether a name is an adverb, a preposition or a vague noun; a scene has places, a report has
    parts.
    """
    whole = name.strip("_").lower()
    is_usual = path.parent.name in ("scene", "report") and whole.startswith(("place", "part"))
    return whole in LOOSE_NAMES.split() and not is_usual


def test_vague_words_and_lines_only_become_fewer() -> None:
    """Each count is at most what it was; whoever brings one down lowers its limit here."""
    paths = sorted(ROOT.rglob("*.py"))
    texts = [path.read_text() for path in paths]
    loose = [name for path in paths for name, _ in bound_names(path) if is_loose(name, path)]
    comments = [line for text in texts for line in text.splitlines() if LEANING.search(line)]
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef)
    nodes = (
        node for text in texts for node in ast.walk(ast.parse(text)) if isinstance(node, kinds)
    )
    docstrings = [text for node in nodes if (text := ast.get_docstring(node) or "")[:5] == "What "]
    lines = sum(text.count("\n") for text in texts)
    counts = dict(zip(MOST, (len(loose), len(comments), len(docstrings), lines), strict=True))
    assert {name: n for name, n in counts.items() if n > MOST[name]} == {}


def test_jobs_alone_write_pages() -> None:
    """Below them, parts of a run fill in the data of `report.page`."""
    writers = {"mjstack.report.html", "mjstack.report.web"}
    users = {package(file) for file, names in FILES.items() if names & writers}
    assert users <= {"jobs", "report"}


def test_third_party_packages_have_one_home() -> None:
    wrong = [
        f"{file} imports {name}"
        for file, names in FILES.items()
        for name in names
        for top in [name.split(".")[0]]
        if top in HOMES and not file.startswith(HOMES[top])
    ]
    assert not wrong


OF_TASKS = re.compile(r"(.*_)?(red|blue)(_.*)?|xy_err.*|slot_err.*|dz_m|'(stack|reach)'")
COLORS = {"jobs/progress.py": "red"}  # of the terminal


def words(path: Path) -> Iterator[tuple[int, str]]:
    """Identifiers, strings in quotation marks, and the words of strings that are no sentences, with
    their lines.
    """
    for node in ast.walk(ast.parse(path.read_text())):
        for key in ("id", "attr", "arg", "name", "value"):
            text = getattr(node, key, None)
            if isinstance(text, str) and " " not in text:
                parts = [text] if key != "value" else [repr(text), *re.findall(r"\w+", text)]
                yield from ((getattr(node, "lineno", 0), part) for part in parts)


def test_only_tasks_know_tasks() -> None:
    """No other module names an object of a task, a task's measure or a task."""
    wrong = [
        f"{path.relative_to(ROOT)}:{line}: {word}"
        for path in sorted(ROOT.rglob("*.py"))
        if path.parent.name != "tasks"
        for line, word in words(path)
        if OF_TASKS.fullmatch(word) and COLORS.get(str(path.relative_to(ROOT))) != word
    ]
    assert not wrong


def test_packages_choose_how_mujoco_draws_before_they_import_it() -> None:
    users = {
        package(file)
        for file, names in FILES.items()
        for name in names
        if name.split(".")[0] in {"mujoco", "mujoco_warp", "mink"}
    }
    first = [ast.parse((ROOT / name / "__init__.py").read_text()).body[1] for name in sorted(users)]
    assert {ast.unparse(node) for node in first} == {"import mjstack.report.gl"}


def test_homes_are_lived_in() -> None:
    used = {name.split(".")[0] for names in FILES.values() for name in names}
    assert set(HOMES) <= used


@pytest.mark.full
def test_native_runs_load_what_they_need(tmp_path: Path) -> None:
    """Neither Warp, plots nor the browser's server."""
    program = """
import sys, torch
import mjstack
from mjstack.cli import run

HEAVY = {"warp", "mujoco_warp", "matplotlib", "viser", "pyarrow", "tensorboard", "rsl_rl"}

def report(step):
    print(step, sorted(HEAVY & sys.modules.keys()), file=sys.stderr)

env = mjstack.make_env(["sim=native"], nworld=1)
env.reset()
env.step(torch.zeros(1, env.action_manager.action_dim))
report("step")
env.close()
import mjstack.jobs.gates
report("jobs")
args = ["gates=[baseline]", "sim=native", "web.episode=false", "hydra.run.dir=run"]
report(run([*args, *sys.argv[1:]]))
"""
    done = subprocess.run(
        [sys.executable, "-c", program, *at_double_speed()],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.stderr.splitlines() == ["step []", "jobs []", "0 []"]


def test_the_package_has_what_its_configuration_names() -> None:
    """Classes of ``conf/``, and Hydra's plugins: their package is a namespace, which an
    ``__init__.py`` would take from the plugins of others.
    """
    root = ROOT.parent
    tools = tomllib.loads((root / "pyproject.toml").read_text())["tool"]
    built = tools["hatch"]["build"]["targets"]
    wheel = {*built["wheel"]["packages"], *built["wheel"]["force-include"]}
    assert {f"/{path}" for path in wheel} <= set(built["sdist"]["include"])
    texts = [path.read_text() for path in (root / "conf").rglob("*.yaml")]
    targets = {match for text in texts for match in re.findall(r"_target_: (\w+)\.", text)}
    assert "hydra_plugins" in targets
    assert {target for target in targets if (root / target).exists()} <= wheel
    assert not (root / "hydra_plugins" / "__init__.py").exists()
