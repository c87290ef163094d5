"""A cloud as a LAZ file whose points have the colour and the number of their plane."""

from __future__ import annotations

import colorsys
import datetime as dt
import math
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import ArgumentError
from orthoflow.files.points.libraries import load_library
from orthoflow.products import PointCloud, PointLabels

# LAS 1.4 with colours; numbers of planes are a field of their own.
_POINT_FORMAT: Final = 7
_VERSION: Final = "1.4"
PLANE_FIELD: Final = "plane"
_CHUNK: Final = 1 << 21
_SCALE_M: Final = 1e-4
_NO_DATE: Final = dt.date(1970, 1, 1)
_LARGEST: Final = 2.0**30
# Hues by the golden ratio: planes of near numbers never look alike.
_HUE_STEP: Final = 0.618033988749895
_SATURATION: Final = 0.6
_NO_PLANE: Final = (128, 128, 128)
# What is darkest in intensity keeps so much of its plane's colour.
_DARKEST: Final = 0.4


def plane_colour(index: int) -> tuple[int, int, int]:
    """Colour (red, green, blue) of a plane by its position in `Planes`; -1 is grey.

    >>> plane_colour(-1), plane_colour(0)
    ((128, 128, 128), (255, 102, 102))
    """
    if index < 0:
        return _NO_PLANE
    red, green, blue = colorsys.hsv_to_rgb((index * _HUE_STEP) % 1.0, _SATURATION, 1.0)
    return round(255 * red), round(255 * green), round(255 * blue)


def write_plane_cloud(path: Path, cloud: PointCloud, labels: PointLabels) -> None:
    """Write all points as LAZ, coloured by plane, piece by piece.

    The field `plane` holds the position of the plane in `planes.json`, -1 for none. Colours are
    the plane's, darker where the intensity is (or, without one, the grey of the cloud's colours).
    World coordinates are kept to a tenth of a millimetre; scans are told by `point_source_id`.

    Args:
        path: the new file, `.laz`.
        cloud: the points.
        labels: of the same points.

    Raises:
        ArgumentError: the labels are of another cloud.
        PluginError: laspy does not load.
    """
    if len(labels.plane_index) != len(cloud):
        raise ArgumentError(
            f"the labels are of {len(labels.plane_index)} points, but the cloud has {len(cloud)}"
        )
    laspy = load_library("laspy", path)
    header = _header(laspy, cloud)
    palette = np.array(
        [plane_colour(k) for k in range(-1, int(labels.plane_index.max(initial=-1)) + 1)]
    )
    low, high = _grey_range(cloud)
    with laspy.open(path, mode="w", header=header) as writer:
        for first in range(0, len(cloud), _CHUNK):
            part = slice(first, min(first + _CHUNK, len(cloud)))
            points = laspy.ScaleAwarePointRecord.zeros(part.stop - part.start, header=header)
            points.x, points.y, points.z = cloud.points_world(part).T
            plane = np.asarray(labels.plane_index[part])
            points[PLANE_FIELD] = plane
            grey = np.clip((_grey(cloud, part) - low) / max(high - low, 1e-6), 0.0, 1.0)
            shade = _DARKEST + (1.0 - _DARKEST) * grey
            # LAS colours have 16 bits.
            colours = 257.0 * palette[plane + 1] * shade[:, None]
            points.red, points.green, points.blue = np.rint(colours).astype(np.uint16).T
            if cloud.intensity is not None:
                intensity = np.clip(cloud.intensity[part], 0.0, 1.0)
                points.intensity = np.rint(65535.0 * intensity).astype(np.uint16)
            if cloud.scan is not None:
                points.point_source_id = cloud.scan[part]
            points.return_number[:] = 1
            points.number_of_returns[:] = 1
            writer.write_points(points)


# Any: laspy has no types.
def _header(laspy: Any, cloud: PointCloud) -> Any:
    header = laspy.LasHeader(point_format=_POINT_FORMAT, version=_VERSION)
    header.add_extra_dim(
        laspy.ExtraBytesParams(name=PLANE_FIELD, type=np.int16, description="plane, -1 for none")
    )
    spans = [float(max(abs(v.min()), abs(v.max()))) for v in (cloud.x, cloud.y, cloud.z) if len(v)]
    coarsest = max(spans, default=0.0) / _LARGEST
    # 32 bits hold two hundred kilometres at this scale.
    scale = _SCALE_M if coarsest <= _SCALE_M else 10.0 ** math.ceil(math.log10(coarsest))
    header.scales = np.full(3, scale)
    header.offsets = np.floor(cloud.origin)
    # The same cloud gives the same bytes on another day; laspy would write today's.
    header.creation_date = _NO_DATE
    header.generating_software = "orthoflow"
    return header


def _grey(cloud: PointCloud, part: slice) -> NDArray[np.float64]:
    if cloud.intensity is not None:
        return np.sqrt(np.maximum(np.asarray(cloud.intensity[part], dtype=np.float64), 0.0))
    if cloud.rgb is not None:
        grey: NDArray[np.float64] = np.asarray(cloud.rgb[part], dtype=np.float64).mean(axis=1)
        return grey
    return np.ones(part.stop - part.start)


def _grey_range(cloud: PointCloud) -> tuple[float, float]:
    """Between which greys most points lie, told from the first and some later ones."""
    if (cloud.intensity is None and cloud.rgb is None) or not len(cloud):
        return 0.0, 1.0
    firsts = range(0, len(cloud), max(1, len(cloud) // 16))
    sample = [_grey(cloud, slice(k, min(k + 4096, len(cloud)))) for k in firsts]
    low, high = np.percentile(np.concatenate(sample), (1.0, 99.0))
    return float(low), float(high)
