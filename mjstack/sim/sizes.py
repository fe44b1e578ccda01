"""Buffer sizes of MJWarp, from the configuration and the defaults of a robot in a scene."""

from dataclasses import dataclass, field, replace
from typing import Any

from mjstack.config.schema import BatchCfg, Config, PlacementsCfg

KEYS = ("nconmax", "njmax", "nccdmax")


@dataclass(frozen=True, kw_only=True)
class BatchSizes:
    """How much room the worlds have.

    Attributes:
        nconmax: Contacts per world, pooled: one world may have more than its share.
        njmax: Constraint rows per world, a hard limit.
        nccdmax: Convex collisions per world, pooled; None for as many as contacts.
        source: Where they come from, for reports.
    """

    nconmax: int
    njmax: int
    nccdmax: int | None = None
    source: str = field(default="the configuration", compare=False)

    def as_kwargs(self) -> dict[str, int]:
        """Arguments for ``mujoco_warp.make_data``.

        Convex collisions are some of the pairs in the contact pool: more room than that has is
        never used, and MJWarp refuses it.
        """
        convex = min(self.nconmax, self.nccdmax or self.nconmax)
        return {"nconmax": self.nconmax, "njmax": self.njmax, "nccdmax": convex}

    def as_overrides(self) -> str:
        """The same on the command line: ``batch.nconmax=40 batch.njmax=184``."""
        return " ".join(f"batch.{name}={value}" for name, value in configured_sizes(self).items())

    def __str__(self) -> str:
        return f"{self.as_overrides()} ({self.source})"


def resolve_sizes(cfg: Config) -> BatchSizes:
    """The configured sizes, with the defaults of this robot and scene where they are null."""
    sizes = _placements(cfg)
    return apply_configured(cfg, BatchSizes(nconmax=sizes.nconmax, njmax=sizes.njmax))


def resolve_env_sizes(cfg: Config) -> BatchSizes:
    """The configured sizes, where they are null with room for random actions: the worst case for
    contacts.
    """
    return apply_configured(cfg, resolve_measuring_sizes(cfg))


def resolve_measuring_sizes(cfg: Config, *, driven: bool = False) -> BatchSizes:
    """Room to begin to measure in: the robot's sizes for random actions, or for a ``driven``
    task; configured ones where they are larger.
    """
    sizes = _placements(cfg)
    nconmax, njmax = sizes.env_nconmax, sizes.env_njmax
    if driven:
        nconmax, njmax = sizes.nconmax, sizes.njmax
    return BatchSizes(
        nconmax=max(nconmax, cfg.batch.nconmax or 0), njmax=max(njmax, cfg.batch.njmax or 0)
    )


def apply_configured(cfg: Config, sizes: BatchSizes) -> BatchSizes:
    """The sizes, with what the configuration sets in their place."""
    return replace(sizes, **configured_sizes(cfg.batch))


def _placements(cfg: Config) -> PlacementsCfg:
    """Those of the scene; a scene that gives all its own positions needs none."""
    return cfg.robot.placements.get(cfg.scene.name) or PlacementsCfg()


def configured_sizes(sizes: BatchSizes | BatchCfg) -> dict[str, Any]:
    """The sizes that are set."""
    return {name: value for name in KEYS if (value := getattr(sizes, name)) is not None}
