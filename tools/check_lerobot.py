"""Check mjstack.adapters.lerobot with LeRobot's own commands, and print a log in Markdown.

    python tools/check_lerobot.py --folder build/lerobot/check

It runs in an environment with LeRobot, which tools/check_lerobot.sh makes. What an earlier call has
finished in the folder is not done again.
"""

import argparse
import json
import math
import os
import platform
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from unittest.mock import patch

import numpy as np
from lerobot.common.control_utils import sanity_check_dataset_robot_compatibility
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.dataset_tools import merge_datasets
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.processor import PolicyProcessorPipeline
from lerobot.robots import make_robot_from_config
from lerobot.scripts import (
    lerobot_record,
    lerobot_replay,
    lerobot_rollout,
    lerobot_teleoperate,
)
from lerobot.scripts.lerobot_eval import eval_policy
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig

from mjstack.adapters.lerobot import LerobotVectorEnv, MjstackEnv, MjstackFollower
from mjstack.adapters.lerobot.robot import MjstackFollowerConfig

ROOT = Path(__file__).parents[1]
PLUGIN = "discover_packages_path=mjstack.adapters.lerobot"
CAMERA = "{front: {type: mjstack, width: 128, height: 128, fps: 30}}"
# What the page's commands have instead, so that a CPU is done in minutes, by a word of each.
SMALL = {
    "job=collect": "job.episodes=6 nworld=6",
    "lerobot-train": "--steps=300 --batch_size=2 --save_freq=300 --log_freq=50 --num_workers=0"
    " --policy.dim_model=64 --policy.n_heads=4 --policy.dim_feedforward=128"
    " --policy.chunk_size=30 --policy.n_action_steps=30"
    f" --env_eval_freq=300 --env.{PLUGIN} --env.type=mjstack '--env.cameras=[front,wrist]'"
    " --eval.batch_size=2 --eval.n_episodes=2",
    "lerobot-eval": "--eval.batch_size=4 --eval.n_episodes=4 --output_dir=outputs/eval",
    "gates=[success]": "nworld=4 gate.success.rate=0.0",
}


@TeleoperatorConfig.register_subclass("scripted")
@dataclass
class ScriptedConfig(TeleoperatorConfig):
    """Moves every joint to and fro."""


class Scripted(Teleoperator):
    """Gives the joints' targets of a wave about the SO-101's start, in degrees."""

    config_class = ScriptedConfig
    name = "scripted"
    action_features = feedback_features = None
    is_connected = is_calibrated = True
    start = (0.0, -22.9, 27.1, 67.4, 87.9, 45.6)

    def __init__(self, config: ScriptedConfig) -> None:
        super().__init__(config)
        self._step = 0

    def connect(self, calibrate: bool = True) -> None:
        """There is nothing to connect, to calibrate, to configure or to feed back."""

    calibrate = configure = disconnect = send_feedback = connect

    def get_action(self) -> dict[str, float]:
        """Targets of the next step."""
        self._step += 1
        wave = 8.0 * math.sin(0.1 * self._step)
        return dict(zip(JOINTS, (value + wave for value in self.start), strict=True))


