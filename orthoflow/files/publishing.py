"""Files of a run for use in other programs; one function per product type.

Each function takes the product, an existing empty folder and the product's digest, and writes the
same bytes for the same product. `k` in file names is the index of the wall's plane in
`planes.json`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import astuple, fields
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.calibration import write_calibration
from orthoflow.files.drawings.geojson import opening_feature
from orthoflow.files.drawings.key_plans import numbered_openings
from orthoflow.files.geotiff import (
    SITE_CRS,
    GridPlace,
    world_file_text,
    write_orthoimage,
    write_raster,
)
from orthoflow.files.images import Cells, cells_per_preview_px, cells_png, grey_cells
from orthoflow.files.polygons import write_features
from orthoflow.files.sidecars import (
    LAYER_MASK_MEANINGS,
    ORTHO_MASK_MEANINGS,
    SURFACE_MASK_MEANINGS,
    frame_json,
    mask_meanings,
    number,
    numbers,
    raster_tags,
    write_bytes,
    write_json,
    write_text,
)
from orthoflow.geometry import Cylinder, Sphere, WallFrame, omega_phi_deg
from orthoflow.geometry.bands import row_bands
from orthoflow.geometry.cameras import opencv_matrix, to_opencv
from orthoflow.geometry.levels import eight_bits
from orthoflow.products import (
    Calibration,
    Camera,
    Cameras,
    JsonValue,
    Layer,
    LayerMask,
    Layers,
    Openings,
    Orthoimage,
    Orthoimages,
    Planes,
    PointCloud,
    ResidualRow,
    Surfaces,
    TieRole,
    Ties,
    Wall,
    Walls,
    is_shown,
    plane_name,
)
from orthoflow.untrusted_text import Value, csv_text

# Maximum number of characters that a file name takes from the name of a source.
_LONGEST_SOURCE: Final = 100
ERROR_CONTENT: Final = (
    "expected error of a point measured in the orthoimage, one standard deviation along u and "
    "along v, metres, due to pose, depth and parallax between photos; NaN = not assessed"
)
PIXEL_CONVENTION: Final = "OpenCV: the centre of the first (top-left) pixel is at (0, 0)"
TIE_COLUMNS: Final = (
    *("photo", "wall", "u_px", "v_px", "x", "y", "z"),
    *("role", "residual_u_px", "residual_v_px", "sigma_px"),
    # The pixel convention is a column, because simple CSV readers do not support comments.
    "opencv_pixel_convention",
)


def publish_cloud(product: PointCloud, folder: Path, digest: str) -> None:
    """Write `scans.json`: data on each scan, and which points and fields were used or omitted."""
    scans = product.source.get("scans")
    if isinstance(scans, list):
        write_json(
            folder / "scans.json",
            {"scans": scans, "n_points": len(product), "product_digest": digest},
        )


def publish_planes(product: Planes, folder: Path, digest: str) -> None:
    """Write `planes.json`: the planes in descending order of their numbers of points."""
    write_json(
        folder / "planes.json",
        {
            "planes": [_plane_json(product, index) for index in range(len(product))],
            "up": numbers(product.up),
            "product_digest": digest,
        },
    )


def _plane_json(product: Planes, index: int) -> dict[str, JsonValue]:
    omega, phi = omega_phi_deg(product.normal[index], product.up)
    entry: dict[str, JsonValue] = {
        "normal": numbers(product.normal[index]),
        "offset_m": float(product.offset[index]),
        "corners_world": numbers(product.corners[index]),
        "n_points": int(product.n_points[index]),
        "rms_mm": number(1000.0 * float(product.rms_m[index])),
        "sigma_angle_deg": product.sigma_angle_deg(index),
        "sigma_offset_mm": 1000.0 * product.sigma_offset_m(index),
        "label": product.names[index],
        "omega_deg": omega,
        "phi_deg": phi,
        "viewpoint": product.viewpoint,
        "side_from": product.side_source(index),
    }
    if product.part_corners is not None and product.part_plane is not None:
        entry["part_corners_world"] = numbers(product.part_corners[product.part_plane == index])
    return entry


def publish_surfaces(product: Surfaces, folder: Path, digest: str) -> None:
    """Write `surfaces.json`: the planes, if included, and the curved surfaces."""
    surfaces: list[JsonValue] = []
    if product.planes is not None:
        surfaces += [
            {"chart": "plane", **_plane_json(product.planes, index)}
            for index in range(product.n_planes)
        ]
    for surface in product.surfaces:
        shape = surface.shape
        entry: dict[str, JsonValue] = {
            "chart": type(shape).__name__.lower(),
            "label": surface.name,
            "axis": numbers(surface.axis_world),
            "is_concave": shape.is_concave,
        }
        if isinstance(shape, Cylinder):
            entry |= {"point": numbers(shape.point_world), "radius_m": shape.radius_m}
        elif isinstance(shape, Sphere):
            entry |= {"centre": numbers(shape.centre_world), "radius_m": shape.radius_m}
        else:
            half_angle_deg = math.degrees(shape.half_angle_rad)
            entry |= {"apex": numbers(shape.apex_world), "half_angle_deg": half_angle_deg}
        start_deg, end_deg = map(math.degrees, surface.arc_rad)
        surfaces.append(
            entry
            | {
                "arc_deg": end_deg - start_deg,
                "arc_from_deg": start_deg,
                "zero_direction": numbers(surface.zero_world),
                "length_m": surface.along_m[1] - surface.along_m[0],
                "along_from_m": surface.along_m[0],
                "n_points": surface.n_points,
                "rms_mm": 1000.0 * surface.rms_m,
                "sigma_axis_deg": number(surface.sigma_axis_deg),
                "sigma_radius_mm": 1000.0 * surface.sigma_radius_m,
            }
        )
    write_json(
        folder / "surfaces.json",
        {"surfaces": surfaces, "up": numbers(product.up), "product_digest": digest},
    )


def publish_walls(product: Walls, folder: Path, digest: str) -> None:
    """Write `wall_<k>_depth.tif`, `wall_<k>_intensity.tif` if available, sidecars and previews.

    If requested, percentiles of the depths are written to `wall_<k>_depth_p<percent>.tif`.
    """
    for index, wall in enumerate(product.walls):
        slab = product.slab(index)
        about: dict[str, JsonValue] = {
            "wall": wall.plane_index,
            "plane_index": wall.plane_index,
            "intensity_source": product.intensity_source,
            "buffer": {"front_m": slab.front_m, "behind_m": slab.behind_m},
            "includes_walls": list(product.included[index]) if product.included else [],
        }
        publish = partial(_publish_raster, wall=wall, about=about, digest=digest)
        depth = "depth in metres along the normal, positive towards the viewer; NaN = no data"
        in_metres = {"unit": "m"}
        stem = f"wall_{wall.plane_index}_depth"
        publish(folder / stem, wall.depth_m, content=depth, tags=in_metres)
        if wall.percentiles_m is not None:
            for k, percent in enumerate(product.percentiles):
                publish(
                    folder / f"{stem}_p{percent}".replace(".", "_"),
                    np.ascontiguousarray(wall.percentiles_m[:, :, k]),
                    content=f"percentile {percent} of the cell's points: {depth}",
                    tags=in_metres,
                )
        if wall.intensity is not None:
            publish(
                folder / f"wall_{wall.plane_index}_intensity",
                wall.intensity,
                content=f"intensity 0..1 ({product.intensity_source}); NaN = no data",
                tags={"unit": "1", "intensity_source": product.intensity_source},
            )


def publish_orthoimages(product: Orthoimages, folder: Path, digest: str) -> None:
    """Write `wall_<k>_ortho.tif`, a raster of its mask, sidecars, a preview, and world files.

    If requested, layers are written as by `publish_layers`.
    """
    if product.layers:
        called = {image.wall: (image.number, image.name) for image in product.images}
        _write_layers(folder, product.layers, called, product.icc_profile, digest)
    for image in product.images:
        shown = np.zeros(image.mask.shape, dtype=np.bool_)
        for rows in row_bands(shown.shape):
            shown[rows] = is_shown(image.mask[rows])
        stem = f"wall_{image.number}_ortho"
        place = GridPlace.of(image.frame)
        colours = "sRGB" if product.icc_profile is None else "ICC profile of the photos"
        content = f"orthoimage, {colours}"
        tags = raster_tags(image.frame, digest=digest, name=image.name, content=content, extra={})
        write_orthoimage(
            folder / f"{stem}.tif",
            image.rgb,
            shown,
            place=place,
            tags=tags,
            icc_profile=product.icc_profile,
        )
        write_text(folder / f"{stem}.tfw", world_file_text(place))
        if image.error_m is not None:
            error_tags = tags | {"content": ERROR_CONTENT, "unit": "m"}
            error_path = folder / f"wall_{image.number}_error.tif"
            write_raster(error_path, image.error_m, place=place, tags=error_tags)
        mask_tags = tags | {"content": "mask of the orthoimage"}
        mask_path = folder / f"{stem}_mask.tif"
        write_raster(mask_path, image.mask, place=place, tags=mask_tags)
        _write_ortho_sidecars(folder, stem, image, {"content": content}, digest)
        picture = cells_png(shown.shape, _cells_of(image, shown))
        _write_preview(folder / f"{stem}.png", picture, image.frame)


def publish_layers(product: Layers, folder: Path, digest: str) -> None:
    """Write `wall_<k>_layer_<n>_<source>.tif` and its sidecar for the layer of each source.

    `n` counts the sources of a wall from 0, since different photo names may become identical in
    file names.
    """
    called = {
        layer.wall: (product.number(layer.wall), product.name(layer.wall))
        for layer in product.layers
    }
    _write_layers(folder, product.layers, called, product.icc_profile, digest)


def _write_layers(
    folder: Path,
    layers: Sequence[Layer],
    called: Mapping[int, tuple[int, str]],
    icc_profile: bytes | None,
    digest: str,
) -> None:
    counts: dict[int, int] = {}
    for layer in layers:
        nth = counts[layer.wall] = counts.get(layer.wall, -1) + 1
        number, name = called.get(layer.wall, (layer.wall, plane_name("wall", layer.wall)))
        source = re.sub(r"[^A-Za-z0-9_-]+", "-", Path(layer.source).stem)[:_LONGEST_SOURCE]
        stem = f"wall_{number}_layer_{nth}_{source}"
        content = f"the part of the wall shown by {layer.source}"
        tags = raster_tags(layer.frame, digest=digest, name=name, content=content, extra={})
        write_orthoimage(
            folder / f"{stem}.tif",
            layer.rgb,
            layer.mask == LayerMask.PAINTED,
            place=GridPlace.of(layer.frame),
            tags=tags,
            icc_profile=icc_profile,
        )
        about: dict[str, JsonValue] = {
            "wall": number,
            "name": name,
            "source": layer.source,
            "content": content,
            "mask": mask_meanings(LAYER_MASK_MEANINGS),
            "bits": 8 * layer.rgb.itemsize,
            "mask_counts": _counts(layer.mask),
            "dataset_mask": "255 where the mask is covered (1), else 0",
            "product_digest": digest,
        }
        write_json(folder / f"{stem}.json", frame_json(layer.frame) | about)


def publish_ties(product: Ties, folder: Path, digest: str) -> None:
    """Write `ties.csv`, with pixels in OpenCV's convention and residuals (observed - computed)."""
    del digest  # A table of numbers has no field for it; the record contains it.
    pixels = to_opencv(product.pixels_photo)
    rows: Iterator[Sequence[Value]] = (
        (
            product.photo_names[int(product.photo[index])],
            product.number(int(product.wall[index])),
            *(_cell(value) for value in pixels[index]),
            *(_cell(value) for value in product.points_world[index]),
            TieRole(int(product.role[index])).name.lower(),
            *(_cell(value) for value in product.residual_px[index]),
            _cell(product.sigma_px[index]),
            "first pixel centre at 0 0",
        )
        for index in range(len(product.photo))
    )
    write_text(folder / "ties.csv", csv_text(chain((TIE_COLUMNS,), rows)))


