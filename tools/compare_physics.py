"""Compare the speed of two checkouts: physics steps and ``env.step`` of MJWarp, in turns.

    python tools/compare_physics.py --base ../before --device cuda:0

Each checkout runs in a process of its own. For each robot and number of worlds, both play the same
joint targets from the same states, one after the other, and the order changes with every
repetition: physics under held joint targets and under random ones, and ``env.step`` with resets. A
row has the milliseconds per call, and the speed of this checkout over the base's: the geometric
mean over the pairs, with a 95 % interval from a bootstrap. ``same`` says whether both ended alike:
on the CPU device bit for bit, on CUDA by the largest difference of a position.
"""

import argparse
import gc
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

_ROOT = Path(__file__).resolve().parent.parent
WORKS = {"held": "physics, held targets", "random": "physics, random targets", "env": "env.step"}
_DECIMATION = 10  # physics steps in one call
_SETTLE = 50  # control steps under random targets before the states are taken


class Worlds:
    """The worlds of one checkout, in its process."""

    def __init__(self, robot: str, nworld: int, device: str, states: str) -> None:
        import torch

        import mjstack

        overrides = [f"robot={robot}", "sim=mjwarp", "graph=auto"]
        self.env = mjstack.make_env(overrides, nworld=nworld, seed=0, device=device)
        self.env.reset(seed=0)
        self.sim = self.env.sim
        limits = torch.as_tensor(self.sim.model.actuator_ctrlrange).float().to(self.sim.device)
        generator = torch.Generator("cpu").manual_seed(0)
        shape = (nworld, limits.shape[0])

        def target() -> torch.Tensor:
            share = torch.rand(shape, generator=generator).to(self.sim.device)
            return limits[:, 0] + (limits[:, 1] - limits[:, 0]) * share

        self.names = ("qpos", "qvel", "act", "ctrl")
        settle = [target() for _ in range(_SETTLE)]
        self.targets = [target() for _ in range(64)]
        shape = (nworld, self.env.action_manager.action_dim)
        self.actions = [
            (2.0 * torch.rand(shape, generator=generator) - 1.0).to(self.sim.device)
            for _ in range(64)
        ]
        if not Path(states).exists():
            for ctrl in settle:
                self.sim.ctrl[:] = ctrl
                self.sim.step(_DECIMATION)
            arrays = {name: getattr(self.sim, name).cpu().numpy() for name in self.names}
            np.savez(states, **arrays)
        with np.load(states) as arrays:
            self.state = {name: torch.from_numpy(arrays[name]) for name in self.names}
        for work in WORKS:  # compile and capture
            self.play(work, 3)

    def play(self, work: str, steps: int) -> dict[str, Any]:
        """Milliseconds per call of a work, and where the first worlds end."""
        if work == "env":
            self.env.reset(seed=0)
        else:
            self.sim.reset()
            for name, values in self.state.items():
                getattr(self.sim, name)[:] = values.to(self.sim.device)
        self.sim.synchronize()
        began = time.perf_counter()
        for step in range(steps):
            if work == "env":
                self.env.step(self.actions[step % len(self.actions)])
                continue
            if work == "random":
                self.sim.ctrl[:] = self.targets[step % len(self.targets)]
            self.sim.step(_DECIMATION)
        self.sim.synchronize()
        seconds = time.perf_counter() - began
        return {"ms": 1e3 * seconds / steps, "qpos": self.sim.qpos[:4].cpu().double().tolist()}


def serve() -> None:
    """Work off the parent's requests, a line of JSON each."""
    sys.stdout, replies = sys.stderr, sys.stdout
    worlds = None
    for line in sys.stdin:
        request = json.loads(line)
        if "robot" in request:
            if worlds:
                worlds.env.close()
            worlds = None
            gc.collect()  # before there are others
            worlds = Worlds(**request)
            reply: dict[str, Any] = {"step": worlds.sim.description}
        else:
            assert worlds
            reply = worlds.play(**request)
        print(json.dumps(reply), file=replies, flush=True)


class Checkout:
    """A checkout's process."""

    def __init__(self, path: Path, python: str) -> None:
        env = {**os.environ, "PYTHONPATH": f"{path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"}
        command = [python, __file__, "--serve"]
        pipe = subprocess.PIPE
        self.process = subprocess.Popen(
            command, cwd=path, env=env, stdin=pipe, stdout=pipe, text=True
        )

    def call(self, **request: Any) -> dict[str, Any]:
        """Send a request, and wait for its reply."""
        assert self.process.stdin
        assert self.process.stdout
        self.process.stdin.write(json.dumps(request) + "\n")
        self.process.stdin.flush()
        line = self.process.stdout.readline()
        if not line:
            raise SystemExit(f"{self.process.args} ended with status {self.process.wait()}")
        return json.loads(line)


def describe(samples: np.ndarray, ends: list[list]) -> str:
    """A row of the table: both medians, the ratio with its interval, and whether both end alike."""
    ratios = np.log(samples[0] / samples[1])
    draws = np.random.default_rng(0).choice(ratios, (10_000, len(ratios))).mean(axis=1)
    low, high = np.exp(np.quantile(draws, (0.025, 0.975)))
    base, current = np.median(samples, axis=1)
    difference = np.nanmax(np.abs(np.array(ends[0]) - np.array(ends[1])))
    same = "same" if ends[0] == ends[1] else f"differ by {difference:.1e}"
    ratio = f"{np.exp(ratios.mean()):.4f} ({low:.4f} to {high:.4f})"
    return f"{base:9.4g} {current:9.4g}   {ratio}   {same}"


def main() -> None:
    """Run both checkouts, and print a row for each robot, number of worlds and work."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--base", type=Path, help="the checkout to compare with")
    parser.add_argument("--python", default=sys.executable, help="the base's; default: this one")
    parser.add_argument("--current", type=Path, default=_ROOT, help="default: this one")
    parser.add_argument("--device", default="cuda:0", help="default: %(default)s")
    parser.add_argument("--robots", nargs="+", default=["so101", "rebot"])
    parser.add_argument("--nworld", nargs="+", type=int, default=[2048, 16_384])
    parser.add_argument("--steps", type=int, default=20, help="calls in a repetition")
    parser.add_argument("--repetitions", type=int, default=10, help="pairs of measurements")
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.serve:
        serve()
        return
    if not args.base:
        parser.error("--base is missing")
    checkouts = [
        Checkout(args.base.resolve(), args.python),
        Checkout(args.current.resolve(), sys.executable),
    ]
    print(f"ms per call (physics: {_DECIMATION} steps): base, current; speed of current over base")
    for robot in args.robots:
        for nworld in args.nworld:
            with TemporaryDirectory() as folder:
                states = f"{folder}/states.npz"
                for checkout in checkouts:
                    reply = checkout.call(
                        robot=robot, nworld=nworld, device=args.device, states=states
                    )
                    print("#", robot, nworld, reply["step"], flush=True)
            for work, title in WORKS.items():
                times: list[list[float]] = [[], []]
                ends: list[list] = [[], []]
                for repetition in range(args.repetitions):
                    for number in (0, 1) if repetition % 2 else (1, 0):
                        reply = checkouts[number].call(work=work, steps=args.steps)
                        times[number].append(reply["ms"])
                        ends[number] = reply["qpos"]
                row = describe(np.array(times), ends)
                print(f"{robot:6} {nworld:6} {title:24} {row}", flush=True)


if __name__ == "__main__":
    main()
