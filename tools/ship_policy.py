"""Put a trained policy into the package, with a card of what it was seen to do.

``python tools/ship_policy.py outputs/mine so101_stack`` takes the folder of a ``job=train``. Its
last policy, or its best one, with weights in float16, is judged by gate *success* on native MuJoCo:
from random starts that neither training nor its own judgement has used, and from ``reset=jitter``.
Only a policy that passes is kept.
"""

import argparse
import json
import shlex
import tempfile
from pathlib import Path

import common

import mjstack
from mjstack.config.fingerprint import SHIPPED
from mjstack.config.load import load_config
from mjstack.episodes.stage import Stage
from mjstack.errors import MjstackError
from mjstack.policy import Policy, load_policy, save_policy
from mjstack.report.provenance import collect_provenance
from mjstack.report.record import GateResult, Status

_SEED = 2_000_000  # of the first starts; trainings use small ones, and are judged from 1,000,000
_LIMITS = (
    "It was trained and judged in simulation alone, with mjstack's model of the robot and exact"
    " poses of the objects. It has not moved a real arm: servos, delays, friction and perception"
    " differ there. It is not meant for other objects, places, control rates or tasks."
)


def main() -> None:
    """Judge the policy of the command line, and keep it if it passes."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("training", type=Path, help="the folder of a job=train")
    parser.add_argument("name", help="of the policy, such as so101_stack")
    parser.add_argument("--seeds", type=common.count, default=4, help="of --nworld starts each")
    parser.add_argument("--nworld", type=common.count, default=256, help="worlds of a seed")
    parser.add_argument("--rate", type=float, default=0.99, help="share without which none is kept")
    parser.add_argument("--which", choices=("last", "best"), default="last", help="of its policies")
    parser.add_argument("--to", type=Path, default=SHIPPED, help="where the policy's folder goes")
    args = parser.parse_args()
    folder = args.to / args.name
    try:
        policy = load_policy(args.training / args.which)
        for name, value in policy.network.named_parameters():
            value.data = value.data.half()
            if not bool(value.isfinite().all()):
                raise MjstackError(f"{name}: expected weights that fit into float16")
        policy.config["job"]["folder"] = None  # of this machine
        with tempfile.TemporaryDirectory() as trial:
            save_policy(Path(trial) / args.name, policy)
            judged = {
                reset: judge(Path(trial) / args.name, reset, args.seeds, args.nworld, args.rate)
                for reset in ("randomized", "jitter")
            }
        card = write_card(args.training, args.which, args.name, policy, judged)
    except MjstackError as error:
        parser.exit(error.exit_code, f"{parser.prog}: {error}\n")
    print(card)
    if any(gate.status is not Status.passed for gate in judged.values()):
        parser.exit(1, f"{parser.prog}: it has not passed, and is not kept\n")
    save_policy(folder, policy)
    (folder / "card.md").write_text(card, encoding="utf-8")


def judge(folder: Path, reset: str, seeds: int, nworld: int, rate: float) -> GateResult:
    """The result of gate *success* from such starts."""
    overrides = ["sim=native", "controller=policy", f"policy={folder}", "gates=[success]"]
    overrides.append(f"gate.success.rate={rate}")
    starts = [f"reset={reset}", f"seed={_SEED}", f"gate.success.seeds={seeds}", f"nworld={nworld}"]
    return mjstack.verify([*overrides, *starts]).gates["success"]


def write_card(
    training: Path, which: str, name: str, policy: Policy, judged: dict[str, GateResult]
) -> str:
    """The card in Markdown; its third line is what ``mjstack list policies`` prints."""
    made = json.loads((training / "report.json").read_text())["provenance"]
    here = collect_provenance()
    overrides = (training / ".hydra" / "overrides.yaml").read_text().splitlines()
    words = [line.removeprefix("- ").strip("'\"") for line in overrides]
    words = [word for word in words if not word.startswith(("job.folder=", "hydra.run.dir="))]
    cfg = load_config([f"{key}={policy.config[key]['name']}" for key in ("task", "robot")])
    texts = Stage(cfg).check.rules.texts
    gate = judged["randomized"]
    counts = gate.metrics
    broken = {rule: counts[f"failed.{rule}"] for rule in texts if f"failed.{rule}" in counts}
    targets = "a joint target"
    if policy.network.chunk > 1:
        targets = f"{policy.network.chunk} joint targets, the first {policy.execute} to be played,"
    size = sum(value.numel() for value in policy.network.parameters())
    rows = {
        "task": f"{cfg.task.name}: {cfg.task.instruction}",
        "robot": f"{cfg.robot.title}, mjstack's built-in model",
        "sees": ", ".join(policy.observation.terms),
        "gives": f"{targets} for each of {', '.join(policy.joints)}",
        "an episode fails by": "; ".join(texts.values()),
        "random starts": f"{rate_text(gate)}; {starts_text(gate)}",
        "the task's threshold": f"{cfg.gate.success.rate:.0%}, which these random starts "
        + ("reach" if counts["success_rate"] >= cfg.gate.success.rate else "do not reach"),
        "broken rules": ", ".join(f"{texts[k]} in {v}" for k, v in broken.items()) or "none",
        "jittered starts": f"{rate_text(judged['jitter'])}; {starts_text(judged['jitter'])}",
        "training": f"`{shlex.join(['mjstack', *words, 'job.folder=outputs/mine'])}`, seed"
        f" {policy.config['seed']}, its {which} policy",
        "trained": f"commit {made['git_commit'][:7]}, {made['date'][:10]}, {made['device']}, torch"
        f" {made['versions']['torch']}",
        "judged": f"commit {here['git_commit'][:7]}, {here['date'][:10]}, MuJoCo"
        f" {here['versions']['mujoco']}, torch {here['versions']['torch']}",
        "judge it again": f"`mjstack controller=policy policy={name} sim=native 'gates=[success]'"
        f" seed={_SEED} nworld={counts['worlds']} gate.success.seeds={counts['seeds']}`",
        "weights": f"{size:,} in float16; means, scales and ranges in float32",
        "limits": _LIMITS,
    }
    title = f"{cfg.robot.title}, task {cfg.task.name}: {rate_text(gate)} on native MuJoCo."
    head = [f"# {name}", "", title, "", "| fact | value |", "| --- | --- |"]
    table = [f"| {key} | {value} |" for key, value in rows.items()]
    return "\n".join([*head, *table, "", "Written by `tools/ship_policy.py`.", ""])


def rate_text(gate: GateResult) -> str:
    """The rate with its interval, as the gate says it."""
    return gate.reason.partition("), ")[0] + ")"


def starts_text(gate: GateResult) -> str:
    """The starts of a gate's episodes."""
    last = _SEED + int(gate.metrics["seeds"]) - 1
    which = gate.notes["starts"].partition("(")[2].removesuffix(")")
    return f"{which}; seeds {_SEED} to {last}, {gate.metrics['worlds']} worlds each"


if __name__ == "__main__":
    main()
