"""Time what a batch of a training from pixels costs, by operation.

    python tools/profile_pixels.py experiment=pixels task=reach nworld=8 cameras=front graph=off

The expert plays a round; its images are learned from under torch's profiler.
"""

import argparse
import math
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from common import count, make_parser, run
from torch.profiler import ProfilerActivity, profile

from mjstack.config.schema import Config
from mjstack.envs.buffers import Advance
from mjstack.episodes.stage import Stage
from mjstack.report.table import Table
from mjstack.train.clone_learner import CloneLearner
from mjstack.train.clone_network import vision_of
from mjstack.train.images import ImagePool, pool_rows
from mjstack.train.rounds import make_round


def measure(args: argparse.Namespace, cfg: Config, advance: Advance) -> Iterator[Table]:
    """Profile batches of the configured training."""
    cfg.job.batches = args.batches
    stage = Stage(cfg)
    device = stage.backend[1]
    kinds = [ProfilerActivity.CPU, *[ProfilerActivity.CUDA] * device.startswith("cuda")]
    with TemporaryDirectory() as name:
        folder = Path(name)
        sizes = vision_of(cfg, cfg.job).sizes
        pool = ImagePool(sizes, pool_rows(stage, stage.episode_steps), device)
        episodes = make_round(stage, folder, None, 0, pool)
        learner = CloneLearner(stage, episodes, folder, pool)
        learner.learn(1)  # warms up
        before = learner.seconds
        with profile(activities=kinds) as found:
            learner.learn(2)
    events = found.key_averages()
    device_times = [event.self_device_time_total for event in events]
    on_device = math.fsum(device_times) > 0.0
    times = device_times if on_device else [event.self_cpu_time_total for event in events]
    ranked = sorted(zip(times, events, strict=True), key=lambda row: -row[0])
    rows = [
        [event.key, f"{1e-3 * time / args.batches:.2f}", f"{time / math.fsum(times):.1%}"]
        for time, event in ranked[: args.rows]
    ]
    milliseconds = 1e3 * (learner.seconds - before) / args.batches
    steps = learner.policy.config["job"]["batch_size"]
    title = f"A batch of {steps} steps: {milliseconds:.1f} ms, on {device}"
    title += f" with {torch.get_num_threads()} threads"
    yield Table(title=title, header=["operation, its own time", "ms per batch", "share"], rows=rows)


if __name__ == "__main__":
    parser = make_parser(__doc__)
    parser.add_argument("--batches", type=count, default=50)
    parser.add_argument("--rows", type=count, default=12, help="operations that are printed")
    run(parser, measure)
