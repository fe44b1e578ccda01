"""Files that appear complete or not at all, folders of one run each, and rows as CSV.

A file may be a stranger's. These are the bounds on what reading one takes, whatever its size is.
"""

import csv
import fcntl
import io
import itertools
import json
import os
import shutil
import stat
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

import numpy as np
import yaml  # type: ignore[import-untyped]

from mjstack.errors import FolderError, MjstackError, first_line
from mjstack.version import __version__

_PACKAGE = Path(__file__).parent
# In a checkout the configuration lies beside the package, in a wheel inside of it.
CONFIG_FOLDER = next(
    folder
    for folder in (_PACKAGE.parent / "conf", _PACKAGE / "conf")
    if (folder / "config.yaml").is_file()
)
MESHES = (".obj", ".stl", ".msh")  # suffixes

# Bytes of a file, and of what an npz file unpacks to
_MOST = {".json": 2**22, ".yaml": 2**20, ".npz": 2**29, ".safetensors": 2**30}
_MOST_BYTES = 2**32  # of any other
_MOST_ARRAYS = 1000  # of an npz file
_MOST_ROWS = 2**20  # of an array: of most files one for each world
_MOST_VALUES = 5_000  # of a configuration, which has some 1,700
_MOST_LETTERS = 3_000  # of a value, which Python can still write where it is a number
_TOO_MANY = f"it has more than {_MOST_VALUES} values, or {_MOST_LETTERS} letters in one"
_KEY = "hydra.run.dir (job=collect, job=train: job.folder)"


@contextmanager
def reading(path: Path, fix: str) -> Iterator[None]:
    """Turn any error while a file, or a folder's files, of an untrusted folder are read inside into
    a `FolderError` of one line. ``fix`` is a sentence without its full stop.
    """
    try:
        for file in path.rglob("*") if path.is_dir() else [path]:
            if not file.is_dir():
                check_regular(file)
        yield
    except MjstackError:
        raise
    except Exception as error:
        reason = getattr(error, "strerror", None) or f"{type(error).__name__}: {first_line(error)}"
        problem = f"{path}: cannot be read ({reason}), expected it as written"
        raise FolderError(problem, fix) from error


def check_regular(path: Path, most: int = _MOST_BYTES) -> None:
    """Check, before anything reads it, that a file ends, and after how many bytes at most: a
    stranger's may be a pipe or a device. An OSError if there is none, a ValueError if it is no
    regular file, or has more bytes; far fewer are enough for text.
    """
    status = path.stat()
    if not stat.S_ISREG(status.st_mode):
        raise ValueError("it is no regular file")
    most = min(most, _MOST.get(path.suffix, _MOST_BYTES))
    if status.st_size > most:
        raise ValueError(f"it has {status.st_size} bytes, more than {most}")
    if path.suffix == ".safetensors":  # the first bytes say how long the names of its tensors are
        with path.open("rb") as file:
            if int.from_bytes(file.read(8), "little") > _MOST[".json"]:
                raise ValueError(f"its header has more than {_MOST['.json']} bytes")


def read_inside(path: Path, most: int = _MOST_BYTES) -> bytes:
    """The content of a file inside its folder, checked as by `check_regular`."""
    if path.resolve().parent != path.parent.resolve():
        raise ValueError("it is a link that leads out of the folder")
    check_regular(path, most)
    return path.read_bytes()


def read_json(path: Path, *keys: str) -> Any:
    """The value below some keys of a JSON file of a folder; any exception if it cannot be read, a
    `ValueError` if it has too many values.
    """
    value = reduce(getitem, keys, json.loads(read_inside(path)))
    if sum(map(repr(value).count, ",:[{")) > _MOST_VALUES:
        raise ValueError(_TOO_MANY)
    return value


def yaml_text(path: Path) -> str:
    """The text of a YAML file; nothing is built of it. Any exception if it cannot be read, has too
    many values or a very long one, or has aliases: a few stand for any number of values.
    """
    check_regular(path)
    text = path.read_text()
    # libyaml, where PyYAML has it: the other parser takes minutes for brackets nested very deep.
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    for number, event in enumerate(yaml.parse(text, Loader=loader)):
        if isinstance(event, yaml.AliasEvent):
            raise yaml.YAMLError("an alias")
        if number > _MOST_VALUES or len(getattr(event, "value", "")) > _MOST_LETTERS:
            raise ValueError(_TOO_MANY)
    return text


def read_npz(path: Path) -> dict[str, np.ndarray]:
    """The arrays of an npz file by name; no object in it is built. Any exception if it cannot be
    read, a `ValueError` if it would be too large once unpacked.
    """
    check_regular(path)
    content = path.read_bytes()
    if content.count(b"PK\x01\x02") > _MOST_ARRAYS:  # once for each in its list
        raise ValueError(f"it has more than {_MOST_ARRAYS} arrays")
    with np.load(io.BytesIO(content)) as file:
        size = sum(member.file_size for member in file.zip.infolist())
        if size > _MOST[".npz"]:
            raise ValueError(f"its arrays have {size} bytes, more than {_MOST['.npz']}")
        arrays = {name: file[name] for name in dict.fromkeys(file.files)}  # one may come twice
    if any(len(np.atleast_1d(array)) > _MOST_ROWS for array in arrays.values()):
        raise ValueError(f"it has more than {_MOST_ROWS} rows")
    return arrays


