"""Demonstrations from a dataset on disk: of job=collect, or any LeRobotDataset v3 with the columns
that a policy sees.
"""

import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from mjstack.config.schema import CloneJobCfg, Config
from mjstack.datasets import lerobot, reader
from mjstack.envs.columns import term_columns
from mjstack.episodes.stage import Stage
from mjstack.errors import FolderError
from mjstack.train.demonstrations import Demonstrations, Source

_ACTION = "action"
_SUCCESS = "next.success"
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
    stored, places = _open(cfg, widths)
    action = _numbers(stored, places[_ACTION])  # degrees, say, are far out of the ranges
    low, high = stage.index.servo_range.T
    worst = np.maximum(low - action, action - high).max(0)
    joint = int(worst.argmax())
    if worst[joint] > _BEYOND:
        values = action[:, joint]
        raise FolderError(
            f"{stored.folder}: {_ACTION} of {cfg.robot.joints[joint]} is {values.min():g} to"
            f" {values.max():g}, expected absolute joint targets within {low[joint]:g} to"
            f" {high[joint]:g} rad or m. Give a dataset with these units"
        )
    seeds = [row["seed"] for row in stored.episodes if "seed" in row]
    return range(min(seeds), max(seeds) + 1) if seeds else range(0)


def read_demonstrations(stage: Stage, widths: dict[str, int]) -> Demonstrations:
    """The episodes of the job's dataset that succeeded, on the device of the training; each rank
    reads its share. Without a column ``next.success`` all are taken to have succeeded. ``widths``
    are the numbers of each term of the policy's observation.

    Raises:
        FolderError: A file is missing or damaged.
    """
    began = time.perf_counter()
    stored, places = _open(stage.cfg, widths)

    # Episodes of the task that succeeded
    ends = np.cumsum([row["length"] for row in stored.episodes])
    starts = np.concatenate([[0], ends[:-1]])
    task = stored.tasks.index(stage.cfg.task.words)
    usable = stored.frames("task_index")[ends - 1, 0] == task
    judged = _SUCCESS in stored.info["features"]
    if judged:
        usable &= stored.frames(_SUCCESS)[ends - 1, 0] != 0.0
    ranks = stage.ranks
    episodes = list(zip(starts[usable], ends[usable], strict=True))[ranks.rank :: ranks.size]
    keep = np.concatenate([np.arange(*episode) for episode in episodes] or [np.arange(0)])
    device = stage.backend[1]

    def on_device(name: str) -> torch.Tensor:
        values = _numbers(stored, places[name])[keep]
        return torch.as_tensor(values.astype(np.float32), device=device)

    played = len(ends[ranks.rank :: ranks.size])
    done = "succeeded in" if judged else f"(none has {_SUCCESS}) are taken to succeed in"
    stage.progress.print_line(
        f"train: {len(episodes)} of {played} episodes of {stored.folder} {done} the task"
    )
    joined = np.cumsum([stop - start for start, stop in episodes], dtype=np.int64)
    return Demonstrations(
        seen=on_device("observation"),
        labels=on_device(_ACTION),
        ends=torch.as_tensor(joined, device=device),
        widths=widths,
        played=played,
        seconds=time.perf_counter() - began,
        source=str(stored.folder),
    )


def _open(
    cfg: Config, widths: Mapping[str, int]
) -> tuple[reader.StoredDataset, dict[str, list[Place]]]:
    """The job's dataset, and where the numbers of the observation and of the action are.

    Raises:
        FolderError: One is missing or damaged, or the dataset is of another robot, task or rate.
    """
    job: CloneJobCfg = cfg.job
    folder = Path(str(job.dataset))
    info = reader.read_info(folder)
    with reader.readable(folder / lerobot.INFO):
        if not info["total_episodes"]:
            raise ValueError("it has no episodes")
        names = {
            name: _names(feature.get("names"))[: math.prod(feature["shape"])]
            for name, feature in info["features"].items()
        }
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
            if str(info["features"].get(feature, {}).get("dtype")).startswith("float"):
                for number, column in enumerate(names[feature]):
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
    used = {feature for numbers in places.values() for feature, _ in numbers}
    stored = reader.read_dataset(folder, used | ({_SUCCESS} & info["features"].keys()))
    if cfg.task.words not in stored.tasks:
        tasks = ", ".join(map(repr, stored.tasks)) or "none"
        problem = f"job.dataset={folder}: has the task {tasks}, expected {cfg.task.words!r}"
        raise FolderError(problem, "Give another dataset, or set task")
    return stored, places


def _names(value: object) -> list[object]:
    """Names of a feature's numbers: LeRobot has a list, or a mapping of lists or of numbers."""
    if isinstance(value, dict):
        if all(isinstance(names, list) for names in value.values()):
            return [name for names in value.values() for name in names]
        return sorted(value, key=value.__getitem__)
    return value if isinstance(value, list) else []


def _numbers(stored: reader.StoredDataset, places: Sequence[Place]) -> np.ndarray:
    """Numbers of the frames, shape ``(frames, numbers)``."""
    columns = {feature: stored.frames(feature) for feature in {feature for feature, _ in places}}
    return np.stack([columns[feature][:, number] for feature, number in places], axis=1)


SOURCE = Source(check_dataset, read_demonstrations)
