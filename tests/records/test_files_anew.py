"""A record that travels alone has its rasters again, as long as somebody needs them."""

from __future__ import annotations

from pathlib import Path

import pytest

from orthoflow.files.geotiff import RasterParts
from orthoflow.products import Orthoimages
from orthoflow.records.open import open_run
from orthoflow.records.runs import Run, published_state
from orthoflow.records.write import with_files
from tests.drawing_runs import WALL, write_drawing_run
from tests.report_runs import without_products


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_drawing_run(tmp_path_factory.mktemp("whole") / "run")


@pytest.fixture
def alone(run: Path, tmp_path: Path) -> Run:
    (tmp_path / "court.h5").write_bytes((run / "run.h5").read_bytes())
    return open_run(tmp_path / "court.h5")


def test_rasters_are_made_of_the_products_and_go_away_again(alone: Run) -> None:
    said: list[str] = []
    with with_files(alone, said.append) as found:
        assert found.path == alone.path
        assert found.folder != alone.folder
        (ortho,) = found.orthoimages
        assert ortho.name == f"wall_{WALL}_ortho.tif"
        product = alone.product("mosaic", "orthoimages")
        assert isinstance(product, Orthoimages)
        with RasterParts(ortho) as raster:
            assert raster.shape == product.images[0].frame.shape
        # What was made is what the run now calls its own.
        states = {published_state(found.folder, file) for file in found.record.published}
        assert states == {"same"}
    left_out = "and other published files are omitted"
    made_anew = "its rasters are recreated from its products"
    assert said == [f"{alone.path} has no files next to it: {made_anew}, {left_out}"]
    assert not ortho.exists()


def test_products_that_are_not_in_the_record_make_no_files(alone: Run) -> None:
    bare = without_products(alone)
    with with_files(bare) as found:
        assert found is bare
