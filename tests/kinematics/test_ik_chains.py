"""Batched inverse kinematics of any chain of hinges and slides, and what it refuses."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from ik_arm import Arm, results, tensors

from mjstack.config.schema import RobotCfg
from mjstack.errors import ArgumentError, ConfigError, MjstackError
from mjstack.kinematics.batched_ik import BatchedIk

ODD = """
<mujoco>
  <worldbody>
    <body name="shoulder" pos="0.1 -0.2 0.3" euler="20 30 40">
      <body pos="0.05 0 0.1" euler="0 50 0">
        <joint name="lift" type="slide" axis="0.2 0.1 1" pos="0.3 0 0" ref="0.05" range="-0.2 0.3"/>
        <joint name="turn" axis="0 1 1" pos="0.02 -0.03 0.04" ref="25" range="-100 100"/>
        <geom size="0.01"/>
        <body pos="0.2 0 0" euler="90 0 0">
          <joint name="passive" axis="1 0 0" pos="0 0.1 0" ref="15"/>
          <geom size="0.01"/>
          <body name="palm" pos="0.1 0.1 0.05">
            <joint name="bend" axis="1 0 1" pos="0 0.01 0" range="-150 150"/>
            <joint name="sway" axis="0 1 0.3" pos="-0.1 0 0.02" range="-120 120"/>
            <geom size="0.01"/>
            <body name="finger" pos="0 0 0.15">
              <joint name="first_finger" axis="1 0 0" pos="0 0 0.02" ref="-30" range="-90 90"/>
              <geom size="0.01"/>
              <site name="a" pos="0.01 0.12 0.06" euler="10 20 30"/>
            </body>
            <body pos="0 0.02 0.1" euler="0 0 45">
              <joint name="second_finger" type="slide" axis="1 0 0" range="-0.1 0.1"/>
              <geom size="0.01"/>
              <body pos="0.03 0 0.02"><geom size="0.01"/><site name="b" pos="0 0 0.03"/></body>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="lift" joint="lift" ctrlrange="-0.1 0.5"/>
    <position name="turn" joint="turn"/>
    <position name="bend" joint="bend"/>
    <position name="sway" joint="sway"/>
    <position name="first_finger" joint="first_finger"/>
    <position name="second_finger" joint="second_finger"/>
  </actuator>
</mujoco>
"""


def odd_arm() -> Arm:
    """Slides and hinges beside their body's origin, two in one body, reference angles, one without
    a command, a fork.
    """
    joints = ["lift", "turn", "bend", "sway"]
    robot = RobotCfg(
        arm_joints=joints,
        gripper_joints=["first_finger", "second_finger"],
        home=[0.1, 0.2, 0.3, 0.1, 0.1, 0.0],
        gripper_open=[0.1, 0.0],
        gripper_closed=[0.0, 0.0],
        ik_joints=joints,
        locked={},
        grasp_sites=["a", "b"],
        approach_body="palm",
        approach_axis=[0.0, 0.6, 0.8],
    )
    return Arm(mujoco.MjModel.from_xml_string(ODD), robot)


def test_any_chain_of_hinges_and_slides(device: str) -> None:
    """Its Jacobian is right if a solve from close by converges as fast as Newton's method."""
    arm = odd_arm()
    commands = np.random.default_rng(18).uniform(arm.low, arm.high, (100, 6))
    commands[:, 0] = np.clip(commands[:, 0], -0.09, 0.29)
    ik = arm.solver(100, device, iterations=5)
    (given,) = tensors(device, commands)
    assert np.abs(ik.forward(given)[0].cpu().numpy() - arm.grasp_point(commands)).max() <= 1e-6
    for found, expected in zip(ik.forward(given)[1:], arm.directions(commands), strict=True):
        assert np.abs(found.cpu().numpy() - expected).max() <= 2e-6
    nudge = np.random.default_rng(19).normal(scale=0.005, size=commands.shape)
    near = np.clip(commands + nudge, arm.low, arm.high)
    near[:, 4:] = commands[:, 4:]
    near[:, 0] = np.clip(near[:, 0], -0.1, 0.3)
    command, distance = results(ik, commands, arm.grasp_point(near))
    assert np.quantile(distance, 0.95) <= 1e-6
    assert (command[:, 0] >= -0.1).all()  # its actuator's range is narrower below
    _, distance = results(ik, commands, np.tile([0.0, 0.0, -5.0], (100, 1)))
    assert np.isfinite(distance).all()


