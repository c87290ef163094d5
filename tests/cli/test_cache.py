"""`orthoflow cache` lists, verifies and collects what is in the store."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.engine_world import toy_world
from tests.studios import asked, said

WORKFLOW = """
orthoflow: 1
name: toy
seed: 7
steps:
  range: {use: make.range}
  dots: {use: work.draws, in: {numbers: range.numbers}}
"""
RUN = ("run", "toy.yaml", "--executor", "inline", "-o")


@pytest.fixture(autouse=True)
def _toys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The working directory, with the toys and their workflow."""
    (tmp_path / "toy.yaml").write_text(WORKFLOW)
    monkeypatch.chdir(tmp_path)
    with toy_world(tmp_path):
        yield


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def test_the_store_is_listed_verified_and_collected(tmp_path: Path) -> None:
    as_stored = "0 results and 0 objects in .orthoflow are unchanged\n"
    assert said("cache", "verify") == as_stored
    asked(*RUN, "first", code=0)
    assert said("cache", "verify") == as_stored.replace("0", "2")
    listed = json.loads(said("cache", "list", "--json"))
    assert {row["method"] for row in listed} == {"make.range", "work.draws"}
    assert said("cache", "list").splitlines()[-1] == "2 results in .orthoflow"
    [figure] = (tmp_path / ".orthoflow" / "objects").glob("*/blob")
    name = figure.parent.name
    flip(figure)
    found = json.loads(asked("cache", "verify", "--json", code=3).stdout)
    assert (found["ok"], found["n_results"], found["n_objects"]) == (False, 1, 1)
    assert [item["what"] for item in found["damaged"]] == [
        "blob",
        f"objects/{name[:12]}/object.json",
    ]
    assert found["damaged"][0]["name"] == f"objects/{name}"
    assert not figure.exists()
    asked("cache", "verify", code=0)
    asked(*RUN, "again", code=0)
    # What is young is kept, and a rehearsal removes nothing.
    assert json.loads(said("cache", "gc", "--json"))["n_results"] == 0
    would = said("cache", "gc", "--older-than", "0", "--dry-run")
    assert would.startswith("would remove 2 results and 2 objects, ")
    asked("cache", "gc", "--older-than", "0", code=0)
    assert json.loads(said("cache", "list", "--json")) == []
