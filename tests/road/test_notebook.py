"""The notebook in `examples/`: executed as a reader would, in an empty folder."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

import orthoflow
from tests.road.conftest import CHECKOUT, ROOT

NOTEBOOK = ROOT / "examples" / "runs.ipynb"


@pytest.mark.long
@pytest.mark.filterwarnings("default")  # of the notebook's own machinery
def test_the_notebook_runs_and_shows_what_it_promises(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import nbclient
    import nbformat

    monkeypatch.setenv("PYTHONPATH", ":".join(CHECKOUT))
    # Charts are shown in the notebook unless a reader's surroundings say otherwise.
    monkeypatch.delenv("MPLBACKEND", raising=False)
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells)
    # Half the points along each side: what is asserted needs no more.
    assert notebook.cells[1].source.count("0.04") == 2
    notebook.cells[1].source = notebook.cells[1].source.replace("0.04", "0.08")
    # In one process, which loads libraries once for all steps.
    for cell in notebook.cells:
        cell.source = cell.source.replace('"direct.yaml", ', '"direct.yaml", executor="inline", ')
    client = nbclient.NotebookClient(
        notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}
    )
    client.execute()
    shown = [
        output.data
        for cell in notebook.cells
        for output in cell.get("outputs", ())
        if output.output_type == "execute_result"
    ]
    assert "first orthoimage" in shown[0]["text/html"]
    assert "completeness" in shown[1]["text/html"]
    assert "data:image/webp" in shown[2]["text/html"]
    runs = [orthoflow.open_run(folder) for folder in sorted((tmp_path / "runs").iterdir())]
    assert [run.record.status for run in runs] == ["ok"] * 3
    shutil.rmtree(tmp_path / "runs")