def publish_cameras(product: Cameras, folder: Path, digest: str) -> None:
    """Write `cameras.json` and other results of the orientation.

    The other files are `calibration.yaml` with the estimated lenses, which can be used to orient
    other photos from the same cameras; `ties.csv` with the residuals, if the ties were kept; and
    `residuals.csv` with the table of residuals.
    """
    write_json(
        folder / "cameras.json",
        {
            "pixel_convention": PIXEL_CONVENTION,
            "camera_axes": "x right, y down, z forward; X_camera = R X_world + t, metres",
            "errors": "one standard deviation; sigma_wall_mm: expected error on the wall due to "
            "the orientation; sigma0_px: error of a pixel coordinate of a control tie, its a "
            "priori value times the standard deviation of unit weight; pose_covariance: of a small "
            "rotation vector in camera axes, radians, and of t, metres",
            "cameras": {camera.photo: _camera_json(camera) for camera in product.cameras},
            "product_digest": digest,
        },
    )
    estimated = {
        camera.photo: camera.intrinsics
        for camera in product.cameras
        if camera.intrinsics is not None and camera.intrinsics.source == "estimated"
    }
    if estimated:
        calibration = Calibration(patterns=tuple(estimated), intrinsics=tuple(estimated.values()))
        write_calibration(folder / "calibration.yaml", calibration)
    if product.ties is not None:
        publish_ties(product.ties, folder, digest)
    if product.residual_table:
        write_text(folder / "residuals.csv", _table_text(product.residual_table))


