"""The title block of a sheet, and what is wrong with one."""

from __future__ import annotations

from pathlib import Path

import pytest

from orthoflow.errors import InputError
from orthoflow.files.drawings.sheet_contents import TitleBlock, read_title_block


def read(folder: Path, text: str) -> TitleBlock:
    path = folder / "block.yaml"
    path.write_text(text, encoding="utf-8")
    return read_title_block(path)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("projct: a\n", "block.yaml:1:1: projct: unknown key projct (did you mean project?)"),
        ("a: 1\nzzz: b\n", "block.yaml:1:1: a: unknown key a; known here: layout, lo"),
        ("title: [1]\n", "block.yaml:1:8: title: input should be a text, got a list"),
        ("title:\n", "title: input should be a text, got nothing"),
        ("- a\n", "block.yaml:1:1: expected the keys layout, logo"),
        ("", "the document is empty"),
        ("title: a\ntitle: b\n", "the key is there already, in line 1; remove one of them"),
        (f"note: {'a' * 301}\n", "note: has 301 letters, at most 300 fit on a sheet"),
        ("layout: middle\n", "block.yaml:1:9: layout: input should be 'column' or 'strip', got"),
        ("fields: [1]\n", "block.yaml:1:9: fields: input should be a mapping, got a list"),
        (
            "title: a\nrevisions:\n  - {by: A}\n",
            ":3:5: revisions[0].mark: mark is missing",
        ),
        (
            "revisions: [{mark: A, texts: b}]\n",
            "block.yaml:1:23: revisions[0].texts: unknown key texts (did you mean text?)",
        ),
        ("logo: none.png\n", "none.png cannot be read: No such file"),
        ("logo: block.yaml\n", "block.yaml is not a JPEG, PNG, TIFF"),
        ("title: [", "block.yaml:"),
        ("a" * 100_001, "block.yaml has 100001 bytes, a title block (YAML) at most 100000"),
    ],
)
def test_what_is_wrong_is_said_in_one_sentence(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(InputError) as caught:
        read(tmp_path, text)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_files_that_are_none_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"missing.yaml cannot be read: No such file"):
        read_title_block(tmp_path / "missing.yaml")
    (tmp_path / "latin.yaml").write_bytes(b"title: \xe9\n")
    with pytest.raises(InputError, match="is not UTF-8 text"):
        read_title_block(tmp_path / "latin.yaml")
