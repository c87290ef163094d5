"""The log of a step: its end is kept, what came before is counted, and nothing grows for ever."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from orthoflow.engine.local import StepLog
from orthoflow.errors import StoreError

KEPT = 256 << 10
LARGEST = 8 << 20


@pytest.fixture
def log(tmp_path: Path) -> Iterator[StepLog]:
    log = StepLog(tmp_path / "step.log")
    yield log
    log.close()


def append(log: StepLog, content: bytes) -> None:
    """As the process of a step does."""
    with log.path.open("ab") as file:
        file.write(content)


def size_of(log: StepLog) -> int:
    return log.path.stat().st_size


def test_a_short_log_is_kept_whole(log: StepLog) -> None:
    append(log, b"first\n")
    append(log, "gr\N{LATIN SMALL LETTER U WITH DIAERESIS}n\0 \xff".encode())
    append(log, b"\xff")
    assert (
        log.text()
        == "first\ngr\N{LATIN SMALL LETTER U WITH DIAERESIS}n \xff\N{REPLACEMENT CHARACTER}"
    )


def test_of_a_long_log_the_end_is_told_and_the_rest_is_counted(log: StepLog) -> None:
    append(log, b"a" * 1000 + b"b" * KEPT)
    assert log.text() == "... (1000 bytes before)\n" + "b" * KEPT
    # Telling it changes nothing.
    assert size_of(log) == KEPT + 1000


def test_a_log_is_shortened_only_beyond_eight_megabytes(log: StepLog) -> None:
    append(log, b"a" * LARGEST)
    log.shorten()
    assert size_of(log) == LARGEST
    append(log, b"b")
    log.shorten()
    notice = f"... ({LARGEST + 1 - KEPT} bytes before)\n"
    assert size_of(log) == KEPT + len(notice)
    assert log.text() == f"... ({LARGEST + 1 - KEPT} bytes before)\n" + "a" * (KEPT - 1) + "b"


def test_a_log_that_was_shortened_goes_on_and_counts_on(log: StepLog) -> None:
    append(log, b"a" * (LARGEST + 1))
    log.shorten()
    append(log, b"end")
    n_before = LARGEST + 4 - KEPT
    assert log.text() == f"... ({n_before} bytes before)\n" + "a" * (KEPT - 3) + "end"
    # Its own notice is nothing that the step said.
    append(log, b"c" * LARGEST)
    log.shorten()
    assert log.text().startswith(f"... ({2 * LARGEST + 4 - KEPT} bytes before)\nccc")
    append(log, b"d" * (LARGEST + 1))
    log.shorten()
    assert log.text().startswith(f"... ({3 * LARGEST + 5 - KEPT} bytes before)\nddd")


def test_an_older_log_is_emptied_and_nothing_is_written_through_a_link(tmp_path: Path) -> None:
    path, link = tmp_path / "a.log", tmp_path / "link.log"
    path.write_text("before", encoding="utf-8")
    link.symlink_to(path)
    with pytest.raises(StoreError, match="cannot write to"):
        StepLog(link)
    assert path.read_text(encoding="utf-8") == "before"
    log = StepLog(path)
    assert log.text() == ""
    log.close()
    assert path.read_bytes() == b""
