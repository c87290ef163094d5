"""How long names, sentences and values may be that the engine keeps and shows, from both sides."""

from __future__ import annotations

import os
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from orthoflow.engine import cleaning, worker
from orthoflow.engine import plan as planning
from orthoflow.engine.file_digests import FileDigests
from orthoflow.engine.journal import cell_file_name
from orthoflow.engine.store import Failures


def test_a_file_is_called_after_its_cell_in_two_hundred_bytes() -> None:
    longest = "a" * 200
    assert cell_file_name(longest) == longest
    for address in ("a" * 201, "ä" * 101, "é" * 150 + "x"):
        name = cell_file_name(address)
        assert len(name.encode()) <= 200
        # As much of it as there is room for, and what tells it from others that begin alike.
        begin, _, digest = name.rpartition("-")
        assert address.startswith(begin)
        assert len(begin.encode()) >= 186
        assert len(digest) == 12
        assert cell_file_name(address + "b") != name


def test_a_cells_sentence_is_remembered_in_four_hundred_letters(tmp_path: Path) -> None:
    failures = Failures.of_store(tmp_path)
    failures.remember("a", "x" * 400)
    failures.remember("b", "x" * 401)
    assert failures.sentence("a") == "x" * 400
    assert failures.sentence("b") == f"{'x' * 400}... (401 characters)"
    failures.forget("a")
    assert failures.sentence("a") == ""


def test_of_a_traceback_the_last_64_kilobytes_are_kept() -> None:
    text = worker._trace(ValueError("b" + "x" * 70_000))
    assert len(text) == 65_536
    assert text.endswith("x\n")
    short = worker._trace(ValueError("b" + "x" * 60_000))
    assert short == f"ValueError: b{'x' * 60_000}\n"


def ingredients(**values: str) -> dict[str, str]:
    return {f"params.{name}": value for name, value in values.items()}


def test_values_that_changed_are_shown_in_forty_letters() -> None:
    fits, longer = '"' + "x" * 38 + '"', '"' + "x" * 39 + '"'
    told = planning._sentence("params.a", ingredients(a=fits), ingredients(a=longer))
    assert told == f"params.a: {fits} -> {longer[:37]}..."
    assert len(told.partition(" -> ")[2]) == 40


@pytest.mark.parametrize(("age_s", "is_kept"), [(1.5, False), (2.5, True)])
def test_a_digest_is_kept_of_a_file_that_rests_for_two_seconds(
    tmp_path: Path, age_s: float, is_kept: bool
) -> None:
    path, memo = tmp_path / "scan.laz", tmp_path / "digests.json"
    path.write_bytes(b"points")
    moment = time.time() - age_s
    os.utime(path, (moment, moment))
    digests = FileDigests(memo)
    digests.digest(path)
    digests.save()
    assert memo.exists() is is_kept


@pytest.mark.parametrize(("days", "is_old"), [(6.99, False), (7.01, True)])
def test_results_are_old_after_so_many_days_of_24_hours(
    tmp_path: Path, days: float, is_old: bool
) -> None:
    (tmp_path / "k.json").touch()
    moment = time.time() - days * 86_400
    os.utime(tmp_path / "k.json", (moment, moment))
    store: Any = SimpleNamespace(results=tmp_path, result=lambda _key: "a result")
    assert list(cleaning._useless_results(store, 7.0)) == ([tmp_path / "k.json"] if is_old else [])
    assert list(cleaning._useless_results(store, None)) == []
    lost: Any = SimpleNamespace(results=tmp_path, result=lambda _key: None)
    assert list(cleaning._useless_results(lost, None)) == [tmp_path / "k.json"]
