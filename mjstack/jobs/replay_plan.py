"""Which worlds of an earlier run are played again, where, and whether they start alike."""

import math
from contextlib import closing, suppress
from dataclasses import dataclass, replace

import numpy as np

from mjstack.config.schema import Backend, Config, SimCfg
from mjstack.envs import driven_config
from mjstack.episodes.earlier_run import EarlierRun, archived_starts
from mjstack.episodes.record import STEMS, EpisodeRecord
from mjstack.episodes.replay import simulate_alone
from mjstack.episodes.stage import Stage
from mjstack.errors import ConfigError, DeviceError, FolderError
from mjstack.gates.success import success_config
from mjstack.policy.lerobot import PREFIX
from mjstack.sim import resolve_backend, resolve_device

# [m, rad], and of quaternions: backends differ by rounding, another start by more
_SAME_START = 1e-6
_NATIVE = (Backend.native, "cpu")


@dataclass(frozen=True, kw_only=True)
class ReplayPlan:
    """One world, or all failing ones, to be played again.

    Attributes:
        run: The earlier run.
        gate: Whose worlds they are, ``batch`` or ``success``.
        failing: Whether they are all failing ones.
        bits: Bits of the rules that each world broke, by seed and world.
        record: The results of the first seed.
        where: Backend and device, each played once; the first is the earlier run's unless ``sim``
            says otherwise.
        stage: The configuration that the gate played under, on the first backend here.
    """

    run: EarlierRun
    gate: str
    failing: bool
    bits: dict[int, dict[int, int]]
    record: EpisodeRecord
    where: list[tuple[Backend, str]]
    stage: Stage

    @property
    def seed(self) -> int:
        """The first seed."""
        return next(iter(self.bits))

    @property
    def world(self) -> int:
        """The first world of the first seed."""
        return next(iter(self.bits[self.seed]))


def plan_replay(cfg: Config) -> ReplayPlan:
    """Read what ``run`` and ``world`` name.

    Raises:
        ConfigError: The run has no such worlds.
        FolderError: The run, or its record, cannot be read.
    """
    for key, expected in (("run", "the folder of an earlier run"), ("world", "one of its worlds")):
        if getattr(cfg, key) is None:
            fix = "Write job=replay run=outputs/<date>/<time> world=17"
            raise ConfigError(key, "null", f"{expected}, because job=replay plays one again", fix)
    resolve_backend(cfg)  # what this command line asks for must be there
    run = EarlierRun.read(str(cfg.run))
    if (run.cfg.policy or "").startswith(PREFIX):
        problem = f"run={cfg.run}: its policy is LeRobot's, whose folder may run code"
        raise FolderError(f"{problem}: expected a run without", "Look at its episode.html")

    # The worlds: [gate:][seed:]number or [gate:]failing
    *heads, tail = str(cfg.world).split(":")
    failing = tail == "failing"
    played_gates = [gate for gate in STEMS if gate in run.cfg.gates]
    gate = heads.pop(0) if heads and not heads[0].isdigit() else (played_gates or ["batch"])[0]
    first = run.cfg.seed
    last = first + run.cfg.gate[gate].seeds - 1
    seed = int(heads[0]) if heads else first
    bits: dict[int, dict[int, int]] = {}
    expected = ""
    if gate not in played_gates:
        noun = "failing worlds" if failing else "a world"
        names = " or ".join(played_gates) or "but it had none"
        expected = f"{noun} of a gate that run had, {names}"
    elif failing:
        bits, episodes = run.failing(gate)
        if not bits:
            expected = f"a world such as 17, as none of gate {gate}'s {episodes} failed"
    elif not first <= seed <= last:
        expected = f"a seed from {first} to {last}, as that run has (seed:world)"
    elif int(tail) >= run.cfg.nworld:
        expected = f"a world from 0 to {run.cfg.nworld - 1}, as that run has"
    if expected:
        raise ConfigError("world", cfg.world, expected)
    record = run.record(min(bits) if failing else seed, gate)
    if not failing:
        bits = {seed: {int(tail): int(record.failed[int(tail)])}}

    # How they are played here
    played = archived_starts(run.cfg, run.folder)
    if gate == "success":
        played = success_config(played)
    where = _choose(cfg.sim, record)
    backend, device = where[0]
    sim = SimCfg(backend=backend, device=device, step=cfg.sim.step)
    # The folder may be a stranger's: what a replay does not play is not built.
    played = replace(driven_config(played), sim=sim, view=cfg.view, video=cfg.video, web=cfg.web)
    return ReplayPlan(
        run=run,
        gate=gate,
        failing=failing,
        bits=bits,
        record=record,
        where=where,
        stage=Stage(played),
    )


def _choose(requested: SimCfg, record: EpisodeRecord) -> list[tuple[Backend, str]]:
    """Backends and devices to play on."""
    auto = requested.backend is Backend.auto
    backend = Backend(record.backend) if auto else requested.backend
    if backend is Backend.native:
        return [_NATIVE]
    device = resolve_device(requested.device)
    if requested.device == "auto" and record.backend == "mjwarp":
        with suppress(DeviceError):  # it is not here
            device = resolve_device(record.device)
    return [(backend, device), *([_NATIVE] if auto else [])]


def check_start(plan: ReplayPlan) -> None:
    """Check that the first world would start where it did in that run.

    Raises:
        FolderError: It would start elsewhere.
    """
    stage = plan.stage
    recorded = plan.record.worlds["start_qpos"][plan.world]
    # MJWarp takes longer to load than the native start does to compute, and rounding may have it
    # draw otherwise.
    for backend, device in dict.fromkeys([_NATIVE, plan.where[0]]):
        with closing(simulate_alone(stage, backend, device)) as sim:
            stage.start(sim, stage.cfg.reset, seed=plan.seed, worlds=[plan.world])
            start = sim.qpos[0].cpu().numpy()
            same = start.shape == recorded.shape
            off = float(np.abs(start - recorded).max()) if same else math.inf
        if off <= _SAME_START:
            return
    raise FolderError(
        f"run={plan.run.folder}: world {plan.world} of seed {plan.seed} would start up to {off:.3g}"
        " (m, rad) from where it did, expected its own start",
        f"Use mjstack at {plan.run.provenance.get('git_commit')}",
    )
