"""The guesses of ``mjstack new robot``, as a table and a picture."""

from collections.abc import Iterable
from pathlib import Path

from mjstack.config.schema import Config
from mjstack.report import picture
from mjstack.report.table import Console, Table
from mjstack.report.write import safely_write
from mjstack.robots.posture import posture
from mjstack.robots.profile import Guess
from mjstack.scene.build import build_model


def show_guesses(guesses: Iterable[Guess], cfg: Config, path: Path) -> None:
    """Print a robot's guessed keys with their reasons, and draw it at home before its table."""
    rows = [[key, str(value), reason] for key, value, reason in guesses]
    table = Table(header=["guessed", "value", "because"], rows=rows)
    Console().print(table.to_console())
    model = build_model(cfg, visuals=True)
    qpos = posture(model, tuple(cfg.robot.joints)).qpos(cfg.robot.home)
    print(safely_write(path, picture.save_scene, model, qpos) or f"picture: {path}")
