"""Texts of strangers as one line, names that tables can have, and paths that can be kept."""

from __future__ import annotations

from pathlib import Path

import pytest

from orthoflow.sdk.lines import is_name, one_line, text_of_path


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("no\n  plane\tat all ", "no plane at all"),
        (5, "5"),
        ("\x1b[31m", "\\x1b[31m"),
        ("a" * 2000, "a" * 2000),
        ("a" * 2001, "a" * 2000 + "... (2001 characters)"),
    ],
    ids=["blanks", "number", "escape", "long", "too long"],
)
def test_a_line_has_two_thousand_letters(text: object, line: str) -> None:
    assert one_line(text) == line


def test_a_line_that_is_cut_says_how_long_it_was() -> None:
    assert one_line("far too long", 8) == "far too ... (12 characters)"
    assert one_line("just fits", 9) == "just fits"
    # Blanks that are taken out make no room for what comes later.
    assert one_line("a         b", 4) == "a... (11 characters)"


def test_what_cannot_say_anything_is_told_by_its_kind() -> None:
    class MuteError(Exception):
        def __str__(self) -> str:
            raise RuntimeError

    assert one_line(MuteError()) == "a MuteError without words"


@pytest.mark.parametrize(
    ("name", "of_file", "of_unit"),
    [
        ("rms_mm", True, True),
        ("m/s", False, True),
        (".", False, True),
        ("..", False, True),
        ("a..b", True, True),
        ("", False, False),
        ("a\nb", False, False),
        (5, False, False),
        ("n" * 200, True, True),
        ("n" * 201, False, False),
        # Of two bytes each.
        ("ä" * 100, True, True),
        ("ä" * 101, False, False),
    ],
)
def test_names_are_printable_and_short(name: object, of_file: bool, of_unit: bool) -> None:
    assert is_name(name) is of_file
    assert is_name(name, also_of_file=False) is of_unit


def test_a_path_is_kept_where_others_can_read_it() -> None:
    assert text_of_path(Path("a/ä.laz")) == str(Path("a/ä.laz"))
    assert text_of_path(Path("a/\udcff.laz")) is None
