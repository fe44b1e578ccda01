"""Captures fixed work once and replays it: Warp's and torch's in one CUDA graph, or Warp's alone on
its CPU device. Warp is loaded where something is captured, because native runs do not need it.
"""

from __future__ import annotations

import gc
import logging
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mjstack.errors import MjstackError, first_line
from mjstack.interrupt import check_interrupt

if TYPE_CHECKING:
    import warp as wp

_ALIGNMENT = 512  # bytes

log = logging.getLogger(__name__)

_nesting = 0  # of graphs that are warming up or being captured
_branching = 0  # of branches that are being captured
# The rest of a broken capture is kept: torch counts its memory as in use until the process ends.
_abandoned: list[tuple[torch.cuda.CUDAGraph, torch.cuda.MemPool]] = []
_capture_streams: dict[str, torch.cuda.Stream] = {}
_side_streams: dict[str, list[torch.cuda.Stream]] = {}
_joined_streams: list[torch.cuda.Stream] = []  # of branches within branches


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

    The first call runs it eagerly, which compiles kernels and makes allocations happen. The second
    captures it, and from then on a call replays it. Whatever the work bakes in (a Python number, a
    solver option, an address) stays as it was at the capture, until `drop` or a new version. A
    graph that is called while another one warms up or is captured only does its work.
    """

    warm_up_seconds = 0.0  # of the eager call, compilation included
    capture_seconds = 0.0

    def __init__(
        self,
        work: Callable[[], None],
        device: torch.device | str,
        mode: str,
        *,
        name: str,
        version: Callable[[], int] = lambda: 0,
        culprit: Callable[[], str] = lambda: "",
        scratch: bool = True,
    ) -> None:
        """Keep the work without running it. Messages have its ``name``.

        Mode ``off`` never captures; ``auto`` goes on eagerly, with one warning, where the capture
        fails; ``require`` raises there. ``version`` changes when the graph has to be captured anew,
        and ``culprit`` names the current term for the message of a failed capture. Warp's
        temporaries come from a `Scratch`, unless ``scratch`` is false.
        """
        self._work = work
        self._mode = mode
        self._name = name
        self._version = version
        self._culprit = culprit
        self._scratch = scratch
        self._device = str(device)
        self.drop()

    @property
    def captured(self) -> bool:
        """Whether the next call replays."""
        return self._replay is not None and self._version() == self._seen

    def __call__(self) -> None:
        """Do the work, in one way or another; between two calls a command can be interrupted."""
        if _nesting:
            self._work()
            return
        check_interrupt()
        if self._version() != self._seen:
            self.drop()
        if self._replay is not None:
            self._replay()
        elif self._mode == "off" or self._failed:
            self._work()
        elif not self._warm:
            self._warm_up()
        else:
            self._capture()
            self()  # capturing does not run anything; where it failed, the work runs eagerly

    def drop(self) -> None:
        """Clear the capture: the next call runs eagerly again, and the one after it captures."""
        self._replay: Callable[[], None] | None = None
        self._memory: tuple[torch.cuda.MemPool, Scratch | None] | None = None
        self._warm = False
        self._failed = False
        self._seen = self._version()

    def _warm_up(self) -> None:
        from mjstack.sim.warp_setup import wp

        began = time.perf_counter()
        with _inside():
            self._work()
            # Warp's temporaries are freed on a stream that torch's do not wait for
            wp.synchronize_device(self._device)
        self._warm = True
        self.warm_up_seconds = time.perf_counter() - began

    def _capture(self) -> None:
        """Capture the work; Python's collector waits, so that nothing is freed in the middle of
        it.
        """
        from mjstack.sim.warp_setup import wp

        began = time.perf_counter()
        device = wp.get_device(self._device)
        wp.synchronize_device(device)
        collecting = gc.isenabled()
        gc.disable()
        try:
            with _inside():
                capture = self._capture_cuda if device.is_cuda else self._capture_cpu
                self._replay = capture(device)
        except Exception as error:
            culprit = f" because of {term}" if (term := self._culprit()) else ""
            failure = MjstackError(
                f"{self._name} cannot be captured{culprit} ({first_line(error)}): expected fixed"
                " shapes and no host read (.item(), .cpu(), nonzero, if tensor)",
                "Correct it, or set graph=off",
            )
            if device.is_cuda:
                with suppress(RuntimeError):  # it reports the failed capture once more
                    torch.cuda.synchronize(wp.device_to_torch(device))
            if self._mode == "require":
                raise failure from error
            self._failed = True
            log.warning("%s It runs eagerly.", failure)
        else:
            self.capture_seconds = time.perf_counter() - began
        finally:
            if collecting:
                gc.enable()

    def _capture_cuda(self, device: wp.Device) -> Callable[[], None]:
        from mjstack.sim.warp_setup import torch_stream_scope, wp

        torch_device = wp.device_to_torch(device)
        # A stream of torch's own making: newer torch refuses to capture on a blocking one. The same
        # in every capture, because a second Warp object for it would unregister it when freed.
        if torch_device not in _capture_streams:
            _capture_streams[torch_device] = torch.cuda.Stream(torch_device)
        stream = _capture_streams[torch_device]
        graph = torch.cuda.CUDAGraph()
        # A conditional node makes Warp interrupt the capture, and what goes on after it has another
        # number. By that number torch knows what to allocate from the graph's own memory, which
        # no one else gets. So there is a second such pool.
        memory = torch.cuda.MemPool()
        pool = torch.cuda.graph_pool_handle()
        scratch = Scratch(device) if self._scratch else None
        _abandoned.append((graph, memory))
        try:
            with (
                torch.cuda.graph(
                    graph, pool=pool, stream=stream, capture_error_mode="thread_local"
                ),
                torch.cuda.use_mem_pool(memory),
                wp.ScopedAllocator(device, scratch),
                torch_stream_scope(device),
                wp.ScopedCapture(stream=wp.get_stream(device), external=True),
            ):
                self._work()
        except Exception:
            # Torch leaves it open where the end of the capture fails, and then aborts the process
            # when any pool is destroyed.
            with suppress(AttributeError, RuntimeError):
                torch._C._cuda_endAllocateToPool(stream.device_index, pool)
            raise
        _abandoned.pop()
        self._memory = memory, scratch
        return graph.replay

    def _capture_cpu(self, device: wp.Device) -> Callable[[], None]:
        from mjstack.sim.warp_setup import wp

        with wp.ScopedDevice(device), wp.ScopedCapture() as capture:
            self._work()
        graph = capture.graph
        return lambda: wp.capture_launch(graph)


class Scratch:
    """An allocator for Warp during one capture. Blocks that were given back serve the next request
    of their size.

    MJWarp allocates some thirty temporaries per step. Through CUDA's own pool each becomes two
    nodes of a captured graph, which run one after the other like kernels do; from here they are
    addresses. A block goes back to the stream that used it, where later work comes after earlier
    work, so parallel branches never share one.
    """

    deallocate_requires_context_guard = False

    def __init__(self, device: wp.Device) -> None:
        self._device = device
        self._free: dict[tuple[int, int], list[int]] = defaultdict(list)  # by stream and size
        self._keys: dict[int, tuple[int, int]] = {}
        self._blocks: list[Tensor] = []

    def allocate(self, size_in_bytes: int) -> int:
        """Address of a block on the current stream."""
        size = -(-size_in_bytes // _ALIGNMENT) * _ALIGNMENT
        key = (self._device.stream.cuda_stream or 0, size)
        if self._free[key]:
            return self._free[key].pop()
        block = torch.empty(size, dtype=torch.uint8, device=str(self._device))
        self._blocks.append(block)
        self._keys[block.data_ptr()] = key
        return block.data_ptr()

    def deallocate(self, ptr: int, size_in_bytes: int) -> None:
        """Take a block back. The memory itself stays, because a graph may write to it at every
        replay.
        """
        self._free[self._keys[ptr]].append(ptr)


def side_by_side(device: torch.device | str, *works: Callable[[], object]) -> None:
    """Do independent works: in a CUDA graph that is being captured as parallel branches, else one
    after the other. None of them may write what another reads or writes, nor keep a temporary that
    another uses.
    """
    if torch.device(device).type != "cuda" or not torch.cuda.is_current_stream_capturing():
        for work in works:
            work()
        return
    from mjstack.sim.warp_setup import torch_stream_scope, wp

    main = torch.cuda.current_stream(device)
    free = _side_streams.setdefault(str(device), [])
    while len(free) < len(works) - 1:
        free.append(torch.cuda.Stream(device))
    used = [free.pop() for _ in works[1:]]  # a branch may fork again, and takes others then
    global _branching
    _branching += 1
    try:
        for stream in used:
            stream.wait_stream(main)
        for stream, work in zip(used, works[1:], strict=True):
            with torch.cuda.stream(stream), torch_stream_scope(wp.get_device(str(device))):
                work()
        works[0]()
        for stream in used:
            main.wait_stream(stream)
    finally:
        _branching -= 1
        _joined_streams.extend(used)
        if not _branching:  # before that, another branch may reuse memory that is still read here
            free.extend(_joined_streams)
            _joined_streams.clear()


def where_any(mask: Tensor, work: Callable[[], None]) -> None:
    """Do work that matters to the masked worlds alone, where there are some; the mask is of shape
    ``(nworld,)``, bool or integers. A CUDA graph that is captured looks in each replay, except in a
    branch, which cannot be interrupted. An eager step on CUDA does not look, which would stop the
    device: the work changes nothing that counts if the mask is empty.
    """
    if mask.is_cuda and torch.cuda.is_current_stream_capturing() and not _branching:
        from mjstack.sim.warp_setup import torch_stream_scope, wp

        if wp.is_conditional_graph_supported():
            with torch_stream_scope(wp.get_device(str(mask.device))):
                wp.capture_if(wp.from_torch(mask.sum(dtype=torch.int32).view(1)), work)
            return
    if mask.is_cuda or bool(mask.any()):
        work()
