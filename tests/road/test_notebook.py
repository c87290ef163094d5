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
    # Progress is one output, with a line per step that has ended.
    first = next(cell for cell in notebook.cells if "orthoflow.run(" in cell.source)
    progress, *others = [one for one in first.outputs if one.output_type != "execute_result"]
    head, *lines = progress["data"]["text/plain"].splitlines()
    assert head.startswith("run ")
    assert all(": started" not in line and " so far" not in line for line in lines)
    assert others == []
    shown = [
        output.data
        for cell in notebook.cells
        for output in cell.get("outputs", ())
        if output.output_type == "execute_result"
    ]
    assert "first orthoimage" in shown[0]["text/html"]
    assert "completeness" in shown[1]["text/html"]
    assert "data:image/webp" in shown[2]["text/html"]
    told = [output.get("text/plain", "") for output in shown]
    assert any(text.startswith("<RunComparison of ") for text in told)
    # The sweep over both rooms, its values as numbers, and their curve.
    table = shown[-2]["text/html"]
    assert all(f"<th>{word}</th>" in table for word in ("calm", "noisy", "0.02", "0.05", "0.10"))
    assert any(
        "image/png" in output.get("data", {}) for output in notebook.cells[-1].get("outputs", ())
    )
    runs = [orthoflow.open_run(folder) for folder in sorted((tmp_path / "runs").iterdir())]
    assert [run.record.status for run in runs] == ["ok"] * 3
    assert len([cell for cell in runs[2].record.cells if cell.step == "plane"]) == 6
    # The room was not simulated twice.
    assert runs[1].cells["room"].cached_from == runs[0].record.run_id
    shutil.rmtree(tmp_path / "runs")
