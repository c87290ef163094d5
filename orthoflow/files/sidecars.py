"""JSON beside the rasters: where a wall's raster lies in the world and what its values mean."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import GeometryError, InputError, StoreError
from orthoflow.geometry import WallFrame
from orthoflow.products import JsonValue, OrthoMask, SurfaceMask

SURFACE_MASK_MEANINGS: Final[dict[SurfaceMask, str]] = {
    SurfaceMask.VOID: "void: no point of the scan fell here",
    SurfaceMask.MEASURED: "measured: points of the scan fell here",
    SurfaceMask.RECOVERED: "recovered: taken from neighbouring cells",
}
ORTHO_MASK_MEANINGS: Final[dict[OrthoMask, str]] = {
    OrthoMask.NONE: "none: no source covers this cell",
    OrthoMask.PAINTED: "painted: a source shows this cell",
    OrthoMask.FILLED: "filled: inpainted from neighbouring cells",
    OrthoMask.OCCLUDED: "occluded: hidden in every source",
    OrthoMask.NO_SURFACE: "no surface: the scan does not know the surface here",
}


def frame_json(frame: WallFrame) -> dict[str, JsonValue]:
    """Frame of a wall's raster: world = origin + gsd * (column * u + row * v) + depth * n."""
    plane = frame.plane
    return {
        "origin_world": numbers(frame.origin_world),
        "u_world": numbers(frame.u_world),
        "v_world": numbers(frame.v_world),
        "normal_world": numbers(frame.normal_world),
        "gsd_m": frame.gsd_m,
        "width": frame.width,
        "height": frame.height,
        "plane": {"normal": numbers(plane.normal), "offset_m": plane.offset_m},
        "corners_world": numbers(frame.corners_world()),
        "raster": {
            "world_from_raster": "origin_world + gsd_m * (column * u_world + row * v_world) + "
            "depth_m * normal_world; v_world points down, cell centres lie at .5",
            "geotiff": "X = gsd_m * column, Y = -gsd_m * row, pixel is area",
        },
    }


def frame_of_raster(
    content: Mapping[str, object],
    *,
    corner_m: tuple[float, float],
    gsd_m: float,
    shape: tuple[int, int],
    name: str,
) -> WallFrame:
    """Place a GeoTIFF in the world whose X and Y are metres in the plane of a wall.

    Args:
        content: `origin_world`, `u_world`, `v_world` (down), `normal_world` of that plane, as in
            the sidecars that orthoflow writes; X counts along u, Y against v.
        corner_m: X and Y of the outer corner of its top-left cell.
        gsd_m: side of its cells.
        shape: its rows and columns.
        name: what to call it in an error.

    Raises:
        InputError: a vector is missing, or they are no frame.
    """
    vectors = {}
    for key in ("origin_world", "u_world", "v_world", "normal_world"):
        try:
            vectors[key] = np.array(content.get(key), dtype=np.float64)
        except (TypeError, ValueError):
            vectors[key] = np.zeros(0)
        if vectors[key].shape != (3,) or not np.isfinite(vectors[key]).all():
            raise InputError(f"{name}: {key} must be three numbers, got {content.get(key)!r}")
    u, v = vectors["u_world"], vectors["v_world"]
    try:
        return WallFrame(
            origin_world=vectors["origin_world"] + corner_m[0] * u - corner_m[1] * v,
            u_world=u,
            v_world=v,
            normal_world=vectors["normal_world"],
            gsd_m=gsd_m,
            width=shape[1],
            height=shape[0],
        )
    except GeometryError as error:
        raise InputError(f"{name}: {error}") from error


def raster_tags(
    frame: WallFrame, *, digest: str, name: str, content: str, extra: Mapping[str, str]
) -> dict[str, str]:
    """Tags of a GeoTIFF: enough to place it in the world without the JSON file beside it."""
    plane = frame.plane
    return {
        "content": content,
        "frame": json.dumps(
            {
                "origin_world": numbers(frame.origin_world),
                "u_world": numbers(frame.u_world),
                "v_world": numbers(frame.v_world),
                "normal_world": numbers(frame.normal_world),
            },
            sort_keys=True,
        ),
        "gsd_m": repr(float(frame.gsd_m)),
        "name": name,
        "plane": json.dumps(
            {"normal": numbers(plane.normal), "offset_m": plane.offset_m}, sort_keys=True
        ),
        "product_digest": digest,
        "software": "orthoflow",
        **extra,
    }


def mask_meanings(meanings: Mapping[SurfaceMask, str] | Mapping[OrthoMask, str]) -> JsonValue:
    """Meaning of each mask value, keyed by the value as JSON wants it, as text."""
    return {str(int(value)): text for value, text in meanings.items()}


def numbers(values: NDArray[np.generic]) -> JsonValue:
    """Nested lists of an array; what is not finite becomes null, which JSON can hold."""
    return _finite(values.tolist())


def number(value: float | None) -> JsonValue:
    """Give a number, or None for what is absent or not finite."""
    return None if value is None or not math.isfinite(value) else float(value)


def write_json(path: Path, content: Mapping[str, JsonValue]) -> None:
    """Write a JSON file as people like to read it.

    Raises:
        StoreError: the file cannot be written.
    """
    write_text(path, json.dumps(content, indent=2, allow_nan=False, ensure_ascii=False) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a UTF-8 text file.

    Raises:
        StoreError: the file cannot be written.
    """
    write_bytes(path, text.encode())


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file.

    Raises:
        StoreError: the file cannot be written.
    """
    try:
        path.write_bytes(content)
    except OSError as error:
        raise StoreError(f"{path.name} cannot be written: {error}; free some space") from error


def _finite(value: object) -> JsonValue:
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_finite(item) for item in value]
    if isinstance(value, bool | int):
        return value
    return number(float(str(value)))