def _table_text(rows: Sequence[ResidualRow]) -> str:
    """Return rows as CSV; `axis` becomes `photo_axis`, because walls also have axes u and v."""
    columns = [
        "photo_axis" if column.name == "axis" else column.name for column in fields(ResidualRow)
    ]
    return csv_text([columns, *(astuple(row) for row in rows)])


def _publish_raster(
    stem: Path,
    values: NDArray[np.float32],
    *,
    wall: Wall,
    about: Mapping[str, JsonValue],
    content: str,
    tags: Mapping[str, str],
    digest: str,
) -> None:
    all_tags = raster_tags(wall.frame, digest=digest, name=wall.name, content=content, extra=tags)
    write_raster(
        stem.with_suffix(".tif"),
        values,
        place=GridPlace.of(wall.frame),
        tags=all_tags,
    )
    write_json(
        stem.with_suffix(".json"),
        {
            **frame_json(wall.frame),
            **about,
            "content": content,
            "name": wall.name,
            "mask": mask_meanings(SURFACE_MASK_MEANINGS),
            "mask_counts": _counts(wall.mask),
            "product_digest": digest,
        },
    )
    picture = cells_png(values.shape, grey_cells(values))
    _write_preview(stem.with_suffix(".png"), picture, wall.frame)


def _cells_of(image: Orthoimage, shown: NDArray[np.bool_]) -> Cells:
    """Return a function for the cells of a preview; 16-bit images are converted in parts."""
    return lambda part: (eight_bits(image.rgb[part]), shown[part])


