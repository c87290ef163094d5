"""`read.orthoimage`: orthoimages from other programs, for comparison with those of orthoflow."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar, Final

import numpy as np
from pydantic import Field

from orthoflow.errors import InputError
from orthoflow.files.geotiff import RasterFile, read_raster
from orthoflow.files.sidecars import (
    MOST_WALLS,
    frame_of_raster,
    read_sidecar,
    shown_value,
    sidecar_of,
)
from orthoflow.geometry.levels import Colours, level_of
from orthoflow.products import InputFiles, Orthoimage, Orthoimages, OrthoMask
from orthoflow.sdk import Method, MethodParams, MetricSpec, Ports, StepContext

_IMAGES: Final = (".tif", ".tiff")


class ReadOrthoimage(Method):
    """Read orthoimages from GeoTIFF files whose X and Y are metres in the plane of a wall.

    The plane is given by a JSON file with the same name (`wall.tif`, `wall.json`) among the input
    files. It contains `origin_world`, `u_world`, `v_world` and `normal_world`, as in the JSON files
    of rasters from orthoflow; a copy of `wall_0_intensity.json` is sufficient. GeoTIFF files from
    orthoflow need no JSON file. X and Y have the same meaning as in GeoTIFF files from orthoflow.
    At the origin, they have the values `x_of_left_m` and `height_of_top_m` of the JSON file, or 0
    if these are missing. The size, cell size and extent of the image may therefore differ from
    those of the raster of the wall. `wall` in the JSON file is the number of the wall, that is, the
    index of its plane in `planes.json`, as in file names.
    """

    id: ClassVar[str] = "read.orthoimage"
    repeatable: ClassVar[tuple[str, ...]] = ("files",)
    determinism = "exact"
    metrics = (
        MetricSpec("n_orthoimages", label="orthoimages"),
        MetricSpec("painted_share", label="covered cells"),
    )
    citations: ClassVar[tuple[str, ...]] = ()

    class Params(MethodParams):
        """Parameters that are not in the files."""

        wall: int = Field(
            0,
            ge=0,
            description="Wall number of images whose JSON file does not contain one: the index "
            "of the plane in planes.json, as in file names.",
        )

    class In(Ports):
        """The GeoTIFF files, and the JSON files that describe their planes."""

        files: InputFiles

    class Out(Ports):
        """The images, ordered by wall."""

        orthoimages: Orthoimages

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Read all files."""
        paths = [
            path
            for path in inputs.files.paths
            if path.suffix.lower() in _IMAGES and not path.stem.endswith("_mask")
        ]
        if not paths:
            raise InputError(
                f"the input {inputs.files.name} contains no GeoTIFF: expected orthoimages (.tif)"
            )
        images: dict[int, Orthoimage] = {}
        for place, path in enumerate(paths):
            ctx.progress(place / len(paths), path.name)
            image = _read(path, inputs.files.paths, params.wall)
            if image.wall in images:
                raise InputError(
                    f"{path.name} and {images[image.wall].sources[0]} both show wall "
                    f"{image.wall}: set another `wall` in the JSON file of one of them"
                )
            images[image.wall] = image
            ctx.log(f"{path.name}: wall {image.wall}, cells of {1e3 * image.frame.gsd_m:g} mm")
        ctx.metric("n_orthoimages", len(images), "1")
        shown = sum(int(np.count_nonzero(image.mask)) for image in images.values())
        total = sum(image.mask.size for image in images.values())
        ctx.metric("painted_share", shown / total, "1")
        return self.Out(
            orthoimages=Orthoimages(images=tuple(images[wall] for wall in sorted(images)))
        )


def _read(path: Path, among: Sequence[Path], wall: int) -> Orthoimage:
    raster = read_raster(path)
    place = _place(path, among, raster)
    number = place.get("wall", wall)
    if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number <= MOST_WALLS:
        raise InputError(
            f"{path.stem}.json: wall must be a wall number from 0 to {MOST_WALLS}, got "
            f"{shown_value(number)}"
        )
    rgb = _rgb(path, raster)
    shown = raster.shown if raster.shown.ndim == 2 else raster.shown[..., 0]
    frame = frame_of_raster(
        place,
        raster=raster.place,
        shape=(rgb.shape[0], rgb.shape[1]),
        name=path.name,
    )
    return Orthoimage(
        frame=frame,
        wall=number,
        name=str(place.get("name", path.stem)),
        rgb=np.where(shown[..., None], rgb, level_of(rgb)(0)),
        mask=np.where(shown, OrthoMask.PAINTED, OrthoMask.NONE).astype(np.uint8),
        source=np.where(shown, 0, -1).astype(np.int16),
        sources=(path.name,),
        plane_index=number,
    )


def _place(path: Path, among: Sequence[Path], raster: RasterFile) -> dict[str, object]:
    """Return the content of the JSON file next to an image, or of the tag that orthoflow wrote."""
    for other in among:
        if other.stem == path.stem and other.suffix.lower() == ".json":
            return read_sidecar(other)
    if "frame" in raster.tags:
        tags = {"name": raster.tags.get("name", path.stem)}
        return sidecar_of(raster.tags["frame"], path.name) | tags
    raise InputError(
        f"{path.name} does not contain its position in the world: add {path.stem}.json with "
        "origin_world, u_world, v_world and normal_world to the files, e.g. a copy of the "
        "wall_<k>_intensity.json that orthoflow wrote"
    )


def _rgb(path: Path, raster: RasterFile) -> Colours:
    """Return the colours (rows, cols, 3) with 8 or 16 bits; a fourth band is transparency."""
    values = raster.values
    bands = values[..., None] if values.ndim == 2 else values
    if bands.shape[2] not in (1, 3, 4) or bands.dtype not in (np.uint8, np.uint16):
        raise InputError(
            f"{path.name} has {bands.shape[2]} bands of {bands.dtype}: expected grey, RGB or RGBA "
            "with 8 or 16 bits"
        )
    colours = np.repeat(bands, 3, axis=2) if bands.shape[2] == 1 else bands[..., :3]
    level = np.uint16 if colours.dtype == np.uint16 else np.uint8
    return np.ascontiguousarray(colours).astype(level)
