"""Plans many worlds at once: this process and others like it take worlds from one queue."""

from __future__ import annotations

import os
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Generator, Sequence
from multiprocessing import Pipe
from multiprocessing.connection import wait

import numpy as np

from mjstack.config.schema import Config
from mjstack.errors import Unreachable, WorkerLost

PARALLEL_FROM = (
    512  # distinct worlds: some 6 s of planning; a worker needs 3 s before its first plan
)
WORLDS_PER_PROCESS = 128  # distinct worlds that pay for one worker more
# worlds, 0.1 s of planning: messages cost little beside it, and the last chunk keeps nobody waiting
# for long
_CHUNK = 8
_AHEAD = 2  # chunks that a worker is given at most, so that it has work while its plans are fetched
_WORKER = "mjstack.drivers.planning_worker"

Plan = tuple[
    int, np.ndarray, float
]  # world, commands at the knots (n, nu), largest distance [m] from a target


def plan_in_parallel(
    cfg: Config,
    plan_world: Callable[[int, np.ndarray], tuple[np.ndarray, float]],
    worlds: Sequence[int],
    sources_xy: np.ndarray,
    processes: int,
) -> Generator[Plan]:
    """Plans worlds here and in worker processes, which are gone when this has ended, in whatever
    way it ends.

    Workers are programs of their own and not forks: this process may hold a CUDA context and
    threads, and its main module need not bear to be imported again. Until they have started, and
    where the system has no room for more of them, the work is done here.

    Args:
        cfg: From which a worker builds the planner.
        plan_world: Plans one world here.
        worlds: Their numbers, ascending.
        sources_xy: Position of each object and place of every world at the start [m], shape
            ``(nworld, sources, 2)``.
        processes: How many plan, this one among them.

    Yields:
        A plan per world, as they come.

    Raises:
        Unreachable: A target is out of reach; of several such worlds it names the first, as one
            process would.
        WorkerLost: A worker has ended by itself.
    """
    queue = deque(worlds)
    failures = list[Unreachable]()
    workers: list[_Worker] = []
    try:
        for number in range(1, processes):
            try:
                workers.append(_Worker(f"{number} of {processes - 1}", cfg))
            except OSError:  # no more processes or files
                break
        while queue or any(worker.pending for worker in workers):
            ready = wait([worker.socket for worker in workers], timeout=0 if queue else None)
            for worker in (worker for worker in workers if worker.socket in ready):
                answer = worker.receive()
                if isinstance(answer, Unreachable):
                    failures.append(answer)
                    # whoever is left there comes after this world; those given out may come before
                    queue.clear()
                else:
                    yield from answer
                worker.give(queue, sources_xy)
            if queue:
                world = queue.popleft()
                try:
                    plan = plan_world(world, sources_xy[world])
                except Unreachable as error:
                    failures.append(error)
                    queue.clear()
                else:
                    yield world, *plan
    finally:
        for worker in workers:
            worker.kill()
        for worker in workers:
            worker.close()
    if failures:
        raise min(failures, key=lambda error: error.world)


class _Worker:
    """A process with a planner of its own, which says when it has started and then answers every
    chunk with its plans.
    """

    def __init__(self, label: str, cfg: Config) -> None:
        """Starts the process.

        Its standard input is a socket for both directions, and its standard output goes nowhere, so
        that nothing an import prints gets between the messages. It is in a process group of its
        own: Ctrl-C comes to this process alone. If this process is killed, the socket closes, and
        the worker ends.

        Args:
            label: What an error calls it.
            cfg: From which it builds its planner.

        Raises:
            OSError: The system has no room for it.
        """
        self.pending = 0  # chunks without an answer
        self._label = label
        self._started = False
        self.socket, theirs = Pipe()
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", _WORKER],
                stdin=theirs.fileno(),
                stdout=subprocess.DEVNULL,
                env=_environment(),
                process_group=0,
            )
        self._send(cfg)

    def receive(self) -> list[Plan] | Unreachable:
        """The next answer; the first is empty, and says that the worker has started."""
        try:
            answer = self.socket.recv()
        except (EOFError, OSError):
            raise WorkerLost(self._label, self._process.wait()) from None
        if self._started:
            self.pending -= 1
        self._started = True
        return answer

    def give(self, queue: deque[int], sources_xy: np.ndarray) -> None:
        """Takes chunks out of the queue until the worker has enough."""
        while queue and self.pending < _AHEAD:
            worlds = [queue.popleft() for _ in range(min(_CHUNK, len(queue)))]
            self._send((worlds, sources_xy[worlds]))
            self.pending += 1

    def kill(self) -> None:
        """Ends the process at once; it has nothing to save."""
        self._process.kill()

    def close(self) -> None:
        """Waits until the process has ended."""
        self._process.wait()
        self.socket.close()

    def _send(self, message: object) -> None:
        try:
            self.socket.send(message)
        except OSError:
            raise WorkerLost(self._label, self._process.wait()) from None


def _environment() -> dict[str, str]:
    """This process's environment, with its import path: mjstack may lie in a checkout that is not
    installed.
    """
    threads = dict.fromkeys(
        ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"
    )  # the cores are taken already
    path = os.pathsep.join(os.path.abspath(entry) for entry in sys.path if isinstance(entry, str))
    # A worker can be killed at any time, also while it writes compiled modules.
    return os.environ | threads | {"PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1"}
