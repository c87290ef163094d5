"""Exports to CAD and GIS: a file per wall, and one of the room if it is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from orthoflow.cli.exports.choices import Choices
from orthoflow.cli.exports.drawings import export_dxf, export_geojson
from orthoflow.errors import ArgumentError
from orthoflow.records.open import open_run
from orthoflow.records.runs import Run
from tests.drawing_runs import WALL, box_image, write_drawing_run


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A wall whose left half one photo paints, and its right half another."""
    image = box_image()
    source = image.source.copy()
    source[:, image.frame.width // 2 :][image.source[:, image.frame.width // 2 :] == 0] = 1
    image = replace(image, source=source, sources=("a.jpg", "b.jpg"))
    return open_run(write_drawing_run(tmp_path_factory.mktemp("drawings") / "run", image=image))


@pytest.mark.parametrize("has_planes", [False, True])
@pytest.mark.parametrize(
    ("export", "suffix", "beside"),
    [
        (export_dxf, "dxf", f"wall_{WALL}_ortho.png"),
        (export_geojson, "geojson", f"wall_{WALL}_seams.geojson"),
    ],
)
def test_files_are_of_each_wall_and_of_the_room_where_it_is_known(
    run: Run,
    tmp_path: Path,
    *,
    export: Callable[[Run, Path, Choices], str],
    suffix: str,
    beside: str,
    has_planes: bool,
) -> None:
    if not has_planes:
        cells = tuple(cell for cell in run.record.cells if cell.step != "plane")
        run = Run(path=run.path, record=replace(run.record, cells=cells))
    export(run, tmp_path / "out", Choices())
    room = {f"room.{suffix}"} if has_planes else set()
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {f"wall_{WALL}.{suffix}", beside} | room
    with pytest.raises(ArgumentError, match=f"it shows {WALL}"):
        export(run, tmp_path / "none", Choices(wall=WALL + 1))
    assert not (tmp_path / "none").exists()
