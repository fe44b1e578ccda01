"""The code of a captured step reads nothing back to the host and copies nothing from it: the source
is checked.
"""

import ast
from pathlib import Path

import pytest

import mjstack

ROOT = Path(mjstack.__file__).parent
READS = {"item", "tolist", "cpu", "numpy", "nonzero", "synchronize", "all_gather_object"}
COPIES = {"tensor", "as_tensor", "from_numpy", "masked_select", "unique", "argwhere"}
CASTS = {"bool", "int", "float"}
# The code that runs within a step, by file and class, "" for functions; None for all of a file.
PATHS: dict[str, dict[str, str] | None] = {
    "envs/env.py": {"Env": "advance _step_physics _evaluate _reset_ended _begin _start"},
    "envs/schedule.py": None,
    "envs/command_delay.py": {"CommandDelay": "late reset"},
    "envs/faults.py": {"FaultLatch": "record record_reward"},
    "envs/outputs.py": {
        "Outputs": "write_final restore_observations returned",
        "EpisodeStatistics": "update",
    },
    "managers/action.py": {"ActionManager": "process apply not_finite reset"},
    "managers/observation.py": {
        "_Part": "value",
        "_Group": "add_noise append restart",
        "ObservationManager": "compute refresh _step",
    },
    "managers/episode.py": {
        "RewardManager": "compute reset",
        "TerminationManager": "compute",
        "_ValueManager ResetManager": "reset",
        "_ValueManager": "_term_values",
    },
    "managers/view.py": {"": "random_uniform zero_rows"},
    "managers/term.py": {"Term": "__call__ reset"},
    "managers/state.py": None,
    "mdp/observation.py": None,
    "mdp/reward.py": None,
    "mdp/geometry.py": None,
    "mdp/termination.py": {
        "": "time_out success non_finite overflow _outside",
        "ObjectOffTable JointLimit": "__call__",
    },
    "mdp/action.py": {
        "JointPosition Gripper": "write_commands",
        "EndEffectorDelta": "write_commands _tilted",
        "_Commands": "_write _write_bounded",
    },
    "mdp/reset.py": {
        "": "home _write_objects",
        "JointNoise JointZeros JitterObjects RandomizeObjects FixtureJoints": "__call__",
        "ObjectMass ObjectFriction ActuatorGains": "read write",
    },
    "mdp/hardware.py": {
        "Servos ObjectSize BaseHeight": "__call__",
        "GripForce": "read write",
    },
    "mdp/starts/randomization.py": {"Randomized": "__call__", "Elements": "scale"},
    "mdp/starts/starts_file.py": {"FromStartsFile": "__call__"},
    "mdp/starts/expert_states.py": {"ExpertStates": "__call__"},
    "episodes/recorder.py": {"Recorder": "update", "": "_read_world read_commands read_state"},
    "episodes/replay.py": {"": "_read_trace"},
    "mdp/starts/placement.py": {"Placement": "choose"},
    "tasks/check.py": {"EpisodeCheck": "update"},
    "tasks/view.py": {
        "Step": (
            "clear value pose pos center quat velocity turn height bounds speed corner_speed "
            "pressed tilt in_hand untouched narrowest supported judged _judged _of_each _sensed"
        ),
        "AllOf": "__call__ by_part __and__",
    },
    "tasks/parts.py": {
        "": "airborne in_hand on_top offset on_table upright in_zone released on_top_of",
        "Streak": "update _counts",
        "Carried InWindow AtRest": "update",
        "AtLeast": "holds unlocked",
    },
    "tasks/placed.py": {"HeldSuccess": "__call__ reset"},
    "tasks/stack.py": {
        "StackCheck": "placed goals",
        "StackSuccess": "_record_step _replace_oldest __call__",
    },
    "tasks/box.py": {
        "BoxCheck": "airborne outside over_box placed goals",
        "_CarriedOver _Release _Settled _Order": "update",
        "_Drop": "update holds",
        "BoxSuccess": "__init__",
    },
    "tasks/progress.py": {"Progress": "__call__ _measure"},
    "tasks/reach.py": {"ReachCheck": "placed trace"},
    "drivers/open_loop.py": {"JointTrajectory": "command"},
    "drivers/driver.py": {"OpenLoopDriver": "command"},
    "drivers/closed_loop.py": {
        "ClosedLoopDriver": "command _advance _judge_grasp _turn",
        "": "_put",
    },
    "drivers/policy.py": {"PolicyDriver": "command _query"},
    "drivers/feedback.py": {
        "CarryTilt": "desired_approach release_approach",
        "FeedbackDriver": "_observe _aim _last_seen _measure _solve _sunk _as_read _keep_finite",
    },
    "drivers/servos.py": {"ServoInverse": "lead sag _hold"},
    "drivers/turning.py": {
        "TurningDriver": "_turn_left _jaw_turn _held_turn _nearest_turn",
        "": "directions",
    },
    "drivers/clockless.py": {
        "ClocklessDriver": (
            "command _decide _find_delivered _lead_point _tilted _points _grasp_offsets"
        ),
    },
    "train/rounds.py": {"MixedDriver": "command"},
    "policy/network.py": {"PolicyNetwork": "normalized measured forward"},
    "episodes/failures.py": {"FailureMonitor": "update", "": "_column_of"},
    "kinematics/batched_ik.py": {"BatchedIk": "solve forward _launch _copy_in"},
    "sim/mjwarp.py": {"MjwarpSimulation": "step reset kinematics _decimation _pose _place"},
    "sim/usage.py": {"Usage": "count clear"},
    "sim/fused/constraints.py": {"": "collision solve"},
    "sim/fused/launch.py": {"": "find arguments largest_tree"},
    "sim/fused/step.py": {"": "rearranged_step"},
    "sim/graph.py": {"": "side_by_side where_any"},
    "sim/draws.py": {"": "draw_uniform"},
    "sim/simulation.py": {"Columns": "read write write_masked", "Simulation": "part"},
    "math.py": None,
}


