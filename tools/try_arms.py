"""Try robots of ``mjstack new robot`` at the gates, and print a row of a table for each.

``python tools/try_arms.py FOLDER... [--gates parity,batch] [--worlds 32]`` takes folders that the
command has written, perhaps edited since. The first column of numbers counts lines of the YAML that
differ from what the command writes now. Without ``--gates`` *baseline* and *success* are run on
native MuJoCo; the others need MuJoCo Warp.
"""

import argparse
import difflib
import tempfile
import time
from contextlib import chdir
from pathlib import Path

import common  # noqa: F401  (its folder is the repository's)
import yaml

import mjstack
from mjstack.config.session import search_path
from mjstack.errors import MjstackError
from mjstack.robots.new import write_new

_COLUMNS = ("arm", "lines edited", "baseline", "parity", "batch", "success", "seconds", "sentence")


def main() -> None:
    """Print the table, a row as soon as its robot is done."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", nargs="+", type=Path, help="of `mjstack new robot`")
    parser.add_argument("--gates", default="", help="beside baseline and success: parity,batch")
    parser.add_argument("--worlds", type=int, default=16)
    args = parser.parse_args()
    print(f"| {' | '.join(_COLUMNS)} |\n|{' --- |' * len(_COLUMNS)}", flush=True)
    for folder in args.folders:
        print(f"| {' | '.join(try_arm(folder, args.gates, args.worlds))} |", flush=True)


def try_arm(folder: Path, gates: str, worlds: int) -> list[str]:
    """The cells of a robot's row."""
    name = folder.resolve().name
    began = time.perf_counter()
    cells = dict.fromkeys(_COLUMNS, "-")
    reasons = []
    for chosen in (["baseline"], gates.split(","), ["success"]):
        overrides = [f"robot={name}", f"nworld={worlds}", f"gates=[{','.join(chosen)}]"]
        if chosen != gates.split(","):
            overrides.append("sim=native")
        elif not gates:
            continue
        try:
            found = mjstack.verify(overrides, config_dir=folder / "conf").gates
        except MjstackError as error:
            reasons.append(str(error))
            break
        cells |= {gate.name: str(gate.status) for gate in found.values()}
        reasons += [gate.reason for gate in found.values() if gate.status != "pass"]
        if "success" in found:
            cells["success"] = found["success"].reason.split(" episodes")[0]
    cells["arm"] = name
    cells["lines edited"] = str(count_edits(folder, name))
    cells["seconds"] = f"{time.perf_counter() - began:.0f}"
    cells["sentence"] = "; ".join(reasons).replace("|", "/").replace("\n", " ")
    return [cells[column] for column in _COLUMNS]


def count_edits(folder: Path, name: str) -> int:
    """How many lines of a robot's YAML are others than the command writes."""
    path = (folder / "conf" / "robot" / f"{name}.yaml").resolve()
    file = path.parent / yaml.safe_load(path.read_text())["file"]
    # The same depth of folders would give the same relative path; that line does not count.
    with tempfile.TemporaryDirectory() as empty, chdir(empty), search_path([]):
        write_new(["robot", name, str(file)])
        before = (Path(name) / "conf" / "robot" / f"{name}.yaml").read_text().splitlines()
    lines = difflib.ndiff(before, path.read_text().splitlines())
    return sum(line.startswith("+ ") and not line.startswith("+ file:") for line in lines)


if __name__ == "__main__":
    main()