def test_the_narrower_of_both_ranges_holds() -> None:
    arm = odd_arm()
    for z, limit in ((5.0, 0.3), (-5.0, -0.1)):
        target = np.array([[0.0, 0.0, z]])
        command, _ = results(arm.solver(1, iterations=60), arm.at_home(1), target)
        assert command[0, 0] == pytest.approx(limit, abs=1e-6)
        assert -0.1 <= command[0, 0] <= 0.3


def test_joints_that_move_one_site_alone_are_refused() -> None:
    arm = odd_arm()
    for joints in ([*arm.robot.ik_joints, "second_finger"], []):
        robot = replace(arm.robot, arm_joints=arm.robot.joints, gripper_joints=[], ik_joints=joints)
        says = "robot.ik_joints=.*: expected joints that move both grasp sites, a and b"
        with pytest.raises(ConfigError, match=says):
            BatchedIk(arm.model, robot, 2, "cpu")


def test_an_approach_body_that_not_every_joint_moves_is_refused() -> None:
    arm = odd_arm()
    for body in ("shoulder", "finger"):
        says = f"robot.approach_body={body}: expected .* moves: palm"
        with pytest.raises(ConfigError, match=says):
            BatchedIk(arm.model, replace(arm.robot, approach_body=body), 2, "cpu")


@pytest.mark.full
def test_a_gain_counts_in_any_chain(device: str) -> None:
    """With a slide among the moved joints, and an approach axis that is none of theirs."""
    arm = odd_arm()
    start = np.random.default_rng(37).uniform(0.5 * arm.low, 0.5 * arm.high, (100, 6))
    start[:, 0] = np.clip(start[:, 0], -0.05, 0.1)
    at = arm.grasp_point(start)
    for gains in ({"posture_gain": 0.2}, {"approach_gain": 0.2}):
        command, distance = results(arm.solver(100, device, iterations=100, **gains), start, at)
        assert (distance <= 0.0001).mean() >= 0.95
        if "posture_gain" in gains:
            before, after = (np.linalg.norm(c - arm.home, axis=1) for c in (start, command))
            assert np.median(before - after) > 0.1
        else:
            before, after = (-arm.directions(c)[1][:, 2] for c in (start, command))
            assert np.median(after - before) > 0.1


def test_other_joint_types_are_refused() -> None:
    hinge = '<joint name="sway" axis="0 1 0.3" pos="-0.1 0 0.02" range="-120 120"/>'
    assert hinge in ODD
    model = mujoco.MjModel.from_xml_string(ODD.replace(hinge, '<joint name="sway" type="ball"/>'))
    with pytest.raises(MjstackError, match="joint 'sway' is of type ball, expected hinge or slide"):
        BatchedIk(model, odd_arm().robot, 2, "cpu")


def test_shapes_are_not_broadcast() -> None:
    ik = odd_arm().solver(3, posture_gain=0.1)
    q = torch.zeros(3, 6)
    goal = torch.zeros(3, 3)
    postures = [(q, goal, torch.zeros(shape)) for shape in ((6,), (1, 6), (3, 4), (1, 3, 6))]
    for arguments, says in (
        ((torch.zeros(1, 6), goal), r"q: found shape \(1, 6\), expected shape \(3, 6\)"),
        ((q, torch.zeros(3)), r"target: found shape \(3,\), expected shape \(3, 3\)"),
        *((posture, "posture: found shape") for posture in postures),
    ):
        with pytest.raises(ArgumentError, match=says):
            ik.solve(*arguments)
    with pytest.raises(ArgumentError, match="q: found shape"):
        ik.forward(torch.zeros(3, 4))
    with pytest.raises(ArgumentError, match="approach: found shape"):
        odd_arm().solver(3, approach_gain=0.1).solve(q, goal, approach=goal[:1])
