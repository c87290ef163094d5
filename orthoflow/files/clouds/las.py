"""A cloud as LAZ 1.4: scans by point source, plane, deviation, normals and photo as extra bytes."""

from __future__ import annotations

import datetime as dt
import math
from pathlib import Path
from typing import Any, Final

import numpy as np

from orthoflow.files.clouds.dressing import DressedCloud, Points
from orthoflow.files.points.scan_file import load_library
from orthoflow.products import PointCloud

# LAS 1.4 with colours.
_POINT_FORMAT: Final = 7
_VERSION: Final = "1.4"
_SCALE_M: Final = 1e-4
_NO_DATE: Final = dt.date(1970, 1, 1)
_LARGEST: Final = 2.0**30
# Names as in CloudCompare and PDAL.
NORMAL_FIELDS: Final = ("NormalX", "NormalY", "NormalZ")


def write_laz(path: Path, dressed: DressedCloud) -> int:
    """Write the selected points, piece by piece; return their number.

    World coordinates are stored to a tenth of a millimetre, relative to the offset of the header.

    Raises:
        PluginError: laspy does not load.
    """
    laspy = load_library("laspy", path)
    header = las_header(laspy, dressed)
    n_written = 0
    with laspy.open(path, mode="w", header=header) as writer:
        for points in dressed.blocks():
            writer.write_points(las_record(laspy, header, points))
            n_written += len(points)
    return n_written


# Any: laspy has no types.
def las_record(laspy: Any, header: Any, points: Points) -> Any:
    """Return points as laspy writes them under a header."""
    record = laspy.ScaleAwarePointRecord.zeros(len(points), header=header)
    record.x, record.y, record.z = points.world.T
    # LAS colours have 16 bits.
    record.red, record.green, record.blue = 257 * points.rgb.astype(np.uint16).T
    for axis, name in enumerate(NORMAL_FIELDS):
        record[name] = points.normal[:, axis]
    for name, values in points.fields().items():
        if name == "intensity":
            record.intensity = np.rint(65535.0 * values).astype(np.uint16)
        else:
            record["point_source_id" if name == "scan" else name] = values
    record.return_number[:] = 1
    record.number_of_returns[:] = 1
    return record


def las_header(laspy: Any, dressed: DressedCloud) -> Any:
    """Return the header of a cloud, without points."""
    cloud = dressed.cloud
    header = laspy.LasHeader(point_format=_POINT_FORMAT, version=_VERSION)
    extra: list[tuple[str, type[np.generic], str]] = [
        (name, np.float32, "of the surface, 0 0 0 unknown") for name in NORMAL_FIELDS
    ]
    if dressed.labels is not None:
        extra.append(("plane", np.int16, "plane, -1 for none"))
    if dressed.wall is not None or (dressed.labels is not None and dressed.planes is not None):
        extra.append(("deviation", np.float32, "m from the plane, to viewer"))
    if dressed.photo_colours is not None:
        extra.append(("photo", np.int16, "photo of the colour, -1 none"))
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams(name=name, type=kind, description=text)
            for name, kind, text in extra
        ]
    )
    header.scales = np.full(3, _scale_m(cloud))
    header.offsets = np.floor(cloud.origin)
    # LAS 1.4 requires it with this point format, with or without a known coordinate system.
    header.global_encoding.wkt = True
    if dressed.crs_wkt:
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(dressed.crs_wkt))
    # Independent of the date, so that the same cloud gives the same bytes.
    header.creation_date = _NO_DATE
    header.generating_software = "orthoflow"
    return header


def _scale_m(cloud: PointCloud) -> float:
    spans = [float(max(abs(v.min()), abs(v.max()))) for v in (cloud.x, cloud.y, cloud.z) if len(v)]
    coarsest = max(spans, default=0.0) / _LARGEST
    # 32 bits hold two hundred kilometres at this scale.
    return _SCALE_M if coarsest <= _SCALE_M else 10.0 ** math.ceil(math.log10(coarsest))