def _write_preview(path: Path, picture: bytes, frame: WallFrame) -> None:
    rows, columns = cells_per_preview_px(frame.shape)
    text = world_file_text(GridPlace.of(frame), rows=rows, columns=columns)
    write_bytes(path, picture)
    write_text(path.with_suffix(".pgw"), text)


def _write_ortho_sidecars(
    folder: Path, stem: str, image: Orthoimage, about: Mapping[str, JsonValue], digest: str
) -> None:
    content = frame_json(image.frame) | {
        "wall": image.number,
        "name": image.name,
        "sources": list(image.sources),
        "bits": 8 * image.rgb.itemsize,
        "mask": mask_meanings(ORTHO_MASK_MEANINGS),
        "mask_counts": _counts(image.mask),
        "dataset_mask": "255 where the mask is covered (1, 5) or filled (2), else 0",
        "mask_raster": f"{stem}_mask.tif",
        "accuracy": accuracy_json(image),
        "product_digest": digest,
    }
    write_json(folder / f"{stem}.json", {**content, **about})
    write_json(folder / f"{stem}_mask.json", content | {"content": "mask of the orthoimage"})


def accuracy_json(image: Orthoimage) -> dict[str, JsonValue]:
    """Return the accuracy of an orthoimage, as far as it is known from checks on its own wall."""
    median, high = image.expected_mm
    is_assessed = math.isfinite(median)
    return {
        "expected_mm_median": number(median),
        "expected_mm_p95": number(high),
        "n_check_points": image.n_check_points,
        "assessed": is_assessed,
    }


