"""A Slurm of one node on this machine, for tests: munged, slurmctld and slurmd from Debian's
slurm-wlm, with everything in a folder of its own.

``python tests/one_node_slurm.py FOLDER`` runs a sweep of four jobs through it, kills slurmd and a
job's step in the middle, starts slurmd again, and prints what was seen.
"""

from __future__ import annotations

import getpass
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "scontrol", "squeue")
CONFIG = """\
ClusterName=one
SlurmctldHost={host}(127.0.0.1)
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
ReturnToService=2
SlurmdTimeout=5
MpiDefault=none
NodeName={host} NodeAddr=127.0.0.1 CPUs={cores} State=UNKNOWN
PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""


def why_not() -> str:
    """Why Slurm cannot run here; empty if it can."""
    path = f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin"
    missing = [name for name in PROGRAMS if shutil.which(name, path=path) is None]
    if missing:
        return f"no {', '.join(missing)} here (apt-get install slurm-wlm munge)"
    return "" if os.getuid() == 0 else "slurmd needs root"


class OneNode:
    """A running Slurm.

    Attributes:
        env: Environment in which Slurm's commands find it.
        lines: What was seen, with seconds since the start.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.lines: list[str] = []
        self._began = time.monotonic()
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        for name in ("state", "spool"):
            (folder / name).mkdir(parents=True)
        folder.chmod(0o755)
        facts = {
            "host": socket.gethostname().split(".")[0],
            "user": getpass.getuser(),
            "folder": folder,
            "ports": free_ports(2),
            "cores": os.cpu_count(),
        }
        (folder / "slurm.conf").write_text(CONFIG.format(**facts))
        key = folder / "munge.key"
        key.write_bytes(os.urandom(128))
        key.chmod(0o400)
        own = {"SLURM_CONF": str(folder / "slurm.conf")}
        own["PATH"] = f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin"
        self.env = os.environ | own

    def say(self, line: str) -> None:
        """Keep a line of what was seen."""
        self.lines.append(f"{time.monotonic() - self._began:6.1f} s  {line}")
        print(self.lines[-1], flush=True)

    def start(self, name: str, *args: str) -> None:
        """Start a daemon in the foreground."""
        log = (self.folder / f"{name}.out").open("ab")
        self._processes[name] = subprocess.Popen(
            [name, *args], env=self.env, stdout=log, stderr=log, stdin=subprocess.DEVNULL
        )

    def kill(self, name: str) -> None:
        """Kill a daemon."""
        process = self._processes.pop(name)
        process.kill()
        process.wait()

    def start_slurmd(self) -> None:
        """Start slurmd, and wait until its node takes jobs."""
        self.start("slurmd", "-D")
        wait_for(lambda: "idle" in self.ask("sinfo", "-h", "-o", "%t"), "an idle node")

    def ask(self, *command: str) -> str:
        """The output of a command of Slurm's."""
        done = subprocess.run(
            command, env=self.env, capture_output=True, text=True, timeout=60, check=False
        )
        return done.stdout.strip()

    def jobs(self) -> dict[str, str]:
        """States of the jobs by their numbers in the array."""
        rows = self.ask("squeue", "-h", "-a", "-t", "all", "-r", "-o", "%K %T").splitlines()
        return dict(row.split() for row in rows if len(row.split()) == 2)

    def stop(self) -> None:
        """End every daemon."""
        for name in reversed(list(self._processes)):
            process = self._processes.pop(name)
            process.terminate()
            with suppress(subprocess.TimeoutExpired):
                process.wait(10)
            process.kill()
            process.wait()


