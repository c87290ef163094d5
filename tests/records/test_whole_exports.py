"""A record as tables and as a crate, to the last letter; and the order of published files."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from orthoflow.records.runs import Run, _by_number, published_files
from orthoflow.records.write import publish_products
from tests.provenance_records import sample_record

CLOUD, WALLS, ENVIRONMENT = "sha256:" + "c" * 64, "sha256:" + "d" * 64, "sha256:" + "e" * 64


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return Run(path=tmp_path / "run.h5", record=sample_record(CLOUD, WALLS))


def test_published_files_come_by_number(run: Run) -> None:
    store = run.folder / "store"
    store.mkdir()
    names = ("wall_10.tif", "wall_2.tif", "2.tif", "a.txt")
    for name in names:
        (store / name).write_text(name)
    first = {store / name: hashlib.sha256(name.encode()).hexdigest() for name in names}
    more = {store / names[0]: first[store / names[0]]}
    files = {"cloud": {"cloud": first, "more": more}, "ortho": {"x": first}}
    (run.folder / "products").mkdir()
    (run.folder / "products" / "old").touch()
    found = publish_products(run.folder, run.record.cells, files, "r")
    there = [path.name for path in published_files(run.folder, "cloud")]
    assert there == [
        *("2.tif", "a.txt", "metrics.csv", "more_wall_10.tif", "wall_2.tif", "wall_10.tif"),
    ]
    assert published_files(run.folder, "ortho") == ()
    assert [file.path for file in found] == sorted(file.path for file in found)
    assert {file.path for file in found} == {
        *(f"products/cloud/{name}" for name in there),
        "products/metrics.csv",
        "products/wall@plane=hough2d,orient=pnp#2/metrics.csv",
    }
    sizes = {file.path: file.size_bytes for file in found}
    assert sizes["products/cloud/wall_2.tif"] == len("wall_2.tif")
    assert _by_number("a2b10") == (("a", 2), ("b", 10), ("", 0))
