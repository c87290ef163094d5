"""`orthoflow.run` as a function: which options it takes, and what it makes of datasets."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from orthoflow.cli import from_python as module
from orthoflow.errors import ArgumentError
from tests.studios import Studio, open_studio


@pytest.fixture
def studio(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Studio:
    return open_studio(tmp_path, monkeypatch)


def test_arrays_and_paths_are_what_a_workflow_would_say() -> None:
    swept = {"sweep": np.array([0.25, 0.5]), "ranks": [np.int64(3)], "file": Path("a/b")}
    datasets = {"hall": {"scan": Path("a/b"), "photos": ("c", Path("d"))}}
    known = module._Arguments(
        workflow="w",
        set={"a.b": swept},
        inputs={"scan": Path("a/b"), "photos": (path for path in [Path("a")])},
        datasets=datasets,
        jobs=np.int64(2),
        only="wall",
    )
    assert known.set == {"a.b": {"sweep": [0.25, 0.5], "ranks": [3], "file": "a/b"}}
    assert known.inputs == {"scan": ("a/b",), "photos": ("a",)}
    assert known.datasets == {"hall": {"scan": "a/b", "photos": ["c", "d"]}}
    assert (known.jobs, known.only) == (2, ("wall",))


@pytest.mark.parametrize(
    ("given", "where"),
    [
        ({"set": {"a.b": object}}, "set.a.b"),
        ({"set_files": {"a": 1}}, "set_files"),
        ({"jobs": True}, "jobs"),
        ({"only_dataa": 1}, "only_dataa"),
    ],
)
def test_an_argument_of_another_form_is_refused_in_a_sentence(
    given: dict[str, Any], where: str
) -> None:
    with pytest.raises(ArgumentError, match=f"^orthoflow.run: {where}: "):
        module.run(**{"workflow": "nothing.yaml", **given})


def test_a_run_from_python_is_one_of_the_command(studio: Studio) -> None:
    (studio.folder / "n.txt").write_text("1.5")
    opened = module.run(
        "studio.yaml",
        inputs={"number": "n.txt"},
        set={"paint.grey": 7},
        output="r",
        only="survey",
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
