"""Demonstrations from a dataset on disk: of job=collect, or any LeRobotDataset v3 with the columns
that a policy sees.
"""

import json
import time
from collections.abc import Mapping, Sequence
from operator import index
from pathlib import Path

import numpy as np
import torch

from mjstack.config.schema import CloneJobCfg, Config
from mjstack.datasets import lerobot, reader
from mjstack.datasets.spec import term_columns
from mjstack.episodes.stage import Stage
from mjstack.errors import FolderError
from mjstack.policy.checkpoint import Facts
from mjstack.train.demonstrations import Demonstrations

_ACTION = "action"
_SUCCESS = "next.success"
_EPISODE = "episode_index"
_TASK = "task_index"
_BEYOND = 1e-3  # rad, m: how far a joint target may be out of its actuator's range

Place = tuple[str, int]  # a feature, and which of its numbers


def check_dataset(stage: Stage, widths: Mapping[str, int]) -> range:
    """Check that a policy can learn from the job's dataset. ``widths`` are the numbers of each term
    of its observation.

    Returns:
        The seeds of the dataset's starts, as far as it names them.

    Raises:
        MjstackError: It is no dataset, lacks columns or frames, or is of another robot, task or
            rate.
    """
    cfg = stage.cfg
    folder, info, places = _open(cfg, widths)
    _task_number(cfg, folder)
    lengths, seeds = _rows(folder, info)
    reader.check_frames(folder, info, lengths)
    # The ranges of the first file: degrees, say, are far out of them
    action = _read(reader.data_files(folder, info)[0], {_ACTION: places[_ACTION]}, info)[_ACTION]
    low, high = stage.index.ctrl_range.T
    worst = np.maximum(low - action, action - high).max(0)
    joint = int(worst.argmax())
    if worst[joint] > _BEYOND:
        values = action[:, joint]
        raise FolderError(
            f"{folder}: {_ACTION} of {cfg.robot.joints[joint]} is {values.min():g} to"
            f" {values.max():g}, expected absolute joint targets within {low[joint]:g} to"
            f" {high[joint]:g} rad or m. Give a dataset with these units"
        )
    return range(min(seeds), max(seeds) + 1) if seeds else range(0)


def read_demonstrations(stage: Stage, widths: dict[str, int]) -> Demonstrations:
    """The episodes of the job's dataset that succeeded, on the device of the training; each rank
    reads its share. Without a column ``next.success`` all are taken to have succeeded. ``widths``
    are the numbers of each term of the policy's observation.

    Raises:
        FolderError: A file is missing or damaged.
    """
    began = time.perf_counter()
    folder, info, places = _open(stage.cfg, widths)
    facts = [_EPISODE, _TASK, *({_SUCCESS} & info["features"].keys())]
    places |= {name: [(name, 0)] for name in facts}
    parts = [_read(path, places, info) for path in reader.data_files(folder, info)]
    columns = {name: np.concatenate([part[name] for part in parts]) for name in places}

    # Episodes of the task that succeeded
    ends = np.flatnonzero(np.diff(columns[_EPISODE][:, 0], append=-1)) + 1
    starts = np.concatenate([[0], ends[:-1]])
    usable = columns[_TASK][ends - 1, 0] == _task_number(stage.cfg, folder)
    if _SUCCESS in columns:
        usable &= columns[_SUCCESS][ends - 1, 0] != 0.0
    ranks = stage.ranks
    episodes = list(zip(starts[usable], ends[usable], strict=True))[ranks.rank :: ranks.size]
    keep = np.concatenate([np.arange(*episode) for episode in episodes] or [np.arange(0)])
    device = stage.backend[1]

    def on_device(name: str) -> torch.Tensor:
        return torch.as_tensor(columns[name][keep].astype(np.float32), device=device)

    played = len(ends[ranks.rank :: ranks.size])
    counts = f"{len(episodes)} of {played} episodes of {folder}"
    result = "succeeded" if _SUCCESS in columns else f"(none has {_SUCCESS}) are taken to succeed"
    stage.progress.print_line(f"train: {counts} {result} in the task")
    joined = np.cumsum([stop - start for start, stop in episodes], dtype=np.int64)
    return Demonstrations(
        seen=on_device("observation"),
        labels=on_device(_ACTION),
        ends=torch.as_tensor(joined, device=device),
        widths=widths,
        played=played,
        seconds=time.perf_counter() - began,
        source=str(folder),
    )


def _read_info(folder: Path) -> Facts:
    """The content of info.json of a LeRobotDataset v3."""
    lerobot.require_pyarrow()
    path = folder / lerobot.INFO
    if not path.is_file():
        problem = f"job.dataset={folder}: has no {lerobot.INFO}, expected a LeRobotDataset v3"
        raise FolderError(problem, "Give the folder dataset of job=collect")
    with reader.readable(path):
        info = json.loads(path.read_text(encoding="utf-8"))
        version = str(info["codebase_version"])
        if not version.startswith("v3"):
            problem = f"job.dataset={folder}: is a LeRobotDataset {version}, expected v3.0"
            raise FolderError(problem, "Convert it with LeRobot")
        reader.check_types(info, written_here="mjstack" in info)
        if info["total_episodes"] < 1:
            raise ValueError("it has no episodes")
        for feature in info["features"].values():
            feature["names"] = _names(feature.get("names"))
    return info


