"""Servos of the group ``actuator``: published figures in the compiled model; what is refused."""

import numpy as np
import pytest
from compositions import load_config, refusal
from environments import few

from mjstack.errors import MjstackError
from mjstack.scene.build import build_model

# Figures of the joints in their order: stiffness, damping, armature, dry and viscous friction.
GTC_BERLIN = (
    [48.94, 51.34, 18.57, 43.03, 47.14, 50.83],
    [2.310, 2.783, 0.535, 2.719, 1.790, 2.345],
    [0.0582, 0.0443, 0.0545, 0.0511, 0.0514, 0.0434],
    [0.215, 0.318, 0.402, 0.296, 0.283, 0.312],
    [1.073, 0.877, 0.493, 0.517, 0.450, 1.139],
)
WORKSHOP = (
    [55.0, 30.0, 25.0, 12.0, 7.0, 4.0],
    [0.7, 0.8, 0.7, 0.5, 0.5, 0.3],
    [0.028] * 6,  # of the robot's file, as the friction is
    [0.052] * 6,
    [0.60] * 6,
)


@pytest.mark.parametrize(
    ("name", "figures"), few([("gtc_berlin", GTC_BERLIN), ("workshop", WORKSHOP)], 2)
)
def test_the_model_has_the_published_figures(name: str, figures: tuple) -> None:
    model = build_model(load_config([f"actuator={name}"]))
    stiffness, damping, armature, dry, viscous = figures
    assert np.allclose(model.actuator_gainprm[:, 0], stiffness)
    assert np.allclose(
        model.actuator_biasprm[:, :3], np.stack([np.zeros(6), *-np.array([stiffness, damping])], 1)
    )
    assert np.allclose(model.actuator_forcerange, [[-3.35, 3.35]] * 6)
    for field, values in (("armature", armature), ("frictionloss", dry), ("damping", viscous)):
        assert np.allclose(getattr(model, f"dof_{field}")[:6], values), field


def test_the_default_keeps_the_files_servos() -> None:
    default, bare = (build_model(load_config(o)) for o in ([], ["actuator=default"]))
    assert np.array_equal(default.actuator_gainprm, bare.actuator_gainprm)
    assert (default.actuator_gainprm[:, 0] == 998.22).all()


@pytest.mark.parametrize(
    ("override", "message"),
    [
        (
            "robot.servos.elbow_flex.stiffness=-1",
            "robot.servos.elbow_flex.stiffness=-1.0: expected",
        ),
        ("+robot.servos.elbow_flex.kp=20", "kp"),
    ],
)
def test_a_value_that_cannot_be_is_refused(override: str, message: str) -> None:
    assert message in refusal(lambda: load_config(["actuator=gtc_berlin", override]))


def test_a_joint_that_the_robot_lacks_is_refused() -> None:
    cfg = load_config(["actuator=gtc_berlin", "robot=rebot"])
    with pytest.raises(MjstackError, match=r"shoulder_pan.* joint1, .* Or set actuator to"):
        build_model(cfg)


def test_one_servo_is_set_over_those_of_the_file() -> None:
    """By ``+``, which is what is said of a key that is not there."""
    key = "robot.servos.elbow_flex"
    message = refusal(lambda: load_config([f"{key}.stiffness=25"]))
    assert message == f"'{key}' is not in the configuration. To add it, write +{key}=..."
    for override in (f"+{key}.stiffness=25", f"+{key}={{stiffness: 25}}"):
        gains = build_model(load_config([override])).actuator_gainprm[:, 0]
        assert gains.tolist() == [998.22, 998.22, 25.0, 998.22, 998.22, 998.22]
