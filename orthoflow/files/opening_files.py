"""Files of openings that people open in other programs: outlines for GIS, and a schedule."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from orthoflow.files.drawings.geojson import opening_feature
from orthoflow.files.drawings.room_lines import numbered_openings
from orthoflow.files.geotiff import SITE_CRS
from orthoflow.files.polygons import write_features
from orthoflow.files.sidecars import write_text
from orthoflow.foreign_text import Value, csv_text
from orthoflow.products import Openings

_COLUMNS: Final = (
    "wall",
    "number",
    "kind",
    "width_m",
    "height_m",
    "sill_m",
    "area_m2",
    "depth_m",
    "edge_sigma_mm",
    "seen_share",
    "n_corners",
)
_DIGITS: Final = 4


def publish_openings(product: Openings, folder: Path, digest: str) -> None:
    """Write `wall_<k>_openings.geojson` per wall that has any, `openings.geojson`, `openings.csv`.

    Those of a wall are in the coordinates of its GeoTIFF, `openings.geojson` in those of the scan,
    x, y, z on the planes of the walls.
    """
    for wall in product.walls:
        own = product.of_wall(wall)
        if own:
            write_features(
                folder / f"wall_{wall}_openings.geojson",
                [opening_feature(opening, place) for place, opening in enumerate(own)],
                own[0].crs,
                digest=digest,
            )
    features = [
        opening_feature(opening, place, in_world=True)
        for place, opening in numbered_openings(product.openings)
    ]
    crs = product.map_crs or SITE_CRS
    write_features(folder / "openings.geojson", features, crs, digest=digest)
    write_text(folder / "openings.csv", csv_text(_rows(product)))


def _rows(product: Openings) -> Iterator[Sequence[Value]]:
    yield _COLUMNS
    for place, opening in numbered_openings(product.openings):
        sigma_m = opening.edge_sigma_m
        yield (
            opening.wall,
            place,
            opening.kind,
            round(opening.width_m, _DIGITS),
            round(opening.height_m, _DIGITS),
            round(opening.sill_m, _DIGITS),
            round(opening.area_m2, _DIGITS),
            None if opening.depth_m is None else round(opening.depth_m, _DIGITS),
            None if sigma_m is None else round(1e3 * sigma_m, 2),
            round(opening.seen_share, _DIGITS),
            len(opening.outline_m),
        )
