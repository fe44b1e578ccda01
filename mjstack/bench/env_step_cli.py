"""What the managers cost: a whole ``env.step``, its physics and its managers alone, alternating on
one trajectory.

On both backends; native MuJoCo beside ``mujoco.rollout``. `mjstack.bench.env_step` says what a turn
is.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

import mujoco
import numpy as np
from mujoco import rollout
from rich.console import Console
from rich.table import Table

from mjstack.bench.env_step import EnvStepTimes, measure_env_step
from mjstack.config import load_config
from mjstack.config.schema import Backend, Config
from mjstack.envs import Env, build_env
from mjstack.errors import ConfigError, MjstackError
from mjstack.report.provenance import collect_provenance
from mjstack.sim import resolve_device
from mjstack.sim.native import NativeSimulation


class RolloutBaseline:
    """``mujoco.rollout`` over the steps of a turn, with the warm starts that it does not carry over
    by itself.
    """

    def __init__(self, env: Env) -> None:
        assert isinstance(env.sim, NativeSimulation)
        self._sim: NativeSimulation = env.sim
        m = self._sim.model
        threads = self._sim.nthread
        self._pool = rollout.Rollout(nthread=threads)
        self._datas = [mujoco.MjData(m) for _ in range(threads)]
        self._nstep = env.cfg.timing.decimation
        n = env.nworld
        self._states = np.empty((n, mujoco.mj_stateSize(m, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
        self._out = np.empty((n, self._nstep, self._states.shape[1]))
        self._sensors = np.empty((n, self._nstep, m.nsensordata))
        self._ctrl: list[np.ndarray] = []
        self._warm: list[np.ndarray] = []

    def begin(self) -> None:
        """Takes the simulation's state as the start."""
        self._ctrl.clear()
        self._warm.clear()
        sim = self._sim
        m = self._sim.model
        data = mujoco.MjData(self._sim.model)
        for w in range(sim.nworld):
            data.qpos = sim.qpos[w].numpy()
            data.qvel = sim.qvel[w].numpy()
            mujoco.mj_getState(m, data, self._states[w], mujoco.mjtState.mjSTATE_FULLPHYSICS)

    def record(self) -> None:
        """Keeps the commands and warm starts of a step."""
        ctrl = self._sim.ctrl.numpy()[:, None]
        self._ctrl.append(
            np.ascontiguousarray(np.broadcast_to(ctrl, (ctrl.shape[0], self._nstep, ctrl.shape[2])))
        )
        self._warm.append(self._sim.qacc_warmstart.numpy().copy())

    def play(self) -> None:
        """Plays the steps that were recorded."""
        states = self._states
        for ctrl, warm in zip(self._ctrl, self._warm, strict=True):
            self._pool.rollout(
                self._sim.model,
                self._datas,
                states,
                ctrl,
                nstep=self._nstep,
                initial_warmstart=warm,
                state=self._out,
                sensordata=self._sensors,
            )
            states = self._out[:, -1].copy()

    def check(self) -> None:
        """Raises unless every world ended as the simulation's did, bit for bit."""
        if not np.array_equal(self._out[:, -1, 1 : 1 + self._sim.model.nq], self._sim.qpos.numpy()):
            raise MjstackError(
                "mujoco.rollout and the simulation ended in different states: the figure would be"
                " void."
            )


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point of scripts/bench_env_step.py."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "overrides",
        nargs="*",
        help="as for run.py, such as task=reach nworld=1024 (default nworld=256)",
    )
    parser.add_argument("--steps", type=int, default=10, help="steps per turn (10)")
    parser.add_argument("--turns", type=int, default=9, help="measured turns (9)")
    parser.add_argument(
        "--cpu-nworld", type=int, default=64, help="most worlds of MJWarp where it has no GPU (64)"
    )
    parser.add_argument("--out", type=Path, help="also write the figures to this JSON file")
    args = parser.parse_args(argv)
    console = Console(soft_wrap=True)
    try:
        for name in ("steps", "turns", "cpu_nworld"):
            if getattr(args, name) < 1:
                raise ConfigError(
                    f"--{name.replace('_', '-')}", getattr(args, name), "an integer of at least 1"
                )
        if args.out is not None and not args.out.absolute().parent.is_dir():
            raise ConfigError("--out", args.out, "a file in a folder that exists")
        cfg = load_config(["nworld=256", *args.overrides])
        results = [
            _run(console, cfg, backend, args) for backend in (Backend.native, Backend.mjwarp)
        ]
    except MjstackError as error:
        Console(stderr=True, soft_wrap=True, markup=False).print(f"mjstack: {error}")
        raise SystemExit(error.exit_code) from error
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    console.print(_table(cfg, results))
    if args.out is not None:
        versions = collect_provenance(config_yaml="", model_text="", device="", driver="")[
            "versions"
        ]
        rows = [
            asdict(r)
            | {
                "overhead": r.overhead,
                "managers_alone_over_physics": statistics.median(r.managers_alone),
                "residual_ms": statistics.median(r.residual_ms),
                "baseline_ratio": r.baseline_ratio,
                "world_steps_per_s": r.world_steps_per_s(r.env_ms),
            }
            for r in results
        ]
        args.out.write_text(
            json.dumps({"command": sys.argv, "versions": versions, "results": rows}, indent=2)
            + "\n"
        )


