"""Hash the verdicts of a fixed list of small runs, to show that a change of the code moved none.

    python tools/verdicts.py --checkout . --folder /tmp/after --out after.json
    python tools/verdicts.py --compare before.json after.json

Gates *batch* and *success* play both robots, tasks stack, box and reach, and the examples, with the
three experts, on native MuJoCo and on MJWarp's CPU device, with fixed seeds. The file has a SHA-256
of every array of each record of episodes (``batch_seed*.npz``, ``success_seed*.npz``) but times
and places, and the number of worlds that succeeded. On one machine equal code gives equal files.
``--compare`` lists the differences, and their sizes where both folders are still there. All runs
together take some ten minutes on one core, less where Warp's kernels are cached; ``--only`` takes a
part. A run that has ended in the folder is not played again.
"""

import argparse
import hashlib
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

_IGNORED = ("seconds", "rank_")
"""Beginnings of the names of arrays that differ from run to run."""
_STEMS = ("batch", "success")
_BOTH = "gates=[batch,success]"
_BATCH = "gates=[batch]"
_WARP = "sim=mjwarp sim.device=cpu"
_STATE = "controller=closed_loop controller.clock=false"
_SEEDS = "gate.batch.seeds=2"
RUNS = {
    # Native MuJoCo. Gate success plays closed_loop in place of open_loop
    "so101_stack": f"{_BOTH} {_SEEDS} nworld=16",
    "rebot_stack": f"robot=rebot {_BOTH} nworld=16 seed=3",
    "so101_stack_closed": f"{_BATCH} controller=closed_loop nworld=16 reset=randomized seed=5",
    "rebot_stack_closed": f"robot=rebot {_BATCH} controller=closed_loop nworld=16",
    "so101_stack_state": f"{_BOTH} {_STATE} nworld=16",
    "rebot_stack_state": f"robot=rebot {_BATCH} {_STATE} nworld=16 seed=7",
    "so101_stack_fine": f"{_BATCH} timing=fine nworld=8",
    "so101_box": f"task=box {_BOTH} nworld=4",
    "rebot_box": f"robot=rebot task=box {_BOTH} nworld=4 seed=11",
    "so101_reach": f"task=reach {_BOTH} nworld=16",
    "rebot_reach": f"robot=rebot task=reach {_BOTH} nworld=16",
    # Examples
    "push": f"--config-dir=examples/push/conf task=push {_BOTH} nworld=8",
    "rebot_push": f"--config-dir=examples/push/conf task=push robot=rebot {_BATCH} nworld=8",
    "tower": f"--config-dir=examples/tower/conf task=tower {_BOTH} nworld=4",
    "drawer": f"--config-dir=examples/drawer/conf task=drawer {_BOTH} nworld=8",
    "scara": f"--config-dir=examples/scara/conf robot=scara {_BOTH} nworld=8",
    # MJWarp
    "warp_so101_stack": f"{_WARP} {_BATCH} nworld=8",
    "warp_rebot_stack": f"{_WARP} robot=rebot {_BATCH} controller=closed_loop nworld=4",
    "warp_so101_state": f"{_WARP} {_BATCH} {_STATE} nworld=4 reset=randomized",
    "warp_so101_reach": f"{_WARP} task=reach {_BOTH} nworld=16",
    "warp_rebot_reach": f"{_WARP} robot=rebot task=reach {_BATCH} nworld=4 controller=closed_loop",
    "warp_scara": f"{_WARP} --config-dir=examples/scara/conf robot=scara {_BATCH} nworld=4",
}
"""Command lines of mjstack by name."""


def play(name: str, checkout: Path, python: Path, folder: Path) -> None:
    """Play a run in a process of its own, unless the folder has it.

    Raises:
        SystemExit: It ended with another status than pass (0) or fail (1).
    """
    report = folder / "report.json"
    if report.exists() and json.loads(report.read_text())["status"] in ("pass", "fail"):
        return
    overrides = RUNS[name].split()
    if not RUNS[name].startswith(_WARP):
        overrides.append("sim=native")
    command = [str(python), "-m", "mjstack", *overrides, "web.episode=false"]
    environment = os.environ | {"PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1"}
    began = time.perf_counter()
    done = subprocess.run(
        [*command, f"hydra.run.dir={folder}"],
        env=environment,
        cwd=checkout,
        capture_output=True,
        text=True,
    )
    print(f"{name}: status {done.returncode}, {time.perf_counter() - began:.0f} s", flush=True)
    if done.returncode not in (0, 1):
        raise SystemExit(f"{name}: {(done.stderr or done.stdout).strip()[-2000:]}")