def functions(tree: ast.Module) -> dict[str, ast.FunctionDef]:
    """Functions and methods by their qualified names."""
    found = {node.name: node for node in tree.body if isinstance(node, ast.FunctionDef)}
    for cls in (node for node in tree.body if isinstance(node, ast.ClassDef)):
        found |= {
            f"{cls.name}.{node.name}": node
            for node in cls.body
            if isinstance(node, ast.FunctionDef)
        }
    return found


def cpu_only(function: ast.FunctionDef) -> set[ast.AST]:
    """What only the CPU gets to: after `not x.is_cuda and`, after `x.is_cuda or`, and in `if not
    x.is_cuda:`.
    """
    skipped: set[ast.AST] = set()

    def asks(node: ast.expr) -> bool:
        return isinstance(node, ast.Name | ast.Attribute) and ast.unparse(node).endswith(
            ("is_cuda", "on_cuda")
        )

    def denies(node: ast.expr) -> bool:
        return isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not) and asks(node.operand)

    for node in ast.walk(function):
        parts: list[ast.AST] = []
        if isinstance(node, ast.BoolOp):
            first = node.values[0]
            guarded = denies(first) if isinstance(node.op, ast.And) else asks(first)
            parts = [*node.values[1:]] if guarded else []
        elif isinstance(node, ast.If):
            test = (
                node.test.values
                if isinstance(node.test, ast.BoolOp) and isinstance(node.test.op, ast.And)
                else [node.test]
            )
            # A step that is given as a number is the host's own.
            ours = any(denies(part) or ast.unparse(part).startswith("isinstance(") for part in test)
            parts = [*node.body] if ours else []
        skipped |= {inner for part in parts for inner in ast.walk(part)}
    return skipped


def host_accesses(function: ast.FunctionDef) -> list[str]:
    """Lines that read from the device, copy to it, or have a shape that depends on data."""
    skipped = cpu_only(function)
    out = []
    for node in ast.walk(function):
        if node in skipped:
            continue
        bad = False
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            base = ast.unparse(node.func.value)
            bad = node.func.attr in READS or (base == "torch" and node.func.attr in COPIES)
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            bad = node.func.id in CASTS and not isinstance(node.args[0], ast.Constant)
        elif isinstance(node, ast.If | ast.While | ast.IfExp):
            # A tensor's own truth: `if mask.any():`.
            test = node.test
            called = (
                isinstance(test, ast.Call)
                and isinstance(test.func, ast.Attribute)
                and test.func.attr in {"any", "all"}
            )
            bad = called and test not in skipped
        elif isinstance(node, ast.Subscript):
            bad = isinstance(node.slice, ast.Name) and node.slice.id in {"mask", "done", "broken"}
        if bad:
            out.append(f"{node.lineno}: {ast.unparse(node)}")
    return out


@pytest.mark.parametrize("path", sorted(PATHS))
def test_a_captured_step_does_not_touch_the_host(path: str) -> None:
    found = functions(ast.parse((ROOT / path).read_text()))
    groups = PATHS[path]
    # A cached function copies once, before the capture
    cached = {n for n, node in found.items() if "cache" in map(ast.unparse, node.decorator_list)}
    names = [name for name in found if name not in cached]
    if groups is not None:
        names = [
            f"{owner}.{name}".lstrip(".")
            for owners, members in groups.items()
            for owner in owners.split() or [""]
            for name in members.split()
        ]
    assert names
    for name in names:
        assert name in found, f"{path} has no {name} any more"
        assert host_accesses(found[name]) == [], f"{path}: {name}"


@pytest.mark.parametrize(
    ("body", "caught"),
    [
        ("x = d.sum().item()", True),
        ("rows = mask.nonzero()", True),
        ("if bool(done.any()):\n        pass", True),
        ("k = torch.tensor([1.0], device=device)", True),
        ("y = x.cpu()", True),
        ("n = int(count)", True),
        ("if not x.is_cuda and not bool(x.any()):\n        return", False),
        ("x = torch.where(mask, a, b)", False),
        ("if x.is_cuda or bool(x.any()):\n        return", False),
        ("if not x.is_cuda:\n        y = x.item()", False),
        ("if x.is_cuda:\n        y = x.item()", True),
        ("if x.is_cuda and bool(x.any()):\n        return", True),
        ("if not x.is_cuda or bool(x.any()):\n        return", True),
        ("if x.any():\n        return", True),
        ("while flag.all():\n        pass", True),
        ("y = x[mask]", True),
    ],
)
def test_the_check_finds_what_it_should(body: str, caught: bool) -> None:
    (function,) = functions(ast.parse(f"def step(x):\n    {body}\n")).values()
    assert bool(host_accesses(function)) is caught
