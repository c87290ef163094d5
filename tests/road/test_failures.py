"""What goes wrong ends in a sentence: bad workflow files, bad scans, methods that misbehave."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner

from orthoflow.cli.program import program
from tests.road.conftest import Shell

Write = Callable[[str, str], Path]

SIX_ERRORS = """\
orthoflow: 1
name: wrong
seeed: 3
inputs:
  scan: {files: 7}
steps:
  cloud: {use: read.scan, in: {files: inputs.scan}}
  plane: {use: plane.hough2dd, in: {cloud: cloud.cloud}}
  wall: {use: raster.grid, in: {cloud: cloud.cloud}}
  cloud: {use: read.scan, in: {files: inputs.scan}}
  ortho: {use: ortho.pointcloud-direct, in: {walls: wall.walls, cloud: second.cloud}}
  first: {use: mosaic.seams, in: {layers: third.layers}}
  second: {use: mosaic.seams, in: {layers: first.layers}}
  a: {use: raster.grid, in: {cloud: cloud.cloud, planes: b.planes}}
  b: {use: plane.hough2d, in: {cloud: a.cloud}}
"""


def no_traceback(said: str) -> bool:
    return "Traceback" not in said and "site-packages" not in said


def test_all_errors_of_a_workflow_file_come_at_once_with_their_lines(
    shell: Shell, write: Write
) -> None:
    write("wrong.yaml", SIX_ERRORS)
    ended = shell("check", "wrong.yaml")
    assert ended.code == 2
    assert no_traceback(ended.said)
    for expected in (
        "wrong.yaml:3:1",  # unknown key
        "did you mean seed",
        "wrong.yaml:5:17",  # wrong type
        "wrong.yaml:8:16",  # unknown method
        "did you mean plane.hough2d",
        "wrong.yaml:9:",  # planes not wired
        "wrong.yaml:10:3",  # duplicate step
        "cycle",
    ):
        assert expected in ended.said


BAD_SCANS: dict[str, bytes] = {
    "corrupt.laz": b"LASF" + bytes(range(256)) * 8,
    "empty.las": b"",
    "photo.jpg": b"\xff\xd8\xff\xe0 not a scan",
}


@pytest.mark.parametrize("name", BAD_SCANS, ids=str)
def test_a_bad_scan_ends_in_one_sentence_with_exit_code_two(
    shell: Shell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    (tmp_path / name).write_bytes(BAD_SCANS[name])
    monkeypatch.chdir(tmp_path)
    # In this process, whose steps come from one server; the next tests start one of their own.
    words = ["run", "direct.yaml", "--input", f"scan={name}", "-o", "run", "--store"]
    ended = CliRunner().invoke(program, [*words, str(shell.store)])
    assert ended.exit_code == 2
    assert no_traceback(ended.output)
    assert name in ended.output


def test_a_truncated_laz_is_named(shell: Shell, tmp_path: Path, shared_data: Path) -> None:
    whole = (shared_data / "lion-takanawa" / "lion_takanawa_1mm.laz").read_bytes()
    (tmp_path / "half.laz").write_bytes(whole[: len(whole) // 2])
    ended = shell("run", "direct.yaml", "--input", "scan=half.laz", "-o", "run")
    assert ended.code == 2
    assert no_traceback(ended.said)
    assert "half.laz" in ended.said


def test_a_scan_that_is_not_there_is_named(shell: Shell) -> None:
    ended = shell("run", "direct.yaml", "--input", "scan=nowhere.laz")
    assert ended.code == 2
    assert "nowhere.laz" in ended.said
    assert no_traceback(ended.said)