def read_records(folder: Path) -> dict[str, dict[str, np.ndarray]]:
    """Arrays of the records in a run's folder, by file and name."""
    records = {}
    for path in sorted(path for stem in _STEMS for path in folder.glob(f"{stem}_seed*.npz")):
        with np.load(path) as arrays:
            names = sorted(name for name in arrays.files if not name.startswith(_IGNORED))
            records[path.name] = {name: arrays[name] for name in names}
    return records


def digest(array: np.ndarray) -> str:
    """SHA-256 of an array, its type and its shape."""
    head = f"{array.dtype.str} {array.shape} ".encode()
    return hashlib.sha256(head + np.ascontiguousarray(array).tobytes()).hexdigest()


def summarise(folder: Path) -> dict[str, Any]:
    """Succeeded worlds and hashes of each record in a run's folder."""
    return {
        file: {
            "succeeded": f"{int((arrays['failed'] == 0).sum())} of {arrays['failed'].size}",
            "arrays": {name: digest(array) for name, array in arrays.items()},
        }
        for file, arrays in read_records(folder).items()
    }


def compare(before: dict[str, Any], after: dict[str, Any]) -> list[str]:
    """A line for each run, record or array that differs or is missing."""
    lines = []
    for run in sorted(before["runs"].keys() | after["runs"].keys()):
        sides = [result["runs"].get(run, {}) for result in (before, after)]
        arrays = [read_records(Path(result["folder"]) / run) for result in (before, after)]
        for file in sorted(sides[0].keys() | sides[1].keys()):
            if not all(file in side for side in sides):
                lines.append(f"{run}/{file}: only {'after' if file in sides[1] else 'before'}")
                continue
            counts = [side[file]["succeeded"] for side in sides]
            if counts[0] != counts[1]:
                lines.append(f"{run}/{file}: {counts[0]} succeeded, now {counts[1]}")
            hashes = [side[file]["arrays"] for side in sides]
            for name in sorted(hashes[0].keys() | hashes[1].keys()):
                if hashes[0].get(name) != hashes[1].get(name):
                    pair = [side.get(file, {}).get(name) for side in arrays]
                    lines.append(f"{run}/{file}: {name} {describe_change(*pair)}")
    return lines


def describe_change(before: np.ndarray | None, after: np.ndarray | None) -> str:
    """The change of an array in a few words."""
    if before is None or after is None:
        return "differs, or is in one of them alone"
    if before.shape != after.shape or before.dtype != after.dtype:
        return f"was {before.dtype} {before.shape}, is {after.dtype} {after.shape}"
    changed = (before != after) & ~((before != before) & (after != after))
    text = f"differs in {int(changed.sum())} of {before.size} elements"
    if before.dtype.kind in "fiu":
        change = np.nan_to_num(abs(after.astype(float) - before.astype(float)), nan=np.inf)
        text += f", by at most {change.max():.3g}"
    return text


def main() -> None:
    """Play and hash, or compare."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    root = Path(__file__).resolve().parents[1]
    parser.add_argument("--checkout", type=Path, default=root, help="of mjstack; default: this one")
    parser.add_argument("--python", type=Path, help="default: the checkout's .venv, or this one")
    parser.add_argument("--folder", type=Path, default=Path("outputs/verdicts"), help="of the runs")
    parser.add_argument("--out", type=Path, default=Path("outputs/verdicts.json"))
    parser.add_argument("--only", default="", help="runs whose name begins so")
    parser.add_argument("--compare", type=Path, nargs=2, metavar=("BEFORE", "AFTER"))
    args = parser.parse_args()
    if args.compare:
        before, after = (json.loads(path.read_text()) for path in args.compare)
        lines = compare(before, after)
        print(*lines, f"{len(before['runs'])} runs, {len(lines)} differences", sep="\n")
        sys.exit(bool(lines))
    checkout = args.checkout.resolve()
    folder = args.folder.resolve()
    local = checkout / ".venv/bin/python"
    python = (args.python or (local if local.exists() else Path(sys.executable))).absolute()
    names = [name for name in RUNS if name.startswith(args.only)]
    if not names:
        parser.error(f"--only {args.only}: no run's name begins so; there are {', '.join(RUNS)}")
    for name in names:
        play(name, checkout, python, folder / name)
    runs = {name: summarise(folder / name) for name in names}
    args.out.write_text(json.dumps({"folder": str(folder), "runs": runs}, indent=1) + "\n")
    for name, records in runs.items():
        print(name, *(f"{file}: {record['succeeded']}" for file, record in records.items()))


if __name__ == "__main__":
    main()
