"""Boxes of a cloud's blocks, by which passes leave out what is far off."""

from __future__ import annotations

import numpy as np
import pytest

from orthoflow.geometry.slabs import BOXED_POINTS
from orthoflow.products import PointCloud


@pytest.mark.parametrize(("n_more", "n_boxes"), [(0, None), (1, 17)])
def test_a_cloud_of_few_blocks_has_no_boxes(n_more: int, n_boxes: int | None) -> None:
    places = np.arange(16 * BOXED_POINTS + n_more, dtype=np.float32)
    cloud = PointCloud(
        origin=np.zeros(3), x=places, y=-places, z=np.zeros_like(places), up=np.array([0, 0, 1.0])
    )
    if n_boxes is None:
        assert cloud.boxes_m is None
        return
    assert cloud.boxes_m is not None
    assert len(cloud.boxes_m) == n_boxes
    first, last = cloud.boxes_m[0], cloud.boxes_m[-1]
    np.testing.assert_array_equal(first[:, 0], [0, BOXED_POINTS - 1])
    np.testing.assert_array_equal(first[:, 1], [1 - BOXED_POINTS, 0])
    np.testing.assert_array_equal(last[:, 0], [places[-1], places[-1]])


def test_points_keep_their_ids_through_several_selections() -> None:
    x, y, z = np.random.default_rng(3).normal(size=(3, 8)).astype(np.float32)
    whole = PointCloud(
        origin=np.array([4e6, 5e6, 0.0]), up=np.array([0.0, 0.0, 1.0]), x=x, y=y, z=z, intensity=x
    )
    places = np.array([5, 1, 3])
    twice = whole.selected(places).selected(np.array([True, False, True]))
    assert twice.point_id is not None
    assert twice.intensity is not None
    np.testing.assert_array_equal(twice.point_id, [5, 3])
    np.testing.assert_array_equal(twice.points_world(), whole.points_world(places[[0, 2]]))
    np.testing.assert_array_equal(twice.intensity, x[[5, 3]])
