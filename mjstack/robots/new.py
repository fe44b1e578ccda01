"""``mjstack new``: the folder of a task or robot of one's own."""

import math
import os
import re
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import mujoco
import yaml  # type: ignore[import-untyped]

from mjstack.config.session import CONFIG_FOLDER, list_choices
from mjstack.errors import MjstackError, first_line
from mjstack.files import check_regular

_MISSING = "fill_in"
_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)  # hinges follow; others are not the robot's own
_GROUPS = {"task": "task", "robot": "robot", "driver": "controller", "action": "action"}
_GRIPPER = re.compile("grip|finger|jaw|thumb|left|right", re.IGNORECASE)


def write_new(args: Sequence[str]) -> list[Path]:
    """Write the files of ``task``, ``driver`` or ``action NAME``, or of ``robot NAME FILE.xml``,
    into a new folder NAME; a MjstackError if the arguments are others, NAME exists, or MuJoCo
    cannot compile the file.
    """
    kind, name = (*args, "", "")[:2]
    if len(args) != (3 if kind == "robot" else 2) or kind not in _GROUPS:
        expected = "task, driver or action NAME, or robot NAME FILE.xml, such as new task lift"
        raise MjstackError(f"new {' '.join(args)}: expected {expected}.")
    folder = Path(name)
    valid = re.fullmatch(r"[a-z][a-z0-9_]{0,63}", name)
    choices = list_choices()[_GROUPS[kind]]
    if not valid or name in choices or folder.exists() or find_spec(name) is not None:
        raise MjstackError(
            f"new {kind} {name}: expected small letters, digits and _, and no folder, {kind} or"
            " Python module of that name. Choose another name."
        )
    words = {"NAME": name} | (_read_robot(Path(args[2]), folder) if kind == "robot" else {})
    text = (CONFIG_FOLDER / "new" / f"{kind}.txt").read_text(encoding="utf-8")
    _, *parts = re.split(r"(?m)^=== (.+)\n", re.sub("@([A-Z]+)@", lambda m: words[m[1]], text))
    paths = [folder / path for path in parts[::2]]
    for path, content in zip(paths, parts[1::2], strict=True):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content, encoding="utf-8")
    return paths


def _read_robot(file: Path, folder: Path) -> dict[str, str]:
    """Joints, jaws and sites of an MJCF file, as YAML has them; a MjstackError if it cannot be
    read, has too few joints, or a name that YAML cannot have.
    """
    try:
        check_regular(file)
        model = mujoco.MjModel.from_xml_path(str(file))
        joints = [model.joint(k) for k in range(model.njnt) if model.jnt_type[k] >= _SLIDE]
        gripper = [joint for joint in joints if _GRIPPER.search(joint.name)]
        if len(gripper) in (0, len(joints)):
            gripper = joints[-1:]
        joints = [joint for joint in joints if joint not in gripper] + gripper
        if len(joints) < 2:
            raise ValueError(f"it has {len(joints)} hinges and slides, fewer than arm and gripper")
        jaws = [int(joint.bodyid[0]) for joint in gripper]
        if len(jaws) == 1:
            jaws.insert(0, int(model.body_parentid[jaws[0]]))
        names = {jaw: [_MISSING] for jaw in jaws}
        for site in map(model.site, range(model.nsite)):
            names.get(int(site.bodyid[0]), []).append(site.name or _MISSING)
        sites = [
            max(on_jaw[1:] or on_jaw, key=lambda name: "grasp" in name) for on_jaw in names.values()
        ]
        qpos = model.key_qpos[0] if model.nkey else model.qpos0
        home = [min(max(float(qpos[j.qposadr[0]]), j.range[0]), j.range[1]) for j in joints]
        values = {
            "FILE": os.path.relpath(file, folder / "conf" / "robot"),
            "ARM": [joint.name for joint in joints[: -len(gripper)]],
            "GRIPPER": [joint.name for joint in gripper],
            "JAWS": [model.body(body).name or _MISSING for body in jaws],
            "SITES": sites[:2],
            "HOME": [round(float(value), 4) for value in home],
            "OPEN": [round(float(joint.range[1]), 4) for joint in gripper],
            "CLOSED": [round(float(joint.range.mean()), 4) for joint in gripper],
        }
        return {key: _to_yaml(value) for key, value in values.items()}
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or first_line(error)
        raise MjstackError(f"{file}: expected an MJCF file: {reason}.") from error


def _to_yaml(value: object) -> str:
    """A name, a number or a list of them in one line of YAML that reads as the same; a `ValueError`
    for a name that the configuration takes for another value.
    """
    if isinstance(value, list):
        return f"[{', '.join(map(_to_yaml, value))}]"
    if not isinstance(value, str):
        return str(value)
    if value in ("", "???") or "${" in value:
        raise ValueError(f"the name {value!r} in it means something else in YAML, or nothing")
    value.encode()
    return yaml.safe_dump(value, default_style='"', allow_unicode=True, width=math.inf).rstrip()
