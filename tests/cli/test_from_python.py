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


def test_what_the_function_takes_is_not_refused() -> None:
    known = ("jobs", "executor", "only", "from_", "until", "force", "set_files", "embed", "store")
    module._refuse_unknown(dict.fromkeys(known, 1))
    module._refuse_unknown({})
    with pytest.raises(ArgumentError, match=r"takes no option; it takes "):
        module._refuse_unknown({"jobs": 1, "option": 2})
    with pytest.raises(ArgumentError, match=r"takes no options \(did you|takes no options; it"):
        module._refuse_unknown({"options": 2})


def test_one_or_several_paths_are_a_tuple_of_texts() -> None:
    assert module._several("a b", "inputs") == ("a b",)
    assert module._several(Path("a/b"), "inputs") == ("a/b",)
    assert module._several(["a", Path("b")], "inputs") == ("a", "b")
    assert module._several((path for path in [Path("a")]), "inputs") == ("a",)
    assert module._several((), "inputs") == ()


def test_arrays_and_paths_are_what_a_workflow_would_say() -> None:
    swept = {"sweep": np.array([0.25, 0.5]), "ranks": [np.int64(3)], "file": Path("a/b")}
    assert module._spelt(module._as_json(swept, "set")) == (
        '{"sweep": [0.25, 0.5], "ranks": [3], "file": "a/b"}'
    )


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (
            {"set": ["a.b=1"]},
            r"set must be a mapping of step\.parameter to a value, .*, got \['a\.b=1'\]",
        ),
        ({"set": {"a.b": object}}, r"set\['a\.b'\] must be a path, a text, a number, a list or"),
        ({"inputs": "x.e57"}, "inputs must be a mapping of the name of an input .*, got 'x.e57'"),
        ({"inputs": {"scan": 5}}, r"inputs\['scan'\] must be a path or a list of paths, got 5"),
        ({"set_files": {"a": 1}}, "set_files must be a path or a list of paths, got {'a': 1}"),
        ({"datasets": ["a"]}, r"datasets must be the path of a CSV file, or a mapping .* \['a'\]"),
        ({"datasets": np.zeros((9, 9))}, "datasets must be .*, got an object of class ndarray"),
        ({"only_data": 5}, "only_data must be the name of a dataset or a list of them, got 5"),
        ({"jobs": "two"}, "jobs must be a whole number, got 'two'"),
        ({"jobs": True}, "jobs must be a whole number, got True"),
        ({"force": True}, "force must be the name of a step or a list of them, got True"),
        ({"embed": "no"}, "embed must be True or False, got 'no'"),
        ({"output": 5}, "output must be a path, got 5"),
        ({"store": None}, "store must be a path, got None"),
        (
            {"workflow": ["a"]},
            r"workflow must be a file, or the name of a shipped workflow, got \['a'\]",
        ),
    ],
)
def test_an_argument_of_another_form_is_refused_in_a_sentence(
    given: dict[str, Any], said: str
) -> None:
    with pytest.raises(ArgumentError, match=said):
        module.run(**{"workflow": "nothing.yaml", **given})


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
    assert record.overrides == (
        "--set paint.grey=7",
        "--input number=n.txt",
        "--only survey",
    )
    assert [(cell.address, cell.status) for cell in record.cells] == [("survey", "ok")]
    assert [file.name for entry in record.inputs for file in entry.files] == ["n.txt"]
    assert (studio.folder / "r" / "run.h5").is_file()
