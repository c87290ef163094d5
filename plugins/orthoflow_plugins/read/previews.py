"""A small picture of a cloud from above."""

from __future__ import annotations

from typing import Final

import numpy as np

from orthoflow.files.images import encode_png
from orthoflow.geometry import basis_from_up
from orthoflow.products import PointCloud

_SIDE_PX: Final = 640
_SAMPLE: Final = 250_000


def plan_view_png(cloud: PointCloud) -> bytes:
    """Give a PNG of the cloud seen from above, brighter where it is denser (logarithmic)."""
    step = max(1, len(cloud) // _SAMPLE)
    offsets = np.column_stack([cloud.x[::step], cloud.y[::step], cloud.z[::step]])
    plan = offsets.astype(np.float64) @ basis_from_up(cloud.up)[:2].T
    # Percentiles, so that stray points do not shrink the building to a dot.
    low, high = np.percentile(plan, [0.1, 99.9], axis=0)
    span = max(float((high - low).max()), 1e-6)
    size = np.maximum(np.ceil((high - low) / span * _SIDE_PX).astype(int), 1)
    cells = np.floor((plan - low) / span * _SIDE_PX).astype(np.int64)
    is_inside = np.all((cells >= 0) & (cells < size), axis=1)
    columns, rows = cells[is_inside].T
    counts = np.bincount(rows * size[0] + columns, minlength=int(size.prod())).astype(np.float64)
    shades = np.log1p(counts)
    grey = np.rint(255.0 * shades / max(float(shades.max()), 1.0)).astype(np.uint8)
    # Row 0 is at the bottom of a map and at the top of an image.
    return encode_png(np.ascontiguousarray(grey.reshape(size[1], size[0])[::-1]))
