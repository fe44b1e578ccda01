"""Captures fixed work once and replays it: Warp's and torch's in one CUDA graph, or Warp's alone on its CPU device."""

from __future__ import annotations

import gc
import logging
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

import torch
import warp as wp

from mjstack.config.schema import GraphMode
from mjstack.errors import CaptureError
from mjstack.sim.arena import Arena
from mjstack.sim.streams import torch_stream_scope

log = logging.getLogger(__name__)

_nesting = 0
_arenas: dict[str, Arena] = {}
_capture_streams: dict[str, torch.cuda.Stream] = {}


def inside_graph() -> bool:
    """Whether the work going on belongs to a graph that is warming up or being captured: inner graphs then step aside."""
    return _nesting > 0


@contextmanager
def _inside() -> Iterator[None]:
    global _nesting
    _nesting += 1
    try:
        yield
    finally:
        _nesting -= 1


class StepGraph:
    """Work that is the same at every call: no host read, fixed shapes, the same memory.

    The first call runs it eagerly, which compiles kernels and makes allocations happen. The second captures it, and from then
    on a call replays it. Whatever the work bakes in (a Python number, a solver option, an address) stays as it was at the
    capture, until `drop` or a new version.

    Attributes:
        captured: Whether the next call replays.
        warm_up_seconds: What the eager call took, compilation included.
        capture_seconds: What the capture took.
    """

    def __init__(
        self,
        work: Callable[[], None],
        device: torch.device | str,
        mode: GraphMode,
        *,
        name: str,
        version: Callable[[], int] = lambda: 0,
        culprit: Callable[[], str] = lambda: "",
    ) -> None:
        """Takes the work without running it.

        Args:
            work: What is captured.
            device: Where it runs.
            mode: ``off`` never captures; ``auto`` goes on eagerly, with one warning, where the capture fails; ``require``
                raises there.
            name: What it is called in messages.
            version: A number that changes when the graph has to be captured anew.
            culprit: Names what was running, for the message of a failed capture.
        """
        self._work, self._mode, self._name = work, mode, name
        self._version, self._culprit = version, culprit
        self._device = wp.get_device(str(device))
        self._replay: Callable[[], None] | None = None
        self._warm = self._failed = False
        self._seen = version()
        self.warm_up_seconds = self.capture_seconds = 0.0

    @property
    def captured(self) -> bool:
        """Whether the next call replays."""
        return self._replay is not None and self._version() == self._seen

    def __call__(self) -> None:
        """Does the work, in one way or another."""
        if self._mode is GraphMode.off or self._failed:
            self._work()
            return
        if self._version() != self._seen:
            self.drop()
        if self._replay is not None:
            self._replay()
        elif not self._warm:
            self._warm_up()
        elif self._capture():
            self()  # capturing does not run anything
        else:
            self._work()

    def drop(self) -> None:
        """Forgets the capture: the next call runs eagerly again, and the one after it captures."""
        self._replay, self._warm, self._failed = None, False, False
        self._seen = self._version()

    def _warm_up(self) -> None:
        began = time.perf_counter()
        with self._scope():
            self._work()
            wp.synchronize_device(self._device)  # Warp's temporaries are freed on a stream that torch's do not wait for
        self._warm = True
        self.warm_up_seconds = time.perf_counter() - began

    def _capture(self) -> bool:
        """Captures the work; Python's collector waits, so that nothing is freed in the middle of it."""
        began = time.perf_counter()
        wp.synchronize_device(self._device)
        collecting = gc.isenabled()
        gc.disable()
        try:
            with self._scope():
                self._replay = self._capture_cuda() if self._device.is_cuda else self._capture_cpu()
        except Exception as error:
            self._failed = True
            failure = CaptureError(self._name, self._culprit(), error)
            if self._device.is_cuda:
                _recover(self._device)
            if self._mode is GraphMode.require:
                self._failed = False
                raise failure from error
            log.warning("%s It runs eagerly.", failure)
            return False
        finally:
            if collecting:
                gc.enable()
        self.capture_seconds = time.perf_counter() - began
        return True

    def _capture_cuda(self) -> Callable[[], None]:
        torch_device = wp.device_to_torch(self._device)
        # A stream of torch's own making: newer torch refuses to capture on a blocking one. The same for ever, because a
        # second Warp object for it would unregister it when freed.
        stream = _capture_streams.setdefault(torch_device, torch.cuda.Stream(torch_device))
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local"):
            scope = torch_stream_scope(self._device)
            with scope, wp.ScopedCapture(stream=wp.get_stream(self._device), external=True):
                self._work()
        return graph.replay

    def _capture_cpu(self) -> Callable[[], None]:
        with wp.ScopedDevice(self._device), wp.ScopedCapture() as capture:
            self._work()
        graph = capture.graph
        return lambda: wp.capture_launch(graph)

    @contextmanager
    def _scope(self) -> Iterator[None]:
        """Marks the work as a graph's, its temporaries from the arena."""
        memory: AbstractContextManager = nullcontext()
        if self._device.is_cuda:
            arena = _arenas.setdefault(str(self._device), Arena(self._device))
            memory = wp.ScopedAllocator(self._device, arena)
        with _inside(), memory:
            yield


def _recover(device: wp.Device) -> None:
    """Clears the error that a broken capture leaves, so that eager work can go on."""
    try:
        torch.cuda.synchronize(wp.device_to_torch(device))
    except RuntimeError:
        log.debug("the first synchronize after a failed capture reports it once more", exc_info=True)


def arena_bytes(device: torch.device | str) -> int:
    """Scratch memory that graphs on a device hold [bytes]."""
    arena = _arenas.get(str(wp.get_device(str(device))))
    return 0 if arena is None else arena.size
