"""Figures of inspections: maps of errors, and displacements as arrows."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.drawing import (
    encode_chart,
    in_column_style,
    map_chart,
    picture_figure,
    round_scale,
)
from orthoflow.geometry import WallFrame
from orthoflow.geometry.levels import eight_bits
from orthoflow.products import Orthoimage

if TYPE_CHECKING:
    from orthoflow.sdk import StepContext

DEPTH_SPAN_MM: Final = 10.0
COLOUR_SPAN_GREY: Final = 60.0
DISPLACEMENT_SPAN_CELLS: Final = 1.0
LONGEST_PX: Final = 1000
# In larger images, squares of cells are averaged before drawing.
WHOLE_CELLS: Final = 1 << 24
# Length at which the 95th percentile of displacements is drawn, relative to the longer image side.
_ARROW_SHARE: Final = 0.06
_NAMES_MOST: Final = 60
_ARROWS_MOST: Final = 1500
_ENLARGED_MOST: Final = 500.0
# Colours of arrows up to the median length, up to twice the median, and beyond.
_ARROW_COLOURS: Final = ("#1a8a1a", "#d09000", "#d01c1c")


def depth_error_map(depth_m: NDArray[np.float64], frame: WallFrame) -> bytes:
    """Draw a map of depth errors: blue behind the true surface, and red in front of it."""
    label = "measured minus true depth [mm]"
    high = DEPTH_SPAN_MM
    return map_chart(1e3 * depth_m, label, frame, low=-high, high=high, cmap="RdBu_r")


def colour_error_map(error_grey: NDArray[np.float64], frame: WallFrame) -> bytes:
    """Draw a map of colour errors, in which large errors are bright."""
    label = "colour error [grey levels]"
    return map_chart(error_grey, label, frame, low=0.0, high=COLOUR_SPAN_GREY)


def displacement_map(displacement_cells: NDArray[np.float64], frame: WallFrame) -> bytes:
    """Draw a map of displacements (rows, cols), in which large displacements are bright."""
    high = DISPLACEMENT_SPAN_CELLS
    return map_chart(displacement_cells, "displacement [cells]", frame, low=0.0, high=high)


@in_column_style()
def vector_map(
    image: Orthoimage,
    places: NDArray[np.float64],
    shift_cells: NDArray[np.float64],
    names: Sequence[str] = (),
) -> bytes:
    """Draw an orthoimage in pale grey, with arrows from true to shown positions.

    Arrows are green up to the median length, yellow up to twice the median, and red beyond. A
    reference arrow is drawn below the image. If there are many arrows, every nth is drawn.

    Args:
        image: the inspected orthoimage.
        places: (n, 2) shown positions (column, row) in cells.
        shift_cells: (n, 2) shown minus true positions in cells.
        names: n labels of the arrows, which are drawn unless there are many; empty for no labels.
    """
    import cv2

    scale = min(1.0, LONGEST_PX / max(image.frame.shape))
    rows, columns = image.frame.shape
    size = (max(1, round(columns * scale)), max(1, round(rows * scale)))
    small = cv2.resize(_grey_means(image), size, interpolation=cv2.INTER_AREA)
    pale = np.clip(0.4 * np.asarray(small) + 150.0, 0.0, 255.0).astype(np.uint8)
    figure, axes = picture_figure(pale, frame=image.frame, extra_inches=0.22)
    if not len(places):
        return encode_chart(figure)
    length = np.linalg.norm(shift_cells, axis=1)
    middle = float(np.median(length))
    kind = np.where(length <= middle, 0, np.where(length <= 2.0 * middle, 1, 2))
    times = enlargement(shift_cells, image)
    drawn = np.arange(0, len(places), max(1, len(places) // _ARROWS_MOST))
    tips, arrows = places[drawn], times * shift_cells[drawn]
    quiver = axes.quiver(
        *(tips - arrows).T,
        *arrows.T,
        angles="xy",
        scale_units="xy",
        scale=1.0,
        color=[_ARROW_COLOURS[k] for k in kind[drawn]],
        units="inches",
        width=0.009,
    )
    cell_mm = 1e3 * image.frame.gsd_m
    known_mm = round_scale(0.5 * cell_mm * _ARROW_SHARE * max(rows, columns) / times)
    axes.quiverkey(
        quiver,
        0.4,
        0.1 / float(figure.get_size_inches()[1]),
        times * known_mm / cell_mm,
        f"{known_mm:g} mm",
        labelpos="E",
        coordinates="figure",
        color="black",
    )
    for place, name in zip(places, names if len(names) <= _NAMES_MOST else (), strict=False):
        at = (float(place[0]), float(place[1]))
        axes.annotate(name, at, xytext=(2, 2), textcoords="offset points", fontsize=6.0)
    return encode_chart(figure)


def _grey_means(image: Orthoimage) -> NDArray[np.float32]:
    """Return grey levels, averaged over squares of cells if the image is large.

    Incomplete squares at the right and bottom borders are omitted.
    """
    factor = 1
    if image.mask.size > WHOLE_CELLS:
        factor = max(1, max(image.frame.shape) // (2 * LONGEST_PX))
    if factor == 1:
        return np.asarray(eight_bits(image.rgb).mean(axis=2, dtype=np.float32))
    rows, columns = (size // factor for size in image.frame.shape)
    means = np.empty((rows, columns), dtype=np.float32)
    for row in range(rows):
        squares = image.rgb[row * factor : (row + 1) * factor, : columns * factor]
        grey = eight_bits(squares).reshape(factor, columns, factor * 3)
        means[row] = grey.mean(axis=(0, 2), dtype=np.float32)
    return means


def draw_arrows(
    ctx: StepContext,
    name: str,
    image: Orthoimage,
    places: NDArray[np.float64],
    shift_cells: NDArray[np.float64],
    *,
    title: str,
    names: Sequence[str] = (),
) -> None:
    """Report a figure of displacements, drawn by `vector_map`."""
    ctx.figure(
        name,
        partial(vector_map, image, places, shift_cells, names),
        f"{image.name}: {title}, enlarged {enlargement(shift_cells, image):g} times; green up to "
        "the median, yellow up to twice the median, red beyond. Short arrows in all directions are "
        "noise; neighbouring arrows in the same direction are a real shift.",
    )


def enlargement(shift_cells: NDArray[np.float64], image: Orthoimage) -> float:
    """Return the factor by which `vector_map` enlarges the displacements (n, 2)."""
    if not len(shift_cells):
        return 1.0
    usual = float(np.percentile(np.linalg.norm(shift_cells, axis=1), 95))
    wanted = _ARROW_SHARE * max(image.frame.shape) / max(usual, 1e-9)
    # Use 1, 2 or 5 times a power of ten, so that figures mostly have the same scale and can be
    # compared.
    return float(np.clip(1.0 / round_scale(1.0 / wanted), 1.0, _ENLARGED_MOST))
