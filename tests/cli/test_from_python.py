"""`orthoflow.run` as a function: which options it takes, and what it makes of datasets."""

from __future__ import annotations

from pathlib import Path

import pytest

from orthoflow.cli import from_python as module
from orthoflow.errors import ArgumentError
from tests.studios import Studio, open_studio


@pytest.fixture
def studio(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Studio:
    return open_studio(tmp_path, monkeypatch)


def test_what_the_function_takes_is_not_refused() -> None:
    known = ("jobs", "executor", "only", "from_", "until", "force", "set_files", "embed", "store")
    module._refuse_unknown(dict.fromkeys(known, 1))
    module._refuse_unknown({})
    with pytest.raises(ArgumentError, match=r"takes no option; it takes "):
        module._refuse_unknown({"jobs": 1, "option": 2})
    with pytest.raises(ArgumentError, match=r"takes no options \(did you|takes no options; it"):
        module._refuse_unknown({"options": 2})


def test_one_or_several_paths_are_a_tuple_of_texts() -> None:
    assert module._several("a b") == ("a b",)
    assert module._several(Path("a/b")) == ("a/b",)
    assert module._several(["a", Path("b")]) == ("a", "b")
    assert module._several(()) == ()


def test_datasets_are_what_a_workflow_would_say_of_them() -> None:
    said = {"hall": {"scan": Path("a/b"), "photos": ("c", Path("d")), "set": {"wall.gsd_m": 0.1}}}
    assert module._datasets(said) == {
        "hall": {"scan": "a/b", "photos": ["c", "d"], "set": {"wall.gsd_m": 0.1}}
    }
    assert module._datasets(Path("a.csv")) == "a.csv"


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
    assert record.overrides == ("--set paint.grey=7", "--input number=n.txt")
    assert [(cell.address, cell.status) for cell in record.cells] == [("survey", "ok")]
    assert [file.name for entry in record.inputs for file in entry.files] == ["n.txt"]
    assert (studio.folder / "r" / "run.h5").is_file()
