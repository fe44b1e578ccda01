"""Complete a robot's profile: the values that follow from others, and the path of its MJCF file."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from mjstack.config.schema import RobotCfg
from mjstack.errors import ConfigError


def complete_robot(robot: RobotCfg, folders: Iterable[Path] = ()) -> None:
    """Fill in what a robot's YAML left out.

    Args:
        robot: The profile; it is changed in place.
        folders: Folders of the configuration search path, the first that has the file wins.

    Raises:
        ConfigError: ``robot.file`` is in none of the folders.
    """
    robot.title = robot.title or robot.name
    robot.start = robot.start or list(robot.home)
    robot.ik_joints = robot.ik_joints or [n for n in robot.arm_joints if n not in robot.locked]
    if robot.file is not None:
        robot.file = str(_find_file(robot.file, folders))


def _find_file(file: str, folders: Iterable[Path]) -> Path:
    """Find a file relative to the ``robot`` group of a search path, or to the working folder."""
    tried = [*(folder / "robot" / file for folder in folders), Path(file)]
    paths = list(dict.fromkeys(path.resolve() for path in tried))
    for path in paths:
        if path.is_file():
            return path
    expected = f"an MJCF file; there is no {' and no '.join(map(str, paths))}"
    raise ConfigError("robot.file", file, expected)
