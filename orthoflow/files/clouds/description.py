"""`cloud.json`: what the points beside it are, and the meaning of their colours and fields."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from orthoflow.files.clouds.colours import BEFORE, BEHIND, ON_PLANE, UNKNOWN
from orthoflow.files.clouds.dressing import DressedCloud
from orthoflow.files.sidecars import numbers, write_json
from orthoflow.products import JsonValue

_MEANINGS: Final = {
    "photos": "colour of the oriented photo that shows the point best; 128 128 128 and photo -1 "
    "where no photo sees it",
    "rgb": "colours of the scan",
    "intensity": "root of the scan's intensity, from its first to its 99th percentile",
    "plane": "a hue per plane, darker where the intensity is, or without one the colour; grey: on "
    "no plane",
    "deviation": "distance from the plane, positive towards the viewer; grey: on no plane",
}


def describe_cloud(path: Path, dressed: DressedCloud, name: str, n_points: int) -> None:
    """Write the description of a cloud's file beside it.

    Raises:
        StoreError: the file cannot be written.
    """
    cloud = dressed.cloud
    about: dict[str, JsonValue] = {
        "file": name,
        "points": n_points,
        "points_of_the_cloud": len(cloud),
        "product_digest": dressed.name,
        "coordinates": "metres, as the scan has them; z or another axis is up as `up` says",
        "up": numbers(cloud.up),
        "origin_world": numbers(cloud.origin),
        "coordinate_system_wkt": dressed.crs_wkt or None,
        "colour": dressed.colouring,
        "colour_meaning": _MEANINGS[dressed.colouring],
        "normals": "least-squares planes of voxels with their neighbours, sides of "
        f"{3.0 * dressed.neighbourhoods.side_m:.4g} m, towards the viewer; 0 0 0: no surface",
        "cleaned": "points with fewer than 10 about them, in 3 x 3 x 3 cubes of "
        f"{3.0 * dressed.neighbourhoods.side_m:.4g} m, are left out"
        if dressed.is_cleaned
        else None,
        "wall": None
        if dressed.wall is None
        else {"plane_index": dressed.wall_plane, "deviation": "from the plane of this wall"},
        "box_world": None if dressed.box_world is None else numbers(dressed.box_world),
        "scans": [_scan(dressed, scan) for scan in dressed.scans],
    }
    if dressed.colouring == "deviation":
        about["colour_scale"] = {
            "unit": "m",
            **{
                f"{place_m:+g}" if place_m else "0": list(colour)
                for place_m, colour in (
                    (-dressed.scale_m, BEHIND),
                    (0.0, ON_PLANE),
                    (dressed.scale_m, BEFORE),
                )
            },
            "none": list(UNKNOWN),
        }
    if dressed.photo_colours is not None and dressed.photo_colours.photo is not None:
        photo = dressed.photo_colours.photo
        counts = np.bincount(np.asarray(photo) + 1, minlength=len(dressed.photo_names) + 1)
        about["photos"] = list(dressed.photo_names)
        about["points_of_the_cloud_by_photo"] = [int(count) for count in counts[1:]]
        about["points_of_the_cloud_unseen"] = int(counts[0])
    write_json(path, about)


def _scan(dressed: DressedCloud, scan: int) -> JsonValue:
    station = dressed.station(scan)
    return {"scan": scan, "station_world": None if station is None else numbers(station)}