def _counts(mask: NDArray[np.uint8]) -> JsonValue:
    counts = sum(
        (np.bincount(mask[rows].ravel(), minlength=256) for rows in row_bands(mask.shape)),
        start=np.zeros(256, dtype=np.int64),
    )
    return {str(value): int(counts[value]) for value in np.flatnonzero(counts)}


def _camera_json(camera: Camera) -> JsonValue:
    entry: dict[str, JsonValue] = {"status": camera.status}
    inner = camera.intrinsics
    if inner is not None:
        entry["K"] = numbers(opencv_matrix(inner.posed()))
        entry["distortion"] = list(inner.distortion)
        entry["width"] = inner.width
        entry["height"] = inner.height
    if camera.rotation_camera_from_world is not None:
        entry["R_camera_from_world"] = numbers(camera.rotation_camera_from_world)
    if camera.translation_camera_from_world is not None:
        entry["t_camera_from_world"] = numbers(camera.translation_camera_from_world)
    if camera.covariance is not None:
        entry["pose_covariance"] = numbers(camera.covariance)
    if camera.sigma_wall_m is not None:
        entry["sigma_wall_mm"] = number(1000.0 * camera.sigma_wall_m)
    if camera.sigma0_px is not None:
        entry["sigma0_px"] = number(camera.sigma0_px)
    return entry


def _cell(value: float) -> float | None:
    """Return a number for a CSV cell; None, i.e. an empty cell, for NaN and infinity."""
    return float(value) if np.isfinite(value) else None


_COLUMNS: Final = (
    "wall number kind width_m height_m sill_m area_m2 depth_m edge_sigma_mm seen_share n_corners"
)
_DIGITS: Final = 4


def publish_openings(product: Openings, folder: Path, digest: str) -> None:
    """Write `openings.geojson`, `openings.csv` and, per wall, `wall_<k>_openings.geojson`.

    The files of a wall are in the coordinates of its GeoTIFF; `openings.geojson` is in scan
    coordinates, with x, y, z on the planes of the walls.
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
    yield _COLUMNS.split()
    for place, opening in numbered_openings(product.openings):
        sigma_m = opening.edge_sigma_m
        lengths = (opening.width_m, opening.height_m, opening.sill_m, opening.area_m2)
        yield (
            *(opening.wall, place, opening.kind),
            *(round(length, _DIGITS) for length in lengths),
            None if opening.depth_m is None else round(opening.depth_m, _DIGITS),
            None if sigma_m is None else round(1e3 * sigma_m, 2),
            round(opening.seen_share, _DIGITS),
            len(opening.outline_m),
        )
