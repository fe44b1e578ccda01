"""A table of arms: how fast each is, beside a bare replayed ``mujoco_warp.step``, and why.

    python tools/bench_arms.py so101 rebot ../arms/vs050 --collision "hull 64" file

An arm is a robot of mjstack, or a folder that ``mjstack new robot`` has written. For each and each
``--collision`` a process with an empty kernel cache runs the gates: its wall time is the first run.
Another one then times the physics step in buffers of the sizes that *capacity* recommended there,
as tools/bench_physics.py does. A cell has a dash where a gate failed or is not one of ``--gates``,
and the last column says why, and which part of a step is MJWarp's. ``--warm`` keeps the kernel
cache.
"""

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from bench_physics import BARE, measure_plans
from common import count, make_parser, spread

from mjstack.config import load_config
from mjstack.episodes.stage import Stage
from mjstack.scene import build_model

_ROOM = 1.25
_CONTACTS = 128  # of a world, where *capacity* failed
_COLUMNS = (
    *("arm", "gripper", "collision", "physics, M steps/s", "bare over it, in hand", "random"),
    *("env.step, 1/s", "batch, s", "first run, s", "lost or slower"),
)


def main() -> None:
    """Measure the arms of the command line, and print a row as soon as one is done."""
    parser = make_parser(__doc__)
    words = "values of robot.collision (default: each arm's own)"
    parser.add_argument("--collision", nargs="+", default=[""], help=words)
    parser.add_argument("--gates", default="baseline,parity,capacity,batch,throughput")
    parser.add_argument("--warm", action="store_true", help="keep the kernel cache")
    parser.add_argument("--steps", type=count, default=20, help="control steps per repetition")
    parser.add_argument("--repetitions", type=count, default=3)
    args = parser.parse_intermixed_args()
    arms = [text for text in args.overrides if "=" not in text]
    options = [text for text in args.overrides if "=" in text]
    print(f"| {' | '.join(_COLUMNS)} |\n|{' --- |' * len(_COLUMNS)}", flush=True)
    for arm in arms:
        for collision in args.collision:
            print(f"| {' | '.join(measure(arm, collision, options, args))} |", flush=True)


def measure(arm: str, collision: str, options: list[str], args: argparse.Namespace) -> list[str]:
    """The cells of an arm's row."""
    folder = Path(arm).resolve()
    config_dir = str(folder / "conf") if folder.is_dir() else None
    overrides = [f"robot={folder.name}", "nworld=2048", *options]
    overrides += [f"robot.collision={collision}"] * bool(collision)
    with tempfile.TemporaryDirectory() as place:
        if not args.warm:
            os.environ["WARP_CACHE_PATH"] = f"{place}/kernels"  # also of the second process
        gates, seconds = run_gates(
            [*overrides, f"gates=[{args.gates}]"], config_dir, Path(place) / "run"
        )
        found = {gate["name"]: gate for gate in gates}
        metrics = {name: gate["metrics"] for name, gate in found.items()}
        reasons = [
            f"{name}: {gate['reason']}" for name, gate in found.items() if gate["status"] == "fail"
        ]
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            ratios = []
            for random, kind in ((False, "recommended"), (True, "recommended_env")):
                sizes = {
                    key.rpartition(".")[2]: value
                    for key, value in metrics.get("capacity", {}).items()
                    if key.startswith(f"{kind}.")
                }
                # The bare step lists pairs of geoms that mjstack's leaves out
                sizes["nconmax"] = math.ceil(_ROOM * sizes.get("nconmax", _CONTACTS))
                sized = [f"batch.{key}={value}" for key, value in sizes.items()]
                work = (overrides + sized, config_dir, random, args.steps, args.repetitions)
                ratios.append(pool.submit(_ratio, *work).result())
    cuda = metrics.get("throughput_cuda", {})
    notes = [gate.get("notes", {}) for gate in gates]
    step = next(
        (note["backend"] for note in notes[::-1] if "MuJoCo Warp" in note.get("backend", "")), ""
    )
    step = step.rpartition(", ")[2]
    gripper, used = _description(overrides, config_dir)
    return [
        *(folder.name, gripper, used),
        _number(cuda, "physics.world_steps_per_s.median", 1e-6, ".2f"),
        *ratios,
        _number(cuda, "env_step.env_steps_per_s.median", 1.0, ",.0f"),
        _number(cuda, "episode.seconds.median", 1.0, ".2f"),
        f"{seconds:.0f}" + " (warm)" * args.warm,
        "; ".join([*reasons, step]).replace("|", "/").replace("\n", " "),
    ]


def run_gates(
    overrides: list[str], config_dir: str | None, folder: Path
) -> tuple[list[dict[str, Any]], float]:
    """Gates' results of a run in a process of its own, and its wall time [s]."""
    command = [
        sys.executable,
        "-m",
        "mjstack",
        *(["--config-dir", config_dir] if config_dir else []),
    ]
    command += [*overrides, "web.episode=false", f"hydra.run.dir={folder}"]
    began = time.perf_counter()
    done = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    seconds = time.perf_counter() - began
    report = folder / "report.json"
    if not report.is_file():
        last = (done.stderr.strip().splitlines() or ["no report"])[-1]
        failed = {"name": "run", "status": "fail", "reason": last, "metrics": {}}
        return [failed], seconds
    return json.loads(report.read_text())["gates"], seconds


def _ratio(
    overrides: list[str], config_dir: str | None, random: bool, steps: int, repetitions: int
) -> str:
    """Time of a bare step over that of mjstack's, or the error."""
    try:
        cfg = load_config(overrides, config_dir=config_dir)
        times = measure_plans(Stage(cfg), steps, repetitions, random, only_planned=True)
        planned = next(ms for name, ms in times.items() if name != BARE)
        return spread([b / a for a, b in zip(planned, times[BARE], strict=True)])
    except Exception as error:
        return f"{type(error).__name__}: {error}".replace("|", "/").replace("\n", " ")


def _description(overrides: list[str], config_dir: str | None) -> tuple[str, str]:
    """An arm's gripper, and how it collides."""
    cfg = load_config(overrides, config_dir=config_dir)
    model = build_model(cfg)
    meshes = int((model.geom_type == 7).sum())
    linked = ", linkage" * bool(model.neq) + ", tendon" * bool(model.ntendon)
    collision = f"{cfg.robot.collision}, {meshes} meshes" if meshes else "no meshes"
    return f"{len(cfg.robot.gripper_joints)} joints{linked}", collision


def _number(metrics: dict[str, float], key: str, scale: float, form: str) -> str:
    return format(scale * metrics[key], form) if key in metrics else "-"


if __name__ == "__main__":
    main()
