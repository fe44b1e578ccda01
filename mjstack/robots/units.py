"""Joint values in LeRobot's units, as its SO-101 follower has them after calibration."""

import numpy as np
from numpy import ndarray

from mjstack.errors import ArgumentError

LEROBOT = "lerobot"  # beside "si"


class LerobotUnits:
    """Degrees from the middle of an arm joint's range, and 0 to 100 over a gripper joint's.

    LeRobot's calibration moves every joint through its range, and takes the middle for zero
    (``so_follower`` with ``use_degrees``).

    Attributes:
        units: Unit of each joint's numbers.
    """

    def __init__(self, arm_joints: int, ranges: ndarray, units: str = LEROBOT) -> None:
        """Take the joints' ranges [rad, m], shape ``(joints, 2)``, the arm's first. With ``si``
        numbers stay as they are.
        """
        arm = np.arange(len(ranges)) < arm_joints
        low, high = ranges.astype(np.float64).T
        self._zero = np.where(arm, 0.5 * (low + high), low)
        self._scale = np.where(arm, 180.0 / np.pi, 100.0 / (high - low))
        if units != LEROBOT:
            self._zero, self._scale = np.zeros_like(low), np.ones_like(low)
        self.units = tuple("deg" if joint else "%" for joint in arm)

    def from_si(self, values: ndarray) -> ndarray:
        """Convert joint values [rad, m], shape ``(…, joints)``; float32, rounded once."""
        return ((values.astype(np.float64) - self._zero) * self._scale).astype(np.float32)

    def to_si(self, values: ndarray) -> ndarray:
        """Convert back to rad and m, shape ``(…, joints)``; float32, rounded once."""
        return (values.astype(np.float64) / self._scale + self._zero).astype(np.float32)

    def check_commands(self, commands: ndarray, positions: ndarray) -> None:
        """Check the first commands of an episode, from where the arm stands in these units; both of
        shape ``(worlds, joints)``. An ArgumentError if they are radians: near to where the arm
        stands in those, and far from it in degrees.
        """
        arm = [k for k, unit in enumerate(self.units) if unit == "deg"]
        degrees = np.abs(commands - positions)[:, arm].max()
        radians = np.abs(commands - self.to_si(positions))[:, arm].max()
        if radians < 0.6 and degrees > 30.0:  # within 34 degrees of there
            expected = f"degrees, near {positions[0, arm].round(1).tolist()}, where the arm stands"
            fix = "Record the data with job.units=lerobot, or set units=si"
            raise ArgumentError("action", f"{commands[0, arm].tolist()}, rad", expected, fix)
