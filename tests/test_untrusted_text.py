"""What strangers call things is shown as it is, and neither obeyed nor turned round."""

from __future__ import annotations

import csv
import io
import json
import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st

from orthoflow.untrusted_text import csv_text, shown, shown_json

ANY = st.text(
    st.characters() | st.sampled_from("\x1b\x9b\u202e\u2066\u200f\u2028\ud800=+-@\t\r\n'")
)
DANGEROUS = {
    "\x1b[31m": "\\x1b[31m",
    "\x9b31m": "\\x9b31m",
    "\x7f": "\\x7f",
    "\0\a\b\r\n": "\\x00\\x07\\x08\\r\\n",
    "a\u202egnp.exe": "a\\u202egnp.exe",
    "\u200e\u200f\u061c": "\\u200e\\u200f\\u061c",
    "\u202a\u202b\u202c\u202d": "\\u202a\\u202b\\u202c\\u202d",
    "\u2066\u2067\u2068\u2069": "\\u2066\\u2067\\u2068\\u2069",
    "\u2028\u2029": "\\u2028\\u2029",
    "\ud800": "\\ud800",
    "\U000e0041\ufeff": "\\U000e0041\\ufeff",
}


@pytest.mark.parametrize("text", DANGEROUS, ids=ascii)
def test_what_a_terminal_obeys_or_readers_cannot_see_is_written_out(text: str) -> None:
    assert shown(text) == DANGEROUS[text]


@pytest.mark.parametrize(
    "text", ["Saal 12", "żółć", "שלום", "\u06a9\u200c\u0647", "👩‍🚒", "a\u00a0b", "漢字"]
)
def test_writing_of_all_the_world_stays_as_it_is(text: str) -> None:
    assert shown(text) == text


@given(ANY)
def test_nothing_shown_has_a_letter_that_is_obeyed(text: str) -> None:
    said = shown(text)
    assert not {unicodedata.category(letter) for letter in said} & {"Cc", "Cs", "Zl", "Zp"}
    said.encode("utf-8")
    assert shown(said) == said
    assert "\n" in shown("one\ntwo", keep="\n")


@given(st.dictionaries(ANY, ANY, max_size=3))
def test_json_stays_the_same_json(value: dict[str, str]) -> None:
    text = shown_json(json.dumps(value, ensure_ascii=False, indent=1))
    assert json.loads(text) == value
    text.encode("utf-8")
    assert shown(text, keep="\n") == text


@pytest.mark.parametrize(
    ("letters", "written"),
    [
        ("a\nb", "a\nb"),
        ("\x9b\u202e", "\\u009b\\u202e"),
        # JSON has letters beyond the first 65,536 as two halves.
        ("\U000e0041", "\\udb40\\udc41"),
        ("\ud800", "\\ud800"),
    ],
    ids=ascii,
)
def test_json_has_what_readers_cannot_see_in_its_own_escapes(letters: str, written: str) -> None:
    assert shown_json(letters) == written


@given(
    st.lists(
        st.lists(
            st.text(st.characters(exclude_categories=["Cs"]) | st.sampled_from(";,\t|\"'= +-@\n"))
            | st.integers()
            | st.floats(allow_nan=False),
            min_size=1,
        ),
        min_size=1,
    )
)
@pytest.mark.parametrize("separator", [",", ";", "\t", "|"])
@pytest.mark.parametrize("strips", [False, True])
def test_no_reader_finds_a_formula(
    separator: str, strips: bool, rows: list[list[str | int | float]]
) -> None:
    text = csv_text(rows)
    read = csv.reader(io.StringIO(text, newline=""), delimiter=separator, skipinitialspace=strips)
    for cell in (cell for row in read for cell in row):
        if (cell.strip() if strips else cell)[:1] in tuple("=+-@"):
            # What stands behind a number begins no cell of its own in the table as it was written.
            float(cell.strip().strip("\"'").split(",")[0].strip("\"' "))


@given(
    st.lists(
        st.lists(
            st.text(st.characters(exclude_categories=["Cs"])) | st.floats(allow_nan=False),
            min_size=1,
        ),
        min_size=1,
    )
)
def test_cells_come_back(rows: list[list[str | float]]) -> None:
    read = list(csv.reader(io.StringIO(csv_text(rows), newline="")))
    assert [len(row) for row in read] == [len(row) for row in rows]
    for cells, row in zip(read, rows, strict=True):
        for cell, value in zip(cells, row, strict=True):
            if isinstance(value, float):
                assert float(cell) == value
            elif not set(value) & set(",;|\t\r\n"):
                assert cell.removeprefix("'") == value


@pytest.mark.parametrize(
    ("cell", "written"),
    [
        ("=HYPERLINK(1)", '"\'=HYPERLINK(1)"'),
        ("-2+3", '"\'-2+3"'),
        ("\t=1", "\"'\t'=1\""),
        ("\uff1d1", '"\'\uff1d1"'),
        ("'quoted", "\"''quoted\""),
        ("-1_000", '"\'-1_000"'),
        ("a;=1+1", '"a;\'=1+1"'),
        ('a\t"=1+1', '"a\t""\'=1+1"'),
        ("a, -3; b", '"a, -3; b"'),
        ("-1.5e-07", '"-1.5e-07"'),
        ("DSC-1.jpg", '"DSC-1.jpg"'),
        (-2.5, "-2.5"),
        (-7, "-7"),
        (None, ""),
        (float("-inf"), "-inf"),
    ],
)
def test_formulas_get_an_apostrophe_and_numbers_none(cell: str | float, written: str) -> None:
    assert csv_text([[cell, "x"]]) == f'{written},"x"\n'
