"""The surface tin: depths are linear in the triangles between points."""

from __future__ import annotations

import numpy as np
import pytest
from orthoflow_plugins.raster.nets import NO_POINT, interpolate_net
from scipy.interpolate import LinearNDInterpolator

from orthoflow.errors import MethodError
from orthoflow.geometry import frame_over
from orthoflow.geometry.slabs import Slab
from tests import raster_scenes as scenes

SHAPE = (340, 260)


def slab_of(known: scenes.KnownWall) -> Slab:
    frame = frame_over(known.planes().corners[0], known.normal, gsd_m=known.gsd_m)
    return Slab(frame=frame, front_m=0.1, behind_m=0.1)


def test_values_are_linear_in_the_triangles_between_points() -> None:
    rng = np.random.default_rng(5)
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    has_point = rng.random(SHAPE) < 0.67
    has_point[30:180, 20:175] = False
    # As far as a gable: beside it nothing was scanned.
    has_point[rows + 60 < columns / 2] = False
    count = int(np.count_nonzero(has_point))
    places = np.column_stack([columns[has_point], rows[has_point]]) + rng.random((count, 2))
    known = scenes.leaning_wall(shape=SHAPE)
    depths_m = (0.02 * np.sin(places[:, 0] / 9.0)).astype(np.float32)
    intensity = rng.random(count).astype(np.float32)
    rgb = rng.integers(0, 256, (count, 3), dtype=np.uint8)
    cloud = scenes.cloud_of(known.world(*places.T, depths_m), intensity=intensity, rgb=rgb)
    point = np.full(SHAPE, NO_POINT)
    point[has_point] = np.arange(count)
    depth_m = np.full(SHAPE, np.nan, dtype=np.float32)
    depth_m[has_point] = depths_m
    found = interpolate_net(cloud, slab_of(known), point.ravel(), depth_m.ravel())
    values = np.column_stack([depths_m, intensity, rgb])
    expected = LinearNDInterpolator(places, values)(columns + 0.5, rows + 0.5).reshape(-1, 5)
    is_inside = np.isfinite(expected[:, 0])
    assert 0.7 < is_inside.mean() < 0.99
    np.testing.assert_array_equal(np.isfinite(found[0]), is_inside)
    apart = np.column_stack(found) - expected
    # Coordinates in float32 may turn single triangles.
    is_off = np.abs(apart[is_inside]) > [1e-5, 1e-3, 0.6, 0.6, 0.6]
    assert is_off.any(axis=1).mean() < 1e-4


def test_a_wall_whose_points_lie_on_a_line_has_no_net() -> None:
    known = scenes.leaning_wall(shape=(40, 60))
    cloud = scenes.cloud_of(known.world(np.arange(5) + 0.5, np.full(5, 3.5), np.zeros(5)))
    point = np.full(40 * 60, NO_POINT)
    point[180:185] = np.arange(5)
    with pytest.raises(MethodError, match="points that span triangles"):
        interpolate_net(cloud, slab_of(known), point, np.zeros(40 * 60, dtype=np.float32))
