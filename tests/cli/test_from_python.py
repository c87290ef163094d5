"""`orthoflow.run` as a function: which options it takes, and what it makes of datasets."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from orthoflow.cli import from_python as module
from orthoflow.engine.journal import RunListener, RunStarted
from orthoflow.errors import ArgumentError, CancelledStepError, WorkflowError
from tests.studios import Studio, open_studio


@pytest.fixture
def studio(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Studio:
    return open_studio(tmp_path, monkeypatch)


def test_arrays_and_paths_are_what_a_workflow_would_say() -> None:
    swept = {"sweep": np.array([0.25, 0.5]), "ranks": [np.int64(3)], "file": Path("a/b")}
    found = json.loads(module.json_of("set", swept))
    assert found == {"sweep": [0.25, 0.5], "ranks": [3], "file": "a/b"}


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"set": {"a.b": object()}}, "set.a.b: expected a path"),
        ({"jobs": True}, "Invalid value for '--jobs': 'True' is not a valid integer"),
        ({"only_dataa": 1}, r"there is no option only_dataa \(did you mean only_data\?\)"),
        ({"set_files": ["a.yaml"]}, None),
    ],
)
def test_an_argument_of_another_form_is_refused_in_a_sentence(
    given: dict[str, Any], said: str | None
) -> None:
    # What is right goes on, to a workflow that is not there.
    error, begins = (ArgumentError, "orthoflow.run: ") if said else (WorkflowError, "there is no")
    with pytest.raises(error, match=f"^{begins}{said or ''}"):
        module.run("nothing.yaml", **given)


def test_a_run_from_python_is_one_of_the_command(studio: Studio) -> None:
    (studio.folder / "n.txt").write_text("1.5")
    opened = module.run(
        "studio.yaml",
        inputs={"number": "n.txt"},
        set={"paint.grey": 7},
        output="r",
        only="survey",
        jobs=np.int64(1),
        executor="inline",
    )
    record = opened.record
    assert record.overrides == (
        "--set paint.grey=7",
        "--input number=n.txt",
        "--only survey",
    )
    assert [(cell.address, cell.status) for cell in record.cells] == [("survey", "ok")]
    assert [file.name for entry in record.inputs for file in entry.files] == ["n.txt"]
    assert (studio.folder / "r" / "run.h5").is_file()


def test_an_interrupted_run_from_python_can_be_resumed(
    studio: Studio, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object, listen: RunListener, **_more: object) -> None:
        (studio.folder / "r").mkdir()
        listen(RunStarted(run_id="r1", n_cells=2, is_resumed=False))
        raise CancelledStepError("stopped")

    monkeypatch.setattr("orthoflow.cli.run.executed", interrupted)
    again: list[str] = []
    monkeypatch.setattr("orthoflow.report.write_page", lambda *_, go_on: again.append(go_on))
    with pytest.raises(CancelledStepError):
        module.run("studio.yaml", set={"paint.grey": 7}, output="r")
    assert again == ["orthoflow run studio.yaml --set paint.grey=7 --store .orthoflow -o r"]
