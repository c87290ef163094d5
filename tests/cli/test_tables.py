"""Plain text on the terminal: columns and quantities."""

from __future__ import annotations

import json

import pytest

from orthoflow.cli import tables


def test_quantities_are_written_as_people_do() -> None:
    times = (0.0, 0.0099, 0.01, 0.994, 0.996, 1.0, 59.94, 59.95, 119.6, 3599.4, 3599.5, 90_000.0)
    assert [tables.duration(seconds) for seconds in times] == [
        *("< 0.01 s", "< 0.01 s", "0.01 s", "0.99 s", "1.00 s", "1.0 s", "59.9 s", "1 min 00 s"),
        *("2 min 00 s", "59 min 59 s", "1 h 00 min", "25 h 00 min"),
    ]
    sizes = (0, 1023, 1024, 1536, 1024**2, 1024**3 - 1, 1024**3, 1024**4, 3000 * 1024**4)
    assert [tables.size(n_bytes) for n_bytes in sizes] == [
        *("0 B", "1023 B", "1.0 KiB", "1.5 KiB", "1.0 MiB", "1024.0 MiB", "1.0 GiB", "1.0 TiB"),
        "3000.0 TiB",
    ]
    values = (-0.5, float("nan"), 0.0, 999_999_999_999_999.0, 1e15, 1234567.5)
    assert [tables.number(value) for value in values] == [
        *("-0.5", "nan", "0", "999999999999999", "1e+15", "1.23457e+06"),
    ]
    assert [tables.counted(n, "cell") for n in (0, 1, 2)] == ["0 cells", "1 cell", "2 cells"]


def test_columns_are_as_wide_as_their_widest_text(capsys: pytest.CaptureFixture[str]) -> None:
    tables.echo_table(("a", "long name", "c"), [("wide text", "b", ""), ("", "", "\x1b[1m")])
    assert capsys.readouterr().out.splitlines() == [
        "a          long name  c",
        "wide text  b",
        "                      \\x1b[1m",
    ]
    tables.echo_table(("a", "b"), [])
    assert capsys.readouterr().out == ""


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
