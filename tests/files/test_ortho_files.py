"""Orthoimages in files: which they are, in which order, and their cells, averaged or in bands."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files import sidecars as module
from orthoflow.files.geotiff import GridPlace, write_orthoimage, write_raster
from orthoflow.files.sidecars import OrthoFile, ortho_files
from orthoflow.files.wall_descriptions import described
from orthoflow.geometry import WallFrame
from tests import samples

ROWS, COLUMNS = 6, 9
RGB = np.random.default_rng(1).integers(0, 256, (ROWS, COLUMNS, 3), dtype=np.uint8)
SHOWN = np.ones((ROWS, COLUMNS), dtype=np.bool_)
SHOWN[4:, 2] = False


def frame(rows: int = ROWS, columns: int = COLUMNS) -> WallFrame:
    return samples.facing_south(0.5, columns, rows)


def ortho(folder: Path, rgb: NDArray[np.uint8 | np.uint16] = RGB) -> OrthoFile:
    path = folder / "wall_0_ortho.tif"
    shown = SHOWN[: len(rgb)]
    write_orthoimage(path, rgb, shown, place=GridPlace(gsd_m=0.5), tags={})
    return OrthoFile(path=path, about=described(path, {}), frame=frame(*rgb.shape[:2]), digest="")


def test_orthoimages_are_known_by_their_names_and_come_in_the_order_of_their_walls(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    beside: dict[str, dict[str, object]] = {
        "wall_12_ortho.tif": {"name": "east", "product_digest": "ab12"},
        "wall_3_ortho.tif": {"name": 5, "product_digest": None},
    }
    monkeypatch.setattr(module, "placed_raster", lambda path: (frame(), beside[path.name]))
    names = [*beside, "wall_3_depth.tif", "wall_123456_ortho.tif", "my_wall_1_ortho.tif"]
    found = ortho_files([Path(name) for name in names])
    assert [(one.wall, one.name, one.digest, one.path.name) for one in found] == [
        (3, "wall 3", "", "wall_3_ortho.tif"),
        (12, "east", "ab12", "wall_12_ortho.tif"),
    ]


def test_pictures_are_averaged_to_their_longest_side_and_cut(tmp_path: Path) -> None:
    image = ortho(tmp_path)
    for longest_px, shape in ((3, (2, 3)), (1, (1, 1)), (100, (6, 9))):
        rgb, shown = image.shrunk(longest_px)
        assert rgb.shape == (*shape, 3)
        assert shown.shape == shape
    np.testing.assert_array_equal(rgb[shown], RGB[SHOWN])
    # All cells of the first are shown, so it is their mean.
    mean = RGB[:3, :3].mean(axis=(0, 1))
    np.testing.assert_allclose(image.shrunk(3)[0][0, 0], mean, atol=1.0)
    rgb, shown = image.part((1, 2, COLUMNS, 5), (3, COLUMNS - 1))
    np.testing.assert_array_equal(shown, SHOWN[2:5, 1:])
    np.testing.assert_array_equal(rgb[shown], RGB[2:5, 1:][shown])


def test_depths_are_no_colours(tmp_path: Path) -> None:
    one = ortho(tmp_path)
    write_raster(
        one.path, np.zeros((ROWS, COLUMNS), np.float32), place=GridPlace(gsd_m=0.5), tags={}
    )
    with pytest.raises(
        InputError, match=r"ortho\.tif has 1 bands of float32; expected 3 bands with 8 or"
    ):
        one.shrunk(9)
