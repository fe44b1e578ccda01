"""Where a result comes from: versions, hardware, commit, and hashes of configuration and model."""

import hashlib
import os
import platform
import subprocess
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path

from mjstack.report.record import Provenance

PACKAGES = ("mjstack", "mujoco", "mujoco-warp", "warp-lang", "torch", "mink", "hydra-core", "numpy")


def collect_provenance(
    *, config_yaml: str, model_text: str, device: str, driver: str
) -> Provenance:
    """Collect what is needed to judge and to repeat a run.

    Args:
        config_yaml: The whole configuration as text.
        model_text: The compiled model as text, whatever file it came from.
        device: What the batch runs on, in words.
        driver: CUDA driver version, or a word why there is none.
    """
    versions: dict[str, str] = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = "from a checkout" if name == "mjstack" else "not installed"
    return {
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S UTC"),
        "versions": versions,
        "device": device,
        "driver": driver,
        "cpu": _cpu_name(),
        "cpu_count": os.cpu_count(),
        "git_commit": _git_commit(),
        "config_sha256": hashlib.sha256(config_yaml.encode()).hexdigest(),
        "model_sha256": hashlib.sha256(model_text.encode()).hexdigest(),
    }


def _cpu_name() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def _git_commit() -> str:
    """The checkout's commit, marked where files differ from it; an installed wheel has none,
    whatever repository it lies in.
    """
    root = Path(__file__).resolve().parents[2]
    mark = "--dirty= with changes"
    git = ["git", "-C", str(root), "describe", "--always", "--abbrev=40", "--exclude=*", mark]
    if not (root / ".git").exists():
        return "no checkout"
    try:
        done = subprocess.run(git, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return "no checkout"
    return done.stdout.strip()
