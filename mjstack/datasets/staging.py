"""Files that take their places together: written beside them first, where a full disk does no harm,
then renamed.
"""

from __future__ import annotations

import contextlib
import os
import signal
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import IO


class Staging:
    """Some files on their way. Whatever goes wrong before `commit` leaves everything as it was."""

    def __init__(self) -> None:
        """Begins with no file."""
        self._files: list[tuple[IO[bytes], Path, Path]] = []

    def open(self, path: Path) -> IO[bytes]:
        """A file to write to, which takes its place in `commit`."""
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=temporary(path))
        file = os.fdopen(handle, "wb")
        self._files.append((file, Path(name), path))
        return file

    def write(self, path: Path, content: bytes) -> None:
        """Adds a file with all its content."""
        self.open(path).write(content)

    def commit(self) -> None:
        """Puts everything onto the disk, then every file to its place, in the order in which they
        were opened.
        """
        for file, name, _ in self._files:
            file.flush()
            os.fsync(file.fileno())
            file.close()
            os.chmod(name, 0o644)
        while self._files:
            _, name, path = self._files[0]
            os.replace(name, path)
            del self._files[0]
            _sync_folder(path.parent)

    def discard(self) -> None:
        """Removes what has not taken its place."""
        for file, name, _ in self._files:
            with contextlib.suppress(
                OSError
            ):  # closing writes what is buffered, for which there may be no room
                file.close()
            name.unlink(missing_ok=True)
        self._files.clear()


def temporary(path: Path) -> str:
    """How the name of a file begins that is on its way to ``path``. Readers do not look at it: it
    is hidden, and no parquet.
    """
    return f".{path.name}."


@contextlib.contextmanager
def interrupts_deferred() -> Iterator[None]:
    """Ctrl-C waits until the block has ended, so that an episode is written as a whole or not at
    all.
    """
    if (
        threading.current_thread() is not threading.main_thread()
    ):  # Python interrupts the main thread alone
        yield
        return
    caught: list[tuple] = []
    before = signal.signal(signal.SIGINT, lambda *args: caught.append(args))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        if caught and callable(before):
            before(*caught[0])


def _sync_folder(folder: Path) -> None:
    """Without this a power cut may keep a later rename and lose an earlier one."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
