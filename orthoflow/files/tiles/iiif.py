"""Export to IIIF: a Presentation 3 manifest with physical scale, and level 0 image services.

Each wall is a canvas; its pictures (orthoimage, intensity, depth and relief) are alternatives that
the viewer offers. An image service is a folder with static tiles and an `info.json`, for any web
server.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.drawings.printed_pictures import Stretch, stretch_of
from orthoflow.files.geotiff import RasterParts
from orthoflow.files.sidecars import write_json
from orthoflow.geometry.levels import eight_bits
from orthoflow.products import JsonValue

TILE_PX: Final = 512
MANIFEST: Final = "manifest.json"
_CONTEXT: Final = "http://iiif.io/api/presentation/3/context.json"
_PHYSICAL: Final = "http://iiif.io/api/annex/services/physdim/1/context.json"
_WHITE: Final = 255


@dataclass(frozen=True, kw_only=True)
class Layer:
    """A picture of a wall.

    Attributes:
        label: description of the picture.
        raster: GeoTIFF of the picture, with three colour bands or one band that is stretched to
            grey.
        stem: name of the folder with the tiles.
    """

    label: str
    raster: Path
    stem: str


@dataclass(frozen=True, kw_only=True)
class Canvas:
    """A wall.

    Attributes:
        label: name of the wall.
        summary: one line, e.g. on the accuracy of the orthoimage.
        layers: pictures with the same cells; the first one is shown initially.
    """

    label: str
    summary: str
    layers: Sequence[Layer]


def write_manifest(folder: Path, title: str, canvases: Sequence[Canvas], base: str) -> int:
    """Write `manifest.json` and the tiles of all layers; return the number of tiles.

    Args:
        folder: existing folder.
        title: title of the manifest.
        canvases: the walls.
        base: URL of the folder on the web server, e.g. `https://example.org/room`.

    Raises:
        InputError: a raster cannot be read.
    """
    base = base.rstrip("/")
    items: list[JsonValue] = []
    count = 0
    for number, canvas in enumerate(canvases, start=1):
        address = f"{base}/canvas/{number}"
        bodies: list[JsonValue] = []
        for layer in canvas.layers:
            shape, gsd_m, n_tiles = _write_service(folder, layer, base)
            count += n_tiles
            bodies.append(_body(layer, shape, base))
        items.append(_canvas(address, canvas, bodies, shape, gsd_m))
    write_json(
        folder / MANIFEST,
        {
            "@context": _CONTEXT,
            "id": f"{base}/{MANIFEST}",
            "type": "Manifest",
            "label": {"en": [title]},
            "items": items,
        },
    )
    return count


def _canvas(
    address: str,
    canvas: Canvas,
    bodies: Sequence[JsonValue],
    shape: tuple[int, int],
    gsd_m: float,
) -> JsonValue:
    choice: JsonValue = {"type": "Choice", "items": list(bodies)}
    body = bodies[0] if len(bodies) == 1 else choice
    return {
        "id": address,
        "type": "Canvas",
        "label": {"en": [canvas.label]},
        "summary": {"en": [canvas.summary]},
        "height": shape[0],
        "width": shape[1],
        "service": [
            {
                "@context": _PHYSICAL,
                "id": f"{address}/scale",
                "type": "PhysicalDimensions",
                "profile": "http://iiif.io/api/annex/services/physdim",
                "physicalScale": 1e3 * gsd_m,
                "physicalUnits": "mm",
            }
        ],
        "items": [
            {
                "id": f"{address}/page",
                "type": "AnnotationPage",
                "items": [
                    {
                        "id": f"{address}/painting",
                        "type": "Annotation",
                        "motivation": "painting",
                        "target": address,
                        "body": body,
                    }
                ],
            }
        ],
    }


def _body(layer: Layer, shape: tuple[int, int], base: str) -> dict[str, JsonValue]:
    rows, columns = shape
    return {
        "id": f"{base}/{layer.stem}/full/{columns},{rows}/0/default.jpg",
        "type": "Image",
        "format": "image/jpeg",
        "label": {"en": [layer.label]},
        "height": rows,
        "width": columns,
        "service": [{"id": f"{base}/{layer.stem}", "type": "ImageService3", "profile": "level0"}],
    }


def _write_service(folder: Path, layer: Layer, base: str) -> tuple[tuple[int, int], float, int]:
    """Write `info.json` and tiles; return the picture's shape, its cell size and the tile count."""
    service = folder / layer.stem
    with RasterParts(layer.raster) as source:
        rows, columns = source.shape
        stretch = stretch_of(layer.raster) if source.bands == 1 else None
        factors = [1]
        while TILE_PX * factors[-1] < max(rows, columns):
            factors.append(2 * factors[-1])
        count = 0
        for factor in factors:
            step = TILE_PX * factor
            for top in range(0, rows, step):
                for left in range(0, columns, step):
                    wide, high = min(step, columns - left), min(step, rows - top)
                    shape = (-(-high // factor), -(-wide // factor))
                    tile = _picture(source, (left, top, left + wide, top + high), shape, stretch)
                    place = service / f"{left},{top},{wide},{high}" / f"{shape[1]},{shape[0]}"
                    _write_jpeg(place / "0" / "default.jpg", tile)
                    count += 1
        # Write the overview that viewers load first; it is the whole picture if that fits into one
        # tile.
        small = factors[-1]
        sizes = [(-(-rows // factor), -(-columns // factor)) for factor in (small, *factors[:1])]
        for shape in dict.fromkeys(sizes):
            whole = _picture(source, (0, 0, columns, rows), shape, stretch)
            name = f"{shape[1]},{shape[0]}"
            _write_jpeg(service / "full" / name / "0" / "default.jpg", whole)
        gsd_m = source.gsd_m
    write_json(
        service / "info.json",
        {
            "@context": "http://iiif.io/api/image/3/context.json",
            "id": f"{base}/{layer.stem}",
            "type": "ImageService3",
            "protocol": "http://iiif.io/api/image",
            "profile": "level0",
            "width": columns,
            "height": rows,
            "sizes": [{"width": c, "height": r} for r, c in dict.fromkeys(sizes)],
            "tiles": [{"width": TILE_PX, "height": TILE_PX, "scaleFactors": [*factors]}],
        },
    )
    return (rows, columns), gsd_m, count


def _picture(
    source: RasterParts,
    box: tuple[int, int, int, int],
    shape: tuple[int, int],
    stretch: Stretch | None,
) -> NDArray[np.uint8]:
    left, top, right, bottom = (float(edge) for edge in box)
    values, shown = source.read((left, top, right, bottom), shape)
    if stretch is None:
        picture = eight_bits(np.ascontiguousarray(values[:, :, :3]))
    else:
        shares = (values.astype(np.float32) - stretch.low) / (stretch.high - stretch.low)
        grey = np.nan_to_num(255.0 * np.clip(shares, 0.0, 1.0), nan=255.0).astype(np.uint8)
        picture = np.repeat(grey[:, :, None], 3, axis=2)
    return np.where(shown[:, :, None], picture, np.uint8(_WHITE))


def _write_jpeg(path: Path, picture: NDArray[np.uint8]) -> None:
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture).save(path, quality=90)