def _open(cfg: Config, widths: Mapping[str, int]) -> tuple[Path, Facts, dict[str, list[Place]]]:
    """The folder of the job's dataset, its info.json, and where the numbers of the observation and
    of the action are.

    Raises:
        FolderError: One is missing, or the dataset is of another robot or rate.
    """
    job: CloneJobCfg = cfg.job
    folder = Path(str(job.dataset))
    info = _read_info(folder)
    expected = {"robot_type": cfg.robot.name, "fps": round(cfg.task.control_hz)}
    for key, value in expected.items():
        if (recorded := info.get(key)) != value:
            cure = "Give another dataset, or set robot and task to its own"
            if recorded and recorded == cfg.robot.lerobot_type:  # in degrees
                cure = "Give one in rad and m: collect it without job.units=lerobot"
            raise FolderError(f"job.dataset={folder}: has {key}={recorded}, expected {value}", cure)

    def locate(features: Sequence[str], columns: Sequence[str]) -> list[Place]:
        """The place of each column in these features; of one name, the first."""
        places: dict[str, Place] = {}
        for feature in features:
            content = info["features"].get(feature, {})
            if str(content.get("dtype")).startswith("float"):
                for number, column in enumerate(content["names"]):
                    places.setdefault(str(column), (feature, number))
        for column in columns:
            if column not in places:
                raise FolderError(
                    f"job.dataset={folder}: has no column {column} in {features[0]}, expected all"
                    " that the policy sees. Collect it with job=collect observation=state, or"
                    " choose observation@job.observation"
                )
        return [places[column] for column in columns]

    terms = job.observation[job.group].terms
    numbers = [
        column
        for term, width in widths.items()
        for column in term_columns(term, width, terms[term].history)
    ]
    name = f"observation.{job.group}"
    beside = [key for key in info["features"] if key.startswith("observation.") and key != name]
    places = {
        "observation": locate([name, *beside], numbers),
        _ACTION: locate([_ACTION], [f"{joint}.pos" for joint in cfg.robot.joints]),
    }
    return folder, info, places


def _names(value: object) -> list[object]:
    """Names of a feature's numbers: LeRobot has a list, or a mapping of lists or of numbers."""
    if isinstance(value, dict):
        if all(isinstance(names, list) for names in value.values()):
            return [name for names in value.values() for name in names]
        return sorted(value, key=value.__getitem__)
    return value if isinstance(value, list) else []


def _rows(folder: Path, info: Facts) -> tuple[list[int], list[int]]:
    """Length of every episode, and its seed as far as the dataset has any."""
    lengths: list[int] = []
    seeds: list[int] = []
    for path in reader.data_files(folder, info, lerobot.EPISODES):
        with reader.readable(path):
            columns = reader.read_table(path, ["length", "seed"]).to_pydict()  # if it has seeds
            lengths += map(index, columns["length"])
            seeds += map(index, columns.get("seed", ()))
    return lengths, seeds


def _task_number(cfg: Config, folder: Path) -> int:
    """Number of the task in the dataset of a folder.

    Raises:
        FolderError: The dataset does not have it.
    """
    path = folder / lerobot.TASKS
    with reader.readable(path):
        table = reader.read_table(path)
        names = table.column_names
        text = "task" if "task" in names else next(n for n in names if n != "task_index")
        numbers = map(index, table["task_index"].to_pylist())
        tasks = dict(zip(table[text].to_pylist(), numbers, strict=True))
    if cfg.task.instruction not in tasks:
        there = f"{', '.join(map(repr, tasks)) or 'none'}, expected {cfg.task.instruction!r}"
        problem = f"job.dataset={folder}: has the task {there}"
        raise FolderError(problem, "Give another dataset, or set task")
    return tasks[cfg.task.instruction]


def _read(path: Path, columns: Mapping[str, Sequence[Place]], info: Facts) -> dict[str, np.ndarray]:
    """Numbers of a data file by name, each shape ``(frames, numbers)``; every row of a feature has
    its shape in info.json.
    """
    features = sorted({feature for places in columns.values() for feature, _ in places})
    with reader.readable(path):
        read = reader.read_columns(path, info, features)
        values = {name: column.astype(float) for name, column in read.items()}
        arrays = {
            name: np.stack([values[feature][:, number] for feature, number in places], axis=1)
            for name, places in columns.items()
        }
        if not all(np.isfinite(array).all() for array in arrays.values()):
            raise ValueError("numbers that are not finite")
        return arrays
