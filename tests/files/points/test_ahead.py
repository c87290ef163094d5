"""Files read ahead by another process: the same blocks, notes and refusals, and no process left."""

from __future__ import annotations

from dataclasses import fields
from itertools import chain
from pathlib import Path

import numpy as np
import psutil
import pytest

from orthoflow.errors import InputError
from orthoflow.files.points import PointBlock, ScanFile, ahead, open_scan
from orthoflow.files.points.ahead import read_ahead
from orthoflow.files.points.columns import columns_of_text
from orthoflow.files.points.decoders import can_share_memory
from tests import scan_files
from tests.optional import skip_unless

READS_AHEAD = skip_unless(can_share_memory(), "right", "shared memory")


@pytest.fixture(autouse=True)
def read_small_files_ahead(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ahead, "_POINTS_LEAST", 1)


def ply(path: Path, count: int) -> Path:
    """A PLY file with colours."""
    rng = np.random.default_rng(count)
    values = {name: rng.normal(size=count).astype(np.float32) for name in "xyz"}
    colours = {name: rng.integers(0, 256, count, dtype=np.uint8) for name in ("red", "green")}
    return scan_files.write_ply(path, {**values, **colours, "blue": colours["red"]})


def e57(path: Path) -> Path:
    """Two scans with poses, a grid, an intensity, and points without a return."""
    rng = np.random.default_rng(1)
    scans = [
        {
            "fields": {
                **{f"cartesian{axis}": rng.normal(size=90) for axis in "XYZ"},
                "intensity": rng.random(90),
                "rowIndex": np.arange(90) // 9,
                "columnIndex": np.arange(90) % 9,
                "cartesianInvalidState": (np.arange(90) % 7 == 0).astype(np.int64),
            },
            "rotation": (0.8, 0.0, 0.0, 0.6),
            "translation": (10.0 * k, 2.0, 1.0),
        }
        for k in range(2)
    ]
    return scan_files.write_e57(path, scans)


def opened(paths: list[Path], columns: str | None = None) -> list[ScanFile]:
    known = None if columns is None else columns_of_text(columns)
    return [open_scan(path, known) for path in paths]


def blocks_of(file: ScanFile) -> list[dict[str, object]]:
    """Copies, since a block is another one when the next is asked for."""
    return [
        {
            field.name: np.array(value) if isinstance(value, np.ndarray) else value
            for field in fields(PointBlock)
            for value in [getattr(block, field.name)]
        }
        for block in file.read()
    ]


@READS_AHEAD
def test_blocks_and_notes_of_several_files_are_those_of_this_process(tmp_path: Path) -> None:
    text = tmp_path / "c.xyz"
    text.write_text("".join(f"{k} 2 3 0.5\n" for k in range(50)))
    laz = scan_files.write_las(tmp_path / "d.laz", np.random.default_rng(2).random((80, 3)))
    # The second has three blocks, one of which is read while another is used.
    paths = [e57(tmp_path / "a.e57"), ply(tmp_path / "b.ply", 1_100_000), text, laz]
    paths.append(ply(tmp_path / "e.ply", 30))
    plain = opened(paths, "x y z intensity")
    expected = [blocks_of(file) for file in plain]
    given = opened(paths, "x y z intensity")
    before = {child.pid for child in psutil.Process().children()}
    with read_ahead(given, paths, columns_of_text("x y z intensity"), cores=2) as files:
        assert len({child.pid for child in psutil.Process().children()} - before) == 1
        assert files[3] is given[3]
        found = [blocks_of(file) for file in files]
    assert {child.pid for child in psutil.Process().children()} == before
    assert [len(blocks) for blocks in found] == [2, 3, 1, 1, 1]
    pairs = zip(chain.from_iterable(found), chain.from_iterable(expected), strict=True)
    for one, other in pairs:
        for name, value in one.items():
            np.testing.assert_array_equal(value, other[name], err_msg=name)
            assert np.asarray(value).dtype == np.asarray(other[name]).dtype, name
    assert [file.notes for file in files] == [file.notes for file in plain]


def test_what_is_refused_is_refused_in_the_same_words(tmp_path: Path) -> None:
    good, cut = ply(tmp_path / "a.ply", 10), ply(tmp_path / "b.ply", 1000)
    files = opened([good, cut])
    cut.write_bytes(cut.read_bytes()[:-500])
    with pytest.raises(InputError) as plain:
        blocks_of(files[1])
    with read_ahead(files, [good, cut], None, cores=2) as read:
        assert len(blocks_of(read[0])) == 1
        with pytest.raises(InputError) as found:
            blocks_of(read[1])
    assert "cut off" in str(found.value)
    assert str(found.value) == str(plain.value)


def test_names_of_many_files_may_be_longer_than_an_argument(tmp_path: Path) -> None:
    folder = tmp_path / ("a" * 200) / ("b" * 200)
    folder.mkdir(parents=True)
    paths = [ply(folder / "0.ply", 3)]
    for k in range(1, 300):
        paths.append(folder / f"{k}.ply")
        paths[k].hardlink_to(paths[0])
    assert sum(len(str(path)) for path in paths) > 1 << 17
    with read_ahead([open_scan(paths[0])] * len(paths), paths, None, cores=2) as read:
        assert sum(len(block["points"]) for file in read for block in blocks_of(file)) == 900


@READS_AHEAD
def test_a_reader_that_dies_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    worker = tmp_path / "worker.py"
    worker.write_text("import os\nos.abort()\n")
    monkeypatch.setattr(ahead, "_WORKER", worker)
    path = ply(tmp_path / "a.ply", 10)
    said = r"a.ply cannot be read as PLY: .* ended with -6"
    with (
        read_ahead(opened([path]), [path], None, cores=2) as read,
        pytest.raises(InputError, match=said),
    ):
        blocks_of(read[0])


@pytest.mark.parametrize(("least", "cores"), [(1, 1), (11, 2)], ids=["one core", "few points"])
def test_one_process_reads_where_another_would_not_pay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, least: int, cores: int
) -> None:
    monkeypatch.setattr(ahead, "_POINTS_LEAST", least)
    path = ply(tmp_path / "a.ply", 10)
    files = opened([path])
    with read_ahead(files, [path], None, cores=cores) as read:
        assert read == files
