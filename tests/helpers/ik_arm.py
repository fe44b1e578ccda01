"""An arm with kinematics by native MuJoCo, to hold batched inverse kinematics against."""

from collections.abc import Iterator

import mujoco
import numpy as np
import torch

from mjstack.config.schema import RobotCfg
from mjstack.kinematics.batched_ik import BatchedIk


class Arm:
    """A robot in a model, with kinematics of its own by native MuJoCo."""

    def __init__(self, model: mujoco.MjModel, robot: RobotCfg) -> None:
        self.model = model
        self.robot = robot
        self.names = [*robot.arm_joints, *robot.gripper_joints]
        self.low, self.high = np.array([model.joint(name).range for name in self.names]).T
        self.moved = [self.names.index(name) for name in robot.ik_joints]
        self.home = np.array(robot.home)
        for name, value in robot.locked.items():
            self.home[self.names.index(name)] = value
        self.home[len(robot.arm_joints) :] = robot.gripper_open

    def _posed(self, commands: np.ndarray) -> Iterator[mujoco.MjData]:
        """The arm at each of some commands."""
        data = mujoco.MjData(self.model)
        for command in np.asarray(commands, dtype=float):
            for name, value in zip(self.names, command, strict=True):
                data.joint(name).qpos[0] = value
            mujoco.mj_kinematics(self.model, data)
            yield data

    def grasp_point(self, commands: np.ndarray) -> np.ndarray:
        sites = self.robot.grasp_sites
        posed = self._posed(commands)
        return np.array([np.mean([data.site(s).xpos for s in sites], axis=0) for data in posed])

    def directions(self, commands: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Closing and approach axis."""
        closing = []
        approach = []
        for data in self._posed(commands):
            first, second = (data.site(name).xpos for name in self.robot.grasp_sites)
            closing.append((second - first) / np.linalg.norm(second - first))
            turned = data.body(self.robot.approach_body).xmat.reshape(3, 3)
            approach.append(turned @ self.robot.approach_axis)
        return np.array(closing), np.array(approach)

    def jacobian(self, command: np.ndarray) -> np.ndarray:
        """Of the grasp point for the joints that inverse kinematics moves, by differences, shape
        ``(3, n_moved)``.
        """
        steps = np.zeros((2 * len(self.moved), len(command)))
        for k, j in enumerate(self.moved):
            steps[2 * k, j] = 1e-5
            steps[2 * k + 1, j] = -1e-5
        at = self.grasp_point(command + steps)
        return ((at[::2] - at[1::2]) / 2e-5).T

    def spare(self, command: np.ndarray) -> np.ndarray:
        """Projects onto what those joints can do without moving the centre, shape ``(n_moved,
        n_moved)``.
        """
        jacobian = self.jacobian(command)
        return np.eye(len(self.moved)) - np.linalg.pinv(jacobian) @ jacobian

    def free(self, commands: np.ndarray, margin: float = 0.01) -> np.ndarray:
        """Worlds in which no moved joint is near a limit."""
        q = commands[:, self.moved]
        low = self.low[self.moved]
        high = self.high[self.moved]
        return ((q > low + margin) & (q < high - margin)).all(1)

    def solver(self, nworld: int, device: str = "cpu", **settings: float) -> BatchedIk:
        return BatchedIk(self.model, self.robot, nworld, device, **settings)

    def at_home(self, nworld: int) -> np.ndarray:
        return np.tile(self.home, (nworld, 1))

    def at_limits(self, nworld: int, seed: int) -> np.ndarray:
        """As `anywhere`, with about half of those joints at a limit, 1e-5 rad inside."""
        commands = self.anywhere(nworld, seed)
        rng = np.random.default_rng(seed + 1000)
        low = self.low + 1e-5
        high = self.high - 1e-5
        ends = np.where(rng.random(commands.shape) < 0.5, low, high)
        chosen = rng.random(commands.shape) < 0.5
        placed = np.where(chosen, ends, np.clip(commands, low, high))
        commands[:, self.moved] = placed[:, self.moved]
        return commands

    def anywhere(self, nworld: int, seed: int) -> np.ndarray:
        """Random positions of the joints that inverse kinematics moves; the others at home, gripper
        open.
        """
        commands = self.at_home(nworld)
        moved = self.moved
        commands[:, moved] = np.random.default_rng(seed).uniform(
            self.low[moved], self.high[moved], (nworld, len(moved))
        )
        return commands


def tensors(device: str, *arrays: np.ndarray) -> list[torch.Tensor]:
    return [torch.as_tensor(array, device=device) for array in arrays]


def results(
    ik: BatchedIk, command: np.ndarray, target: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """A solve, copied to the host as float64."""
    new, distance = ik.solve(*tensors(str(ik.device), command, target))
    return new.cpu().numpy().astype(float), distance.cpu().numpy().astype(float)
