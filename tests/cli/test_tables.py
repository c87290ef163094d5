"""Plain text on the terminal: columns, quantities in words, and how far products lie apart."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import pytest

from orthoflow.cli import tables


@pytest.mark.parametrize(
    ("seconds", "said"),
    [
        (0.996, "1.00 s"),
        (61.0, "1 min 01 s"),
        (3599.0, "59 min 59 s"),
        (7380.0, "2 h 03 min"),
        (0.0, "< 0.01 s"),
        (0.0099, "< 0.01 s"),
        (0.01, "0.01 s"),
        (0.994, "0.99 s"),
        (1.0, "1.0 s"),
        (59.94, "59.9 s"),
        (59.95, "1 min 00 s"),
        (119.6, "2 min 00 s"),
        (3599.4, "59 min 59 s"),
        (3599.5, "1 h 00 min"),
        (3629.0, "1 h 00 min"),
        (3631.0, "1 h 01 min"),
        (90_000.0, "25 h 00 min"),
    ],
)
def test_times_are_said_as_people_do(seconds: float, said: str) -> None:
    assert tables.duration(seconds) == said


@pytest.mark.parametrize(
    ("n_bytes", "said"),
    [
        (1.5 * 1024**3, "1.5 GiB"),
        (1024**4, "1.0 TiB"),
        (4096 * 1024**4, "4096.0 TiB"),
        (0, "0 B"),
        (1023, "1023 B"),
        (1024, "1.0 KiB"),
        (1536, "1.5 KiB"),
        (1024**2, "1.0 MiB"),
        (1024**3 - 1, "1024.0 MiB"),
        (1024**3, "1.0 GiB"),
        (3 * 1024**4, "3.0 TiB"),
        (3000 * 1024**4, "3000.0 TiB"),
    ],
)
def test_bytes_are_said_in_binary_units(n_bytes: float, said: str) -> None:
    assert tables.size(n_bytes) == said


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (-0.5, "-0.5"),
        (float("nan"), "nan"),
        (0.0, "0"),
        (999_999_999_999_999.0, "999999999999999"),
        (1e15, "1e+15"),
        (1234567.5, "1.23457e+06"),
        (-0.125, "-0.125"),
    ],
)
def test_counts_are_said_to_the_last_digit(value: float, said: str) -> None:
    assert tables.number(value) == said


@pytest.mark.parametrize(("count", "said"), [(0, "0 cells"), (1, "1 cell"), (2, "2 cells")])
def test_one_is_one(count: int, said: str) -> None:
    assert tables.counted(count, "cell") == said


def test_columns_are_as_wide_as_their_widest_text() -> None:
    lines = tables.table_lines(
        ("a", "long name", "c"), [("wide text", "b", ""), ("", "", "\x1b[1m")]
    )
    assert lines == [
        "a          long name  c",
        "wide text  b",
        "                      \\x1b[1m",
    ]


def test_a_table_without_rows_has_no_header(capsys: pytest.CaptureFixture[str]) -> None:
    tables.echo_table(("a", "b"), [])
    assert capsys.readouterr().out == ""
    tables.echo_table(("a", "b"), [("1", "2")])
    assert capsys.readouterr().out == "a  b\n1  2\n"


def test_what_a_terminal_would_obey_is_written_out(capsys: pytest.CaptureFixture[str]) -> None:
    tables.echo("\x1b[31mred", "plain")
    tables.echo("told", err=True)
    tables.echo()
    said = capsys.readouterr()
    assert (said.out, said.err) == ("\\x1b[31mred\nplain\n\n", "told\n")
    tables.echo_json({"name": "w\N{LATIN SMALL LETTER A WITH DIAERESIS}nde\x9b", "n": 1})
    printed = capsys.readouterr().out
    assert json.loads(printed) == {
        "name": "w\N{LATIN SMALL LETTER A WITH DIAERESIS}nde\x9b",
        "n": 1,
    }
    assert "\N{LATIN SMALL LETTER A WITH DIAERESIS}" in printed
    assert "\x9b" not in printed


def test_lines_fold_at_words_and_long_words_stay_whole() -> None:
    assert tables.folded("one two-three four", 10) == ["one", "  two-three", "  four"]
    assert tables.folded("a " + "b" * 20, 10) == ["a", "  " + "b" * 20]


def test_sentences_fold_on_terminals_only(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "12")
    tables.echo_folded("one two three four")
    assert capsys.readouterr().out == "one two three four\n"
    monkeypatch.setattr(tables.sys.stdout, "isatty", lambda: True)
    tables.echo_folded("one two three four")
    assert capsys.readouterr().out == "one two\n  three four\n"


def product(verdict: str, *distances: Any, reason: str = "") -> Any:
    return SimpleNamespace(
        cell="wall",
        port="walls",
        type_name="walls",
        verdict=verdict,
        reason=reason,
        distances=distances,
    )


def apart(field: str, largest: float | None, unit: str) -> Any:
    return SimpleNamespace(field=field, largest=largest, unit=unit)


def test_products_are_counted_by_their_verdict() -> None:
    given = [product("different"), product("identical"), product("identical")]
    assert tables.verdict_counts(given) == "3 products: 2 identical, 1 different"
    assert tables.verdict_counts(given[:1]) == "1 product: 1 different"


def test_distances_of_products_are_said_with_their_units(
    capsys: pytest.CaptureFixture[str],
) -> None:
    tables.echo_distances(
        [
            product("identical"),
            product(
                "different",
                apart("rgb", 3.0, "grey"),
                apart("count", 2.0, "1"),
                apart("depth_m", 0.0125, "m"),
                apart("mask", None, "1"),
                reason="another shape",
            ),
        ]
    )
    lines = capsys.readouterr().out.splitlines()
    assert lines.pop(2) == (
        "wall.walls  walls  different  3 grey levels (rgb), 2 (count), 0.0125 m (depth_m), "
        "not comparable (mask)"
    )
    assert lines == [
        "product     type   verdict    largest differences",
        "wall.walls  walls  identical",
        "wall.walls different: another shape",
        "2 products: 1 identical, 1 different",
    ]
