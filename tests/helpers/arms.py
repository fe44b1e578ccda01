"""Small arms, each with what grippers and rigs of industry have: models for tests of the step."""

import mujoco

FRAME = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast" cone="elliptic" jacobian="dense"/>
  <compiler angle="radian"/>
  <default><geom mass=".1" friction=".8"/></default>
  <worldbody>
    <geom type="plane" size="2 2 .1"/>
    <body name="cube" pos=".3 0 .03">
      <freejoint/><geom name="cube" type="box" size=".02 .02 .03" mass=".05"/>
    </body>
    {bodies}
    <body name="arm" pos="0 0 .25">
      <joint name="lift" type="slide" axis="0 0 1" range="-.2 .2" damping="5"/>
      <geom type="capsule" size=".02" fromto="0 0 0 .2 0 0"/><site name="wrist" pos=".2 0 0"/>
      <camera name="eye" pos="0 0 .1" mode="trackcom"/>
      <body pos=".3 0 0">
        <joint name="turn" axis="0 0 1" damping=".2" armature=".01"/>
        <geom type="box" size=".03 .05 .02"/>
        <geom name="pulley" size=".02" pos="-.04 .03 -.04" mass=".01"/>
        {hand}
      </body>
    </body>
  </worldbody>
  {rest}
</mujoco>
"""
FINGERS = """
<body name="left" pos="0 .045 -.04">
  <joint name="left" type="slide" axis="0 1 0" range="-.03 .02" {0}/>
  <geom type="box" size=".01 .01 .04"/><site name="tip" pos="0 0 -.04"/>
</body>
<body name="right" pos="0 -.045 -.04">
  <joint name="right" type="slide" axis="0 -1 0" range="-.03 .02" {0}/>
  <geom type="box" size=".01 .01 .04"/>
</body>
"""
LIFT = '<position joint="lift" kp="300" kv="20" ctrlrange="-.2 .1"/>'
GRIP = """<tendon><fixed name="grip" {0}>
<joint joint="left" coef=".5"/><joint joint="right" coef=".5"/></fixed></tendon>"""


def _arm(hand: str, rest: str, bodies: str = "") -> str:
    return FRAME.format(hand=hand, rest=rest, bodies=bodies)


# A jaw of two four-bar linkages, whose drivers a tendon turns
LINKAGE = "".join(
    f"""
<body name="{side}_driver" pos="0 {sign}.02 0">
  <joint name="{side}_driver" axis="{sign}1 0 0" range="-.2 .8" armature=".002" damping=".1"/>
  <geom type="capsule" size=".005" fromto="0 0 0 0 {sign}.03 -.02" mass=".02"/>
  <body name="{side}_coupler" pos="0 {sign}.03 -.02">
    <joint name="{side}_coupler" axis="{sign}1 0 0" damping=".01"/>
    <geom type="capsule" size=".005" fromto="0 0 0 0 0 -.04" mass=".02"/>
  </body>
</body>
<body name="{side}_spring" pos="0 {sign}.01 -.02">
  <joint name="{side}_spring" axis="{sign}1 0 0" stiffness=".05" damping=".01" armature=".001"/>
  <geom type="capsule" size=".005" fromto="0 0 0 0 {sign}.03 -.02" mass=".02"/>
  <body name="{side}_follower" pos="0 {sign}.03 -.02">
    <joint name="{side}_follower" axis="{sign}1 0 0" damping=".01"/>
    <geom type="box" size=".01 .005 .02" pos="0 0 -.03" mass=".02"/>
  </body>
