"""The SCARA of the examples with parts of its file replaced, as files of other people have them."""

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

from compositions import load_config

from mjstack.config.schema import Config

SCARA = Path(__file__).parents[2] / "examples" / "scara"
MJCF = (SCARA / "scara.xml").read_text()
SERVOS = {m[1]: m[0] for m in re.finditer(r'<position name="(\w+)"[^>]*/>', MJCF)}
"""Its servos' elements, by joint."""


@cache
def scara(*overrides: str) -> Config:
    """Its configuration, for reading only."""
    return load_config(["robot=scara", *overrides], SCARA / "conf")


def write_arm(folder: Path, *pairs: tuple[str, str]) -> Path:
    """Write the file with some parts replaced, which have to be there."""
    text = MJCF
    for old, new in pairs:
        assert old in text, old
        text = text.replace(old, new)
    file = folder / "arm.xml"
    file.write_text(text)
    return file


def changed(
    folder: Path, *pairs: tuple[str, str], cfg: Config | None = None, **fields: object
) -> Config:
    """The configuration with parts of the file replaced, and other fields of the profile."""
    cfg = cfg or scara()
    file = write_arm(folder, *pairs)
    return replace(cfg, robot=replace(cfg.robot, file=str(file), **fields))  # type: ignore[arg-type]
