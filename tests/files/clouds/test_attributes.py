"""Points that are chosen and attributed: by scan, box and wall; signs of normals; deviations."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.files.clouds.attributes import AttributedCloud
from orthoflow.files.clouds.neighbourhoods import Neighbourhoods, neighbourhoods_of
from orthoflow.products import PointCloud, PointLabels
from tests import cloud_scenes
from tests.cloud_scenes import NORMALS, ORIGIN, planes

N_SIDE = 24
corner = partial(cloud_scenes.corner, N_SIDE, 0.3)
CORNER = corner()
IS_FLOOR = np.arange(len(CORNER)) >= N_SIDE**2
NEAR = neighbourhoods_of(CORNER)


def with_attributes(
    cloud: PointCloud = CORNER, *, near: Neighbourhoods = NEAR, **more: Any
) -> AttributedCloud:
    return AttributedCloud(cloud=cloud, colouring="intensity", neighbourhoods=near, **more)


_NORMAL = ("nx", "ny", "nz")
_RGB = ["red", "green", "blue"]


def normals(attributed: AttributedCloud, scan: int | None = None) -> NDArray[np.float32]:
    blocks = list(attributed.blocks(scan))
    return np.column_stack([np.concatenate([b[name] for b in blocks]) for name in _NORMAL])


def test_normals_look_at_the_scanner_of_their_scan() -> None:
    # The second scan was taken from behind the wall and from below the floor.
    stations = ORIGIN + np.array([[1.0, 1.0, 1.0], [-1.0, 1.0, -1.0]])
    cloud = corner(stations=stations, stations_source="file")
    side = np.where(CORNER.scan == 0, 1.0, -1.0)
    expected = side[:, None] * NORMALS[IS_FLOOR.astype(int)]
    np.testing.assert_allclose(normals(with_attributes(cloud)), expected, atol=1e-5)
    np.testing.assert_allclose(
        normals(with_attributes(cloud), 1), expected[CORNER.scan == 1], atol=1e-5
    )
    # Without a number per point, all are of the first.
    one = normals(with_attributes(replace(cloud, scan=None)))
    np.testing.assert_allclose(one, np.abs(expected), atol=1e-5)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_normals_look_where_those_of_their_planes_do_else_up(sign: float) -> None:
    # Two stations, and it is unknown which points belong to which.
    cloud = corner(stations=ORIGIN + np.ones((2, 3)), stations_source="view_from")
    index = IS_FLOOR.astype(np.int16)
    index[-N_SIDE:] = -1
    attributed = with_attributes(cloud, planes=planes(sign), labels=PointLabels(plane_index=index))
    expected = sign * NORMALS[index]
    expected[-N_SIDE:] = NORMALS[1]
    np.testing.assert_allclose(normals(attributed), expected, atol=1e-5)
    up = normals(with_attributes(cloud))[IS_FLOOR]
    np.testing.assert_allclose(up, np.tile(NORMALS[1], (len(up), 1)), atol=1e-5)


def test_a_station_is_known_where_the_files_say_one_for_every_scan() -> None:
    stations = ORIGIN + np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    both = with_attributes(corner(stations=stations, stations_source="file"))
    assert both.scans == (0, 1)
    np.testing.assert_array_equal([both.station(0), both.station(1)], stations)
    single = with_attributes(corner(scan=None, stations=stations[:1], stations_source="file"))
    assert single.scans == (0,)
    np.testing.assert_array_equal(single.station(0), stations[0])
    guessed = corner(stations=stations, stations_source="view_from")
    fewer = corner(stations=stations[:1], stations_source="file")
    for cloud in (guessed, fewer, CORNER):
        assert with_attributes(cloud).station(0) is None


def test_what_no_colour_is_known_for_is_grey() -> None:
    cloud = corner(intensity=np.linspace(0.0, 1.0, len(CORNER), dtype=np.float32))
    (plain,) = replace(with_attributes(cloud), colouring="intensity").blocks()
    assert all((plain[name] == plain["red"]).all() for name in _RGB)
    assert len(np.unique(plain["red"])) > 100
    # Without planes there is no deviation, without labels no plane to colour by.
    for colouring in ("deviation", "plane", "rgb"):
        (block,) = replace(with_attributes(cloud), colouring=colouring).blocks()
        np.testing.assert_array_equal(block[_RGB], plain[_RGB])
    labels = PointLabels(plane_index=IS_FLOOR.astype(np.int16))
    for colouring in ("deviation", "plane"):
        known = with_attributes(cloud, planes=planes(), labels=labels)
        (block,) = replace(known, colouring=colouring).blocks()
        assert (block[_RGB] != plain[_RGB]).any()


# Neighbourhoods


def cloud_of(offsets: NDArray[np.floating]) -> PointCloud:
    x, y, z = (np.ascontiguousarray(axis) for axis in offsets.T.astype(np.float32))
    return PointCloud(origin=np.full(3, 1e6), x=x, y=y, z=z, up=np.array([0.0, 0.0, 1.0]))


def test_normals_take_the_voxels_about_them_together() -> None:
    grid = np.stack(np.meshgrid(np.arange(24), np.arange(24)), axis=-1).reshape(-1, 2) / 8.0
    tilted = np.column_stack([grid, 0.5 * grid[:, 0] - 0.25 * grid[:, 1]])
    near = neighbourhoods_of(cloud_of(tilted))
    truth = np.array([-0.5, 0.25, 1.0]) / np.linalg.norm([-0.5, 0.25, 1.0])
    found = near.normals[near.places(tilted.astype(np.float32).astype(np.float64))]
    # At the very corner a voxel may have too few about it.
    known = found.any(axis=1)
    assert known.mean() > 0.99
    np.testing.assert_allclose(np.abs(found[known] @ truth), 1.0, atol=1e-4)
    assert not near.alone.any()
