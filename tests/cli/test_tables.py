"""Plain text on the terminal: columns and quantities."""

from __future__ import annotations

import json

import pytest

from orthoflow.cli import tables


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
