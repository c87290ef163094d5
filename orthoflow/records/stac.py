"""Export of orthoimages as a STAC collection with one item per GeoTIFF and relative links.

The export follows STAC 1.1.0 with the extensions projection 2.0.0 and file 2.1.0. Only rasters in
map coordinates are georeferenced; rasters in the plane of a wall become items without a geometry,
which STAC allows.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Final

from orthoflow.errors import ArgumentError
from orthoflow.files.geotiff import RasterPlace, place_of
from orthoflow.files.sidecars import read_sidecar
from orthoflow.files.wall_descriptions import described
from orthoflow.products import JsonValue
from orthoflow.records.runs import PRODUCTS_FOLDER, Run, copy_files, creating
from orthoflow.untrusted_text import json_bytes, shown

COLLECTION_FILE: Final = "collection.json"
_VERSION: Final = "1.1.0"
_PROJECTION: Final = "https://stac-extensions.github.io/projection/v2.0.0/schema.json"
_FILE: Final = "https://stac-extensions.github.io/file/v2.1.0/schema.json"
_GEOTIFF: Final = "image/tiff; application=geotiff; profile=cloud-optimized"
_ORTHO: Final = "_ortho.tif"
# Map the end of a file name to the STAC asset: key, media type and roles.
_BESIDE: Final = {
    "_ortho.tif": ("image", _GEOTIFF, ["data"]),
    "_ortho_mask.tif": ("mask", "image/tiff; application=geotiff", ["metadata"]),
    "_ortho.png": ("preview", "image/png", ["thumbnail"]),
    "_ortho.json": ("placing", "application/json", ["metadata"]),
    "_error.tif": ("error", "image/tiff; application=geotiff", ["metadata"]),
}
_DESCRIBED: Final = ("painted_share", "expected_mm_median", "expected_mm_p95", "recommended")
_EVERYWHERE: Final = (-180.0, -90.0, 180.0, 90.0)
# In a multihash, this prefix states that the hash is a SHA-256 with 32 bytes.
_MULTIHASH: Final = "1220"


@dataclass(frozen=True, kw_only=True)
class _Ortho:
    """An orthoimage in the export folder.

    Attributes:
        path: path relative to the export folder.
        address: address of its cell.
        place: position of the raster.
    """

    path: PurePosixPath
    address: str
    place: RasterPlace

    @property
    def item_path(self) -> PurePosixPath:
        """Path of the STAC item; `wall_0_ortho.json` is already the name of the sidecar."""
        return self.path.with_name(f"{self.path.stem}.item.json")


def write_stac(run: Run, folder: Path) -> int:
    """Copy the orthoimages of a run, write a STAC collection, and return the number of items.

    Args:
        run: the run, with its published files.
        folder: existing empty folder.

    Raises:
        ArgumentError: the run published no orthoimages, or their files are missing.
        RecordError: a published file was changed.
        StoreError: the disk cannot be written to.
    """
    inside = {
        f"{PRODUCTS_FOLDER}/{path.parent.name}/{path.name}": address
        for address, files in run.files.items()
        for path in files
        # Omit repeats: their content is the same, and the # in their file names would begin a
        # fragment in a link.
        if run.cells[address].repeat == 0 and path.name.endswith(tuple(_BESIDE))
    }
    copied = copy_files(run.folder, folder, inside, run.record.published)
    orthos = [
        _Ortho(path=PurePosixPath(path), address=inside[path], place=place_of(folder / path))
        for path in copied
        if path.endswith(_ORTHO)
    ]
    if not orthos:
        raise ArgumentError(
            run.with_failure(
                f"the run {run.record.run_id} has no orthoimages among its published files, so "
                "there is nothing to describe"
            )
        )
    for ortho in orthos:
        beside = [path for path in copied if _is_beside(PurePosixPath(path), ortho)]
        item = _item(run, folder, ortho, beside)
        _write(folder, ortho.item_path, item)
    _write(folder, PurePosixPath(COLLECTION_FILE), _collection(run, orthos))
    return len(orthos)


def _is_beside(path: PurePosixPath, ortho: _Ortho) -> bool:
    stem = ortho.path.name.removesuffix(_ORTHO)
    return path.parent == ortho.path.parent and path.name in {stem + end for end in _BESIDE}


def _item(run: Run, folder: Path, ortho: _Ortho, beside: list[str]) -> dict[str, JsonValue]:
    place, sidecar = ortho.place, read_sidecar(folder / ortho.path.with_suffix(".json"))
    about = described(folder / ortho.path, sidecar)
    outline: list[JsonValue] = [list(corner) for corner in ortho.place.outline_lonlat]
    geometry: JsonValue = {"type": "Polygon", "coordinates": [outline]} if outline else None
    digest = sidecar.get("product_digest")
    cell = run.cells[ortho.address]
    up = "/".join([".."] * (len(ortho.item_path.parts) - 1)) or "."
    collection = f"{up}/{COLLECTION_FILE}"
    item: dict[str, JsonValue] = {
        "type": "Feature",
        "stac_version": _VERSION,
        "stac_extensions": [_PROJECTION, _FILE],
        "id": _item_id(ortho),
        "collection": run.record.run_id,
        "geometry": geometry,
        "properties": {
            "datetime": cell.ended or run.record.ended,
            "title": f"{about.name}, {ortho.address}",
            "description": about.sentence,
            **{f"orthoflow:{name}": getattr(about, name) for name in _DESCRIBED},
            "gsd": place.transform[0],
            "processing_digest": digest if isinstance(digest, str) else None,
            "proj:code": None if place.epsg is None else f"EPSG:{place.epsg}",
            "proj:wkt2": place.wkt2 or None,
            "proj:shape": list(place.shape),
            "proj:transform": list(place.transform),
            "proj:bbox": list(place.bounds),
        },
        "links": [
            {"rel": "root", "href": collection, "type": "application/json"},
            {"rel": "parent", "href": collection, "type": "application/json"},
            {"rel": "collection", "href": collection, "type": "application/json"},
        ],
        "assets": {
            key: entry
            for path in beside
            for key, entry in (_asset(run, PurePosixPath(path), ortho),)
        },
    }
    if place.outline_lonlat:
        item["bbox"] = list(_bbox([place]))
    return item


def _asset(run: Run, path: PurePosixPath, ortho: _Ortho) -> tuple[str, dict[str, JsonValue]]:
    stem = ortho.path.name.removesuffix(_ORTHO)
    key, media_type, roles = _BESIDE[path.name.removeprefix(stem)]
    entry: dict[str, JsonValue] = {"href": f"./{path.name}", "type": media_type, "roles": [*roles]}
    for file in run.record.published:
        if file.path == str(path):
            entry["file:size"] = file.size_bytes
            entry["file:checksum"] = f"{_MULTIHASH}{file.sha256}"
    return key, entry


def _collection(run: Run, orthos: list[_Ortho]) -> dict[str, JsonValue]:
    record = run.record
    on_earth = [ortho.place for ortho in orthos if ortho.place.outline_lonlat]
    text = f"Orthoimages of the run {record.run_id} of the workflow {record.name}."
    if len(on_earth) < len(orthos):
        text += (
            " Items without a geometry use local coordinates in the plane of their wall, which are "
            "not georeferenced; the extent of the collection does not include them."
        )
    bbox: list[JsonValue] = list(_bbox(on_earth) if on_earth else _EVERYWHERE)
    items: list[JsonValue] = [
        {"rel": "item", "href": f"./{ortho.item_path}", "type": "application/geo+json"}
        for ortho in orthos
    ]
    root: JsonValue = {"rel": "root", "href": f"./{COLLECTION_FILE}", "type": "application/json"}
    return {
        "type": "Collection",
        "stac_version": _VERSION,
        "stac_extensions": [],
        "id": record.run_id,
        "title": record.name,
        "description": text,
        "license": "other",
        "providers": [{"name": record.created_by, "roles": ["processor"]}],
        "extent": {
            "spatial": {"bbox": [bbox]},
            "temporal": {"interval": [[record.started or None, record.ended or None]]},
        },
        "links": [root, *items],
    }


def _bbox(places: list[RasterPlace]) -> tuple[float, float, float, float]:
    lon, lat = zip(*(corner for place in places for corner in place.outline_lonlat), strict=True)
    return min(lon), min(lat), max(lon), max(lat)


def _item_id(ortho: _Ortho) -> str:
    return f"{shown(ortho.address)}.{ortho.path.stem}"


def _write(folder: Path, path: PurePosixPath, content: Mapping[str, JsonValue]) -> None:
    with creating(folder, str(path)) as stream:
        stream.write(json_bytes(content, indent=1) + b"\n")
