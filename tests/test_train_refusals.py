"""Trainings that are refused in one line, by the check before anything is written."""

import pytest
from compositions import load_config, refusal
from test_pixels import SMALL
from test_ppo import REACH as PPO

from mjstack.jobs import check_job

CLONE = ("job=train", "trainer=clone", "sim=native")
PIXELS = ("job=train", "experiment=pixels", *SMALL)
DAGGER = ("job=train", "trainer=dagger", "task=reach", "sim=native")
BAD: dict[tuple[str, ...], list[tuple[list[str], str]]] = {
    CLONE: [
        (["task=reach", "task.check=null"], "task=reach: expected a task with phases and a check"),
        (["job.group=nope"], "observation group 'nope' does not exist"),
        (
            ["job.trainer=os.getcwd"],
            "job.trainer=os.getcwd: expected a mjstack.train.trainer.Trainer",
        ),
        (["job.test_seed=0"], "job.test_seed=0: expected seeds that training does not use"),
        (
            ["job.observation.policy.terms.headings.func=mjstack.mdp.observation.nope"],
            "policy.terms.headings: func=mjstack.mdp.observation.nope: 'nope' does",
        ),
        (["job.leave_out=[joint_vle]"], "Did you mean 'joint_vel'?"),
        (["observation@job.observation=nope"], "nope"),
        (["job.gripper_noise=0.1"], "'job.gripper_noise' does not exist"),
        (["job.episodes=1"], "job.episodes=1: expected at least 2"),
        (["job.batches=0"], "job.batches=0: expected an integer of at least 1"),
        (["job.hidden=[0]"], "job.hidden=[0]"),
        (["trainer=clon"], "Did you mean 'clone'?"),
    ],
    PPO: [
        (
            ["job.iterations=null"],
            "job.iterations=null: expected a number, or a limit in job.minutes",
        ),
        (["job.minibatches=64"], "job.minibatches=64: expected at most 8"),
        (["job.leave_out=[nope]"], "term of policy 'nope' does not exist"),
        (
            ["+job.observation.policy.terms.joint_pos.params.foo=1"],
            "job.observation.policy.terms.joint_pos: parameter 'foo' does not exist",
        ),
        (["job.batch_size=3"], "job.batch_size is a key of trainer=dagger and trainer=clone"),
        (
            ["reset=expert_states", "reset.expert.params.path=/nowhere"],
            "a file of states; it cannot",
        ),
        (["reset=expert_states", "reset.expert.params.share=2"], "reset.expert.params.share=2"),
        (["job.std=0"], "job.std=0"),
    ],
    PIXELS: [
        (["job.vision.cameras=[front,side]"], "job.vision.cameras: camera 'side' does not exist"),
        (["job.vision.cameras=[front,front]"], "job.vision.cameras=['front', 'front']: expected"),
        (["job.vision.channels=[]"], "job.vision.channels=[]: expected at least one number"),
        (["scene.cameras.front.outputs=[depth]"], "expected rgb among them, which a policy sees"),
        (["job.vision.pool=1000000000000"], "job.vision.pool=1000000000000: expected at most"),
        (
            ["trainer=clone", "job.dataset=outputs/demos"],
            "expected null, because images are rendered",
        ),
        (["trainer=pixels"], "trainer=pixels: 'pixels' does not exist. Available: clone, dagger"),
    ],
    DAGGER: [
        (["controller.clock=true"], "Set trainer=clone, which learns from any expert"),
        (["job.dataset=outputs"], "job.dataset=outputs: expected null"),
        (["job.rounds=-1"], "job.rounds=-1"),
        (["task=stack", "job.wider=1"], "Or set job.wider=0, in place of 1."),
        (["reset.cubes.params.xy=0.03"], "reset.cubes.params.xy=0.03: expected"),
        (["job.episodes=1"], "job.episodes=1: expected at least 2"),
    ],
}
# In test-rest alone: another case has the same kind in make test
ALIKE = ("job.gripper_noise=0.1", "job.batch_size=3", "observation@job.observation=nope")
ALIKE += ("job.hidden=[0]", "job.std=0", "job.rounds=-1", "job.vision.channels=[]")
ALIKE += ("job.vision.cameras=[front,front]", "trainer=pixels", "job.dataset=outputs")
CASES = [
    pytest.param(
        base, *case, id=" ".join(case[0]), marks=[pytest.mark.full] * (case[0][0] in ALIKE)
    )
    for base, cases in BAD.items()
    for case in cases
]


@pytest.mark.parametrize(("base", "overrides", "says"), CASES)
def test_bad_input_is_one_line(base: tuple[str, ...], overrides: list[str], says: str) -> None:
    args = [*base, *overrides, "job.folder=out"]
    refusal(lambda: check_job(load_config(args), args), says)
