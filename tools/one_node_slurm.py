"""Kill the node of a Slurm sweep, and check that its jobs are played again.

    python tools/one_node_slurm.py FOLDER

Starts munged, slurmctld and slurmd (Debian's slurm-wlm and munge; root) with everything in the
folder, runs a sweep of four jobs of eight seeds each through it, kills slurmd and the steps of the
jobs in the middle, and starts slurmd again. The exit status is 0 if every job has all its episodes,
and a job that was killed has its first seeds beside it. It takes some five minutes.
"""

import argparse
import getpass
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

JOBS = 4
SEEDS = 8  # of each job
NWORLD = 4
PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "scontrol", "squeue")
PATH = f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin"
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


class Node:
    """A running Slurm of one node, its files in a folder."""

    def __init__(self, folder: Path) -> None:
        """Write its configuration and its key."""
        self._folder = folder
        self._began = time.monotonic()
        self._daemons: dict[str, subprocess.Popen[bytes]] = {}
        for name in ("state", "spool"):
            (folder / name).mkdir(parents=True)
        folder.chmod(0o755)
        sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(2)]
        facts = {
            "host": socket.gethostname().split(".")[0],
            "user": getpass.getuser(),
            "folder": folder,
            "ports": [server.getsockname()[1] for server in sockets],
            "cores": os.cpu_count(),
        }
        for server in sockets:
            server.close()
        config = folder / "slurm.conf"
        config.write_text(CONFIG.format(**facts))
        key = folder / "munge.key"
        key.write_bytes(os.urandom(128))
        key.chmod(0o400)
        self.environment = os.environ | {"SLURM_CONF": str(config), "PATH": PATH}

    def log(self, line: str) -> None:
        """Print a line with the seconds since the start."""
        print(f"{time.monotonic() - self._began:6.1f} s  {line}", flush=True)

    def start(self, name: str, *options: str) -> None:
        """Start a daemon in the foreground."""
        with (self._folder / f"{name}.out").open("ab") as log:
            self._daemons[name] = self.open([name, *options], log)

    def open(self, command: list[str], log: object) -> "subprocess.Popen[bytes]":
        """Start a process that finds this Slurm."""
        return subprocess.Popen(
            command,
            env=self.environment,
            cwd=self._folder,
            stdin=subprocess.DEVNULL,
            stdout=log,  # type: ignore[arg-type]
            stderr=subprocess.STDOUT,
        )

    def start_slurmd(self) -> None:
        """Start slurmd, and wait until its node takes jobs."""
        self.start("slurmd", "-D")
        wait_for(lambda: "idle" in self.query("sinfo", "-h", "-o", "%t"), "an idle node")

    def kill_slurmd(self) -> None:
        """Kill slurmd, the jobs, and the processes of Slurm that watch them."""
        daemon = self._daemons.pop("slurmd")
        daemon.kill()
        daemon.wait()
        marker = f"SLURM_CONF={self._folder}/slurm.conf".encode()
        for path in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                variables = (path / "environ").read_bytes().split(b"\0")
                of_job = any(variable.startswith(b"SLURM_JOB_ID=") for variable in variables)
                watcher = (path / "comm").read_text().strip() == "slurmstepd"
                if marker in variables and (of_job or watcher):
                    os.kill(int(path.name), signal.SIGKILL)

    def query(self, *command: str) -> str:
        """The output of a command of Slurm's."""
        done = subprocess.run(
            command, env=self.environment, capture_output=True, text=True, timeout=60
        )
        return done.stdout.strip()

    def jobs(self) -> dict[str, str]:
        """States of the jobs by their numbers in the array."""
        rows = self.query("squeue", "-h", "-a", "-t", "all", "-r", "-o", "%K %T").splitlines()
        return dict(row.split() for row in rows if len(row.split()) == 2)

    def stop(self) -> None:
        """End every daemon."""
        for daemon in reversed(self._daemons.values()):
            daemon.terminate()
            with suppress(subprocess.TimeoutExpired):
                daemon.wait(10)
            daemon.kill()
            daemon.wait()


@contextmanager
def start_node(folder: Path) -> Iterator[Node]:
    """A Slurm of one node that takes jobs."""
    node = Node(folder)
    files = {"key-file": "key", "socket": "socket", "pid-file": "pid", "log-file": "log"}
    files["seed-file"] = "seed"
    try:
        options = [f"--{option}={folder}/munge.{ending}" for option, ending in files.items()]
        node.start("munged", "--foreground", "--force", *options)
        wait_for((folder / "munge.socket").exists, "munged")
        node.start("slurmctld", "-D")
        node.start_slurmd()
        node.log(f"{node.query('sinfo', '-V')}: one node takes jobs")
        yield node
    finally:
        node.stop()


def wait_for(condition: Callable[[], object], expected: str, seconds: float = 120.0) -> None:
    """Wait until a condition holds."""
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(f"no {expected} after {seconds:g} s")
        time.sleep(0.2)


def interrupt_sweep(node: Node, folder: Path) -> int:
    """Run the sweep and kill the node in its middle; return the sweep's exit status."""
    command = [sys.executable, "-m", "mjstack", "-m", "hydra/launcher=submitit_slurm"]
    command += [f"hydra.launcher.{key}=null" for key in ("gpus_per_node", "cpus_per_task")]
    command += ["task=reach", "sim=native", "gates=[batch]", f"nworld={NWORLD}"]
    command += [f"seed={','.join(str(100 * job) for job in range(JOBS))}"]
    command += [f"gate.batch.seeds={SEEDS}", f"hydra.sweep.dir={folder}"]
    with folder.with_suffix(".log").open("wb") as log:
        process = node.open(command, log)
    try:
        wait_for((folder / "0/batch_seed1.npz").exists, "second seed of job 0", 400.0)
        seeds = len(list((folder / "0").glob("batch_seed*.npz")))
        node.log(f"job 0 has finished {seeds} of {SEEDS} seeds; jobs are {node.jobs()}")
        node.kill_slurmd()
        node.log("killed slurmd and the steps of the jobs")
        wait_for(lambda: "down" in node.query("sinfo", "-h", "-o", "%t"), "node that is down")
        node.log(f"the node is down; jobs are {node.jobs()}")
        node.start_slurmd()
        node.log("slurmd is back")
        status = process.wait(900)
        node.log(f"the sweep has ended with status {status}; jobs are {node.jobs()}")
        return status
    finally:
        process.kill()
        process.wait()


def main() -> None:
    """Check that Slurm can run here, run the sweep, and judge its reports."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="a new one, for Slurm's files and the sweep's")
    folder = parser.parse_args().folder.resolve()
    missing = [name for name in PROGRAMS if shutil.which(name, path=PATH) is None]
    if missing:
        parser.error(f"no {', '.join(missing)} here (apt-get install slurm-wlm munge)")
    if os.getuid() != 0:
        parser.error("slurmd needs root")
    folder.mkdir(parents=True)
    with start_node(folder / "slurm") as node:
        status = interrupt_sweep(node, folder / "sweep")
        repeated = 0
        for job in range(JOBS):
            report = json.loads((folder / f"sweep/{job}/report.json").read_text())
            (gate,) = report["gates"]
            episodes = gate["metrics"]["episodes"]
            repeated += (folder / f"sweep/{job}-earlier-1").exists()
            node.log(f"job {job}: {episodes} episodes")
            status |= episodes != SEEDS * NWORLD
        sys.exit(status or not repeated)


if __name__ == "__main__":
    main()
