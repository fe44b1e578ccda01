"""How often the expert does every task, with and without a clock, from random starts.

    python tools/expert_rates.py --nworld 32 sim=native                   # two cores
    python tools/expert_rates.py --nworld 4096 --out rates.csv sim=mjwarp # a GPU

Tasks are those of mjstack, its examples and `mjstack new task`. A row has the worlds that
succeeded, how many broke each rule, and seconds. Other arguments are overrides.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import mjstack
from mjstack.episodes.stage import Stage
from mjstack.errors import MjstackError
from mjstack.files import to_csv

ROOT = Path(__file__).parents[1]
TASKS = ("stack", "box", "reach", "tower", "push", "slot", "peg", "lift", "drawer")
MODES = {"clock": "controller.clock=true", "no clock": "controller.clock=false"}


def config_folder(task: str, folder: Path) -> Path | None:
    """The folder of a task's configuration; that of `mjstack new task` is written for lift."""
    if task == "lift":
        if not (folder / "lift").exists():
            command = [sys.executable, "-m", "mjstack", "new", "task", "lift"]
            subprocess.run(command, cwd=folder, check=True, stdout=subprocess.DEVNULL)
        return folder / "lift" / "conf"
    example = ROOT / "examples" / task / "conf"
    return example if example.exists() else None


def play(
    task: str, mode: str, overrides: list[str], nworld: int, folder: Path
) -> dict[str, object]:
    """A row: how many worlds succeeded, and how many broke each rule."""
    began = time.perf_counter()
    chosen = [f"task={task}", "controller=closed_loop", "reset=randomized", f"nworld={nworld}"]
    try:
        cfg = mjstack.load_config(
            [*chosen, MODES[mode], *overrides], config_dir=config_folder(task, folder)
        )
        stage = Stage(cfg)
        episode = stage.play(stage.batch_simulation(nworld), cfg.reset)
        failing = stage.check.rules.failing(episode.failed)
        succeeded: object = int((episode.failed == 0).sum())
    except MjstackError as error:
        succeeded, failing = "", {f"{error}"[:150]: []}
    broken = "; ".join(f"{rule} {len(worlds)}" for rule, worlds in failing.items())
    seconds = round(time.perf_counter() - began, 1)
    return {"succeeded": succeeded, "broken": broken, "seconds": seconds}


def main() -> None:
    """Play and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--nworld", type=int, default=32)
    parser.add_argument("--tasks", nargs="+", default=TASKS)
    parser.add_argument("--robots", nargs="+", default=("so101", "rebot"))
    parser.add_argument("--modes", nargs="+", default=tuple(MODES), choices=tuple(MODES))
    parser.add_argument("--out", type=Path, help="a CSV file")
    args, overrides = parser.parse_known_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for task in args.tasks:
            for robot in args.robots:
                for mode in args.modes:
                    row: dict[str, object] = {"task": task, "robot": robot, "mode": mode}
                    options = [f"robot={robot}", *overrides]
                    row |= play(task, mode, options, args.nworld, Path(folder))
                    rows.append(row)
                    print(*row.values(), sep="\t", flush=True)
                    if args.out:
                        args.out.write_text(to_csv(rows))


if __name__ == "__main__":
    main()
