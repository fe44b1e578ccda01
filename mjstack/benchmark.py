"""What the managers cost: physics alone and a whole ``env.step``, alternating on one trajectory, on both backends.

A turn starts from the same state for every candidate and plays the same random actions. Physics alone is the action
manager's commands and the physics steps. So the ratio is of one run, one trajectory and one machine's mood.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import mujoco
import numpy as np
import torch
from mujoco import rollout
from rich.console import Console
from rich.table import Table

from mjstack.config import load_config
from mjstack.config.schema import Backend, Config
from mjstack.envs import Env, build_env
from mjstack.errors import ConfigError, MjstackError
from mjstack.gates.episode import restore, snapshot
from mjstack.report.provenance import collect_provenance
from mjstack.sim import resolve_device
from mjstack.sim.native import NativeSimulation


@dataclass(kw_only=True, slots=True)
class EnvStepResult:
    """Times of one backend.

    Attributes:
        backend: Backend and hardware.
        nworld: Number of worlds.
        frames: Frames per turn.
        substeps: Physics steps per frame.
        physics_ms: Per frame and turn [ms], physics alone.
        env_ms: Per frame and turn [ms], ``env.step``.
        rollout_ms: Per frame and turn [ms], plain ``mujoco.rollout`` on as many threads; empty on MJWarp.
        episodes: Episodes that ended, and were reset, within the measured turns.
    """

    backend: str
    nworld: int
    frames: int
    substeps: int
    physics_ms: list[float] = field(default_factory=list)
    env_ms: list[float] = field(default_factory=list)
    rollout_ms: list[float] = field(default_factory=list)
    episodes: float = 0.0

    @property
    def overheads(self) -> list[float]:
        """env.step's time over physics', less 1, of every turn."""
        return [e / p - 1.0 for e, p in zip(self.env_ms, self.physics_ms, strict=True)]

    @property
    def overhead(self) -> float:
        """Their median. On a busy machine it need not be the ratio of the medians."""
        return statistics.median(self.overheads)

    @property
    def rollout_ratio(self) -> float | None:
        """Median of rollout's time over physics': 1 is rollout's speed. None where it was not measured."""
        if not self.rollout_ms:
            return None
        return statistics.median(r / p for r, p in zip(self.rollout_ms, self.physics_ms, strict=True))

    def world_steps_per_s(self, milliseconds: list[float]) -> float:
        """Physics steps of all worlds per second, median."""
        return 1e3 * self.nworld * self.substeps / statistics.median(milliseconds)


def measure_env_step(
    env: Env, *, frames: int, turns: int, with_rollout: bool = False, progress: Callable[[int], None] | None = None
) -> EnvStepResult:
    """Plays random actions in turns.

    Args:
        env: The environment.
        frames: Frames per turn.
        turns: Measured turns; one before them warms up.
        with_rollout: Also time ``mujoco.rollout``; the simulation must be native, without model fields.
        progress: Told the turns done.
    """
    sim, substeps = env.sim, env.cfg.timing.substeps
    env.reset(seed=env.cfg.seed)
    result = EnvStepResult(backend=sim.description, nworld=env.nworld, frames=frames, substeps=substeps)
    generator = torch.Generator().manual_seed(0)
    manager = env.action_manager
    low, high = manager.low.float().cpu(), manager.high.float().cpu()

    def timed(work: Callable[[], None]) -> float:
        sim.synchronize()
        began = time.perf_counter()
        work()
        sim.synchronize()
        return 1e3 * (time.perf_counter() - began) / frames

    plain = _Rollout(env, frames) if with_rollout and isinstance(sim, NativeSimulation) else None
    for turn in range(turns + 1):
        actions = [
            (low + (high - low) * torch.rand((env.nworld, manager.action_dim), generator=generator)).to(env.device)
            for _ in range(frames)
        ]
        start = snapshot(sim)

        def physics(actions: list[torch.Tensor] = actions, record: bool = False) -> None:
            for action in actions:
                manager.process(action)
                manager.write_commands()
                if record and plain is not None:
                    plain.record()
                sim.step(substeps)

        def whole(actions: list[torch.Tensor] = actions) -> None:
            for action in actions:
                env.step(action)

        times: list[float] = []
        if plain is not None:
            restore(sim, start)
            plain.begin()
            physics(record=True)
            times.append(timed(plain.play))
            if not np.array_equal(plain.qpos, sim.qpos.numpy()):
                raise MjstackError("mujoco.rollout and the simulation ended in different states: the figure would be void.")
        restore(sim, start)
        times.append(timed(physics))
        restore(sim, start)
        env.read_statistics()
        times.append(timed(whole))
        if turn:  # the first one warms up
            result.env_ms.append(times.pop())
            result.physics_ms.append(times.pop())
            result.rollout_ms.extend(times)
            result.episodes += env.read_statistics()["episodes"]
            if progress is not None:
                progress(turn)
    return result


