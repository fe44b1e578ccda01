"""One world of a batch played again, alone: its trajectory, and a report on every rule."""

import numpy as np
from torch import Tensor
from typing_extensions import override

from mjstack.drivers.driver import Driver
from mjstack.envs import Env
from mjstack.episodes.recorder import Channels, Read, Recorder, read_state
from mjstack.episodes.rollout import Episode
from mjstack.sim import describe_overflow
from mjstack.tasks.view import Step


def _read_start(env: Env, driver: Driver) -> Read:
    sim = env.sim
    fields = {f"field.{name}": field for name, field in sim.fields.items()}
    return lambda: {"start_qpos": sim.qpos.double(), "start_qvel": sim.qvel.double(), **fields}


def _read_trace(env: Env, driver: Driver) -> Read:
    """State, objects and the check's values, by name in the file."""
    state = read_state(env, driver)
    check = env.check
    objects = Step(env, list(env.cfg.scene.free))

    def read() -> dict[str, Tensor]:
        return {
            **state(),
            "object_pos_m": objects.pos,
            "object_speed_m_per_s": objects.speed,
            "object_height_m": objects.height,
            **check.trace(env.state),
            "phase": driver.phase,
        }

    return read


class WorldTrace(Recorder):
    """Records a world that is alone.

    Attributes:
        arrays: Its start, and its state and the check's values at step ends, by name in an npz
            file; from the end of the episode on.
    """

    channels = (Channels(_read_start, lambda steps: [0]), Channels(_read_trace))

    @override
    def finish(self) -> None:
        rows = {name: rows[:, 0].cpu().numpy() for name, rows in self.rows.items()}
        starts = ("start_", "field.")
        self.arrays = {k: v[0] if k.startswith(starts) else v for k, v in rows.items()}
        names = np.array([phase.name for phase in self.driver.phases] or [""])
        self.arrays["time_s"] = np.arange(1, len(rows["phase"]) + 1) * self.env.cfg.timing.step_dt
        self.arrays["phase"] = names[rows["phase"]]

    def explain(self, episode: Episode) -> list[str]:
        """A line for each rule. Whether it held is the check's result; the numbers say why."""
        sim = self.env.sim
        check = self.env.check
        bits = int(episode.failed[0])
        finite = np.isfinite(np.hstack((self.arrays["qpos"], self.arrays["qvel"]))).all(1)
        lost = int(finite.argmin())  # the first step, if any
        steps = len(finite) * self.env.cfg.timing.decimation
        where = f"not in step {lost}, in {self.arrays['phase'][lost]}"
        reports = {
            "FINITE": ("always" if finite.all() else where, "always"),
            "STEPS": (f"{int(sim.step_count[0])} physics steps", f"{steps}"),
            "OVERFLOW": (describe_overflow(int(sim.overflow[0])) or "none", "none"),
            **check.report(episode.result),
        }
        return [
            f"{name}: {f'BROKEN, {check.rules.texts[name]}' if bits & bit else 'held'}:"
            f" {reports[name][0]} (wanted: {reports[name][1]})"
            for name, bit in check.rules.items()
        ]
