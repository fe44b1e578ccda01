"""Policies for tests: small networks with random weights, which drive worlds without success; and
trainings in two processes.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import torch
from compositions import load_config
from environments import configure

from mjstack.config.fingerprint import config_content
from mjstack.config.schema import Backend, Config
from mjstack.envs import build_env
from mjstack.episodes.context import RunContext
from mjstack.policy import Policy, PolicyNetwork, save_policy


def make_policy(
    cfg: Config, *, group: str = "policy", chunk: int = 6, execute: int = 4, seed: int = 0
) -> Policy:
    """A policy around the robot's start that moves every joint by up to some 0.05 rad. If the
    configuration has a policy decide below the control rate, its actions are those of the
    configuration.
    """
    env = build_env(cfg, nworld=1, backend=Backend.native, device="cpu")
    widths = env.observation_manager.term_dims[group]
    action = cfg.action if cfg.timing.policy_decimation > 1 else None
    width = env.action_manager.action_dim if action else len(cfg.robot.joints)
    env.close()
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network = PolicyNetwork(sum(widths.values()), width, chunk, [16, 16])
    if action is None:
        start = torch.tensor(cfg.robot.start, dtype=torch.float32)
        network.set_scale("action", start, torch.full_like(start, 0.05))
    return Policy(
        network=network,
        group=group,
        observation=cfg.observation[group],
        widths=widths,
        execute=execute,
        hidden=[16, 16],
        config=config_content(cfg),
        action=action,
        training={"seed": seed},
    )


def hold_above_red(folder: Path) -> Path:
    """The folder of a policy of task reach that holds the arm above the nominal red cube."""
    nominal = RunContext(load_config(["task=reach", "sim=native", "reset=nominal"])).nominal
    policy = make_policy(configure("task=reach"), chunk=1, execute=1)
    reached = torch.from_numpy(nominal.world.qpos[-1]).float()[: policy.network.joints]
    policy.network.set_scale("action", reached, torch.full_like(reached, 1e-6))
    save_policy(folder, policy)
    return folder


def write_policy(folder: Path, cfg: Config, **options: int | str) -> Path:
    """The folder of such a policy."""
    save_policy(folder, make_policy(cfg, **options))  # type: ignore[arg-type]
    return folder


def run_as_torchrun(overrides: Sequence[str], folder: Path) -> list[str]:
    """Run a command in two processes, as torchrun starts them, with Gloo on a CPU, in the folders
    ``0`` and ``1``; returns what each has printed.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    started = []
    for rank in ("0", "1"):
        own = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": "2"}
        where = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
        (folder / rank).mkdir()
        process = subprocess.Popen(
            [sys.executable, "-m", "mjstack", *overrides],
            env=os.environ | own | where,
            cwd=folder / rank,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        started.append(process)
    texts = [process.communicate(timeout=300) for process in started]
    assert [process.returncode for process in started] == [0, 0], texts
    return [out for out, _ in texts]