JOINTS = [f"{name}.pos" for name in ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex")]
JOINTS += ["wrist_roll.pos", "gripper.pos"]


def command(line: str, folder: Path) -> float:
    """Run a command line in a folder; its time [s]."""
    print(f"$ {line}", file=sys.stderr, flush=True)
    began = time.perf_counter()
    log = folder / "commands.log"
    with log.open("a") as out:
        done = subprocess.run(shlex.split(line), cwd=folder, stdout=out, stderr=subprocess.STDOUT)
    if done.returncode:
        sys.exit(f"{line}\nended with {done.returncode}:\n{log.read_text()[-2000:]}")
    return time.perf_counter() - began


def report_versions() -> str:
    """Machine and packages."""
    cpu = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists() and (match := re.search(r"model name\s*: (.*)", info.read_text())):
        cpu = match[1]
    names = ("mjstack", "lerobot", "torch", "numpy", "mujoco", "gymnasium", "av")
    packages = ", ".join(f"{name} {version(name)}" for name in names)
    cores = len(os.sched_getaffinity(0))
    return f"{cores} cores of {cpu}; Python {platform.python_version()}, {packages}"


def check_policy(folder: Path) -> str:
    """A policy of ours in lerobot-eval: the success that our gate finds, from other starts."""
    env = f"--env.{PLUGIN} --env.type=mjstack --env.policy=exported"
    overrides = "--env.overrides=[sim=native,reset=jitter]"
    command(
        "mjstack job=train timing=hz30 sim=native reset=jitter nworld=64 job.folder=mine", folder
    )
    command(
        "mjstack job=export policy=mine/last timing=hz30 job.format=lerobot hydra.run.dir=exported",
        folder,
    )
    seconds = command(
        f"lerobot-eval --policy.path=exported {env} {overrides} --eval.batch_size=64"
        " --eval.n_episodes=64 --output_dir=evaluated",
        folder,
    )
    result = json.loads((folder / "evaluated" / "eval_info.json").read_text())["overall"]
    gates = json.loads((folder / "mine" / "report.json").read_text())["gates"]
    gate = next(gate for gate in gates if gate["name"] == "success")["metrics"]
    low, high = gate["success_rate_low95"], gate["success_rate_high95"]
    rate = result["pc_success"] / 100
    judged = f"gate success {gate['succeeded']} of {gate['episodes']}"
    if not low <= rate <= high:
        sys.exit(f"lerobot-eval found {rate}, {judged}")
    env_cfg = MjstackEnv(policy=str(folder / "exported"), overrides=["sim=native", "reset=jitter"])
    worlds = env_cfg.create_envs(64)["mjstack"][0]
    worlds.reset(seed=list(range(1000, 1064)))
    distinct = len(np.unique(worlds.inner.sim.qpos.numpy(), axis=0))
    if distinct < 64:
        sys.exit(f"only {distinct} of 64 starts differ")
    alone = evaluate(folder / "exported", worlds)
    worlds.close()
    return (
        f"policy of `job=train timing=hz30`: lerobot-eval {100 * rate:.1f} % of 64 from {distinct}"
        f" starts, {judged}, interval {100 * low:.1f} to {100 * high:.1f} %;"
        f" {64 * 60 / alone:.0f} episodes a minute, {64 * 60 / result['eval_s']:.0f} with films of"
        f" ten ({alone:.0f} and {result['eval_s']:.0f} s, the command {seconds:.0f} s)"
    )


def evaluate(folder: Path, worlds: LerobotVectorEnv) -> float:
    """Time of LeRobot's evaluation of a policy without films [s]."""
    config = PreTrainedConfig.from_pretrained(folder)
    policy = get_policy_class(config.type).from_pretrained(folder, config=config)
    processors = make_pre_post_processors(config, str(folder))
    nothing = [PolicyProcessorPipeline(steps=[]) for _ in range(2)]
    result = eval_policy(worlds, policy, *nothing, *processors, n_episodes=64, start_seed=1000)
    return result["aggregated"]["eval_s"]


def check_page(folder: Path) -> str:
    """The commands of docs/lerobot.md from nothing to an evaluated ACT, on a small scale."""
    page = (ROOT / "docs" / "lerobot.md").read_text()
    block = page.split("## Five commands")[1].split("```console\n")[1].split("```")[0]
    lines = [line[2:] for line in block.replace("\\\n", " ").splitlines() if line.startswith("$ ")]
    if len(lines) != 5:
        sys.exit(f"docs/lerobot.md has {len(lines)} commands, expected five")
    times = []
    for line in lines[1:]:  # the first one installs
        extra = next(text for key, text in SMALL.items() if key in line)
        times.append(f"{command(f'{line} {extra}', folder):.0f}")
    overall = json.loads((folder / "outputs" / "eval" / "eval_info.json").read_text())["overall"]
    return (
        f"the page's commands (300 steps of a small ACT, 6 demonstrations): {', '.join(times)} s;"
        f" lerobot-eval {overall['pc_success']:.0f} % of {overall['n_episodes']}"
    )


@contextmanager
def arguments(line: str):
    """A command line of a function that parses sys.argv."""
    print(f"$ {line}", file=sys.stderr, flush=True)
    with patch.object(sys, "argv", shlex.split(line)):
        yield


@contextmanager
def watched():
    """Joints of `mjstack_follower` before each action, and the actions."""
    seen: list[list[float]] = []
    sent: list[list[float]] = []
    send = MjstackFollower.send_action

    def watch(self: MjstackFollower, action: dict) -> dict:
        observation = self.get_observation()
        seen.append([observation[name] for name in JOINTS])
        sent.append([float(action[name]) for name in JOINTS])
        return send(self, action)

    with patch.object(MjstackFollower, "send_action", watch):
        yield seen, sent


def check_drive(folder: Path) -> str:
    """`mjstack_follower` driven by a teleoperator and by the ACT of `check_page`."""
    robot = f"--robot.{PLUGIN} --robot.type=mjstack_follower --robot.id=sim --robot.seed=3"
    act = folder.parent / "page/outputs/act/checkpoints/last/pretrained_model"
    cameras = "{front: {type: mjstack, width: 128, height: 128, fps: 30}, wrist: {type: mjstack,"
    cameras += " width: 128, height: 128, fps: 30}}"
    parts = []
    with (
        arguments(f"lerobot-teleoperate {robot} --teleop.type=scripted --fps=30 --teleop_time_s=5"),
        patch.object(lerobot_teleoperate, "make_teleoperator_from_config", Scripted),
        watched() as steps,
    ):
        lerobot_teleoperate.teleoperate()
    parts.append(("lerobot-teleoperate with a scripted teleoperator", steps))
    with (
        arguments(
            f"lerobot-rollout {robot} --robot.cameras='{cameras}' --strategy.type=base"
            f" --policy.path={act} --policy.device=cpu --fps=30 --duration=5"
            " --task='Put the red cube onto the blue cube.'"
        ),
        watched() as steps,
    ):
        lerobot_rollout.rollout()
    parts.append(("lerobot-rollout with the page's ACT", steps))
    texts = []
    for name, (seen, sent) in parts:
        moved = float(np.ptp(seen, axis=0).max())
        apart = float(np.abs(np.subtract(seen[1:], sent[:-1])).max())
        if len(seen) < 30 or moved < 0.5 or not np.isfinite(sent).all():
            sys.exit(f"{name}: {len(seen)} steps, joints moved by {moved} degrees")
        texts.append(
            f"{name}: {len(seen)} actions, joints moved by up to {moved:.1f} degrees, and were at"
            f" most {apart:.1f} from their targets one step later"
        )
    return "; ".join(texts)


def check_robot(folder: Path) -> str:
    """A recording of `mjstack_follower`, replayed and merged."""
    robot = f"--robot.{PLUGIN} --robot.type=mjstack_follower --robot.id=sim --robot.seed=3"
    root = folder / "recorded"
    task = "'--dataset.single_task=Put the red cube onto the blue cube.'"
    with (
        arguments(
            f"lerobot-record {robot} --robot.cameras='{CAMERA}' --teleop.type=scripted"
            f" --dataset.repo_id=local/recorded --dataset.root={root} --dataset.num_episodes=1"
            f" --dataset.episode_time_s=5 --dataset.push_to_hub=false {task} --play_sounds=false"
        ),
        patch.object(lerobot_record, "make_teleoperator_from_config", Scripted),
    ):
        lerobot_record.record()
    recorded = LeRobotDataset("local/recorded", root=root, video_backend="pyav")
    states = np.array(recorded.hf_dataset.with_format("numpy")["observation.state"][:])
    with (
        arguments(
            f"lerobot-replay {robot} --dataset.repo_id=local/recorded --dataset.root={root}"
            " --dataset.episode=0 --play_sounds=false"
        ),
        watched() as (seen, _),
    ):
        lerobot_replay.replay()
    apart = float(np.abs(np.array(seen) - states).max())
    if len(seen) != len(states) or apart > 0.1 or np.ptp(states, axis=0).min() < 5.0:
        sys.exit(f"the replay is {apart} degrees apart, of {len(seen)} and {len(states)} steps")

    # A dataset as the real follower writes one, made up
    made = LeRobotDataset.create(
        "local/made_up",
        30,
        recorded.features,
        root=folder / "made_up",
        robot_type="so_follower",
        use_videos=True,
    )
    draws = np.random.default_rng(0)
    for _ in range(20):
        frame = {
            name: draws.normal(size=6).astype(np.float32)
            for name in ("observation.state", "action")
        }
        frame["observation.images.front"] = draws.integers(0, 255, (128, 128, 3), dtype=np.uint8)
        made.add_frame(frame | {"task": "Something else."})
    made.save_episode()
    made.finalize()
    command(
        "mjstack job=collect job.units=lerobot timing=hz30 cameras=front sim=native nworld=2"
        " job.episodes=2 job.codec=av1 job.folder=collected",
        folder,
    )
    parts = [
        LeRobotDataset(f"local/{name}", root=folder / place, video_backend="pyav")
        for name, place in (
            ("recorded", "recorded"),
            ("made_up", "made_up"),
            ("demos", "collected/dataset"),
        )
    ]
    follower = make_robot_from_config(MjstackFollowerConfig(id="sim"))
    for part in parts:  # what lerobot-record asks before it goes on with a dataset
        sanity_check_dataset_robot_compatibility(part, follower, 30, recorded.features)
    merged = merge_datasets(parts, "local/merged", folder / "merged")
    frames = sum(part.num_frames for part in parts)
    if merged.num_frames != frames or merged.meta.robot_type != "so_follower":
        sys.exit(f"merged: {merged.num_frames} of {frames} frames, robot {merged.meta.robot_type}")
    return (
        f"lerobot-record through mjstack_follower: {len(states)} frames; lerobot-replay at most"
        f" {apart:.2g} degrees from them; merged with a dataset of so_follower and one of"
        f" job=collect: {frames} frames of {merged.num_episodes} episodes"
    )


CHECKS: dict[str, Callable[[Path], str]] = {
    "policy": check_policy,
    "robot": check_robot,
    "page": check_page,
    "drive": check_drive,
}


def main() -> None:
    """Run the checks."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--folder", type=Path, default=ROOT / "build" / "lerobot" / "check")
    parser.add_argument("--only", choices=CHECKS, help="one of the checks")
    options = parser.parse_args()
    print(f"- {report_versions()}", flush=True)
    for name, check in CHECKS.items():
        folder = options.folder.resolve() / name
        result = folder / "result.txt"
        if options.only in (None, name) and not result.exists():
            folder.mkdir(parents=True, exist_ok=True)
            result.write_text(check(folder))
        if result.exists():
            print(f"- {name}: {result.read_text()}", flush=True)


if __name__ == "__main__":
    main()
