"""A job in several processes, called ranks, as torchrun starts them: one per device. Objects go
over Gloo, tensors on CUDA over NCCL.
"""

import logging
import os
import signal
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
from mjstack.process import available_cores, own_command

T = TypeVar("T")
_JOIN = timedelta(minutes=5)  # until all ranks must have joined
_WORK = timedelta(days=30)  # a rank may wait for another one's whole gate
_GRACE = 10.0  # s, in which a rank that has gone leaves its reason
_KILLED = " was killed"


@dataclass(frozen=True)
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

    def average_gradients(self, parameters: Iterable[Tensor]) -> None:
        """Replace gradients by their means over the processes, in place."""
        if self.size == 1:
            return
        gradients = [p.grad for p in parameters if p.grad is not None]
        flat = torch.cat([gradient.flatten() for gradient in gradients])
        dist.all_reduce(flat)
        means = (flat / self.size).split([gradient.numel() for gradient in gradients])
        for gradient, mean in zip(gradients, means, strict=True):
            gradient.copy_(mean.view_as(gradient))

    def gather(self, value: T) -> list[T]:
        """An object of every process, by rank; no tensor of it is on CUDA. A RankError says which
        other rank has gone, and why.
        """
        if self.size == 1:
            return [value]
        values: list[Any] = [None] * self.size
        try:
            dist.all_gather_object(values, value)
        except RuntimeError as error:
            until = time.monotonic() + _GRACE
            while not self._losses() and time.monotonic() < until:
                time.sleep(0.1)
            raise self._gone(error) from error
        return values

    def on_all_ranks(self, work: Callable[[], T]) -> T:
        """The result of work that every rank does for itself, as `in_all`."""
        results: list[T] = []
        self.in_all(lambda: results.append(work()))
        return results[0]

    def from_first(self, work: Callable[[], T]) -> T:
        """The result of work that rank 0 alone does, in every rank; a RankError in the others if it
        fails there.
        """
        first: Callable[[], Any] = work if self.writes else lambda: None
        return self.in_all(first)[0]

    def in_all(self, work: Callable[[], T]) -> list[T]:
        """The results of work that every rank does, by rank. If it fails in one, it fails in all,
        in the others by a RankError. One error in all of them is rank 0's.
        """
        if self.size == 1:
            return [work()]
        result: Any = None
        failure = text = None
        try:
            result = work()
        except (Exception, SystemExit) as error:
            failure = error
            text = describe_error(error)
        problems, results = zip(*self.gather((text, result)), strict=True)
        failed = [rank for rank, problem in enumerate(problems) if problem is not None]
        if not failed:
            return list(results)
        if failure is not None and self.writes:
            raise failure
        who = "" if 0 in failed else f"rank {failed[0]} of {self.size}: "
        raise RankError(f"{who}{problems[failed[0]]}", printed=not self.writes) from failure

    def cause(self, error: BaseException) -> BaseException:
        """The error behind one that has ended this rank's work: torchrun stops the others where one
        has gone, as a user does.
        """
        if not (interrupted() or isinstance(error, KeyboardInterrupt)) or not self._losses():
            return error
        withdraw_interrupt()
        return self._gone(error)

    def _losses(self) -> dict[int, str]:
        """Why other ranks have gone before their work was done, by rank, as far as it is known."""
        losses = {}
        for rank in range(self.size):
            place_key = f"place/{rank}"
            ended = f"ended/{rank}"
            with suppress(Exception):  # there is no store, or the rank that has it may be gone
                if rank == self.rank or not _store.check([place_key]):
                    continue
                host, pid = _store.get(place_key).decode().split()
                # A rank that concludes says so before its process ends.
                dead = host == socket.gethostname() and not _alive(int(pid))
                who = f"rank {rank} of {self.size} ({host}"
                if not _store.check([ended]):
                    if dead:
                        losses[rank] = f"{who}, process {pid}){_KILLED}"
                elif problem := _store.get(ended).decode():
                    losses[rank] = f"{who}) failed: {problem}"
        return losses

    def _gone(self, error: BaseException) -> RankError:
        """The error of a rank that has gone, which another error has shown: the lowest one that was
        not killed prints it.
        """
        losses = self._losses()
        lower = [losses.get(rank, "") for rank in range(self.rank)]
        printed = bool(losses) and not all(loss.endswith(_KILLED) for loss in lower)
        unknown = f"another rank has gone ({first_line(error)})"
        return RankError(next(iter(losses.values()), unknown), printed=printed, gone=True)


