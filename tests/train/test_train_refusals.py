"""Trainings that are refused in one line, by the check before anything is written."""

import pytest
from compositions import load_config, refusal
from environments import few
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
        (["job.episodes=1"], "job.episodes=1: expected at least 2"),
        (["job.batches=0"], "job.batches=0: expected an integer of at least 1"),
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
        (
            ["reset=expert_states", "reset.expert.params.path=/nowhere"],
            "a file of states; it cannot",
        ),
        (["reset=expert_states", "reset.expert.params.share=2"], "reset.expert.params.share=2"),
    ],
    PIXELS: [
        (["job.vision.cameras=[front,side]"], "job.vision.cameras: camera 'side' does not exist"),
        (["scene.cameras.front.outputs=[depth]"], "expected rgb among them, which a policy sees"),
        (["job.vision.pool=1000000000000"], "job.vision.pool=1000000000000: expected at most"),
        (
            ["trainer=clone", "job.dataset=outputs/demos"],
            "expected null, because images are rendered",
        ),
    ],
    DAGGER: [
        (["controller.clock=true"], "Set trainer=clone, which learns from any expert"),
        (["task=stack", "job.wider=1"], "Or set job.wider=0, in place of 1."),
        (["reset.cubes.params.xy=0.03"], "reset.cubes.params.xy=0.03: expected"),
        (["job.episodes=1"], "job.episodes=1: expected at least 2"),
    ],
}
CASES = [(base, *case) for base, cases in BAD.items() for case in cases]


@pytest.mark.parametrize(
    ("base", "overrides", "says"), few(CASES, 2), ids=[" ".join(case[1]) for case in CASES]
)
def test_bad_input_is_one_line(base: tuple[str, ...], overrides: list[str], says: str) -> None:
    args = [*base, *overrides, "job.folder=out"]
    refusal(lambda: check_job(load_config(args), args), says)
