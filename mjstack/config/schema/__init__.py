"""The configuration as dataclasses: one per group, and `Config`, which the library receives.

Hydra merges `conf/` into these types, so that a misspelt key or a value of the wrong type is an
error before anything runs. Lengths are in m, angles in rad, times in s. Values live in `conf/`, not
here.
"""

from mjstack.config.schema.gate import (
    BatchGateCfg,
    CapacityCfg,
    GateCfg,
    GateFuncCfg,
    ParityCfg,
    SuccessGateCfg,
    ThroughputCfg,
)
from mjstack.config.schema.job import (
    JOB_SCHEMAS,
    CollectJobCfg,
    JobCfg,
    ReachabilityJobCfg,
    ScalingJobCfg,
    StudyJobCfg,
)
from mjstack.config.schema.physics import (
    Backend,
    BatchCfg,
    Cone,
    GraphMode,
    SimCfg,
    SolverCfg,
    TimingCfg,
)
from mjstack.config.schema.robot import ModelCfg, PlacementsCfg, RobotCfg, RobotSource
from mjstack.config.schema.root import Config
from mjstack.config.schema.scene import SHAPES, BoxCfg, ObjectCfg, PlaceCfg, SceneCfg
from mjstack.config.schema.task import ControllerCfg, PhaseCfg, TaskCfg
from mjstack.config.schema.term import (
    ActionTermCfg,
    ObservationGroupCfg,
    ObservationTermCfg,
    RewardTermCfg,
    TermCfg,
    TerminationTermCfg,
)

__all__ = [
    "JOB_SCHEMAS",
    "SHAPES",
    "ActionTermCfg",
    "Backend",
    "BatchCfg",
    "BatchGateCfg",
    "BoxCfg",
    "CapacityCfg",
    "CollectJobCfg",
    "Cone",
    "Config",
    "ControllerCfg",
    "GateCfg",
    "GateFuncCfg",
    "GraphMode",
    "JobCfg",
    "ModelCfg",
    "ObjectCfg",
    "ObservationGroupCfg",
    "ObservationTermCfg",
    "ParityCfg",
    "PhaseCfg",
    "PlaceCfg",
    "PlacementsCfg",
    "ReachabilityJobCfg",
    "RewardTermCfg",
    "RobotCfg",
    "RobotSource",
    "ScalingJobCfg",
    "SceneCfg",
    "SimCfg",
    "SolverCfg",
    "StudyJobCfg",
    "SuccessGateCfg",
    "TaskCfg",
    "TermCfg",
    "TerminationTermCfg",
    "ThroughputCfg",
    "TimingCfg",
]
