"""Nets of triangles: those of tiles are those of the whole wall."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.raster import nets
from orthoflow_plugins.raster.nets import NO_POINT, Net, Vertices, interpolate_net
from scipy.spatial import Delaunay

from orthoflow.errors import MethodError
from orthoflow.geometry import frame_over
from orthoflow.geometry.slabs import Slab
from orthoflow.products import PointCloud
from tests import raster_scenes as scenes

SHAPE = (240, 260)
# Rows and columns without points: a window that triangles close, and one that is too wide.
WINDOW = (slice(30, 80), slice(20, 75))
GATE = (slice(110, 240), slice(110, 240))
SPAN_MOST = 120


def slab_of(known: scenes.KnownWall) -> Slab:
    frame = frame_over(known.planes().corners[0], known.normal, gsd_m=known.gsd_m)
    return Slab(frame=frame, front_m=0.1, behind_m=0.1)


@pytest.fixture(scope="module")
def wall() -> tuple[PointCloud, Slab, Vertices]:
    """A wall with a point in two of three cells, a window and a gate."""
    rng = np.random.default_rng(5)
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    has_point = rng.random(SHAPE) < 0.67
    has_point[WINDOW] = has_point[GATE] = False
    # As far as a gable: beside it nothing was scanned.
    has_point[rows + 60 < columns / 2] = False
    count = int(np.count_nonzero(has_point))
    places = np.column_stack([columns[has_point], rows[has_point]]) + rng.random((count, 2))
    known = scenes.leaning_wall(shape=SHAPE)
    depths_m = (0.02 * np.sin(places[:, 0] / 9.0)).astype(np.float32)
    cloud = scenes.cloud_of(
        known.world(places[:, 0], places[:, 1], depths_m),
        intensity=rng.random(count).astype(np.float32),
        rgb=rng.integers(0, 256, (count, 3), dtype=np.uint8),
    )
    point = np.full(SHAPE, NO_POINT)
    point[has_point] = np.arange(count)
    depth_m = np.full(SHAPE, np.nan, dtype=np.float32)
    depth_m[has_point] = depths_m
    slab = slab_of(known)
    return cloud, slab, Vertices(point=point, depth_m=depth_m)


@pytest.fixture(scope="module")
def whole(wall: tuple[PointCloud, Slab, Vertices]) -> Net:
    return interpolate_net(*wall)


def in_tiles(wall: tuple[PointCloud, Slab, Vertices], tile_cells: int) -> Net:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(nets, "VERTICES_MOST", 1000)
        patch.setattr(nets, "_TILE_CELLS", tile_cells)
        patch.setattr(nets, "SPAN_MOST_CELLS", SPAN_MOST)
        return interpolate_net(*wall)


@pytest.fixture(scope="module")
def tiled(wall: tuple[PointCloud, Slab, Vertices]) -> dict[int, Net]:
    """The net of each size of tiles, in cells; the last size takes the wall whole."""
    return {tile_cells: in_tiles(wall, tile_cells) for tile_cells in (90, 140, 300)}


def diameters(wall: tuple[PointCloud, Slab, Vertices], net: Net) -> NDArray[np.float64]:
    """Of the circle about each cell's triangle, by the law of sines; NaN outside the net."""
    cloud, slab, vertices = wall
    points = cloud.origin + np.column_stack([cloud.x, cloud.y, cloud.z])
    places = slab.frame.wall_from_world(points)[:, :2]
    delaunay = Delaunay(places[vertices.point[vertices.point != NO_POINT]])
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]] + 0.5
    simplex = delaunay.find_simplex(np.column_stack([columns.ravel(), rows.ravel()]))
    corners = delaunay.points[delaunay.simplices]
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    one, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = 0.5 * np.abs(one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0])
    found = sides.prod(axis=1) / (2.0 * area)
    np.testing.assert_array_equal(simplex >= 0, np.isfinite(net.depth_m))
    return np.where(simplex >= 0, found[simplex], np.nan)


@pytest.mark.parametrize("tile_cells", [90, 140])
def test_tiles_give_the_triangles_of_the_whole(
    wall: tuple[PointCloud, Slab, Vertices],
    whole: Net,
    tiled: dict[int, Net],
    tile_cells: int,
) -> None:
    net = tiled[tile_cells]
    told = np.isfinite(net.depth_m)
    assert told.reshape(SHAPE)[WINDOW].all()
    assert not told.reshape(SHAPE)[170:180, 170:180].any()
    across = diameters(wall, whole)
    assert told[across <= SPAN_MOST].all()
    # Of wider circles only those that lie beside the wall for the most part.
    assert np.count_nonzero(told & ~(across <= SPAN_MOST)) < 0.01 * told.size
    np.testing.assert_allclose(net.depth_m[told], whole.depth_m[told], rtol=0, atol=1e-7)
    np.testing.assert_allclose(net.intensity[told], whole.intensity[told], rtol=0, atol=1e-6)
    assert (net.rgb[told] != whole.rgb[told]).mean() < 1e-4
    assert not net.rgb[~told].any()


def test_a_large_wall_whose_points_lie_on_a_line_has_no_net(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(nets, "VERTICES_MOST", 3)
    known = scenes.leaning_wall(shape=(40, 60))
    cloud = scenes.cloud_of(known.world(np.arange(5) + 0.5, np.full(5, 3.5), np.zeros(5)))
    point = np.full((40, 60), NO_POINT)
    point[3, :5] = np.arange(5)
    vertices = Vertices(point=point, depth_m=np.zeros((40, 60), dtype=np.float32))
    slab = slab_of(known)
    with pytest.raises(MethodError, match="points that span triangles"):
        interpolate_net(cloud, slab, vertices)
