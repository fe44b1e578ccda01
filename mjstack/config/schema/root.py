"""The whole configuration."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from omegaconf import MISSING

from mjstack.config.schema.gate import GateCfg
from mjstack.config.schema.job import JobCfg
from mjstack.config.schema.physics import BatchCfg, GraphMode, SimCfg, SolverCfg, TimingCfg
from mjstack.config.schema.robot import ModelCfg, RobotCfg
from mjstack.config.schema.scene import SceneCfg
from mjstack.config.schema.task import ControllerCfg, TaskCfg


@dataclass(kw_only=True, slots=True)
class Config:
    """Everything a run needs."""

    robot: RobotCfg = field(default_factory=RobotCfg)
    model: ModelCfg = field(default_factory=ModelCfg)
    scene: SceneCfg = field(default_factory=SceneCfg)
    timing: TimingCfg = field(default_factory=TimingCfg)
    solver: SolverCfg = field(default_factory=SolverCfg)
    batch: BatchCfg = field(default_factory=BatchCfg)
    sim: SimCfg = field(default_factory=SimCfg)
    # Terms by name. OmegaConf would not let a command line add a term to a typed dict, so the store
    # types them: ActionTermCfg, ObservationGroupCfg, TermCfg, TerminationTermCfg and RewardTermCfg.
    action: dict[str, Any] = field(default_factory=dict)
    observation: dict[str, Any] = field(default_factory=dict)
    reset: dict[str, Any] = field(default_factory=dict)
    termination: dict[str, Any] = field(default_factory=dict)
    reward: dict[str, Any] = field(default_factory=dict)
    task: TaskCfg = field(default_factory=TaskCfg)
    controller: ControllerCfg = field(default_factory=ControllerCfg)
    gate: GateCfg = field(default_factory=GateCfg)
    job: JobCfg = field(default_factory=JobCfg)
    nworld: int = MISSING
    seed: int = MISSING
    gates: list[str] = MISSING
    graph: GraphMode = MISSING
    view: bool = MISSING
    video: bool = MISSING
    starts: str | None = None
    run: str | None = None
    world: str | None = None
