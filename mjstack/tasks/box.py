"""Check of the box task: fixed-size state machines on the device, fed step by step, for every world
at once.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import ClassVar

import numpy as np
import torch

from mjstack.config.schema import Config
from mjstack.config.validate import BOX_ROLES
from mjstack.errors import ConfigError, ParameterError
from mjstack.managers.base import EnvView
from mjstack.math import not_finite, quat_to_matrix
from mjstack.mdp.geometry import gripper_opening
from mjstack.scene import LowestPoint, SceneIndex, table_top
from mjstack.scene.index import Columns
from mjstack.scene.phases import Phase
from mjstack.sim.simulation import LOST_PHYSICS, Simulation
from mjstack.tasks.box_report import report_box
from mjstack.tasks.check import CheckResult, EpisodeCheck, Rules
from mjstack.tasks.streaks import extend_carry, extend_run

COLORS = ("red", "blue")  # the order of every dimension over cubes


_PER_CUBE = {
    "GRASP": "not grasped",
    "LIFT": "not lifted",
    "CARRY": "not carried over the box",
    "DROP": "dropped",
    "RELEASE": "not released",
    "SETTLED": "not at rest in the box after its release",
}
RULES = Rules(
    {
        **{
            f"{name}_{c.upper()}": f"{c} {text}" for name, text in _PER_CUBE.items() for c in COLORS
        },
        "ORDER": "blue grasped before red was released",
        "INSIDE": "a cube not at rest in the box at the end",
        "JAW_CLEAR": "gripper too low at the end",
    }
)


class CubesAndBox:
    """Both cubes of every world as the rules see them, red first, float32.

    Poses, speeds and the gripper come from qpos and qvel, which are never stale. Forces are those
    of the last physics step. A sensor gives the net force of a jaw on a cube; that is the sum of
    the normal forces up to a factor of 1.6, because friction adds at most 1.2 times the normal
    force across it and the normals of one jaw on a convex cube do not cancel. The threshold is ten
    million times smaller than a grasp's force: it tells contact from none.
    """

    def __init__(self, cfg: Config, index: SceneIndex, device: torch.device) -> None:
        """Reads addresses, thresholds and the box's place.

        Raises:
            ConfigError: The scene has no box.
        """
        scene = cfg.scene
        box = cfg.scene.box
        if box is None:
            raise ConfigError("scene", scene.name, "a scene with a box", "Set scene=box")
        self._t = cfg.gate.box
        self._half = scene.objects[COLORS[0]].size[0]
        self.top = table_top(scene)
        self.rim = self.top + box.height
        self._qpos = [index.object_address(name)[0] for name in COLORS]
        self._qvel = [index.object_address(name)[1] for name in COLORS]
        self._jaws = [index.jaw_force[name] for name in COLORS]
        self._supports = [index.support_force[name] for name in COLORS]

        def constant(values: object) -> torch.Tensor:
            return torch.tensor(values, dtype=torch.float32, device=device)

        low = [box.center[i] - box.half[i] for i in (0, 1)]
        high = [box.center[i] + box.half[i] for i in (0, 1)]
        self._low, self._high = constant([*low, self.top + box.floor]), constant([*high, self.rim])
        self._slots = constant([scene.places[f"{name}_slot"].xy for name in COLORS])
        self._corners = self._half * constant(list(itertools.product((-1.0, 1.0), repeat=3)))
        self._gripper = Columns(index.robot_qpos[index.n_arm :], device)
        self._closed = constant(cfg.robot.gripper_closed)
        self._opening = constant(cfg.robot.gripper_open) - self._closed

    def pose(self, sim: Simulation) -> torch.Tensor:
        """Position [m] and quaternion (wxyz), shape ``(nworld, 2, 7)``."""
        return torch.stack([sim.qpos[:, a : a + 7] for a in self._qpos], dim=1).float()

    def bounds(self, pos: torch.Tensor, turn: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Least and largest coordinates of the eight corners [m], each ``(nworld, 2, 3)``, from
        centres and matrices.
        """
        reach = self._half * turn.abs().sum(-1)
        return pos - reach, pos + reach

    def speed(self, sim: Simulation, turn: torch.Tensor) -> torch.Tensor:
        """Speed of the fastest corner [m/s], shape ``(nworld, 2)``."""
        velocity = torch.stack([sim.qvel[:, a : a + 6] for a in self._qvel], dim=1).float()
        # A free joint's linear velocity is the world's, its angular velocity the body's: all of it
        # in the body's frame.
        linear = (turn * velocity[..., :3, None]).sum(-2)
        spin = velocity[..., None, 3:].expand(-1, -1, 8, -1)
        corners = linear[..., None, :] + torch.linalg.cross(spin, self._corners.expand_as(spin))
        return torch.linalg.vector_norm(corners, dim=-1).amax(-1)

    def beyond(self, low: torch.Tensor, high: torch.Tensor) -> torch.Tensor:
        """How far the outermost corner is outside of the box [m], negative inside, shape ``(nworld,
        2)``.
        """
        return torch.maximum(self._low - low, high - self._high).amax(-1)

    def over(self, low: torch.Tensor, high: torch.Tensor) -> torch.Tensor:
        """Whether all eight corners are over the inside of the box or in it, shape ``(nworld, 2)``,
        bool.
        """
        return ((low >= self._low) & (high <= self._high))[..., :2].all(-1)

    def inside(self, low: torch.Tensor, high: torch.Tensor) -> torch.Tensor:
        """Whether all eight corners are in the box, shape ``(nworld, 2)``, bool."""
        return self.beyond(low, high) <= self._t.inside

    def off_slot(self, pos: torch.Tensor) -> torch.Tensor:
        """Horizontal distance of each cube from its place in the box [m], shape ``(nworld, 2)``."""
        return torch.linalg.vector_norm(pos[..., :2] - self._slots, dim=-1)

    def pressed(self, sim: Simulation) -> torch.Tensor:
        """Whether each jaw presses on each cube, shape ``(nworld, 2, jaws)``, bool."""
        return self._forces(sim, self._jaws) > self._t.force

    def supported(self, sim: Simulation) -> torch.Tensor:
        """Whether the table, the floor, the box or the other cube presses on each cube, shape
        ``(nworld, 2)``, bool.
        """
        return (self._forces(sim, self._supports) > self._t.force).any(-1)

    def opening(self, sim: Simulation) -> torch.Tensor:
        """How far the gripper is open as measured, 0 closed to 1 open, the least open joint, shape
        ``(nworld,)``.
        """
        return ((self._gripper.read(sim.qpos).float() - self._closed) / self._opening).amin(1)

    def _forces(self, sim: Simulation, addresses: list[list[int]]) -> torch.Tensor:
        """Sizes of sensed forces [N], shape ``(nworld, 2, n)``."""
        parts = [
            torch.stack([sim.sensordata[:, a : a + 3] for a in row], dim=1) for row in addresses
        ]
        return torch.linalg.vector_norm(torch.stack(parts, dim=1), dim=-1)


