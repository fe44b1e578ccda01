"""Pairs of geoms are left out of collision only where no posture lets them touch."""

import itertools

import mujoco
import numpy as np
import pytest
from environments import configure

from mjstack.config.schema import Backend
from mjstack.scene import build_model
from mjstack.sim import make_simulation
from mjstack.sim.clearance import find_separate
from mjstack.sim.mjwarp import MjwarpSimulation
from mjstack.sim.sizes import resolve_sizes

# A bar that turns about z passes a pin, which a hinge of its own may bring nearer
BAR = """<mujoco><compiler angle="radian"/><worldbody>
  <body><joint axis="0 0 1" {bar}/><geom type="capsule" size=".01" fromto="0 0 0 .2 0 0"/></body>
  <body pos="0 {far} 0"><joint {pin}/><geom type="sphere" size=".01" pos="0 0 {up}"/></body>
</worldbody></mujoco>"""


def far_apart(up: str = "0", **words: str) -> bool:
    model = mujoco.MjModel.from_xml_string(BAR.format(up=up, **words))
    return bool(find_separate(model, np.array([[0, 1]]))[0])


@pytest.mark.parametrize("bar", ["", 'range="-1 1.9"'])
def test_a_bar_that_passes_by_millimetres_is_apart(bar: str) -> None:
    """It reaches 210 mm, the pin's near side is at 212 or 209.8 mm."""
    pin = 'axis="0 0 1"'
    assert far_apart(bar=bar, pin=pin, far="0.222")
    assert not far_apart(bar=bar, pin=pin, far="0.2198")


def test_a_touch_in_few_postures_is_found() -> None:
    """The pin is in the bar's way for one degree of each hinge; nearly all postures are clear."""
    pin = 'axis="1 0 0"'
    assert not far_apart(bar="", pin=pin, far="0.2398", up=".02")
    assert far_apart(bar="", pin=pin, far="0.2445", up=".02")


@pytest.mark.parametrize("kind", ["slide", "ball", "free"])
def test_without_a_bound_nothing_is_apart(kind: str) -> None:
    """A range bounds nothing: joints overshoot it."""
    assert far_apart(bar='range="0 .1"', pin='axis="0 0 1"', far="0.3")
    assert not far_apart(bar='range="0 .1"', pin='axis="0 0 1"', far="0.15")
    assert not far_apart(bar='range="0 .1"', pin=f'axis="0 1 0" type="{kind}"', far="0.3")


def test_a_wrist_carries_what_lies_along_its_axis() -> None:
    """A ball on the roll axis of a wrist, half a metre out, is swung by the hinge before it."""
    model = mujoco.MjModel.from_xml_string("""<mujoco><worldbody>
      <body><joint axis="0 0 1"/><geom size=".01" mass="1" contype="0" conaffinity="0"/>
        <body><joint axis="1 0 0"/><geom size=".02" pos=".5 0 0"/></body></body>
      <geom size=".02" pos="0 .5 0"/></worldbody></mujoco>""")
    pair = [[model.geom_pos[:, 0].argmax(), model.geom_pos[:, 1].argmax()]]
    assert not find_separate(model, np.array(pair))[0]


def test_no_posture_of_a_robot_touches_what_is_left_out(robot: str) -> None:
    """In 300 postures, at the ends of the ranges and beyond them among others."""
    model = build_model(configure(robot=robot))
    pairs = np.array([*itertools.combinations(range(model.ngeom), 2)])
    out = {tuple(pair) for pair in pairs[find_separate(model, pairs)].tolist()}
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    single = model.jnt_type >= int(mujoco.mjtJoint.mjJNT_SLIDE)
    low, high = model.jnt_range[single].T
    for _ in range(300):
        share = rng.choice([0.0, 1.0, rng.uniform()], len(low))
        data.qpos[model.jnt_qposadr[single]] = low + share * (high - low)
        mujoco.mj_fwdPosition(model, data)
        touching = {tuple(sorted(pair)) for pair in data.contact.geom.tolist()}
        assert not touching & out
    assert robot != "so101" or out


def test_the_worlds_list_what_is_left() -> None:
    """By type too; all pairs where worlds may differ in what the proof reads."""
    cfg = configure(robot="so101")
    model = build_model(cfg)
    left = []
    for fields in ((), ("body_mass",), ("geom_size",)):
        sim = make_simulation(
            model,
            cfg,
            1,
            backend=Backend.mjwarp,
            device="cpu",
            fields=fields,
            sizes=resolve_sizes(cfg),
        )
        assert isinstance(sim, MjwarpSimulation)
        pairs = sim._stepped.nxn_geom_pair_filtered.numpy()
        assert (
            len(sim._stepped.nxn_pairid_filtered)
            == len(pairs)
            == sum(sim._stepped.geom_pair_type_count)
        )
        left.append(len(pairs))
        every = sim._m.nxn_geom_pair_filtered.numpy()
        assert (
            len(pairs) == (~find_separate(model, every)).sum()
            if fields != ("geom_size",)
            else len(every)
        )
    assert left[0] == left[1] < left[2]