class _Rollout:
    """``mujoco.rollout`` over the frames of a turn, with the warm starts that it does not carry over by itself."""

    def __init__(self, env: Env, frames: int) -> None:
        assert isinstance(env.sim, NativeSimulation)
        self._sim: NativeSimulation = env.sim
        m = self._sim.model
        threads = self._sim.nthread
        self._pool = rollout.Rollout(nthread=threads)
        self._datas = [mujoco.MjData(m) for _ in range(threads)]
        self._nstep, n = env.cfg.timing.substeps, env.nworld
        self._states = np.empty((n, mujoco.mj_stateSize(m, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
        self._out = np.empty((n, self._nstep, self._states.shape[1]))
        self._sensors = np.empty((n, self._nstep, m.nsensordata))
        self._ctrl: list[np.ndarray] = []
        self._warm: list[np.ndarray] = []

    @property
    def qpos(self) -> np.ndarray:
        return self._out[:, -1, 1 : 1 + self._sim.model.nq]

    def begin(self) -> None:
        """Takes the simulation's state as the start."""
        self._ctrl.clear()
        self._warm.clear()
        sim, m, data = self._sim, self._sim.model, mujoco.MjData(self._sim.model)
        for w in range(sim.nworld):
            data.qpos, data.qvel = sim.qpos[w].numpy(), sim.qvel[w].numpy()
            mujoco.mj_getState(m, data, self._states[w], mujoco.mjtState.mjSTATE_FULLPHYSICS)

    def record(self) -> None:
        """Keeps the commands and warm starts of a frame."""
        ctrl = self._sim.ctrl.numpy()[:, None]
        self._ctrl.append(np.ascontiguousarray(np.broadcast_to(ctrl, (ctrl.shape[0], self._nstep, ctrl.shape[2]))))
        self._warm.append(self._sim.qacc_warmstart.numpy().copy())

    def play(self) -> None:
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


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point of scripts/bench_env_step.py."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("overrides", nargs="*", help="as for run.py, such as task=reach nworld=1024 (default nworld=256)")
    parser.add_argument("--frames", type=int, default=10, help="frames per turn (10)")
    parser.add_argument("--turns", type=int, default=9, help="measured turns (9)")
    parser.add_argument("--cpu-nworld", type=int, default=64, help="most worlds of MJWarp where it has no GPU (64)")
    parser.add_argument("--out", type=Path, help="also write the figures to this JSON file")
    args = parser.parse_args(argv)
    console = Console(soft_wrap=True)
    try:
        for name in ("frames", "turns", "cpu_nworld"):
            if getattr(args, name) < 1:
                raise ConfigError(f"--{name.replace('_', '-')}", getattr(args, name), "an integer of at least 1")
        if args.out is not None and not args.out.absolute().parent.is_dir():
            raise ConfigError("--out", args.out, "a file in a folder that exists")
        cfg = load_config(["nworld=256", *args.overrides])
        results = [_run(console, cfg, backend, args) for backend in (Backend.native, Backend.mjwarp)]
    except MjstackError as error:
        Console(stderr=True, soft_wrap=True, markup=False).print(f"mjstack: {error}")
        raise SystemExit(error.exit_code) from error
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    console.print(_table(cfg, results))
    if args.out is not None:
        versions = collect_provenance(config_yaml="", model_text="", device="", driver="")["versions"]
        rows = [
            asdict(r)
            | {"overhead": r.overhead, "rollout_ratio": r.rollout_ratio, "world_steps_per_s": r.world_steps_per_s(r.env_ms)}
            for r in results
        ]
        args.out.write_text(json.dumps({"command": sys.argv, "versions": versions, "results": rows}, indent=2) + "\n")


def _run(console: Console, cfg: Config, backend: Backend, args: argparse.Namespace) -> EnvStepResult:
    device = "cpu" if backend is Backend.native else resolve_device(cfg.sim.device)
    slow = backend is Backend.mjwarp and device == "cpu"
    nworld = min(cfg.nworld, args.cpu_nworld) if slow else cfg.nworld
    env = build_env(cfg, nworld=nworld, backend=backend, device=device)
    # mujoco.rollout has one model for all worlds.
    plain = backend is Backend.native and not env.sim.fields
    with console.status(f"{env.sim.description}, {nworld} worlds") as status:
        result = measure_env_step(
            env,
            frames=args.frames,
            turns=args.turns,
            with_rollout=plain,
            progress=lambda turn: status.update(f"{env.sim.description}, {nworld} worlds: turn {turn} of {args.turns}"),
        )
    env.close()
    return result


def _table(cfg: Config, results: list[EnvStepResult]) -> Table:
    table = Table(title=f"env.step against physics alone: {cfg.task.name}, {cfg.robot.title}, random actions, with resets")
    table.add_column("medians over the turns")
    for result in results:
        table.add_column(result.backend, justify="right", overflow="fold")
    rows: list[tuple[str, Callable[[EnvStepResult], str]]] = [
        ("worlds", lambda r: f"{r.nworld:,}"),
        ("physics alone, ms per frame", lambda r: f"{statistics.median(r.physics_ms):.2f}"),
        ("env.step, ms per frame", lambda r: f"{statistics.median(r.env_ms):.2f}"),
        ("managers over physics, turn by turn", lambda r: f"{100.0 * r.overhead:+.1f} %"),
        ("the same, least and most", lambda r: f"{100.0 * min(r.overheads):+.1f} to {100.0 * max(r.overheads):+.1f} %"),
        ("physics alone, world-steps/s", lambda r: f"{r.world_steps_per_s(r.physics_ms):,.0f}"),
        ("env.step, world-steps/s", lambda r: f"{r.world_steps_per_s(r.env_ms):,.0f}"),
        (
            "physics in percent of mujoco.rollout",
            lambda r: "-" if r.rollout_ratio is None else f"{100.0 * r.rollout_ratio:.0f} %",
        ),
        ("episodes that were reset meanwhile", lambda r: f"{r.episodes:.0f}"),
    ]
    for name, value in rows:
        table.add_row(name, *(value(result) for result in results))
    return table
