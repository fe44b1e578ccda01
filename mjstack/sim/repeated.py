"""Work that is repeated step by step, captured or not."""

from collections.abc import Callable

import torch

from mjstack.config.schema import GraphMode


class Repeated:
    """Work that is the same at every call, and just runs; `mjstack.sim.graph.StepGraph` captures
    it.

    Attributes:
        warm_up_seconds: Time of the first call, if it was a warm-up [s].
        capture_seconds: Time of the capture [s].
    """

    warm_up_seconds = 0.0
    capture_seconds = 0.0

    def __init__(self, work: Callable[[], None]) -> None:
        """``work`` is called as it is."""
        self._work = work

    @property
    def captured(self) -> bool:
        """Whether the next call replays a graph."""
        return False

    def __call__(self) -> None:
        """Do the work."""
        self._work()

    def drop(self) -> None:
        """Free the graph and its memory."""


def as_graph(
    work: Callable[[], None],
    device: torch.device,
    mode: GraphMode,
    *,
    name: str,
    version: Callable[[], int],
    culprit: Callable[[], str],
) -> Repeated:
    """Work as a `StepGraph` on CUDA, whose arguments these are; elsewhere as it is."""
    if device.type != "cuda":
        return Repeated(work)
    from mjstack.sim.graph import StepGraph  # loads Warp, which native runs do not need

    return StepGraph(work, device, mode, name=name, version=version, culprit=culprit)


def in_parallel(device: torch.device, *works: Callable[[], None]) -> None:
    """Do independent works; they are parallel branches where a CUDA graph is captured."""
    if device.type == "cuda":
        from mjstack.sim.graph import side_by_side  # loads Warp, which native runs do not need

        side_by_side(device, *works)
        return
    for work in works:
        work()
