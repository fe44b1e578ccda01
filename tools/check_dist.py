"""Build wheel and sdist, and check both as their users would have them.

Each Python of ``--python`` gets an empty environment outside of the checkout, where the wheel is
installed by pip alone; ``python3.11:constraints.txt`` with versions of that file, else the newest.
There run the gates, ``experiment=demo``, an example in its own folder and the tests that need no
checkout. Then the same with the sdist in the wheel's place. ``--log`` writes the tables as a page.
``--quick`` builds the wheel alone, and tries its gates and ``experiment=demo`` in an empty
environment of this Python, with versions of constraints.txt.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
import tomllib
import zipfile
from datetime import UTC, datetime
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
MOST = 12_000_000  # bytes of either file
DEMO = ["experiment=demo", "nworld=4"]
GATES = ["gates=[baseline,parity]", "nworld=4"]
TESTS = (  # they read nothing of the checkout, and need pytest alone
    *("test_rng_math", "test_managers", "test_stack_check", "test_open_loop", "test_simulation"),
    *("test_verify",),
)
MARKED = "not full and not long"
IN_WHEEL = (
    *("mjstack/py.typed", "mjstack/conf/config.yaml", "mjstack/conf/new/task.txt"),
    *("mjstack/robots/so101.xml", "mjstack/robots/rebot.xml"),
    *("policies/so101_stack/card.md", "policies/rebot_stack/card.md"),
    *("licenses/LICENSE", "licenses/NOTICE"),
)
IN_SDIST = (
    *("/LICENSE", "/NOTICE", "/README.md", "/CHANGELOG.md", "/CITATION.cff", "/pyproject.toml"),
    *("/conf/config.yaml", "/tests/conftest.py", "/tools/check_dist.py"),
    *("/examples/slot/slot.py", "/examples/scara/scara.xml", "/constraints.txt"),
)
NAMED = "hydra-core|mink|mujoco|mujoco-warp|numpy|torch|warp-lang"  # packages, in the log
NOWHERE = re.compile(r"__pycache__|\.pyc$|/outputs/|\.venv|/\.git/|/build/|MUJOCO_LOG")

Row = list[str]


def main() -> None:
    """Build, check, and print what was seen."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    pythons = ["python3.11:constraints.txt", "python3.12", "python3.13"]
    parser.add_argument("--python", nargs="*", default=pythons)
    parser.add_argument("--log", type=Path, help="a Markdown page to write")
    parser.add_argument("--quick", action="store_true")
    args = parser.parse_args()
    os.environ.pop("PYTHONPATH", None)  # which may name the checkout
    for name in [] if args.quick else args.python:
        python = name.partition(":")[0]
        try:
            subprocess.run([python, "-V"], check=True, capture_output=True)
        except (OSError, subprocess.CalledProcessError):
            parser.error(f"{python} does not run here. Install it, or name others with --python")
    version = check_versions()
    with tempfile.TemporaryDirectory(prefix="dist") as name:
        work = Path(name)
        if args.quick:
            try_quickly(work)
            return
        files = build(work)
        rows = [check_content(file, version) for file in files]
        text = table(["file", "size", "files"], rows)
        for python in args.python:
            text += f"\n\n{check_python(python, files, work)}"
            print(text, flush=True)
    if args.log:
        title = f"# Distribution of {version}, checked {datetime.now(UTC):%Y-%m-%d}"
        intro = (
            "`make dist`, on two cores, no GPU. Times are wall times, with other work beside it."
        )
        args.log.write_text(f"{title}\n\n{intro}\n\n{text}\n", encoding="utf-8")


def check_versions() -> str:
    """The version, which is the same wherever it is written."""
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    for file, line in {
        "mjstack/version.py": f'__version__ = "{version}"',
        "CITATION.cff": f"version: {version}",
        "CHANGELOG.md": f"## {version}",
    }.items():
        if line not in (ROOT / file).read_text(encoding="utf-8"):
            raise SystemExit(f"{file}: expected {line!r}, as in pyproject.toml")
    return version


def build(work: Path) -> list[Path]:
    """Wheel and sdist in ``dist/``, the wheel made from the sdist, and both as twine wants them."""
    tool = make_environment(sys.executable, work / "tools")
    call([tool, "-m", "pip", "install", "--quiet", "build", "twine"])
    shutil.rmtree(ROOT / "dist", ignore_errors=True)
    call([tool, "-m", "build", "--outdir", str(ROOT / "dist"), str(ROOT)])
    files = sorted((ROOT / "dist").iterdir())
    call([tool, "-m", "twine", "check", "--strict", *map(str, files)])
    return files


