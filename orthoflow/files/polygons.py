"""GeoJSON files: reading polygons drawn in other programs, and writing features."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.geotiff import SITE_CRS, SITE_CRS_WKT, epsg_of, local_crs_wkt
from orthoflow.files.sidecars import write_bytes
from orthoflow.geometry.frames import FARTHEST_M
from orthoflow.products.product import JsonValue
from orthoflow.untrusted_text import json_bytes, open_file, parse_json

Feature: TypeAlias = dict[str, JsonValue]

#: bytes of a GeoJSON file with masks or seams
MOST_BYTES: Final = 50_000_000
# Each polygon may cover a whole photo.
#: polygons in a GeoJSON file with masks or seams
MOST_POLYGONS: Final = 10_000
_CORNERS_LEAST: Final = 3


@dataclass(frozen=True, kw_only=True)
class NamedPolygon:
    """A polygon with a name from one of its properties.

    Attributes:
        name: value of the property that contains the name.
        rings: corners (n, 2) of each ring, float64, the outer ring first, then holes.
        properties: all properties of the feature.
    """

    name: str
    rings: tuple[NDArray[np.float64], ...]
    properties: Mapping[str, object] = field(default_factory=dict)


def read_polygons(path: Path, name: str, *, what: str) -> list[NamedPolygon]:
    """Read a GeoJSON FeatureCollection of polygons, each of which has a name in one property.

    Args:
        path: the file.
        name: key of the property that contains the name of a polygon.
        what: expected content of the file, for error messages, such as "a mask of photos".

    Raises:
        InputError: the file has another content.
    """
    expected = (
        f"{path.name} is not {what}: expected a GeoJSON FeatureCollection of polygons, each with "
        f'the property "{name}"'
    )
    try:
        with open_file(path) as stream:
            text = stream.read(MOST_BYTES + 1)
        if len(text) > MOST_BYTES:
            raise InputError(f"it has more than {MOST_BYTES} bytes")
        content = parse_json(text.decode())
    except (OSError, ValueError) as error:
        raise InputError(f"{expected}; {error}") from error
    features = content.get("features") if isinstance(content, dict) else None
    if not isinstance(features, list):
        raise InputError(expected)
    found: list[NamedPolygon] = []
    for number, feature in enumerate(features):
        try:
            found += _polygons_of(feature, name)
        except (TypeError, ValueError, KeyError, IndexError, OverflowError) as error:
            raise InputError(f"{expected} (feature {number})") from error
        if len(found) > MOST_POLYGONS:
            raise InputError(f"{path.name} contains more than {MOST_POLYGONS} polygons: split it")
    return found


def _polygons_of(feature: Any, name: str) -> Iterator[NamedPolygon]:
    """Yield the polygons of a feature; an invalid feature raises various exceptions."""
    properties, geometry = feature["properties"], feature["geometry"]
    kinds = {"Polygon": [geometry["coordinates"]], "MultiPolygon": geometry["coordinates"]}
    for parts in kinds[geometry["type"]]:
        rings = tuple(np.array(ring, dtype=np.float64)[:, :2] for ring in parts)
        is_valid = rings and isinstance(properties[name], str)
        if not is_valid or not all(
            len(ring) >= _CORNERS_LEAST and (np.abs(ring) < FARTHEST_M).all() for ring in rings
        ):
            raise ValueError
        yield NamedPolygon(name=properties[name], rings=rings, properties=dict(properties))


def filled(rings: tuple[NDArray[np.float64], ...], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Return a mask (rows, cols) of the cells whose centre is in a polygon and not in its holes.

    Args:
        rings: (n, 2) corners as (column, row), with the centre of the first cell at (0.5, 0.5).
        shape: rows and columns.
    """
    from rasterio.features import rasterize

    coordinates = [np.vstack([ring, ring[:1]]).tolist() for ring in rings]
    polygon = {"type": "Polygon", "coordinates": coordinates}
    return np.asarray(rasterize([polygon], out_shape=shape, dtype=np.uint8), dtype=np.bool_)


def outlines(
    values: NDArray[np.int16 | np.int32],
) -> list[tuple[int, tuple[NDArray[np.float64], ...]]]:
    """Return the areas of equal value as rings (n, 2) of (column, row) along cell edges.

    The outer ring comes first, then holes; each ring ends with its first corner, as in GeoJSON.

    Args:
        values: (rows, cols); negative values belong to no area.
    """
    from rasterio.features import shapes

    found = []
    for geometry, value in shapes(values, mask=values >= 0, connectivity=4):
        rings = tuple(np.array(ring, dtype=np.float64) for ring in geometry["coordinates"])
        found.append((int(value), rings))
    return found


def write_features(
    path: Path,
    features: Iterable[Feature],
    crs: str,
    *,
    indent: int | None = 1,
    digest: str | None = None,
) -> None:
    """Write a GeoJSON FeatureCollection in metres.

    The file contains the name of its coordinate system in the form that GDAL reads, although RFC
    7946 only allows degrees: without the name, a GIS would interpret metres as degrees.

    Args:
        path: the file.
        features: features in order, each with type, properties and geometry as in RFC 7946.
        crs: an EPSG code, `site` (coordinates of the scan), or the name of a wall's own system, as
            in `WallFrame.crs`.
        indent: indentation of the text; None for a single line.
        digest: digest of the product shown, or None.

    Raises:
        StoreError: the file cannot be written.
    """
    epsg = epsg_of(crs)
    local = SITE_CRS_WKT if crs == SITE_CRS else local_crs_wkt(crs)
    name = local if epsg is None else f"urn:ogc:def:crs:EPSG::{epsg}"
    content: dict[str, JsonValue] = {"type": "FeatureCollection", "name": path.stem}
    if digest is not None:
        content["product_digest"] = digest
    content["crs"] = {"type": "name", "properties": {"name": name}}
    content["features"] = list(features)
    write_bytes(path, json_bytes(content, indent=indent) + b"\n")
