"""The journal of a run folder: what it keeps, who may go on with it, and what is refused."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from orthoflow.engine.journal import (
    JOURNAL,
    RECORD_FILE,
    Journal,
    is_running,
    kept_from_others,
    require_run_folder,
)
from orthoflow.errors import ArgumentError, StoreError

BUSY = "is in use by another run; wait until it has ended, or"


def ended(address: str) -> dict[str, str | bool]:
    return {"address": address, "key": f"key of {address}", "status": "ok", "cached": False}


def lines(folder: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in (folder / JOURNAL).read_text().splitlines()]


def test_a_run_folder_is_of_one_run_at_a_time(tmp_path: Path) -> None:
    assert is_running(tmp_path) is False
    with Journal(tmp_path / "run", "hall"):
        assert is_running(tmp_path / "run")
        for refused in (Journal, require_run_folder):
            with pytest.raises(ArgumentError, match=BUSY):
                refused(tmp_path / "run", "hall")
    assert not is_running(tmp_path / "run")
    require_run_folder(tmp_path / "run", "hall")
    with pytest.raises(ArgumentError, match="an unfinished run of hall, not of court; choose"):
        require_run_folder(tmp_path / "run", "court")


def test_nobody_goes_on_with_a_run_while_what_came_out_is_written(tmp_path: Path) -> None:
    with Journal(tmp_path / "run", "hall"):
        pass
    with kept_from_others(tmp_path / "run"):
        assert is_running(tmp_path / "run")
        with pytest.raises(ArgumentError, match=BUSY):
            Journal(tmp_path / "run", "hall")
    with Journal(tmp_path / "run", "hall") as journal:
        assert journal.is_resumed
        with pytest.raises(ArgumentError, match=BUSY), kept_from_others(tmp_path / "run"):
            pass
    # Of a folder without a journal there is nobody to keep out.
    with kept_from_others(tmp_path / "new"):
        assert not (tmp_path / "new").exists()


def test_a_line_that_was_cut_off_is_removed_and_a_damaged_one_is_told(tmp_path: Path) -> None:
    with Journal(tmp_path, "hall") as journal:
        journal.write("finished", **ended("a"))
    path = tmp_path / JOURNAL
    whole = path.read_bytes()
    path.write_bytes(whole + b'{"event": "finish')
    with Journal(tmp_path, "hall") as journal:
        assert journal.finished_keys == {"key of a"}
        journal.write("finished", **ended("b"))
    assert path.read_bytes().startswith(whole)
    assert [line["event"] for line in lines(tmp_path)] == [
        *("run", "finished", "resumed", "finished"),
    ]
    for damaged in (whole.replace(b"finished", b"vanished"), whole.partition(b"\n")[2]):
        path.write_bytes(damaged)
        with pytest.raises(StoreError, match=r"journal\.jsonl is damaged; remove .* or choose"):
            Journal(tmp_path, "hall")
        # It may be mended, and be opened then.
        assert not is_running(tmp_path)


def test_a_finished_run_is_not_continued(tmp_path: Path) -> None:
    with Journal(tmp_path, "hall", run_id="r1") as journal:
        journal.write("ended")
    (tmp_path / RECORD_FILE).write_text("the record")
    with pytest.raises(ArgumentError, match=r"contains a finished run \(run\.h5\); choose another"):
        Journal(tmp_path, "hall")
    assert (tmp_path / RECORD_FILE).read_text() == "the record"


def test_a_folder_of_something_else_is_refused_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / JOURNAL
    for make, reason in (
        ((tmp_path / "notes.txt").touch, "is not empty and contains no unfinished run; choose"),
        (lambda: path.symlink_to("elsewhere"), r"journal\.jsonl is a link or a pipe; choose"),
        (lambda: os.mkfifo(path), r"journal\.jsonl is a link or a pipe; choose"),
    ):
        make()
        (made,) = tmp_path.iterdir()
        with pytest.raises(ArgumentError, match=reason):
            Journal(tmp_path, "hall")
        assert list(tmp_path.iterdir()) == [made]
        made.unlink()
    # A record whose journal nobody can read is of a finished run.
    path.write_text("nothing\n")
    (tmp_path / RECORD_FILE).touch()
    with pytest.raises(ArgumentError, match="contains a finished run"):
        Journal(tmp_path, "hall")
