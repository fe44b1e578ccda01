"""Where a result comes from: versions, processor and commit."""

import os
import platform
import subprocess
from contextlib import suppress
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path

from mjstack.report.record import Provenance
from mjstack.version import __version__

PACKAGES = ("mujoco", "mujoco-warp", "warp-lang", "torch", "mink", "hydra-core", "numpy")


def collect_provenance() -> Provenance:
    """Date, versions, processor and commit."""
    versions = {"python": platform.python_version(), "mjstack": __version__}
    versions |= {name: metadata.version(name) for name in PACKAGES}
    return {
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S UTC"),
        "versions": versions,
        "cpu": _cpu_name(),
        "cpu_count": os.cpu_count(),
        "git_commit": _git_commit(),
    }


def _cpu_name() -> str:
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _git_commit() -> str:
    """The checkout's commit, marked where files differ from it; an installed wheel has none, even
    inside a repository.
    """
    root = Path(__file__).resolve().parents[2]
    mark = "--dirty= with changes"
    git = ["git", "-C", str(root), "describe", "--always", "--abbrev=40", "--exclude=*", mark]
    commit = ""
    if (root / ".git").exists():
        with suppress(OSError, subprocess.SubprocessError):
            commit = subprocess.run(git, capture_output=True, text=True, timeout=10).stdout.strip()
    return commit or "no checkout"
