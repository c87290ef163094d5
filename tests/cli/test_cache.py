"""`orthoflow cache verify` and a run report what was damaged in the store."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.engine_world import toy_world
from tests.killed_runs import run_here

WORKFLOW = """
orthoflow: 1
name: toy
seed: 7
steps:
  range: {use: make.range}
  dots: {use: work.draws, in: {numbers: range.numbers}}
"""
RUN = ("run", "toy.yaml", "--executor", "inline", "-o")

Said = Callable[..., tuple[int, str]]


@pytest.fixture
def say(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Iterator[Said]:
    """Run a command in a folder with the toys; give its exit code and what it printed."""

    def said(*arguments: str) -> tuple[int, str]:
        capsys.readouterr()
        code = run_here(arguments)
        printed = capsys.readouterr()
        return code, printed.err + printed.out

    (tmp_path / "toy.yaml").write_text(WORKFLOW)
    monkeypatch.chdir(tmp_path)
    with toy_world(tmp_path):
        yield said


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def test_the_store_is_listed_verified_and_collected(say: Said, tmp_path: Path) -> None:
    as_stored = "0 results and 0 objects in .orthoflow are unchanged\n"
    assert say("cache", "verify") == (0, as_stored)
    assert say(*RUN, "first")[0] == 0
    assert say("cache", "verify") == (0, as_stored.replace("0", "2"))
    assert {row["method"] for row in json.loads(say("cache", "list", "--json")[1])} == {
        "make.range",
        "work.draws",
    }
    assert say("cache", "list")[1].splitlines()[-1] == "2 results in .orthoflow"
    [figure] = (tmp_path / ".orthoflow" / "objects").glob("*/blob")
    name = figure.parent.name
    flip(figure)
    code, text = say("cache", "verify", "--json")
    found = json.loads(text)
    assert (code, found["ok"], found["n_results"], found["n_objects"]) == (3, False, 1, 1)
    assert [item["what"] for item in found["damaged"]] == [
        "blob",
        f"objects/{name[:12]}/object.json",
    ]
    assert found["damaged"][0]["name"] == f"objects/{name}"
    assert not figure.exists()
    assert say("cache", "verify")[0] == 0
    assert say(*RUN, "again")[0] == 0
    # What is young is kept, and a rehearsal removes nothing.
    assert json.loads(say("cache", "gc", "--json")[1])["n_results"] == 0
    would = say("cache", "gc", "--older-than", "0", "--dry-run")[1]
    assert would.startswith("would remove 2 results and 2 objects, ")
    assert say("cache", "gc", "--older-than", "0")[0] == 0
    assert json.loads(say("cache", "list", "--json")[1]) == []
