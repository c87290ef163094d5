"""The listing of public data is what the tests use, and fetching keeps only what is the same."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest

from benchmarks import fetch_real_data
from benchmarks.fetch_real_data import LISTING, ROOT, fetch


def test_the_listing_has_the_checksums_of_the_data(shared_data: Path) -> None:
    def refuse(url: str) -> bytes:
        raise OSError(url)

    assert fetch(shared_data, refuse) == []


def test_only_what_has_its_checksum_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = {
        "a/good.txt": {"source": "x y/good.txt", "sha256": hashlib.sha256(b"good").hexdigest()},
        "bad.txt": {"source": "bad.txt", "sha256": hashlib.sha256(b"other").hexdigest()},
        "gone.txt": {"source": "gone.txt", "sha256": "0" * 64},
    }
    listing = tmp_path / "listing.json"
    item = {"repository": "one/two", "commit": "abc", "licence": "MIT", "files": files}
    listing.write_text(json.dumps({"scan": item}))
    monkeypatch.setattr(fetch_real_data, "LISTING", listing)
    asked: list[str] = []

    def get(url: str) -> bytes:
        asked.append(url.removeprefix("https://raw.githubusercontent.com/one/two/abc/"))
        if url.endswith("gone.txt"):
            raise OSError("404")
        return b"good"

    problems = fetch(tmp_path / "data", get)
    assert [problem.rpartition(": ")[2] for problem in problems] == [
        "its content is not what was published",
        "404",
    ]
    assert (tmp_path / "data/scan/a/good.txt").read_bytes() == b"good"
    assert not (tmp_path / "data/scan/bad.txt").exists()
    assert asked == ["x%20y/good.txt", "bad.txt", "gone.txt"]
    # What is there is not fetched again.
    fetch(tmp_path / "data", get)
    assert asked[3:] == ["bad.txt", "gone.txt"]


def test_the_document_names_every_set_with_source_and_licence() -> None:
    text = (ROOT / "docs" / "real-data.md").read_text("utf-8")
    for name, item in json.loads(LISTING.read_text("utf-8")).items():
        (row,) = [line for line in text.splitlines() if line.startswith(f"| `{name}`")]
        assert f"github.com/{item['repository']}/tree/{item['commit']}" in row
        assert item["licence"] in row
