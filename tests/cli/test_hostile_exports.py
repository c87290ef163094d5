"""What lies beside a record is as the record states and nothing else, whatever is made of it."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import rasterio
from affine import Affine

from orthoflow.files.geotiff import RasterParts
from tests import hostile_records as hostile
from tests.drawing_runs import WALL, export, write_drawing_run

ORTHO = Path("products", "mosaic", f"wall_{WALL}_ortho.tif")
DRAWN = ("sheet", "dxf", "geojson")
PICTURED = (*DRAWN, "gltf", "tiles", "stac")


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_drawing_run(tmp_path_factory.mktemp("drawn") / "run")


@pytest.fixture
def run(drawn: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(drawn, tmp_path / "run"))


def check_refused(run: Path, target: str, code: int, *said: str) -> None:
    done = export(run, target, run.parent / target, code=code)
    for part in said:
        assert part in " ".join(done.output.split()), target
    assert [path.name for path in run.parent.iterdir()] == [run.name]


def exchange_ortho(run: Path, width: int, height: int, gsd_m: float = 0.01, **tags: str) -> None:
    """Write an orthoimage of empty cells, which take no room, in the place of the true one."""
    placed = Affine(gsd_m, 0.0, 0.0, 0.0, -gsd_m, 0.0)
    shape = {"width": width, "height": height, "count": 3, "dtype": "uint8"}
    layout = {"tiled": True, "blockxsize": 4096, "blockysize": 4096, "compress": "DEFLATE"}
    (run / ORTHO).unlink()
    with rasterio.open(
        run / ORTHO, "w", "GTiff", transform=placed, SPARSE_OK=True, **shape, **layout
    ) as raster:
        raster.update_tags(ns="OVERVIEWS", **tags)
    hostile.publish_again(run)


Cells = tuple[int, int, float, dict[str, str]]
ELSEWHERE = "/vsicurl/http://127.0.0.1:9/a.tif"


@pytest.mark.parametrize(
    ("cells", "sentence"),
    [
        ((100_000, 100_000, 0.01, {}), "declares 100000 x 100000 cells in 3 bands, but its "),
        ((60, 40, 1e-300, {}), "has cells of 1e-300 m; expected 1e-06 to 1e+06 m"),
        ((600, 400, 0.01, {"OVERVIEW_FILE": ELSEWHERE}), "stores its overviews in another file"),
    ],
)
def test_a_picture_that_no_wall_can_have_is_refused_at_once(
    run: Path, cells: Cells, sentence: str
) -> None:
    width, height, gsd_m, tags = cells
    exchange_ortho(run, width, height, gsd_m, **tags)
    assert (run / ORTHO).stat().st_size < 50_000
    for target in PICTURED if gsd_m == 0.01 else ("sheet", "dxf", "geojson", "gltf", "tiles"):
        check_refused(run, target, 2, sentence)


def test_pictures_that_were_changed_are_not_handed_on(run: Path) -> None:
    content = (run / ORTHO).read_bytes()
    (run / ORTHO).write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    for target in (*PICTURED, "ro-crate"):
        check_refused(run, target, 3, "has been changed since the run")


@pytest.mark.parametrize("suffix", [".tif", ".json"])
def test_what_stands_in_the_place_of_a_picture_is_not_read(run: Path, suffix: str) -> None:
    place = (run / ORTHO).with_suffix(suffix)
    place.unlink()
    os.mkfifo(place)
    for target in PICTURED:
        done = export(run, target, run.parent / target)
        assert done.exit_code in ((0, 2, 3) if suffix == ".tif" else (2, 3)), (target, done.output)
        assert "itself failed" not in done.output
    made = {path for path in run.parent.rglob("*") if not path.is_relative_to(run)}
    assert not [path for path in made if path.is_symlink() or path.name == place.name]


def test_what_lies_beside_a_picture_shows_nothing_of_itself(run: Path) -> None:
    """GDAL would take overviews and masks from there, and whatever files these name."""
    exchange_ortho(run, 600, 400)
    other = run.parent / "other.tif"
    shutil.copy(run / ORTHO, other)
    with rasterio.open(other, "r+") as raster:
        raster.write(np.full((3, 400, 600), 222, np.uint8))
    overviews = f'<Metadata domain="OVERVIEWS"><MDI key="OVERVIEW_FILE">{other}</MDI></Metadata>'
    beside = {
        ".ovr": other.read_bytes(),
        ".msk": other.read_bytes(),
        ".aux.xml": f"<PAMDataset>{overviews}</PAMDataset>".encode(),
    }
    for suffix, content in beside.items():
        path = Path(f"{run / ORTHO}{suffix}")
        path.write_bytes(content)
        with RasterParts(run / ORTHO) as raster:
            # Smaller than the cells, so that overviews are looked for.
            values, shown = raster.read((0.0, 0.0, 600.0, 400.0), (40, 60))
        assert (int(values.max()), bool(shown.all())) == (0, True), suffix
        path.unlink()
