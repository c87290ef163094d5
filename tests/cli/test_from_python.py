"""`orthoflow.run` as a function: which options it takes, and what it makes of datasets."""

from __future__ import annotations

import csv
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


def test_a_mapping_of_datasets_is_a_table_with_what_each_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    said = {
        "hall": {"scan": "hall, old.e57", "set": {"wall.gsd_m": 0.005, "wall.name": "a"}},
        "yard": {"photos": Path("/far/photos")},
    }
    table = module._written(said, tmp_path / "t.csv")
    with table.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    scan = str(tmp_path / "hall, old.e57")
    first = {"name": "hall", "scan": scan, "wall.gsd_m": "0.005", "wall.name": '"a"', "photos": ""}
    second = dict.fromkeys(first, "") | {"name": "yard", "photos": "/far/photos"}
    assert rows == [first, second]


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