def write_atomic(path: Path, content: str | bytes) -> None:
    """Write a file beside its place and move it there.

    A full disk or a kill leaves the old file. Files that are written one after the other outlast a
    power cut in this order. An OSError if it cannot be written.
    """
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(name, 0o644)
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def write_npz(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write arrays as a compressed npz file in one step; an OSError if it cannot be written."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    write_atomic(path, buffer.getvalue())


@contextmanager
def claim_folder(
    folder: Path,
    job: str = "",
    *,
    marker: str = "",
    numbered: bool = False,
    key: str = _KEY,
) -> Iterator[Path]:
    """Make a run's folder, and keep other runs out of it until the block ends. If that fails before
    the run has written anything, the folder is as it was, or gone again.

    Args:
        folder: The folder.
        job: As of `check_unused`.
        marker: As of `check_unused`.
        numbered: Where the folder is there, make another: its name and ``-2``, ``-3``, ...
        key: As of `check_unused`.

    Yields:
        The folder.

    Raises:
        FolderError: It cannot be made, has another run, or another process is writing it.
    """
    name = folder.name
    handle = None
    made: list[Path] = []
    try:
        for number in itertools.count(2):
            missing = [path for path in (folder, *folder.parents) if not path.exists()]
            try:
                folder.mkdir(parents=True, exist_ok=not numbered)
                made = missing
                break
            except FileExistsError:
                if not numbered:
                    raise
            folder = folder.with_name(f"{name}-{number}")
        handle = lock_folder(folder)
        existing = {*folder.iterdir()}
        check_unused(folder, job, marker=marker, key=key)
        yield folder
    except BaseException as error:
        if handle is not None:  # else it is another process's
            with suppress(OSError):  # something stays
                new = {*folder.iterdir()} - existing
                if all(path.name == ".hydra" or path.suffix == ".log" for path in new):  # Hydra's
                    for path in new:
                        (shutil.rmtree if path.name == ".hydra" else os.remove)(path)
                for path in made:
                    path.rmdir()
        if not isinstance(error, OSError):
            raise
        problem = f"{folder} cannot be written ({error.strerror or error})"
        raise FolderError(problem, f"Make room, or set {key} to another") from error
    finally:
        if handle is not None:
            os.close(handle)


def _run_files(folder: Path) -> list[Path]:
    """Everything in a folder beside what a run or a sweep that never began leaves: logs, Hydra's
    files and JSON that is half-written.
    """
    return sorted(
        path
        for path in folder.glob("*")
        if path.name != ".hydra" and path.suffix != ".log" and not path.match(".*.json.*")
    )


def move_aside(folder: Path) -> Path:
    """Move what a run has left in its folder to a new folder beside it, beside logs and Hydra's
    files, which may be open; an OSError if it cannot be made or a file cannot be moved.
    """
    for number in itertools.count(1):
        moved_folder = folder.with_name(f"{folder.name}-earlier-{number}")
        with suppress(FileExistsError):
            moved_folder.mkdir()
            break
    for path in _run_files(folder):
        path.rename(moved_folder / path.name)
    return moved_folder


def check_unused(folder: Path, job: str = "", *, marker: str = "", key: str = _KEY) -> None:
    """Check that no run has begun in a folder, or one that a job goes on with. It alone decides
    whose a folder is.

    Args:
        folder: The folder, which need not be there.
        job: As report.json names a job that goes on with the run; empty if none may.
        marker: A file by which a sweep, which has no report, knows its folder.
        key: Configuration key that names another folder.

    Raises:
        FolderError: It has another run, or other files, or links in place of files to be written.
    """
    # A folder for data may be on another disk.
    paths = [path for path in folder.glob("*") if path.name == ".hydra" or not path.is_dir()]
    refuse_links([*paths, *folder.glob(".hydra/*")], f"Remove it, or set {key} to another folder")
    used = _run_files(folder)
    if not used or (marker and (folder / marker).is_file()):
        return
    with suppress(Exception):  # it may hold anything
        if job and read_json(folder / "report.json", "resumes") == job:
            return
    raise FolderError(
        f"{folder} has {used[0].name}{made_by(folder)}, expected a new or an empty folder, or one"
        f" with which this job can go on. Set {key} to another"
    )


def refuse_links(paths: Iterable[Path], fix: str) -> None:
    """Raise a `FolderError` for the first of some paths that is a link; ``fix`` says what to do."""
    for path in paths:
        if path.is_symlink():
            raise FolderError(f"{path} is a link, and what it leads to would be overwritten", fix)


def made_by(folder: Path) -> str:
    """The version of mjstack that made a run's or a sweep's folder, to follow its name; empty if it
    is this one, or no report has it.
    """
    for report in (folder / "report.json", *sorted(folder.glob("*/report.json"))):
        with suppress(Exception):  # it may hold anything
            version = read_json(report, "provenance", "versions", "mjstack")
            return "" if version == __version__ else f" of mjstack {str(version)[:40]}"
    return ""


def lock_folder(folder: Path) -> int:
    """A descriptor that keeps other writers out until it is closed, also by the end of the process.
    A FolderError if another writer has it, an OSError if it cannot be opened. A file system without
    locks keeps nobody out.
    """
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(handle)
        problem = f"{folder} is open in another writer, expected one at a time"
        raise FolderError(problem, "Wait, or give another folder") from error
    except OSError:
        pass
    return handle


def to_csv(rows: Sequence[Mapping[str, object]], columns: Sequence[str] = ()) -> str:
    """Rows, values by column, as CSV text; a value that is missing or None is an empty cell. The
    first columns may be given; other keys of the rows follow, in order of appearance.
    """
    columns = list(dict.fromkeys([*columns, *(name for row in rows for name in row)]))
    text_buffer = io.StringIO()
    writer = csv.DictWriter(text_buffer, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text_buffer.getvalue()
