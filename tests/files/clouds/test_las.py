"""LAZ as laspy reads it: which extra bytes there are, the scale of coordinates, and the header."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest

from orthoflow.files.clouds.attributes import AttributedCloud
from orthoflow.files.clouds.neighbourhoods import neighbourhoods_of
from orthoflow.files.clouds.writers import write_laz
from orthoflow.files.geotiff import epsg_wkt
from orthoflow.products import PointCloud


def floor(size_m: float = 1.0) -> PointCloud:
    a, b = (axis.ravel() for axis in np.meshgrid(*[np.linspace(0.0, size_m, 12)] * 2))
    x, y = (np.ascontiguousarray(axis, np.float32) for axis in (a, b))
    up = np.array([0.0, 0.0, 1.0])
    return PointCloud(origin=np.array([1e5, 2e5, 50.5]), x=x, y=y, z=np.zeros_like(x), up=up)


def with_attributes(cloud: PointCloud) -> AttributedCloud:
    return AttributedCloud(cloud=cloud, colouring="plane", neighbourhoods=neighbourhoods_of(cloud))


def written(path: Path, attributed: AttributedCloud) -> laspy.LasData:
    write_laz(path, attributed)
    return laspy.read(path)


@pytest.mark.parametrize("crs_wkt", ["", epsg_wkt(25832)], ids=["unknown", "known"])
def test_a_header_has_a_coordinate_system_where_there_is_one_and_only_wkt_ever(
    tmp_path: Path, crs_wkt: str
) -> None:
    found = written(tmp_path / "a.laz", replace(with_attributes(floor()), crs_wkt=crs_wkt))
    # LAS 1.4 has it for points of its formats from 6 on, whether there is one or not.
    assert found.header.global_encoding.wkt
    systems = [one.string for one in found.header.vlrs if one.record_id == 2112]
    assert systems == ([crs_wkt] if crs_wkt else [])


@pytest.mark.parametrize(
    ("size_m", "scale_m"),
    # 31 bits with a sign hold 214 km in steps of a tenth of a millimetre, and the origin may lie
    # anywhere within.
    [(1.0, 1e-4), (107_000.0, 1e-4), (108_000.0, 1e-3), (2_000_000.0, 1e-2)],
)
def test_coordinates_keep_a_tenth_of_a_millimetre_where_that_fits(
    tmp_path: Path, size_m: float, scale_m: float
) -> None:
    cloud = floor(size_m)
    # Of a mirrored cloud the farthest point has a negative offset.
    for one in (cloud, replace(cloud, x=-cloud.x, y=np.zeros_like(cloud.y))):
        found = written(tmp_path / "a.laz", with_attributes(one))
        np.testing.assert_allclose(found.header.scales, scale_m, rtol=1e-9)
        np.testing.assert_allclose(found.xyz, one.points_world(), atol=0.51 * scale_m)