class BoxCheck(EpisodeCheck):
    """Collects what the rules of the check need. Memory: some numbers per world and cube, whatever
    the episode's length.

    Worlds may be in different phases. A cube's first phase, its approach, forgets what was found
    before: a world that goes back to it to grasp anew is judged from its last attempt.

    A cube is loaded while both jaws press on it, and airborne while it is loaded, up from the table
    and touches no support.
    """

    rules = RULES
    summaries: ClassVar = {
        "slot_err_red_max_m": ("slot_err_red_m", "max"),
        "slot_err_blue_max_m": ("slot_err_blue_m", "max"),
        "beyond_max_m": ("beyond_m", "max"),
        "corner_speed_max_m_per_s": ("corner_speed_m_per_s", "max"),
        "jaw_clearance_min_m": ("jaw_clearance_m", "min"),
        "grasp_steps_red_min": ("grasp_steps_red", "min"),
        "grasp_steps_blue_min": ("grasp_steps_blue", "min"),
        "settled_steps_red_min": ("settled_steps_red", "min"),
        "settled_steps_blue_min": ("settled_steps_blue", "min"),
    }

    def __init__(
        self, cfg: Config, index: SceneIndex, phases: list[Phase], nworld: int, device: torch.device
    ) -> None:
        """Allocates for nworld worlds."""
        self._t = cfg.gate.box
        self._timing = cfg.timing
        self._robot = cfg.robot
        self._cubes = CubesAndBox(cfg, index, device)
        self._steps = phases[-1].stop
        self._step = torch.zeros(1, dtype=torch.int64, device=device)
        rows = [
            [[phase.name == f"{role}_{color}" for color in COLORS] for role in BOX_ROLES]
            for phase in phases
        ]
        self._roles = torch.tensor(rows, device=device)  # (phase, role, cube)

        self._finite = torch.ones(nworld, dtype=torch.bool, device=device)
        self._too_early = torch.zeros(
            nworld, dtype=torch.bool, device=device
        )  # blue loaded before red was released
        self._from = torch.zeros(
            (nworld, 2, 2), dtype=torch.float32, device=device
        )  # where a carry started
        # What an approach forgets, in one tensor.
        self._attempt = torch.zeros((11, nworld, 2), dtype=torch.float32, device=device)
        (
            self._grasp_run,
            self._grasp_best,
            self._lift_run,
            self._lift_best,
            self._carry_run,
            self._carry_far,
            self._carry_best,  # farthest of any run that is long enough
            self._unloaded,  # steps between the last grasp and the release
            self._over,  # in the last frame of the hold
            self._opening,  # widest without contact since the opening began
            self._settled,  # steps at rest in the box, as of the settling's last step
        ) = self._attempt.unbind(0)
        self._rest_run = torch.zeros((nworld, 2), dtype=torch.float32, device=device)
        self._last = torch.full(
            (3, nworld, 2), torch.nan, device=device
        )  # beyond, speed, off the slot

    def update(self, sim: Simulation, phase: torch.Tensor) -> None:
        """Takes in the state at the end of a step. Fixed shapes, no host read."""
        t = self._t
        cubes = self._cubes
        going = self._step < self._steps  # steps after the end count for nothing
        role = dict(
            zip(
                BOX_ROLES,
                (self._roles.index_select(0, phase) & going[:, None, None]).unbind(1),
                strict=True,
            )
        )
        self._finite &= ~not_finite(sim.qpos, sim.qvel)
        # Not by a product: what an earlier attempt left may be NaN.
        self._attempt.masked_fill_(role["approach"], 0.0)

        pose = cubes.pose(sim)
        pos = pose[..., :3]
        turn = quat_to_matrix(pose[..., 3:])
        low, high = cubes.bounds(pos, turn)
        pressed = cubes.pressed(sim)
        loaded = pressed.all(-1)
        free = ~pressed.any(-1)
        airborne = loaded & (low[..., 2] - cubes.top >= t.lift_height) & ~cubes.supported(sim)

        extend_run(self._grasp_run, self._grasp_best, loaded, role["close"])
        extend_run(self._lift_run, self._lift_best, airborne, role["lift"] | role["carry"])
        extend_carry(
            self._carry_run, self._carry_far, self._from, pos[..., :2], airborne & role["carry"]
        )
        far = torch.where(self._carry_run >= t.carry_steps, self._carry_far, 0.0)
        torch.maximum(self._carry_best, far, out=self._carry_best)

        # A grasp that slips while the jaws still close has to be made anew; what counts is the last
        # one.
        self._unloaded.masked_fill_(role["close"] & (self._grasp_run == t.grasp_steps), 0.0)
        grasped = self._grasp_best >= t.grasp_steps
        in_hand = role["close"] | role["lift"] | role["carry"] | role["hold"]
        self._unloaded.add_(grasped & in_hand & ~loaded)
        self._over.copy_(torch.where(role["hold"], cubes.over(low, high), self._over))
        letting_go = role["open"] | role["retreat"] | role["settle"]
        opening = torch.where(letting_go & free, cubes.opening(sim)[:, None], 0.0)
        torch.maximum(self._opening, opening, out=self._opening)
        self._too_early |= loaded[:, 1] & (self._opening[:, 0] < t.open_fraction) & going

        beyond = cubes.beyond(low, high)
        speed = cubes.speed(sim, turn)
        still = free & (beyond <= t.inside) & (speed < t.rest_speed)
        self._rest_run.copy_(torch.where(going, (self._rest_run + 1.0) * still, self._rest_run))
        self._settled.copy_(torch.where(role["settle"], self._rest_run, self._settled))
        self._last.copy_(
            torch.where(going, torch.stack((beyond, speed, cubes.off_slot(pos))), self._last)
        )
        self._step += 1

    def result(self, sim: Simulation) -> CheckResult:
        """Judges the episode; every rule that was not shown to hold has failed."""
        t = self._t
        sim.kinematics()
        lowest = LowestPoint(sim.model, self._robot.jaw_bodies, sim.device).height(
            sim.xpos, sim.xquat
        )
        clearance = lowest - self._cubes.rim  # the rim is above the table
        complete = int(self._step) == self._steps
        beyond, speed, off_slot = self._last.unbind(0)
        per_cube = {
            "GRASP": self._grasp_best >= t.grasp_steps,
            "LIFT": self._lift_best >= t.lift_steps,
            "CARRY": (self._carry_best >= t.carry_distance) & (self._over > 0.0),
            "DROP": self._unloaded == 0.0,
            "RELEASE": self._opening >= t.open_fraction,
            "SETTLED": self._settled >= t.window,
        }
        held = {
            "FINITE": self._finite,
            "STEPS": (sim.step_count == self._steps * self._timing.decimation) & complete,
            "OVERFLOW": (sim.overflow & LOST_PHYSICS) == 0,
            **{
                f"{n}_{c.upper()}": ok[:, i]
                for n, ok in per_cube.items()
                for i, c in enumerate(COLORS)
            },
            "ORDER": ~self._too_early,
            "INSIDE": (self._rest_run >= t.window).all(1) & complete,
            "JAW_CLEAR": (clearance >= t.jaw_clearance) & complete,
        }
        values = {
            "beyond_m": beyond.amax(1),
            "corner_speed_m_per_s": speed.amax(1),
            "jaw_clearance_m": clearance,
            "rest_steps": self._rest_run.amin(1),
            "blue_too_early": self._too_early.float(),
        }
        kept = {
            "slot_err_{}_m": off_slot,
            "grasp_steps_{}": self._grasp_best,
            "lift_steps_{}": self._lift_best,
            "carry_{}_m": self._carry_best,
            "over_box_{}": self._over,
            "unloaded_steps_{}": self._unloaded,
            "opening_{}": self._opening,
            "settled_steps_{}": self._settled,
        }
        values |= {
            name.format(color): value[:, i]
            for name, value in kept.items()
            for i, color in enumerate(COLORS)
        }
        return CheckResult.of(RULES, held, values)

    def placed(self, sim: Simulation) -> torch.Tensor:
        """Whether each cube is in the box right now."""
        pose = self._cubes.pose(sim)
        return self._cubes.inside(*self._cubes.bounds(pose[..., :3], quat_to_matrix(pose[..., 3:])))

    @classmethod
    def thresholds(cls, cfg: Config) -> dict[str, float]:
        """The rules' numbers, with units."""
        t = cfg.gate.box
        return {
            "force_n": t.force,
            "grasp_steps": t.grasp_steps,
            "lift_height_m": t.lift_height,
            "lift_steps": t.lift_steps,
            "carry_steps": t.carry_steps,
            "carry_distance_m": t.carry_distance,
            "open_fraction": t.open_fraction,
            "beyond_max_m": t.inside,
            "rest_speed_m_per_s": t.rest_speed,
            "window_steps": t.window,
            "jaw_clearance_m": t.jaw_clearance,
        }

    @classmethod
    def explain(
        cls, cfg: Config, steps: Mapping[str, np.ndarray], values: Mapping[str, float]
    ) -> dict[str, tuple[str, str]]:
        """See `report_box`."""
        return report_box(cfg, values)

    @classmethod
    def headline(cls, values: Mapping[str, float]) -> str:
        """How well the cubes are placed."""
        red, blue, jaws = (
            1e3 * values[name] for name in ("slot_err_red_m", "slot_err_blue_m", "jaw_clearance_m")
        )
        return (
            f"red {red:.1f} mm, blue {blue:.1f} mm off their places, jaws {jaws:.0f} mm above"
            " the rim"
        )


