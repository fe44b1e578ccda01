"""Compares N GPUs with one, in alternating runs, each in processes of its own.

    python scripts/bench_many.py --gpus 2 --what weak --worlds 2048 8192 32768 -- robot=so101

Each call adds its runs to ``many.jsonl`` in the folder, and draws table and picture of all runs
there. ``weak`` has so many worlds on each GPU, ``strong`` so many on all of them together; both
measure physics, the validated episode and ``env.step``, without planning. ``ppo`` trains for some
iterations with so many worlds on each GPU, and ``sweep`` runs eight batches of so many worlds.
"""

import argparse
import json
import statistics
import sys
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from matplotlib.figure import Figure  # noqa: E402

from mjstack.files import to_csv, write_atomic  # noqa: E402
from mjstack.process import Child, stop_all  # noqa: E402
from mjstack.report.formats import to_markdown  # noqa: E402
from mjstack.report.sections import Part, Section  # noqa: E402
from mjstack.report.table import Console, Table  # noqa: E402

SPEEDS = {
    "physics": "physics.world_steps_per_s.median",
    "episode": "episode.world_steps_per_s.median",
    "env.step": "env_step.env_steps_per_s.median",
}
FIGURES = (*SPEEDS, "batch", "samples/s", "gate runs/h")
SWEEP = 8  # jobs
Run = dict[str, Any]
"""``what``, ``worlds`` (as on the command line), ``gpus``, ``round``, ``seconds`` of the whole
command, ``status``, and the figures by name."""


