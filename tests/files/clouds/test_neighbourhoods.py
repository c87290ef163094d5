"""What lies about the points of a cloud: normals of surfaces, and points that are alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.clouds.neighbourhoods import neighbourhoods_of
from orthoflow.products import PointCloud


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
