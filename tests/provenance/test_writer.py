"""What a record says of folders: nothing, whichever way a path is written."""

from __future__ import annotations

from pathlib import Path

import pytest
from orthoflow_provenance.writer import without_folders


@pytest.mark.parametrize(
    ("folders", "text", "said"),
    [
        # The longest first: of a folder within another nothing is left.
        (("/srv/old scans", "/srv/old scans/of may"), "in /srv/old scans/of may/a.las", "in a.las"),
        (("/srv/old scans",), "in /srv/old scans/of may/a.las", "in of may/a.las"),
        # The root is part of every path, and of much that is none.
        (("/",), "from https://example.org", "from https://example.org"),
        ((), "in /srv/scans/a.las", "in a.las"),
    ],
)
def test_folders_are_taken_out_of_texts(folders: tuple[str, ...], text: str, said: str) -> None:
    assert without_folders(text, [Path(folder) for folder in folders]) == said


def test_the_home_and_the_working_directory_are_taken_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    home, work = tmp_path / "jane doe", tmp_path / "my work"
    home.mkdir()
    work.mkdir()
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.chdir(work)
    assert without_folders(f"{home}/a b.las and {work}/c.las") == "a b.las and c.las"

    def nowhere() -> Path:
        raise RuntimeError

    monkeypatch.setattr(Path, "home", nowhere)
    assert without_folders(f"{work}/c.las") == "c.las"