_current = Ranks()
_store: Any = None


def current_ranks() -> Ranks:
    """The processes of this job, as far as they have joined; one otherwise."""
    return _current


def _alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return not Path("/proc/self/stat").exists()  # a system without it
    return state not in "ZX"


def see_one_gpu() -> None:
    """Leave this rank its own GPU alone, which is ``cuda:0`` then: libraries take that one for
    granted. To be called before anything asks for CUDA, be it whether there is some.
    """
    count = torch.cuda.device_count()  # asks the driver's management library, which begins nothing
    if count > 1:
        names = os.environ.get("CUDA_VISIBLE_DEVICES") or ",".join(map(str, range(count)))
        number = int(os.environ.get("LOCAL_RANK", 0)) % count
        os.environ["CUDA_VISIBLE_DEVICES"] = names.split(",")[number].strip()


@contextmanager
def joined() -> Iterator[Ranks]:
    """Join the processes of the job that torchrun has started; a MjstackError if not all of them
    come, or the port is in use.
    """
    global _current, _store
    see_one_gpu()
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if count:
        torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", 0)) % count)
    nccl = count > 0 and dist.is_nccl_available()
    try:
        store, rank, size = next(iter(dist.rendezvous("env://", timeout=_JOIN)))
        _store = dist.PrefixStore("mjstack", store)
        _store.set(f"place/{rank}", f"{socket.gethostname()} {os.getpid()}")
        dist.init_process_group(
            "cpu:gloo,cuda:nccl" if nccl else "gloo",
            store=dist.PrefixStore("group", store),
            rank=rank,
            world_size=size,
            timeout=_WORK,
        )
    except (RuntimeError, ValueError) as error:  # torch's errors of the network are such
        address = ":".join(os.environ.get(name, "?") for name in ("MASTER_ADDR", "MASTER_PORT"))
        raise MjstackError(
            f"the {os.environ.get('WORLD_SIZE')} ranks did not meet at {address}"
            f" ({first_line(error)})",
            "Start all of them, each with the same address and a port that is free",
        ) from error
    _current = Ranks(rank, size)
    problem = ""  # of this rank, for the others
    try:
        yield _current
    except RankError:
        raise
    except Exception as error:
        problem = describe_error(error)
        raise
    finally:
        _current = Ranks()
        with suppress(Exception):  # the rank that has the store may be gone
            _store.set(f"ended/{rank}", problem)
        with suppress(RuntimeError):
            dist.destroy_process_group()


def launch(args: Sequence[str], count: int) -> int:
    """Run this command with its arguments in some ranks on this machine, by torch's elastic launch,
    and return its exit status.
    """
    from torch.distributed.elastic.multiprocessing import SignalException
    from torch.distributed.elastic.multiprocessing.errors import ChildFailedError
    from torch.distributed.launcher.api import LaunchConfig, elastic_launch

    logging.disable(logging.CRITICAL)  # ranks say themselves what is wrong
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, available_cores() // count)))
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
        codes = {failure.exitcode for failure in error.failures.values()}
        # torch ends the others by SIGTERM, which is status 130 where they have not begun.
        killed = False
        for rank, failure in sorted(error.failures.items()):
            if failure.exitcode < 0 and failure.exitcode != -signal.SIGTERM:
                killed = True
                if rank == 0 or 1 not in codes:  # else another rank has said so
                    name = failure.signal_name()
                    text = f"rank {rank} of {count} was killed ({name}, process {failure.pid})"
                    print(f"mjstack: {text}", file=sys.stderr)
        return 1 if killed else next((code for code in (2, EXIT_CODE) if code in codes), 1)
    finally:
        logging.disable(logging.NOTSET)
    return 0
