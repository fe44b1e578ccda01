"""A job in several processes, called ranks, as torchrun starts them: one per device. Objects go
over Gloo, tensors on CUDA over NCCL.
"""

import logging
import os
import socket
import sys
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

from mjstack.errors import MjstackError, RankError, describe_error, first_line
from mjstack.interrupt import EXIT_CODE, interrupted, withdraw_interrupt
from mjstack.process import is_rank, own_command

T = TypeVar("T")
_JOIN = timedelta(minutes=5)  # until all ranks must have joined
_WORK = timedelta(days=30)  # a rank may wait for another one's whole gate
_GRACE = 10.0  # s, in which a rank that has gone leaves its reason
_KEY = "mjstack"


@dataclass(frozen=True, slots=True)
class Ranks:
    """The processes of a job.

    Attributes:
        rank: Number of this one. Number 0 alone writes files and prints.
        size: How many there are.
    """

    rank: int = 0
    size: int = 1

    @property
    def writes(self) -> bool:
        """Whether this process writes files."""
        return self.rank == 0

    def share(self, count: int) -> range:
        """This rank's part of some worlds: neighbours, as many as the others have or one more."""
        return range(self.rank * count // self.size, (self.rank + 1) * count // self.size)

    def sum_(self, *tensors: Tensor) -> None:
        """Replace tensors by their sums over the processes, in place."""
        if self.size > 1:
            for tensor in tensors:
                dist.all_reduce(tensor)

    def any(self, flag: bool) -> bool:
        """Whether a flag is set in any process."""
        count = torch.tensor([float(flag)])
        self.sum_(count)
        return bool(count > 0.0)

    def stop_together(self) -> None:
        """Stop here if any process was asked to: one that goes on would wait for the others in its
        next sum.

        Raises:
            KeyboardInterrupt: One was.
        """
        if self.any(interrupted()):
            raise KeyboardInterrupt

    def average_gradients(self, parameters: Iterable[Tensor]) -> None:
        """Replace gradients by their means over the processes, in place."""
        if self.size == 1:
            return
        gradients = [p.grad for p in parameters if p.grad is not None]
        flat = torch.cat([gradient.flatten() for gradient in gradients])
        dist.all_reduce(flat)
        parts = (flat / self.size).split([gradient.numel() for gradient in gradients])
        for gradient, part in zip(gradients, parts, strict=True):
            gradient.copy_(part.view_as(gradient))

    def gather(self, value: T) -> list[T]:
        """An object of every process, by rank; no tensor of it is on CUDA.

        Raises:
            RankError: Another rank has gone; says which, and why.
        """
        if self.size == 1:
            return [value]
        found: list[Any] = [None] * self.size
        try:
            dist.all_gather_object(found, value)
        except RuntimeError as error:
            raise self._gone(self._wait_for_lost(), error) from error
        return found

    def alike(self, work: Callable[[], T]) -> T:
        """The result of work that every rank does for itself, as `in_all`."""
        kept: list[T] = []
        self.in_all(lambda: kept.append(work()))
        return kept[0]

    def from_first(self, work: Callable[[], T]) -> T:
        """The result of work that rank 0 alone does, in every rank.

        Raises:
            RankError: It failed there, in the other ranks.
        """
        mine: Callable[[], Any] = work if self.writes else lambda: None
        return self.in_all(mine)[0]

    def in_all(self, work: Callable[[], T]) -> list[T]:
        """The results of work that every rank does, by rank. If it fails in one, it fails in all.

        Raises:
            RankError: It failed in another rank. One error in all of them is rank 0's.
        """
        if self.size == 1:
            return [work()]
        result: Any = None
        own = text = None
        try:
            result = work()
        except (Exception, SystemExit) as error:
            own = error
            text = describe_error(error, "MJSTACK_DEBUG=1 shows the traceback")
        found = self.gather((text, result))
        failed = [rank for rank, (problem, _) in enumerate(found) if problem is not None]
        if not failed:
            return [each for _, each in found]
        if own is not None and self.writes:
            raise own
        who = "" if 0 in failed else f"rank {failed[0]} of {self.size}: "
        raise RankError(f"{who}{found[failed[0]][0]}", told=not self.writes) from own

    def cause(self, error: BaseException) -> BaseException:
        """The error behind one that has ended this rank's work: torchrun stops the others where one
        has gone, as a user does.
        """
        stopped = interrupted() or isinstance(error, KeyboardInterrupt)
        if not stopped or not (lost := self.lost()):
            return error
        withdraw_interrupt()
        return self._gone(lost, error)

    def end(self, problem: str = "") -> None:
        """Leave word for the other ranks of how this one ended."""
        if _store is not None:
            with suppress(Exception):  # the rank that has the store may be gone
                _store.set(f"{_KEY}/ended/{self.rank}", problem)

    def lost(self) -> str:
        """Why another rank has gone before its work was done; empty if none is known to be."""
        if _store is None:
            return ""
        for rank in range(self.size):
            with suppress(Exception):
                if rank == self.rank or not _store.check([f"{_KEY}/place/{rank}"]):
                    continue
                if process := self._killed(rank):
                    return f"rank {rank} of {self.size} ({process}) was killed"
                ended = f"{_KEY}/ended/{rank}"
                if _store.check([ended]) and (problem := _store.get(ended).decode()):
                    host = _store.get(f"{_KEY}/place/{rank}").decode().split()[0]
                    return f"rank {rank} of {self.size} ({host}) failed: {problem}"
        return ""

    def _killed(self, rank: int) -> str:
        """Host and process of a rank of this machine that has ended without a word."""
        host, pid = _store.get(f"{_KEY}/place/{rank}").decode().split()
        # A rank that concludes says so before its process ends.
        dead = host == socket.gethostname() and not _alive(int(pid))
        silent = dead and not _store.check([f"{_KEY}/ended/{rank}"])
        return f"{host}, process {pid}" if silent else ""

    def _gone(self, lost: str, error: BaseException) -> RankError:
        """The error of a rank that has gone: the lowest one that was not killed tells the user.

        Args:
            lost: Why it has gone; empty if that is not known.
            error: The error in which this rank has seen it.
        """
        told = False
        with suppress(Exception):  # the rank that has the store may be gone
            told = bool(lost) and not all(self._killed(rank) for rank in range(self.rank))
        return RankError(
            lost or f"another rank has gone ({first_line(error)})", told=told, gone=True
        )

    def _wait_for_lost(self) -> str:
        """Why ranks cannot talk any more, if that is known in time."""
        until = time.monotonic() + _GRACE
        while not (found := self.lost()) and time.monotonic() < until:
            time.sleep(0.1)
        return found


_current = Ranks()
_store: Any = None


def current_ranks() -> Ranks:
    """The processes of this job, as far as they have joined; one otherwise."""
    return _current


def _alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return not Path("/proc/self/stat").exists()  # a system that does not tell
    return state not in "ZX"


@contextmanager
def joined() -> Iterator[Ranks]:
    """Join the processes of the job inside, if torchrun has started several.

    Raises:
        MjstackError: Not all of them came, or the port is in use.
    """
    global _current, _store
    if not is_rank():
        yield _current
        return
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if count:
        torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", 0)) % count)
    nccl = count > 0 and dist.is_nccl_available()
    try:
        _store, rank, size = next(iter(dist.rendezvous("env://", timeout=_JOIN)))
        _store.set(f"{_KEY}/place/{rank}", f"{socket.gethostname()} {os.getpid()}")
        dist.init_process_group(
            "cpu:gloo,cuda:nccl" if nccl else "gloo",
            store=dist.PrefixStore("group", _store),
            rank=rank,
            world_size=size,
            timeout=_WORK,
        )
    except (RuntimeError, ValueError) as error:  # torch's errors of the network are such
        raise _join_error(error) from error
    _current = Ranks(rank, size)
    try:
        yield _current
    finally:
        _current = Ranks()
        with suppress(RuntimeError):
            dist.destroy_process_group()


def _join_error(error: Exception) -> MjstackError:
    address = ":".join(os.environ.get(name, "?") for name in ("MASTER_ADDR", "MASTER_PORT"))
    if "EADDRINUSE" in str(error) or "address already in use" in str(error).lower():
        return MjstackError(
            f"MASTER_PORT={os.environ.get('MASTER_PORT')}: is in use on this machine, expected a"
            " free port, at which ranks meet",
            "Give another (torchrun --master-port), or none",
        )
    return MjstackError(
        f"the {os.environ.get('WORLD_SIZE')} ranks did not meet at {address} ({first_line(error)})",
        "Start all of them, each with the same address and port",
    )


def launch(args: Sequence[str], count: int) -> int:
    """Run this command in ranks on this machine, by torch's elastic launch, and return its exit
    status.

    Args:
        args: The command's arguments.
        count: How many ranks.
    """
    from torch.distributed.elastic.multiprocessing import SignalException
    from torch.distributed.elastic.multiprocessing.errors import ChildFailedError
    from torch.distributed.launcher.api import LaunchConfig, elastic_launch

    logging.disable(logging.CRITICAL)  # ranks say themselves what is wrong
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, cores // count)))
    config = LaunchConfig(
        min_nodes=1,
        max_nodes=1,
        nproc_per_node=count,
        run_id=uuid.uuid4().hex,
        rdzv_backend="c10d",
        rdzv_endpoint="localhost:0",
        max_restarts=0,
    )
    program, *rest = own_command(args)
    try:
        elastic_launch(config, program)(*rest)
    except SignalException:
        return EXIT_CODE
    except ChildFailedError as error:
        first = error.failures.get(0)
        if first is not None and first.exitcode < 0:  # the others may have ended before they know
            print(f"mjstack: rank 0 of {count} was killed ({first.signal_name()})", file=sys.stderr)
        codes = {failure.exitcode for failure in error.failures.values()}
        return next((code for code in (2, EXIT_CODE) if code in codes), 1)
    finally:
        logging.disable(logging.NOTSET)
    return 0
