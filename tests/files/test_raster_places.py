"""Where a GeoTIFF lies, in its map and on Earth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.testing import assert_allclose

from orthoflow.files.geotiff import GridPlace, place_of, write_orthoimage, write_raster


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
