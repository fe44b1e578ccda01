"""Runs of steps in a row: what rules of the check count, for every world, or every world and cube,
at once.
"""

from __future__ import annotations

import torch


def extend_run(
    run: torch.Tensor, best: torch.Tensor, holds: torch.Tensor, judged: torch.Tensor
) -> None:
    """Goes on with a run in the judged steps, and keeps the longest. In the others it stays as it
    is: nothing looks at it.

    Args:
        run: Length of the run [steps], shape ``(...)``, float32.
        best: The longest so far [steps].
        holds: Whether this step belongs to a run, bool; one that does not ends it.
        judged: Whether this step counts, bool.
    """
    run.copy_(torch.where(judged, (run + 1.0) * holds, run))
    torch.maximum(best, run, out=best)


def extend_carry(
    run: torch.Tensor,
    far: torch.Tensor,
    start: torch.Tensor,
    xy: torch.Tensor,
    in_air: torch.Tensor,
) -> None:
    """Goes on with an uninterrupted run in the air, or ends it.

    Args:
        run: Length of the run [steps], shape ``(...)``, float32.
        far: Largest distance from the run's own start [m].
        start: Where it started [m], shape ``(..., 2)``.
        xy: Where the cube is [m], likewise.
        in_air: Whether this step belongs to a run, bool.
    """
    starts = in_air & (run == 0.0)
    start.copy_(torch.where(starts[..., None], xy, start))
    run.add_(1.0).mul_(in_air)
    away = torch.linalg.vector_norm(xy - start, dim=-1)
    far.copy_(torch.where(in_air, torch.maximum(far, away), 0.0))
