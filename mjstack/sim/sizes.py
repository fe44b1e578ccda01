"""Buffer sizes of MJWarp, from the configuration and the defaults of a robot in a scene."""

from __future__ import annotations

from dataclasses import dataclass

from mjstack.config.schema import Config


@dataclass(frozen=True, kw_only=True, slots=True)
class BatchSizes:
    """How much room the worlds have.

    Attributes:
        nconmax: Contacts per world, pooled: one world may have more than its share.
        naconmax: Contacts of all worlds together, or None for ``nconmax * nworld``.
        njmax: Constraint rows per world, a hard limit.
        nccdmax: Convex collisions per world, pooled, or None for MJWarp's default.
        naccdmax: Convex collisions of all worlds together, or None.
    """

    nconmax: int
    njmax: int
    naconmax: int | None = None
    nccdmax: int | None = None
    naccdmax: int | None = None

    def as_kwargs(self) -> dict[str, int]:
        """Arguments for ``mujoco_warp.make_data``."""
        names = ("nconmax", "njmax", "naconmax", "nccdmax", "naccdmax")
        return {name: getattr(self, name) for name in names if getattr(self, name) is not None}

    def contact_pool(self, nworld: int) -> int:
        """Contacts that fit into the pool of nworld worlds."""
        return self.naconmax if self.naconmax is not None else self.nconmax * nworld


def resolve_sizes(cfg: Config) -> BatchSizes:
    """The configured sizes, with the defaults of this robot and scene where they are null."""
    layout = cfg.robot.layouts[cfg.scene.name]
    return _sizes(cfg, layout.nconmax, layout.njmax)


def resolve_env_sizes(cfg: Config) -> BatchSizes:
    """Likewise with room for random actions, the worst case for contacts."""
    layout = cfg.robot.layouts[cfg.scene.name]
    return _sizes(cfg, layout.env_nconmax, layout.env_njmax)


def _sizes(cfg: Config, nconmax: int, njmax: int) -> BatchSizes:
    return BatchSizes(
        nconmax=cfg.batch.nconmax if cfg.batch.nconmax is not None else nconmax,
        njmax=cfg.batch.njmax if cfg.batch.njmax is not None else njmax,
        naconmax=cfg.batch.naconmax,
        nccdmax=cfg.batch.nccdmax,
        naccdmax=cfg.batch.naccdmax,
    )