class BoxSuccess:
    """Achieved while both cubes have been at rest in the box, out of the jaws, for the whole
    window, and the gripper is open.

    The window and the limits are those of the check, ``gate.box``.
    """

    def __init__(self, env: EnvView, *, open_fraction: float) -> None:
        """Allocates the counter.

        Args:
            env: The environment.
            open_fraction: How far the gripper must be open, from 0 (closed) to 1 (open), as
                measured.

        Raises:
            MjstackError: The fraction is out of range, or the scene has no box.
        """
        if not 0.0 <= open_fraction <= 1.0:
            raise ParameterError("open_fraction", open_fraction, "a number from 0 to 1")
        self._t = env.cfg.gate.box
        self._open = open_fraction
        self._cubes = CubesAndBox(env.cfg, env.index, env.device)
        self._held = torch.zeros(env.nworld, dtype=torch.int32, device=env.device)

    def __call__(self, env: EnvView) -> torch.Tensor:
        """Takes in a step; shape ``(nworld,)``, bool."""
        cubes = self._cubes
        pose = cubes.pose(env.sim)
        turn = quat_to_matrix(pose[..., 3:])
        inside = cubes.inside(*cubes.bounds(pose[..., :3], turn))
        still = (
            inside
            & (cubes.speed(env.sim, turn) < self._t.rest_speed)
            & ~cubes.pressed(env.sim).any(-1)
        )
        self._held.add_(1).mul_(still.all(1))
        return (self._held >= self._t.window) & (gripper_opening(env) >= self._open).all(1)

    def reset(self, mask: torch.Tensor) -> None:
        """Forgets the masked worlds."""
        self._held.masked_fill_(mask, 0)
