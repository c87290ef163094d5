"""What a GeoTIFF may say of itself: sizes that its bytes can hold, cells in metres, maps."""

from __future__ import annotations

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


def stated(width: int, height: int = 1, count: int = 1, **tags: str) -> Any:
    return SimpleNamespace(
        width=width, height=height, count=count, tags=lambda ns: tags if ns == "OVERVIEWS" else {}
    )


def stored(folder: Path, n_bytes: int) -> Path:
    path = folder / "wall.tif"
    with path.open("wb") as stream:
        stream.truncate(n_bytes)
    return path


def test_a_larger_one_states_eleven_hundred_values_a_byte(tmp_path: Path) -> None:
    path = stored(tmp_path, 1_000_000)
    check_header(path, stated(1_100_000, 1000))
    with pytest.raises(InputError, match="1100001 x 1000 cells in 1 bands, but its 1000000 bytes"):
        check_header(path, stated(1_100_001, 1000))


def test_a_file_that_names_another_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^wall\.tif stores its overviews in another file"):
        check_header(stored(tmp_path, 100), stated(4, OVERVIEW_FILE="http://a/b.ovr"))


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
    assert found.bands == ("uint8",) * len(found.bands)
    assert len(found.bands) in (3, 4)
    west, east = (np.array(found.outline_lonlat)[places] for places in ([0, 3, 4], [1, 2]))
    # Ten metres are 1.35e-4 degrees of longitude at 48.1 degrees north, and 9e-5 of latitude.
    assert_allclose(west[:, 0], 9.0 - 1.345e-4, atol=1e-6)
    assert_allclose(east[:, 0], 9.0 + 1.345e-4, atol=1e-6)
    lower, upper = (np.array(found.outline_lonlat)[places, 1] for places in ([0, 1, 4], [2, 3]))
    assert np.ptp(lower) < 1e-8
    assert_allclose(upper - lower[:2], 8.99e-5, atol=1e-7)
    assert_allclose(lower, 48.157, atol=0.01)


def test_a_raster_in_the_plane_of_its_wall_is_no_place_on_earth(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    write_raster(path, np.zeros((2, 3), np.float32), place=GridPlace(gsd_m=0.5), tags={})
    found = place_of(path)
    assert (found.epsg, found.outline_lonlat) == (None, ())
    assert found.wkt2.startswith('ENGCRS["run 00000000-000000-000000 plane, metres"')
    assert (found.shape, found.bands) == ((2, 3), ("float32",))
    assert found.bounds == (0.0, -1.0, 1.5, 0.0)
