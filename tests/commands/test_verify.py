"""The gates from Python."""

import gc
from pathlib import Path

import pytest
from compositions import load_config
from environments import Capture, Patch

import mjstack
import mjstack.sim
from mjstack.jobs import runner as job_runner

REACH = ["task=reach", "sim=native", "nworld=2"]


def test_results_and_records_come_back_and_nothing_is_left(
    tmp_path: Path, monkeypatch: Patch, capsys: Capture
) -> None:
    monkeypatch.chdir(tmp_path)
    found = mjstack.verify([*REACH, "gates=[baseline,batch,success]", "gate.success.seeds=2"])
    assert found.status == "pass"
    assert list(found.gates) == ["baseline", "batch", "success"]
    assert found.gates["batch"].metrics["success_rate"] == 1.0
    assert found.gates["baseline"].metrics["distance_m"] <= 0.02
    assert [message.split(":")[0] for message in found.messages] == [
        *("pass baseline", "pass batch", "pass success")
    ]
    assert [record.seed for record in found.records["success"]] == [0, 1]
    assert found.records["batch"][0].succeeded.tolist() == [True, True]
    assert list(tmp_path.iterdir()) == []
    assert capsys.readouterr() == ("", "")


def test_what_fails_is_said() -> None:
    found = mjstack.verify([*REACH, "gates=[baseline]", "task.check.distance=1e-6"])
    assert found.status == "fail"
    assert found.messages == ["fail baseline: failed: grasp point not above red"]
    assert found.gates["baseline"].beyond == ["reached_steps"]
    with pytest.raises(mjstack.MjstackError, match=r"nworld=0: expected"):
        mjstack.verify(["nworld=0"])


@pytest.mark.full
def test_a_warp_that_cannot_be_loaded_fails_no_run(monkeypatch: Patch) -> None:
    """The gates that play on it fail."""

    def broken(name: str) -> None:
        raise OSError(name)

    checked = job_runner.check_job(load_config([*REACH, "gates=[baseline]"]))
    monkeypatch.setattr(job_runner.importlib, "import_module", broken)
    checked._load(warp=True)
    assert gc.isenabled()
    gc.unfreeze()
