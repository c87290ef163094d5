"""Distances inside what a layer paints, against those of OpenCV, which has the whole in memory."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from orthoflow_plugins.mosaic.depths_inside import column_distances, depths_inside

from orthoflow.geometry.bands import in_memory
from orthoflow.products import LayerMask


@pytest.mark.parametrize("share", [0.0, 0.001, 0.02, 0.5, 1.0])
@pytest.mark.parametrize("shape", [(1, 1), (1, 70), (60, 1), (83, 131)])
def test_depths_are_those_of_the_whole(shape: tuple[int, int], share: float) -> None:
    rng = np.random.default_rng(4)
    mask = np.full(shape, LayerMask.PAINTED, dtype=np.uint8)
    mask[rng.random(shape) < share] = LayerMask.OCCLUDED
    distances = column_distances(mask, "inside", in_memory)
    padded = np.pad((mask == LayerMask.PAINTED).astype(np.uint8), 1)
    expected = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    parts = [slice(0, shape[0] // 3), slice(shape[0] // 3, shape[0])]
    found = np.concatenate([depths_inside(distances, part) for part in parts])
    np.testing.assert_allclose(found, expected, rtol=1e-6)
