"""Energy of a GPU over some work, from NVML's counter; or one line that says why there is none."""

import time
from collections.abc import Callable
from functools import partial

from mjstack.drivers.driver import Driver
from mjstack.envs import Env
from mjstack.episodes.rollout import Observer
from mjstack.sim import cuda_uuid

_EAGER = 2  # steps: the warm-up, and the one that is captured
SHORTEST = 0.5  # s, of a stretch of work on average: the counter moves some ten times a second


class EnergyMeter:
    """Adds up what the GPU's energy counter moves from `start` to `stop`. It counts the whole GPU,
    for every process on it.

    Attributes:
        reason: Why there is no figure; empty where there is one.
    """

    def __init__(self, device: str) -> None:
        """Open the counter.

        Args:
            device: ``cpu`` or ``cuda:N``.
        """
        self._counter: Callable[[], float] = lambda: 0.0  # [mJ]
        self._began = self._first = 0.0
        self.clear()
        self.reason = ""
        self._cpu = device == "cpu"
        if self._cpu:
            return
        try:
            import pynvml

            pynvml.nvmlInit()
            handle = pynvml.nvmlDeviceGetHandleByUUID(cuda_uuid(device))
            pynvml.nvmlDeviceGetTotalEnergyConsumption(handle)
        except ImportError:
            self.reason = "nvidia-ml-py is not installed: pip install 'mjstack[gpu]'"
        except pynvml.NVMLError as error:  # a part of a GPU, or an old one, has no counter
            self.reason = f"NVML: {error}"
        else:
            self._counter = partial(pynvml.nvmlDeviceGetTotalEnergyConsumption, handle)

    def clear(self) -> None:
        """Clear what was added up."""
        self._joules = self._seconds = 0.0
        self._stretches = 0

    def start(self) -> None:
        """Begin a stretch of work, the device idle."""
        self._first = self._counter()
        self._began = time.perf_counter()

    def stop(self) -> None:
        """End it, the device idle again, and add it."""
        self._seconds += time.perf_counter() - self._began
        self._joules += 1e-3 * (self._counter() - self._first)
        self._stretches += 1

    @property
    def missing(self) -> str:
        """Why there is no figure; empty where there is one, and on a CPU."""
        each = self._seconds / max(self._stretches, 1)
        if self._cpu or self.reason or each >= SHORTEST:
            return self.reason
        return f"stretches of {each:.2g} s are too short for NVML's counter"

    def metrics(self) -> dict[str, float]:
        """Energy and mean power of the stretches; nothing where they are missing."""
        if self._cpu or self.missing:
            return {}
        return {"gpu_power_mean_w": self._joules / self._seconds, "gpu_energy_j": self._joules}

    def notes(self) -> dict[str, str]:
        """Why they are missing."""
        return {"gpu_power_mean_w": f"not measured: {self.missing}"} if self.missing else {}


class EnergyObserver(Observer):
    """Measures the energy of a rollout's steps from the third on, when all are replayed."""

    def __init__(self, meter: EnergyMeter) -> None:
        """``meter`` adds it up."""
        self._meter = meter

    def start(self, env: Env, driver: Driver) -> None:
        """See `Observer`."""
        self._sim = env.sim

    def after_step(self, step: int) -> None:
        """See `Observer`."""
        if step == _EAGER - 1:
            self._sim.synchronize()
            reading = time.perf_counter()
            self._meter.start()
            self.aside = time.perf_counter() - reading

    def finish(self) -> None:
        """See `Observer`."""
        self._meter.stop()
