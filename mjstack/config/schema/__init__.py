"""The configuration as dataclasses: one per group, and `Config`, which the library receives.

Hydra merges `conf/` into these types, so that a misspelt key or a value of the wrong type is an
error before anything runs. Lengths are in m, angles in rad, times in s. Values live in `conf/`, not
here.
"""

from mjstack.config.schema.jobs import *
from mjstack.config.schema.robot import *
from mjstack.config.schema.root import Config as Config
from mjstack.config.schema.run import *
from mjstack.config.schema.scene import *
from mjstack.config.schema.task import *