def measure(what: str, worlds: int, gpus: int, args: argparse.Namespace) -> Run:
    """One run on some GPUs, or on some ranks where there is no GPU."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "run"
        command = [*args.overrides]
        if what == "sweep":
            seeds = ",".join(map(str, range(SWEEP)))
            command += ["-m", "hydra/launcher=gpus", f"hydra.launcher.jobs={gpus}", f"seed={seeds}"]
            command += ["gates=[batch]", f"nworld={worlds}", f"hydra.sweep.dir={folder}"]
        else:
            total = worlds if what == "strong" else gpus * worlds
            command += [f"devices={gpus}", f"nworld={total}"]
        if what == "ppo":
            command += ["job=train", "trainer=ppo", f"job.iterations={args.iterations}"]
            command += [f"job.folder={folder}", f"job.save_every={max(1, args.iterations // 5)}"]
        elif what in ("weak", "strong"):
            command += ["gates=[batch,throughput]", "gate.throughput.native_baseline=false"]
            command += ["gate.throughput.precision=0"]  # ranks measure at the same time, as long
            command += [f"hydra.run.dir={folder}"]
        with (Path(place) / "output.log").open("wb") as output:
            child = Child(command, output, folder=Path(place))
            try:
                run: Run = {"status": child.wait(), "seconds": child.seconds}
            finally:
                stop_all([child])
        text = (Path(place) / "output.log").read_text(errors="replace").strip()
        if run["status"] == 2:  # the command line is wrong, for every run
            print(text, file=sys.stderr)
            sys.exit(2)
        try:
            if what == "sweep" and run["status"]:
                raise ValueError("a job failed")
            run |= read(what, folder, gpus, run["seconds"])
        except (OSError, KeyError, ValueError, IndexError) as error:
            run["error"] = f"{error!r}: {text[-400:]}"
        return run


def read(what: str, folder: Path, gpus: int, seconds: float) -> dict[str, float]:
    """The figures of a run, by name."""
    if what == "sweep":
        return {"gate runs/h": 3600.0 * SWEEP / seconds}
    if what == "ppo":
        header, *rows = (folder / "train.csv").read_text().splitlines()
        column = header.split(",").index("decisions_per_s")
        rates = [float(row.split(",")[column]) for row in rows]
        return {"samples/s": statistics.median(rates[1:] or rates)}
    gates = json.loads((folder / "report.json").read_text())["gates"]
    metrics = {gate["name"]: gate["metrics"] for gate in gates if gate["status"] != "skip"}
    batch = metrics["batch"]
    speed = metrics.get("throughput_cuda") or metrics["throughput"]
    figures = {"succeeded": batch["succeeded"], "episodes": batch["episodes"]}
    if "world_steps_per_s" in batch:  # void where worlds failed
        figures["batch"] = batch["world_steps_per_s"]
    for name, key in SPEEDS.items():
        key = f"all_ranks.{key}" if gpus > 1 else key
        if key in speed:
            figures[name] = speed[key]
    return figures


def rows_of(runs: list[Run]) -> list[dict[str, Any]]:
    """A row for each measurement and figure: N GPUs over one, by neighbouring runs."""
    keys = ("what", "worlds", "gpus", "round")
    runs_by = {tuple(run[key] for key in keys): run for run in runs}
    rows = []
    for what, worlds, gpus in sorted({key[:3] for key in runs_by if key[2] > 1}):
        for name in FIGURES:
            pairs = [
                (single[name], several[name])
                for (*kind, number), several in runs_by.items()
                if kind == [what, worlds, gpus]
                and (single := runs_by.get((what, worlds, 1, number)))
                and name in single.keys() & several.keys()
            ]
            if not pairs:
                continue
            ratios = sorted(large / small for small, large in pairs)
            rows.append(
                {
                    "what": what,
                    "worlds": worlds,
                    "gpus": gpus,
                    "figure": name,
                    "one": statistics.median(small for small, _ in pairs),
                    "many": statistics.median(large for _, large in pairs),
                    "ratio": statistics.median(ratios),
                    "range": f"{ratios[0]:.3f} to {ratios[-1]:.3f}",
                    "rounds": len(pairs),
                }
            )
    return rows


def write(folder: Path, runs: list[Run]) -> None:
    """Write many.md, many.csv and many.png of all runs, and print the table."""
    title = "N GPUs over one"
    rows = rows_of(runs)
    texts = [
        row
        | {"one": f"{row['one']:,.0f}", "many": f"{row['many']:,.0f}"}
        | {"ratio": f"{row['ratio']:.3f}", "worlds": f"{row['worlds']:,}"}
        for row in rows
    ]
    columns = {"measurement": "what", "worlds": "worlds", "figure": "figure", "GPUs": "gpus"}
    columns |= {"one GPU": "one", "all": "many", "ratio": "ratio", "smallest to largest": "range"}
    table = Table.of(columns | {"rounds": "rounds"}, texts, title)
    Console(soft_wrap=True).print(table.to_console())

    def draw(path: Path) -> None:
        names = [f"{r['what']} {r['worlds']:,}, {r['figure']}, {r['gpus']} GPUs" for r in rows]
        picture = Figure((9, 1.2 + 0.3 * len(rows)), layout="constrained")
        axes = picture.subplots()
        axes.barh(range(len(rows)), [row["ratio"] / row["gpus"] for row in rows])
        axes.set_yticks(range(len(rows)), names)
        axes.invert_yaxis()
        axes.axvline(1.0, color="0.3", linewidth=1.0)
        axes.set(xlabel="ratio over the number of GPUs (1: perfect)", title=title)
        axes.grid(alpha=0.3, axis="x")
        picture.savefig(path, dpi=100)

    picture = folder / "many.png"
    if rows:
        draw(picture)
    write_atomic(folder / "many.csv", to_csv(rows))
    parts: list[Part] = [table, *([picture] if picture.exists() else [])]
    write_atomic(folder / "many.md", to_markdown([Section(title=title, parts=parts, level=1)]))


def main() -> None:
    """Measure as the command line says."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--gpus", type=int, default=2)
    parser.add_argument("--what", choices=("weak", "strong", "ppo", "sweep"), default="weak")
    parser.add_argument("--worlds", type=int, nargs="+", default=[2048])
    parser.add_argument("--rounds", type=int, default=3, help="pairs of runs")
    parser.add_argument("--iterations", type=int, default=20, help="ppo: of each run")
    parser.add_argument("--folder", type=Path, default=Path("outputs/many"))
    parser.add_argument("overrides", nargs="*", help="as for run.py")
    args = parser.parse_args()
    if args.gpus < 2:
        parser.error(f"--gpus {args.gpus}: expected at least 2, which are compared with one")
    log = args.folder / "many.jsonl"
    runs = [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []
    first = 1 + max((run["round"] for run in runs), default=-1)
    for number in range(first, first + args.rounds):
        for worlds in args.worlds:
            for gpus in (1, args.gpus)[:: 1 if number % 2 else -1]:  # what drifts, for both
                facts = {"what": args.what, "worlds": worlds, "gpus": gpus, "round": number}
                run = facts | measure(args.what, worlds, gpus, args)
                print(json.dumps(run), flush=True)
                args.folder.mkdir(parents=True, exist_ok=True)
                with log.open("a") as file:
                    file.write(json.dumps(run) + "\n")
                runs.append(run)
    write(args.folder, runs)


if __name__ == "__main__":
    main()