def check_content(file: Path, version: str) -> Row:
    """A row of a file that has what it should, and nothing else."""
    if file.suffix == ".whl":
        names = zipfile.ZipFile(file).namelist()
        wanted = IN_WHEEL
        others = {name.partition("/")[0] for name in names}
        others -= {"mjstack", "hydra_plugins", f"mjstack-{version}.dist-info"}
    else:
        with tarfile.open(file) as archive:
            names = archive.getnames()
        wanted = IN_SDIST
        others = {name for name in names if not name.startswith(f"mjstack-{version}/")}
    missing = [end for end in wanted if not any(name.endswith(end) for name in names)]
    surplus = [*others, *filter(NOWHERE.search, names)]
    size = file.stat().st_size
    if missing or surplus or size > MOST:
        raise SystemExit(f"{file.name}: missing {missing}, surplus {surplus}, {size} bytes")
    return [file.name, f"{size / 1e6:.2f} MB", f"{len(names)}"]


def check_python(name: str, files: list[Path], work: Path) -> str:
    """What a Python's empty environment did with both files, as Markdown."""
    wheel, sdist = files
    python, _, constraint = name.partition(":")
    own = work / "own"
    unpacked = work / "sdist"
    with tarfile.open(sdist) as archive:
        archive.extractall(unpacked, filter="data")
    (source,) = unpacked.iterdir()
    release = subprocess.check_output([python, "-V"], text=True).strip()
    began = time.perf_counter()
    interpreter = make_environment(python, own)
    pip = [interpreter, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    if constraint:
        pip += ["--constraint", str(ROOT / constraint)]
    rows = []
    for file, *options in ((wheel,), (sdist, "--no-deps", "--force-reinstall")):
        seconds = call([*pip, *map(str, options), str(file)])
        rows.append([f"`pip install {file.name}`", f"{seconds:.0f} s"])
        folder = work / file.suffix.strip(".")
        first = [interpreter, "-m", "mjstack", "gates=[baseline]", "sim=native"]
        folder.mkdir()
        rows.append(["`mjstack gates=[baseline] sim=native`", f"{call(first, folder):.0f} s"])
        if file == wheel:
            seconds = time.perf_counter() - began
            rows.append(["from no environment to a gate that passed", f"{seconds:.0f} s"])
            call([*pip, "pytest"])
        rows += use(interpreter, source, folder)
        shutil.rmtree(folder)
    freeze = [interpreter, "-m", "pip", "freeze"]
    frozen = subprocess.run(freeze, capture_output=True, text=True, check=True).stdout
    packages = re.findall(rf"(?im)^((?:{NAMED})==.*)", frozen)
    size = sum(path.lstat().st_size for path in own.rglob("*") if not path.is_dir())
    shutil.rmtree(own)
    shutil.rmtree(unpacked)
    versions = f"versions of {constraint}" if constraint else "newest versions"
    head = f"## Python {release.removeprefix('Python ')}, {versions}\n\n"
    head += f"{', '.join(packages)}; {size / 1e9:.1f} GB in all\n\n"
    return head + table(["step", "time"], rows)


def use(python: str, source: Path, folder: Path) -> list[Row]:
    """Steps in a folder outside of the checkout, each with its time; one that fails ends it all."""
    mjstack = [python, "-m", "mjstack"]
    scara = shutil.copytree(source / "examples" / "scara", folder / "scara")
    shutil.copytree(source / "tests", folder / "tests")
    shutil.copy(source / "pyproject.toml", folder)
    example = ["--config-dir", "conf", "robot=scara", "gates=[baseline]", "sim=native"]
    files = [f"tests/{name}.py" for name in TESTS]
    steps = {
        "`mjstack gates=[baseline,parity] nworld=4`": ([*mjstack, *GATES], folder),
        "`mjstack experiment=demo nworld=4`": ([*mjstack, *DEMO], folder),
        "`mjstack --config-dir conf robot=scara` in `examples/scara`": (
            [*mjstack, *example],
            scara,
        ),
        f"{len(files)} files of tests": (
            [python, "-m", "pytest", "-q", "-m", MARKED, *files],
            folder,
        ),
    }
    return [[name, f"{call(words, where):.0f} s"] for name, (words, where) in steps.items()]


def try_quickly(work: Path) -> None:
    """The wheel alone, in an empty environment of this Python and versions of constraints.txt."""
    pip = ["-m", "pip", "--disable-pip-version-check", "--quiet"]
    call([sys.executable, *pip, "wheel", "--no-deps", "--wheel-dir", str(work), str(ROOT)])
    (wheel,) = work.glob("*.whl")
    print(check_content(wheel, check_versions()))
    python = make_environment(sys.executable, work / "own")
    call([python, *pip, "install", "--constraint", str(ROOT / "constraints.txt"), str(wheel)])
    for words in (GATES, DEMO):
        call([python, "-m", "mjstack", *words], work)


def make_environment(python: str, folder: Path) -> str:
    """The interpreter of an empty environment."""
    call([python, "-m", "venv", str(folder)])
    return str(folder / "bin" / "python")


def call(words: list[str], folder: Path | None = None) -> float:
    """Seconds of a command that succeeds; its output is shown if it does not."""
    began = time.perf_counter()
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(
            f"{' '.join(words)}: exit status {done.returncode}\n{done.stdout}{done.stderr}"
        )
    return time.perf_counter() - began


def table(header: Row, rows: list[Row]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


if __name__ == "__main__":
    main()
