"""What a GeoTIFF may say of itself: sizes that its bytes can hold, cells in metres, maps."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from orthoflow.errors import InputError
from orthoflow.files import geotiff as module
from orthoflow.files.geotiff import (
    GridPlace,
    check_header,
    epsg_wkt,
    place_of,
    require_map_crs,
    write_orthoimage,
    write_raster,
)


def test_a_header_states_what_its_file_can_hold(tmp_path: Path) -> None:
    def stated(width: int, **tags: str) -> Any:
        return SimpleNamespace(
            width=width, height=1000, count=1, tags=lambda ns: tags if ns == "OVERVIEWS" else {}
        )

    path = tmp_path / "wall.tif"
    path.touch()
    os.truncate(path, 1_000_000)
    check_header(path, stated(1_100_000))
    with pytest.raises(InputError, match="1100001 x 1000 cells in 1 bands, but its 1000000 bytes"):
        check_header(path, stated(1_100_001))
    with pytest.raises(InputError, match=r"^wall\.tif stores its overviews in another file"):
        check_header(path, stated(4, OVERVIEW_FILE="http://a/b.ovr"))


# --- coordinate systems ---


def test_maps_are_in_metres() -> None:
    for crs in ("EPSG:25832", "EPSG:2100", "site"):
        require_map_crs(crs)
    # Degrees, and feet.
    for crs in ("EPSG:4326", "EPSG:2263"):
        with pytest.raises(InputError, match=f"^{crs} is not a coordinate system in metres"):
            require_map_crs(crs)
    assert "25832" in epsg_wkt(25832)
    assert epsg_wkt(999_999) == ""


def test_a_part_of_a_raster_is_read_where_it_lies(tmp_path: Path) -> None:
    values = np.arange(48, dtype=np.float32).reshape(6, 8)
    module.write_raster(tmp_path / "a.tif", values, place=module.GridPlace(gsd_m=0.5), tags={})
    with module.RasterParts(tmp_path / "a.tif") as source:
        part, shown = source.read((2.0, 1.0, 7.0, 4.0), (3, 5))
        halved, _ = source.read((2.0, 0.0, 6.0, 4.0), (2, 2))
    np.testing.assert_array_equal(part, values[1:4, 2:7])
    assert shown.all()
    np.testing.assert_allclose(halved, values[:4, 2:6].reshape(2, 2, 2, 2).mean(axis=(1, 3)))


# Where a raster lies


def test_a_raster_in_a_map_lies_on_earth(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    # On the central meridian of zone 32, nine degrees east.
    place = GridPlace(gsd_m=2.5, corner_m=(499_990.0, 5_334_000.0), crs="EPSG:25832")
    rgb = np.zeros((4, 8, 3), np.uint8)
    write_orthoimage(path, rgb, np.ones((4, 8), np.bool_), place=place, tags={})
    found = place_of(path)
    assert found.shape == (4, 8)
    assert_allclose(found.transform, (2.5, 0.0, 499_990.0, 0.0, -2.5, 5_334_000.0))
    assert found.bounds == (499_990.0, 5_333_990.0, 500_010.0, 5_334_000.0)
    assert found.epsg == 25832
    assert found.wkt2.startswith("PROJCRS[")
    assert set(found.bands) == {"uint8"}
    assert len(found.bands) in (3, 4)
    lon, lat = np.array(found.outline_lonlat).T
    # Ten metres are 1.35e-4 degrees of longitude at 48.1 degrees north, and 9e-5 of latitude.
    assert_allclose(lon, 9.0 + 1.345e-4 * np.array([-1, 1, 1, -1, -1]), atol=1e-6)
    assert_allclose(lat - lat[0], 8.99e-5 * np.array([0, 0, 1, 1, 0]), atol=1e-7)
    assert lat[0] == pytest.approx(48.157, abs=0.01)


def test_a_raster_in_the_plane_of_its_wall_is_no_place_on_earth(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    write_raster(path, np.zeros((2, 3), np.float32), place=GridPlace(gsd_m=0.5), tags={})
    found = place_of(path)
    assert (found.epsg, found.outline_lonlat) == (None, ())
    assert found.wkt2.startswith('ENGCRS["run 00000000-000000-000000 plane, metres"')
    assert (found.shape, found.bands) == ((2, 3), ("float32",))
    assert found.bounds == (0.0, -1.0, 1.5, 0.0)
