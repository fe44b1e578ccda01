"""Does it work at all: both robots, an environment step and an episode."""

from pathlib import Path

import pytest

from mjstack import cli, make_env


def test_an_environment_steps(robot: str) -> None:
    env = make_env([f"robot={robot}", "sim=native", "reset=randomized"], nworld=2)
    env.reset(seed=0)
    action = 0.1 * (env.action_manager.low + env.action_manager.high).float().expand(2, -1)
    _, reward, _, _, _ = env.step(action)
    assert reward.isfinite().all()
    env.close()


@pytest.mark.parametrize(
    "overrides",
    [["task=stack"], pytest.param(["task=box", "robot=rebot"], marks=pytest.mark.full)],
    ids=str,
)
def test_the_baseline_passes(overrides: list[str], tmp_path: Path) -> None:
    assert cli.run([*overrides, "gates=[baseline]", f"hydra.run.dir={tmp_path}"]) == 0
    assert (tmp_path / "report.json").is_file()
