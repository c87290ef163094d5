"""Texts of strangers as one line, names that tables can have, and paths that can be kept."""

from __future__ import annotations

from pathlib import Path

from orthoflow.sdk.lines import one_line, text_of_path


def test_what_cannot_say_anything_is_told_by_its_kind() -> None:
    class MuteError(Exception):
        def __str__(self) -> str:
            raise RuntimeError

    assert one_line(MuteError()) == "a MuteError without a message"


def test_a_path_is_kept_where_others_can_read_it() -> None:
    assert text_of_path(Path("a/ä.laz")) == str(Path("a/ä.laz"))
    assert text_of_path(Path("a/\udcff.laz")) is None