@contextmanager
def one_node(folder: Path) -> Iterator[OneNode]:
    """A Slurm of one node inside."""
    node = OneNode(folder)
    try:
        node.start(
            "munged",
            "--foreground",
            "--force",
            f"--key-file={folder}/munge.key",
            f"--socket={folder}/munge.socket",
            f"--pid-file={folder}/munged.pid",
            f"--log-file={folder}/munged.log",
            f"--seed-file={folder}/munged.seed",
        )
        wait_for((folder / "munge.socket").exists, "munged")
        node.start("slurmctld", "-D")
        node.start_slurmd()
        node.say(f"{node.ask('sinfo', '-V')}: one node takes jobs")
        yield node
    finally:
        node.stop()


def free_ports(count: int) -> list[int]:
    """Ports that nothing has."""
    held = [socket.create_server(("127.0.0.1", 0)) for _ in range(count)]
    ports = [each.getsockname()[1] for each in held]
    for each in held:
        each.close()
    return ports


def wait_for(condition: Callable[[], object], what: str, seconds: float = 120.0) -> None:
    """Wait until something is so."""
    until = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > until:
            raise TimeoutError(f"no {what} after {seconds:g} s")
        time.sleep(0.2)


def interrupt_a_sweep(folder: Path, overrides: Sequence[str]) -> tuple[OneNode, Path, int]:
    """Run a sweep of four jobs of eight seeds each, and kill slurmd and a job's step in the middle.

    Returns:
        The node, the folder of the sweep, and its exit status.
    """
    sweep = folder / "sweep"
    command = [sys.executable, "-m", "mjstack", "-m", "hydra/launcher=submitit_slurm"]
    command += [f"hydra.launcher.{key}=null" for key in ("gpus_per_node", "cpus_per_task")]
    command += ["seed=0,100,200,300", "gate.batch.seeds=8", f"hydra.sweep.dir={sweep}", *overrides]
    with one_node(folder / "slurm") as node:
        log = (folder / "sweep.log").open("wb")
        process = subprocess.Popen(
            command, env=node.env, cwd=folder, stdout=log, stderr=log, stdin=subprocess.DEVNULL
        )
        try:
            one = sweep / "0"
            wait_for((one / "worlds_seed1.npz").exists, "second seed of job 0", 400.0)
            before = sorted(path.name for path in one.glob("worlds_seed*.npz"))
            node.say(f"job 0 has finished {len(before)} of 8 seeds; jobs are {node.jobs()}")
            node.kill("slurmd")
            for pid in steps_of(node.folder):
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            node.say("killed slurmd and the steps of the jobs")
            wait_for(lambda: "down" in node.ask("sinfo", "-h", "-o", "%t"), "node that is down")
            node.say(f"the node is down; jobs are {node.jobs()}")
            node.start_slurmd()
            node.say("slurmd is back")
            status = process.wait(900)
            node.say(f"the sweep has ended with status {status}; jobs are {node.jobs()}")
        finally:
            process.kill()
            process.wait()
        for number in range(4):
            report = json.loads((sweep / str(number) / "report.json").read_text())
            (gate,) = report["gates"]
            calls = len(report["provenance"].get("earlier_calls", []))
            node.say(
                f"job {number}: {gate['metrics']['episodes']} episodes, calls before the last"
                f" one: {calls}{''.join(f'; {line}' for line in gate['details'][:1])}"
            )
    return node, sweep, status


def steps_of(folder: Path) -> list[int]:
    """Processes of jobs that a Slurm in a folder has started, and those that look after them."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            environment = (path / "environ").read_bytes().split(b"\0")
            name = (path / "comm").read_text().strip()
            ours = f"SLURM_CONF={folder}/slurm.conf".encode() in environment
            of_job = any(each.startswith(b"SLURM_JOB_ID=") for each in environment)
            if ours and (of_job or name == "slurmstepd"):
                found.append(int(path.name))
    return found


if __name__ == "__main__":
    from environments import one_second_episode

    place = Path(sys.argv[1]).resolve()
    place.mkdir(parents=True)
    interrupt_a_sweep(place, ["sim=native", "gates=[batch]", "nworld=4", *one_second_episode()])