</body>
"""
    for side, sign in (("left", ""), ("right", "-"))
)
XMLS = {
    "tendon": _arm(
        FINGERS.format(""),
        GRIP.format(
            'limited="true" range="-.02 .015" stiffness="30" springlength="-.005 .002"'
            ' damping="4" frictionloss=".1" armature=".05"'
        )
        + f"""<actuator>{LIFT}
        <position tendon="grip" kp="120" kv="3" gear="1.5" ctrlrange="-.03 .02" forcerange="-3 3"/>
        </actuator>
        <sensor><tendonpos tendon="grip"/><tendonvel tendon="grip"/>
        <tendonactuatorfrc tendon="grip"/><tendonlimitfrc tendon="grip"/>
        <framepos objtype="site" objname="tip"/></sensor>""",
    ),
    "pulled": _arm(
        FINGERS.format('damping="2" armature=".01"'),
        """<tendon><fixed name="a" stiffness="20 3 2" springlength="-.005 .002" damping="4 1 1"
        armature=".05" limited="true" range="-.01 .01" actuatorfrclimited="true"
        actuatorfrcrange="-1 .8"><joint joint="left" coef=".5"/><joint joint="right" coef=".5"/>
        <joint joint="turn" coef="-.2"/></fixed>
        <fixed name="b" damping="1"><joint joint="turn" coef="2"/>
        <joint joint="lift" coef=".3"/></fixed></tendon>"""
        + f"""<actuator>{LIFT}
        <position tendon="a" kp="120" kv="3" gear="1.5" ctrlrange="-.03 .02" forcerange="-3 .9"/>
        <general tendon="a" gaintype="affine" gainprm=".5 .1 -.2" ctrlrange="-1 1"/>
        <general tendon="b" gear=".7" armature=".02" damping=".05 .1 .2" gainprm=".3"
        dyntype="integrator" actrange="-1 1"/>
        <motor tendon="b" gear="2" armature=".01" damping=".1" forcerange="-.1 .1"/></actuator>
        <sensor><tendonactuatorfrc tendon="a"/></sensor>""",
    ),
    "mimic": _arm(
        FINGERS.format('damping="3"'),
        f"""<equality>
        <joint joint1="right" joint2="left" polycoef="0 1.1 .5 0 0" solref=".005 1"/>
        <joint joint1="turn" polycoef=".2 0 0 0 0"/></equality>
        <actuator>{LIFT}<position joint="left" kp="90" kv="2" ctrlrange="-.03 .02"/></actuator>
        <sensor><jointpos joint="right"/></sensor>""",
    ),
    "tied": _arm(
        FINGERS.format('damping="3"'),
        """<tendon><fixed name="a"><joint joint="left" coef="1"/></fixed>
        <fixed name="b" damping="1"><joint joint="right" coef=".8"/><joint joint="turn" coef=".1"/>
        </fixed></tendon>
        <equality><tendon tendon1="a" tendon2="b" polycoef="0 1 0 0 0"/></equality>"""
        + f"""<actuator>{LIFT}<general tendon="a" dyntype="filter" dynprm=".03" gainprm="50"
        gaintype="affine" biastype="affine" biasprm="0 -60 -2" actearly="true"/>
        <position joint="turn" kp="20" kv="1" ctrlrange="-1 1"/></actuator>
        <sensor><tendonpos tendon="b"/></sensor>""",
    ),
    "linkage": _arm(
        LINKAGE,
        f"""<equality>
        <connect body1="left_follower" body2="left_coupler" anchor="0 0 -.02" solref=".005 1"/>
        <connect body1="right_follower" body2="right_coupler" anchor="0 0 -.02" solref=".005 1"/>
        <joint joint1="left_driver" joint2="right_driver" solref=".005 1"/></equality>
        <tendon><fixed name="grip"><joint joint="left_driver" coef=".5"/>
        <joint joint="right_driver" coef=".5"/></fixed></tendon>
        <actuator>{LIFT}<general tendon="grip" biastype="affine" gainprm="2" biasprm="0 -2 -.1"
        ctrlrange="0 .8" forcerange="-1 1"/></actuator>
        <sensor><accelerometer site="wrist"/><force site="wrist"/><torque site="wrist"/>
        <framelinacc objtype="body" objname="cube"/>
        <framepos objtype="body" objname="cube" reftype="camera" refname="eye"/></sensor>""",
    ),
    "weld": _arm(
        FINGERS.format('damping="3" stiffness="40"'),
        f"""<equality><weld body1="guide" body2="held" torquescale=".5"/>
        <weld site1="a" site2="b" active="false"/>
        <connect site1="wrist" site2="c"/></equality>
        <actuator>{LIFT}<motor joint="turn" gear=".5" ctrlrange="-1 1"/></actuator>
        <sensor><frameangacc objtype="site" objname="b"/></sensor>""",
        bodies="""<body name="guide" mocap="true" pos="-.3 0 .3"/>
        <body name="held" pos="-.3 .02 .3"><freejoint/><geom size=".03"/><site name="a"/></body>
        <body pos="-.1 .2 .4"><joint axis="1 0 0"/><joint axis="0 1 0" damping=".1"/>
        <geom type="capsule" size=".01" fromto="0 0 0 .2 -.1 -.1"/><site name="b" pos=".2 -.1 -.1"/>
        <site name="c" pos=".3 -.2 -.15"/></body>""",
    ),
    "dead": _arm(
        FINGERS.format('damping="3"'),
        GRIP.format("")
        + f"""<actuator>{LIFT}<position joint="left" kp="90" kv="2" ctrlrange="-.03 .02"/>
        <position joint="right" kp="90" kv="2" ctrlrange="-.03 .02"/></actuator>""",
    ),
    "spatial": _arm(
        FINGERS.format('damping="3"'),
        f"""<tendon><spatial name="cable" limited="true" range="0 .5" stiffness="5" damping=".5">
        <site site="wrist"/><geom geom="pulley"/><site site="tip"/></spatial>
        <spatial name="rod" armature=".02"><site site="wrist"/><site site="tip"/></spatial></tendon>
        <actuator>{LIFT}<motor tendon="cable" gear=".2" ctrlrange="-1 1"/></actuator>""",
    ),
}


def model_of(name: str) -> mujoco.MjModel:
    """The arm of this name, compiled."""
    return mujoco.MjModel.from_xml_string(XMLS[name])
