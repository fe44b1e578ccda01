"""The notebook of the documentation runs from its first cell to the last."""

import json
import os
import sys
from pathlib import Path

import pytest
from doc_blocks import ROOT
from environments import Patch

import mjstack

NOTEBOOK = ROOT / "docs" / "quickstart.ipynb"


@pytest.mark.long
def test_the_notebook_runs(tmp_path: Path, monkeypatch: Patch) -> None:
    """In a folder of its own; it ends with a clip and a picture of the policy."""
    nbformat = pytest.importorskip("nbformat")
    nbclient = pytest.importorskip("nbclient")
    monkeypatch.setenv("PATH", str(Path(sys.executable).parent), prepend=os.pathsep)
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbformat.validate(notebook)
    resources = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(notebook, timeout=300, resources=resources).execute()
    shown = [
        kind
        for cell in notebook.cells
        for output in cell.get("outputs", [])
        for kind in output.get("data", {})
    ]
    assert {"image/gif", "image/png", "text/markdown"} <= set(shown)
    text = "".join(
        output.get("text", "") for cell in notebook.cells for output in cell.get("outputs", [])
    )
    for line in ("pass baseline", "pass batch", "pass success", "succeeded"):
        assert line in text


def test_the_notebook_has_no_outputs_and_says_where_it_ran() -> None:
    cells = json.loads(NOTEBOOK.read_text())["cells"]
    assert not any(cell.get("outputs") for cell in cells)
    assert "has not been run there" in "".join(cells[0]["source"])
    assert f"mjstack-{mjstack.__version__}-py3" in "".join(cells[2]["source"])
