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
        ("title: [1]\n", "block.yaml:1:8: title: input should be text, got a list"),
        (f"note: {'a' * 301}\n", "note: has 301 characters; at most 300 fit on a sheet"),
        ("layout: middle\n", "block.yaml:1:9: layout: input should be 'column' or 'strip', got"),
        (
            "revisions: [{mark: A, texts: b}]\n",
            "block.yaml:1:23: revisions[0].texts: unknown key texts (did you mean text?)",
        ),
        ("logo: none.png\n", "cannot read none.png: No such file"),
        ("logo: block.yaml\n", "block.yaml is not a JPEG, PNG, TIFF"),
        (
            "a" * 100_001,
            "block.yaml has 100001 bytes, but a title block (YAML) may have at most 100000",
        ),
    ],
)
def test_what_is_wrong_is_said_in_one_sentence(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(InputError) as caught:
        read(tmp_path, text)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)
