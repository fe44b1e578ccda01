"""All private parts of mujoco_warp that mjstack uses are as in the release that it was written for.
Where they are not, see docs/design.md, "A new release of MuJoCo Warp".
"""

import ast
import dataclasses
import importlib.util
import inspect
import os
import shutil
import subprocess
import sys
from pathlib import Path

import mujoco
import pytest
import warp as wp

import mjstack.sim
from mjstack.sim import compiling
from mjstack.sim.fused import launch
from mjstack.sim.mujoco_warp import mjw

SIM = Path(mjstack.sim.__file__).parent
KERNELS = (("tree", "positions"), ("tree", "forces"), ("tree", "advance"), ("rows",), ("newton",))
ARRAYS = Path(__file__).parents[1] / "data" / "mjwarp_arrays.txt"
"""Arrays and numbers that the C++ texts name, by type and number of dimensions."""
OWNERS = {
    **{"m": mjw.Model, "d": mjw.Data, "rc": mjw.RenderContext, "opt": mjw.Option},
    **{"m.opt": mjw.Option, "m.callback": mjw.Callback},
    **{"d.contact": mjw.Contact, "d.efc": mjw.Constraint},
}
"""Classes of what the Python code reads members of, by the names that it has there."""
SIGNATURES = {
    "collision_core.create_collision_context": "naconmax",
    "collision_convex.convex_narrowphase": "m d ctx collision_table",
    "collision_primitive._primitive_narrowphase": (
        "primitive_collisions_types primitive_collisions_func"
    ),
    "math.upper_trid_index": "n i j",
    "smooth.tendon_armature": "m d",
    "smooth._geom_local_to_global": (
        "body_rootid body_weldid body_mocapid geom_bodyid geom_pos geom_quat xpos_in xquat_in "
        "geom_xpos_out geom_xmat_out"
    ),
}
"""Functions of ``mujoco_warp._src``, with their parameters."""
CALLS = {
    mjw.collision: """
        d.nacon.zero_ create_collision_context d.ncollision.zero_ d.nacon.zero_ nxn_broadphase
        sap_broadphase _narrowphase flex_collision wp.launch m.callback.contactfilter _sort_contacts
    """,
    mjw._src.collision_driver._narrowphase: """
        collision_table.copy collision_table.items collision_table.items convex_narrowphase
        primitive_narrowphase sdf_narrowphase
    """,
    mjw.primitive_narrowphase: """
        _PRIMITIVE_COLLISIONS.items upper_trid_index len primitive_collision_types.append
        primitive_collision_func.append wp.launch _primitive_narrowphase
    """,
}
"""Calls of the functions that `constraints.collision` stands for, in their order."""


def changed(name: str, expected: object, actual: object) -> str:
    """The sentence of a failure."""
    return (
        f"mujoco_warp {mjw.__version__} has changed {name}: expected {expected}, found {actual};"
        ' see "A new release of MuJoCo Warp" in docs/design.md.'
    )


@pytest.fixture(scope="module")
def world() -> tuple[mjw.Model, mjw.Data]:
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><option jacobian='dense'/><worldbody><body><freejoint/><geom size='.1'/></body>"
        "</worldbody></mujoco>"
    )
    with wp.ScopedDevice("cpu"):
        return mjw.put_model(model), mjw.make_data(model, nworld=1, njmax=8, nconmax=8)


def test_arrays_of_the_kernels(world: tuple[mjw.Model, mjw.Data]) -> None:
    lines = (line.split(": ") for line in ARRAYS.read_text().splitlines())
    expected = {name: kind for kind, names in lines for name in names.split()}
    assert set(expected) == {name for texts in KERNELS for name in launch._names(texts)[0]}
    for name, kind in expected.items():
        try:
            value = launch.find(name, *world)
        except AttributeError:
            value = None
        actual = "number" if isinstance(value, int) else "nothing"
        if isinstance(value, wp.array):
            actual = f"{value.dtype.__name__} {value.ndim}"
        assert actual == kind, changed(name, kind, actual)