def _run(console: Console, cfg: Config, backend: Backend, args: argparse.Namespace) -> EnvStepTimes:
    device = "cpu" if backend is Backend.native else resolve_device(cfg.sim.device)
    slow = backend is Backend.mjwarp and device == "cpu"
    nworld = min(cfg.nworld, args.cpu_nworld) if slow else cfg.nworld
    env = build_env(cfg, nworld=nworld, backend=backend, device=device)
    # mujoco.rollout has one model for all worlds.
    plain = backend is Backend.native and not env.sim.fields
    with console.status(f"{env.sim.description}, {nworld} worlds") as status:
        result = measure_env_step(
            env,
            steps=args.steps,
            turns=args.turns,
            baseline=RolloutBaseline(env) if plain else None,
            progress=lambda turn: status.update(
                f"{env.sim.description}, {nworld} worlds: turn {turn} of {args.turns}"
            ),
        )
    env.close()
    if result.problem:
        raise MjstackError(f"{result.backend}: no figure: {result.problem}.")
    return result


def _table(cfg: Config, results: list[EnvStepTimes]) -> Table:
    table = Table(
        title=(
            f"env.step against physics alone: {cfg.task.name}, {cfg.robot.title}, random actions,"
            " with resets"
        )
    )
    table.add_column("medians over the turns")
    for result in results:
        table.add_column(result.backend, justify="right", overflow="fold")
    rows: list[tuple[str, Callable[[EnvStepTimes], str]]] = [
        ("worlds", lambda r: f"{r.nworld:,}"),
        ("physics alone, ms per step", lambda r: f"{statistics.median(r.physics_ms):.2f}"),
        ("managers alone, ms per step", lambda r: f"{statistics.median(r.managers_ms):.2f}"),
        ("env.step, ms per step", lambda r: f"{statistics.median(r.env_ms):.2f}"),
        ("managers over physics, turn by turn", lambda r: f"{100.0 * r.overhead:+.1f} %"),
        (
            "the same, least and most",
            lambda r: f"{100.0 * min(r.overheads):+.1f} to {100.0 * max(r.overheads):+.1f} %",
        ),
        (
            "managers alone over physics",
            lambda r: f"{100.0 * statistics.median(r.managers_alone):.1f} %",
        ),
        ("env.step less both, ms per step", lambda r: f"{statistics.median(r.residual_ms):+.2f}"),
        ("physics alone, world-steps/s", lambda r: f"{r.world_steps_per_s(r.physics_ms):,.0f}"),
        ("env.step, world-steps/s", lambda r: f"{r.world_steps_per_s(r.env_ms):,.0f}"),
        (
            "physics in percent of mujoco.rollout",
            lambda r: "-" if r.baseline_ratio is None else f"{100.0 * r.baseline_ratio:.0f} %",
        ),
        ("episodes that were reset meanwhile", lambda r: f"{r.episodes:.0f}"),
    ]
    for name, value in rows:
        table.add_row(name, *(value(result) for result in results))
    return table
