"""Pictures of an orientation: ties on the photos, and the predicted error on the walls."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.images import decode_image, encode_webp
from orthoflow.products import Photo, TieRole
from orthoflow.sdk import StepContext
from orthoflow_plugins.orient.judging import Case
from orthoflow_plugins.orient.wall_errors import sigmas_on_wall

_SIDE_PX: Final = 900
# markiewicz2015, Figure 17: control green, rejected red, check yellow.
_COLOURS: Final = {
    TieRole.REJECTED: (220, 40, 40),
    TieRole.CONTROL: (40, 200, 60),
    TieRole.CHECK: (250, 220, 40),
}
_FIGURES_MOST: Final = 24
_SUB_PIXEL_BITS: Final = 4
# Cells along the longer side of a map of predicted errors, and pixels per cell.
_MAP_CELLS: Final = 90
_MAP_ZOOM: Final = 8
_UNSEEN_BGR: Final = (60, 40, 20)


def figure_name(prefix: str, photo_name: str) -> str:
    """Name of a photo's figure: letters, digits, `-` and `_`."""
    stem = photo_name.rpartition(".")[0] or photo_name
    return f"{prefix}_{re.sub(r'[^A-Za-z0-9_-]', '-', stem)}"


def draw_ties(
    ctx: StepContext,
    photo: Photo,
    pixels_photo: NDArray[np.float64],
    role: NDArray[np.uint8],
    status: str,
) -> None:
    """Draw a photo's ties on it: control green, check yellow, rejected red."""
    import cv2

    if len(ctx.figures) >= _FIGURES_MOST:
        return
    name = figure_name("ties", photo.name)
    if any(figure.name == name for figure in ctx.figures):
        name = f"{name}-{len(ctx.figures)}"
    rgb = decode_image(photo.encoded, f"photo {photo.name}")
    scale = min(1.0, _SIDE_PX / max(rgb.shape[:2]))
    size = (max(1, round(photo.width * scale)), max(1, round(photo.height * scale)))
    small = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    # Dimmed, so that the marks stand out.
    canvas = np.rint(0.7 * small).astype(np.uint8)
    unit = 1 << _SUB_PIXEL_BITS
    for kind, colour in _COLOURS.items():
        at = np.rint((pixels_photo[role == kind] * scale - 0.5) * unit).astype(int)
        for u, v in at.tolist():
            cv2.circle(canvas, (u, v), 2 * unit, colour, -1, cv2.LINE_AA, _SUB_PIXEL_BITS)
    ctx.figure(
        name,
        encode_webp(canvas),
        f"Ties of {photo.name}: control green, check yellow, rejected red. {status}.",
    )


def draw_wall_errors(ctx: StepContext, cases: Sequence[Case]) -> None:
    """Draw the predicted error over each wall, at every place that of the photo that knows it best.

    Args:
        ctx: takes the pictures.
        cases: of the photos that are ok.
    """
    walls = {wall.index: wall for case in cases for wall in case.known}
    for index in sorted(walls):
        wall = walls[index]
        if len(ctx.figures) >= _FIGURES_MOST:
            return
        across, down = np.linalg.norm(wall.corners_world[[3, 1]] - wall.corners_world[0], axis=1)
        cell_m = max(across, down) / _MAP_CELLS
        shape = (max(1, round(down / cell_m)), max(1, round(across / cell_m)))
        best = np.full(shape, np.inf)
        for case in cases:
            sigmas = sigmas_on_wall(case.estimate.resection, wall, shape)
            best = np.fmin(best, sigmas)
        shown = np.isfinite(best)
        if not shown.any():
            continue
        # A corner that photos hardly reach must not darken all the rest.
        median_m, high_m = np.percentile(best[shown], [50.0, 98.0])
        ctx.figure(
            f"wall_{index}_predicted_error",
            _error_map(best / high_m),
            f"Predicted error of a coordinate on wall {index}, of the photo that knows each place "
            f"best: black 0 to yellow {1e3 * high_m:.2g} mm and more, median "
            f"{1e3 * median_m:.2g} mm; blue where no oriented photo shows the wall.",
        )


def _error_map(shares: NDArray[np.float64]) -> bytes:
    import cv2

    shown = np.isfinite(shares)
    grey = np.rint(255.0 * np.clip(np.where(shown, shares, 0.0), 0.0, 1.0)).astype(np.uint8)
    bgr = np.asarray(cv2.applyColorMap(grey, cv2.COLORMAP_INFERNO), dtype=np.uint8)
    bgr[~shown] = _UNSEEN_BGR
    size = (_MAP_ZOOM * shares.shape[1], _MAP_ZOOM * shares.shape[0])
    enlarged = cv2.resize(bgr, size, interpolation=cv2.INTER_NEAREST)
    return encode_webp(np.asarray(enlarged, dtype=np.uint8)[:, :, ::-1])
