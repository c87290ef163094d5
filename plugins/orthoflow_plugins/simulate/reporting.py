"""What `simulate.room` reports: numbers of points, the scan step reached, a true picture."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import frame_over
from orthoflow.geometry.scene_views import render_frame
from orthoflow.products import JsonValue, Photos, PointCloud, Truth
from orthoflow.sdk import StepContext

_PICTURE_GSD_M = 0.01
_TILE_M = 0.1
_THUMB_PX = 300
_CHUNK = 1 << 20


@dataclass(frozen=True, kw_only=True)
class ScanStep:
    """Spacing of the points on a wall, as if they lay in a square grid.

    Attributes:
        median_m: half of the wall is scanned at least as finely.
        p90_m: nine tenths are.
    """

    median_m: float
    p90_m: float


def report_room(truth: Truth, cloud: PointCloud, ctx: StepContext) -> None:
    """Report metrics and the true orthoimage of the wall with the most points."""
    ctx.metric("n_points", len(cloud), "1")
    ctx.metric("n_true_planes", len(truth.planes), "1")
    ctx.metric("main_wall_points", int(truth.planes.n_points[0]), "1")
    spoilt = truth.details["n_spoilt"]
    if isinstance(spoilt, int):
        ctx.metric("outlier_share", spoilt / len(cloud), "1")
    step = measured_step(truth, cloud, 0)
    if step is not None:
        ctx.metric("scan_step_median_mm", 1000.0 * step.median_m, "mm")
        ctx.metric("scan_step_p90_mm", 1000.0 * step.p90_m, "mm")
    ctx.figure(
        "main_wall",
        _picture(truth, ctx.cores),
        f"True orthoimage of the {truth.planes.names[0]} at {_PICTURE_GSD_M * 1000:.0f} mm.",
    )


def report_photos(truth: Truth, photos: Photos, ctx: StepContext) -> None:
    """Report how the photos were taken, and show them side by side; nothing without photos."""
    if not photos.photos:
        return
    entries = truth.details["photos"]
    gsds, obliquities = [], []
    if isinstance(entries, list):
        for entry in entries:
            if isinstance(entry, dict):
                gsds.append(_number(entry["gsd_mm"]))
                obliquities.append(_number(entry["obliquity_deg"]))
    ctx.metric("n_photos", len(photos.photos), "1")
    ctx.metric("photo_megapixels", sum(p.width * p.height for p in photos.photos) / 1e6, "1")
    ctx.metric("photo_gsd_mm", float(np.mean(gsds)), "mm")
    ctx.metric("photo_obliquity_max_deg", max(obliquities), "deg")
    ctx.figure("photos", _contact_sheet(photos), "The photos, in the order of their names.")


def _number(value: JsonValue) -> float:
    return float(value) if isinstance(value, int | float) else float("nan")


def _contact_sheet(photos: Photos) -> bytes:
    from orthoflow.files.images import decode_image, encode_webp

    small = []
    for photo in photos.photos:
        step = max(1, photo.width // _THUMB_PX)
        small.append(decode_image(photo.encoded, photo.name)[::step, ::step])
    per_row = math.ceil(math.sqrt(len(small)))
    blank = np.zeros_like(small[0])
    small += [blank] * (-len(small) % per_row)
    rows = [np.hstack(small[i : i + per_row]) for i in range(0, len(small), per_row)]
    return encode_webp(np.vstack(rows))


def measured_step(truth: Truth, cloud: PointCloud, plane: int) -> ScanStep | None:
    """Measure the scan step on a plane from the points in tiles of 10 cm; None without tiles."""
    frame = frame_over(truth.planes.corners[plane], truth.planes.normal[plane], gsd_m=_TILE_M)
    counts = np.zeros(frame.shape, dtype=np.int64)
    for start in range(0, len(cloud), _CHUNK):
        chosen = np.flatnonzero(truth.labels[start : start + _CHUNK] == plane) + start
        pixels = np.floor(frame.wall_from_world(cloud.points_world(chosen))[:, :2]).astype(int)
        inside = np.all((pixels >= 0) & (pixels < [frame.width, frame.height]), axis=1)
        np.add.at(counts, (pixels[inside, 1], pixels[inside, 0]), 1)
    whole = counts[_inner(counts > 0)]
    if whole.size == 0:
        return None
    steps = _TILE_M / np.sqrt(whole)
    return ScanStep(median_m=float(np.median(steps)), p90_m=float(np.percentile(steps, 90)))


def _inner(filled: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Tiles whose neighbours all hold points: no rim of the wall cuts them."""
    padded = np.pad(filled, 1)
    inner = np.ones_like(filled)
    for row in range(3):
        for column in range(3):
            inner &= padded[row : row + filled.shape[0], column : column + filled.shape[1]]
    return inner


def _picture(truth: Truth, cores: int) -> bytes:
    from orthoflow.files.images import encode_webp

    frame = frame_over(truth.planes.corners[0], truth.planes.normal[0], gsd_m=_PICTURE_GSD_M)
    image = render_frame(truth.scene, frame, buffer_front_m=0.3, buffer_behind_m=0.3, supersample=2)
    return encode_webp(np.nan_to_num(image.rgb).round().astype(np.uint8))
