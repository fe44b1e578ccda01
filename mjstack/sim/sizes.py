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


def robot_sizes(cfg: Config, *, driven: bool = True) -> BatchSizes:
    """The defaults of this robot and scene: for the driven task, or else for random actions, the
    worst case for contacts.
    """
    # A scene that gives all its own positions needs no placements.
    sizes = cfg.robot.placements.get(cfg.scene.name) or PlacementsCfg()
    if driven:
        return BatchSizes(nconmax=sizes.nconmax, njmax=sizes.njmax)
    return BatchSizes(nconmax=sizes.env_nconmax, njmax=sizes.env_njmax)


def resolve_sizes(cfg: Config, *, driven: bool = True) -> BatchSizes:
    """The configured sizes, where they are null those of `robot_sizes`."""
    return apply_configured(cfg, robot_sizes(cfg, driven=driven))


def apply_configured(cfg: Config, sizes: BatchSizes) -> BatchSizes:
    """The sizes, with what the configuration sets in their place."""
    return replace(sizes, **configured_sizes(cfg.batch))


def configured_sizes(sizes: BatchSizes | BatchCfg) -> dict[str, Any]:
    """The sizes that are set."""
    return {name: value for name in KEYS if (value := getattr(sizes, name)) is not None}
