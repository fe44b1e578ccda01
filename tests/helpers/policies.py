"""Policies for tests: small networks with random weights, which drive worlds without success; and
what trainings leave, interrupted ones and ones in two processes.
"""

import os
import socket
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from compositions import load_config
from environments import Patch, configure, report_of

import mjstack.interrupt as interrupt
from mjstack.cli import run
from mjstack.config.fingerprint import config_content
from mjstack.config.schema import Backend, Config
from mjstack.envs import build_env
from mjstack.episodes.run import Run
from mjstack.episodes.stage import Stage
from mjstack.interrupt import handle_interrupts
from mjstack.policy import Policy, PolicyNetwork, Vision, load_policy, save_policy
from mjstack.train.learner import Learner


def make_policy(
    cfg: Config,
    *,
    group: str = "policy",
    chunk: int = 6,
    execute: int = 4,
    seed: int = 0,
    vision: Vision | None = None,
) -> Policy:
    """A policy around the robot's start that moves every joint by up to some 0.05 rad. If the
    configuration has a policy decide below the control rate, its action terms are those of the
    configuration.
    """
    env = build_env(cfg, nworld=1, backend=Backend.native, device="cpu")
    widths = env.observation_manager.term_dims[group]
    targets = cfg.timing.policy_decimation == 1
    width = len(cfg.robot.joints) if targets else env.action_manager.action_dim
    env.close()
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network = PolicyNetwork(sum(widths.values()), width, chunk, [16, 16], vision)
    if targets:
        start = torch.tensor(cfg.robot.start, dtype=torch.float32)
        network.set_scale("action", start, torch.full_like(start, 0.05))
    action = cfg.controller.action if targets else cfg.action
    facts = (widths, execute, config_content(cfg), action, {"seed": seed})
    return Policy(network, group, cfg.observation[group], *facts)


def hold_above_red(folder: Path) -> Path:
    """The folder of a policy of task reach that holds the arm above the nominal red cube."""
    nominal = Run(Stage(load_config(["task=reach", "sim=native", "reset=nominal"]))).nominal
    policy = make_policy(configure("task=reach"), chunk=1, execute=1)
    reached = torch.from_numpy(nominal.world.qpos[-1]).float()[: policy.network.width]
    policy.network.set_scale("action", reached, torch.full_like(reached, 1e-6))
    save_policy(folder, policy)
    return folder


def write_policy(folder: Path, cfg: Config, **options: int | str) -> Path:
    """The folder of such a policy."""
    save_policy(folder, make_policy(cfg, **options))  # type: ignore[arg-type]
    return folder


def report(folder: Path) -> dict:
    """The gates of a run's report by name."""
    return {gate["name"]: gate for gate in report_of(folder)["gates"]}


def curve(folder: Path) -> np.ndarray:
    """The rows of a training's curve, by column."""
    return np.genfromtxt(folder / "train.csv", delimiter=",", names=True)


def assert_drives(policy: Path, out: Path, *overrides: str, nworld: int = 2) -> None:
    """A policy drives gate *batch*, in which every world may fail."""
    drive = ["controller=policy", f"policy={policy}", "gates=[batch]", "sim=native"]
    drive.append("web.episode=false")
    limits = [f"nworld={nworld}", "gate.batch.rate=0.0"]
    assert run([*drive, *limits, *overrides, f"hydra.run.dir={out}"]) == 0


def weights(folder: Path) -> dict[str, torch.Tensor]:
    """The weights of a policy's folder."""
    return load_policy(folder).network.state_dict()


def same(a: Path, b: Path) -> bool:
    """Whether two policies have the same weights, bit for bit."""
    first = weights(a)
    return all(torch.equal(value, first[name]) for name, value in weights(b).items())


def interrupt_in_step(patch: Patch, learner: type[Learner], number: int) -> None:
    """Let Ctrl-C come in a step of a training, which looks for it after each."""
    step = learner._step

    def stop(self: Learner) -> None:
        step(self)
        self._look_every = 1
        if self.done + 1 == number:
            patch.setattr(interrupt, "_asked", True)

    patch.setattr(learner, "_step", stop)


def interrupted(command: Sequence[str], learner: type[Learner], number: int) -> None:
    """Run a training in which Ctrl-C comes in a step."""
    with pytest.MonkeyPatch.context() as patch, handle_interrupts():
        interrupt_in_step(patch, learner, number)
        assert run(command) == 130


def run_as_torchrun(
    overrides: Sequence[str], folder: Path, program: Sequence[str] = ("-m", "mjstack")
) -> list[str]:
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
            [sys.executable, *program, *overrides],
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