def test_members_of_the_classes() -> None:
    used = {mjw.RenderContext: {"ray", "ray_offset"}}
    for path in (*SIM.glob("mjwarp*.py"), SIM / "usage.py", *SIM.glob("fused/*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Attribute):
                owner = OWNERS.get(ast.unparse(node.value).removeprefix("self._"))
                used.setdefault(owner, set()).add(node.attr)
    for owner in OWNERS.values():
        members = {field.name for field in dataclasses.fields(owner)} | set(dir(owner))
        assert used[owner]
        for name in sorted(used[owner] - members):
            pytest.fail(changed(f"{owner.__name__}.{name}", "a member", "none"))


def test_private_functions() -> None:
    for name, parameters in SIGNATURES.items():
        module, _, function = name.partition(".")
        value = getattr(getattr(mjw._src, module, None), function, None)
        value = getattr(value, "func", value)  # of one for kernels
        actual = " ".join(inspect.signature(value).parameters) if value else "nothing"
        assert actual == parameters, changed(f"_src.{name}", f"({parameters})", f"({actual})")


def test_modules_that_are_compiled_ahead() -> None:
    for name in compiling.SHARED:
        full = f"mujoco_warp._src.{name}"
        assert importlib.util.find_spec(full), changed(full, "a module", "none")


def test_the_narrow_phase(world: tuple[mjw.Model, mjw.Data]) -> None:
    """Its pairs, its kernel's parameters, and the functions that launch it."""
    source = mjw._src
    primitive = set(source.collision_primitive._PRIMITIVE_COLLISIONS)
    table = source.collision_driver.MJ_COLLISION_TABLE
    kinds = {types for types, kind in table.items() if kind.name == "PRIMITIVE"}
    expected = kinds | {(mjw.GeomType.BOX, mjw.GeomType.BOX)}
    name = "the pairs of collision_primitive._PRIMITIVE_COLLISIONS"
    assert primitive == expected, changed(name, expected, primitive)
    kernel = source.collision_primitive._primitive_narrowphase([], [])
    with wp.ScopedDevice("cpu"):
        context = source.collision_core.create_collision_context(8)
    for parameter in inspect.signature(kernel.func).parameters:
        try:
            assert list(launch.arguments(kernel, *world, context))
        except AttributeError as error:
            pytest.fail(changed("the narrow phase's kernel", f"an owner of {parameter}", error))
    for function, calls in CALLS.items():
        tree = ast.parse(inspect.getsource(inspect.unwrap(function)))
        nodes = [node for node in ast.walk(tree.body[0]) if isinstance(node, ast.Call)]
        nodes.sort(key=lambda node: (node.lineno, node.col_offset))
        actual = [
            ast.unparse(node.func) for node in nodes if ast.unparse(node.func) != "event_scope"
        ]
        expected = calls.split()
        assert actual == expected, changed(f"the calls of {function.__name__}", expected, actual)


MAKE = """
import sys

from mjstack.config import load_config
from mjstack.config.schema import Backend
from mjstack.scene import build_model
from mjstack.sim import make_simulation
from mjstack.sim.sizes import resolve_sizes

for robot in sys.argv[1:]:
    cfg = load_config([f"robot={robot}"])
    for sizes in (resolve_sizes(cfg), resolve_sizes(cfg, driven=False)):  # the first ones overflow
        print(make_simulation(
            build_model(cfg), cfg, 8, backend=Backend.mjwarp, device="cpu", sizes=sizes
        ).plan)
"""
KEPT = "else kbimp[0]\n"  # the stiffness of a row
ALTERED = "else 1.02 * kbimp[0]\n"


@pytest.mark.full
@pytest.mark.parametrize(
    ("alters", "robots", "plan"),
    [
        (False, ["so101", "rebot"], "fused step"),
        (
            True,
            ["so101"],
            "stock step (mjstack's was written for mujoco-warp 4.0.0, and differs from its step by",
        ),
    ],
)
def test_another_release_is_compared_with_its_own_step(
    alters: bool, robots: list[str], plan: str, tmp_path: Path
) -> None:
    """A copy of mujoco_warp with another version, as it is and with rows 2 % stiffer."""
    package = Path(mjw.__file__).parent
    copy = tmp_path / "mujoco_warp"
    shutil.copytree(package, copy, ignore=shutil.ignore_patterns("test_data", "__pycache__"))
    named = copy / "__init__.py"
    text = named.read_text()
    version = 'metadata.version("mujoco_warp")'
    assert version in text
    named.write_text(text.replace(version, '"4.0.9"'))
    rows = copy / "_src/constraint.py"
    text = rows.read_text()
    assert text.count(KEPT) == 1
    rows.write_text(text.replace(KEPT, ALTERED if alters else KEPT))
    path = os.pathsep.join([str(tmp_path), *sys.path])
    done = subprocess.run(
        [sys.executable, "-c", MAKE, *robots],
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=True,
    )
    lines = done.stdout.splitlines()
    assert len(lines) == 2 * len(robots)
    assert all(line.startswith(plan) for line in lines), lines
