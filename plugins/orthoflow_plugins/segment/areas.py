"""Areas of a wall that lie behind its face or are empty, and the kind of opening of each."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.products import OpeningKind, SurfaceMask, Wall
from orthoflow_plugins.segment.sight_lines import SightLines

# Narrower connections do not join areas.
_NECK_CELLS: Final = 3
# Shares of the cells of an area, crossed by rays or empty, that decide its kind.
_CROSSED_LEAST: Final = 0.1
_EMPTY_LEAST: Final = 0.5
# If this share of the measured cells lies behind a plane, the plane is not the wall's face.
_FACE_LEAST: Final = 0.5
_CELLS_TOLD: Final = 1 << 25


@dataclass(frozen=True, kw_only=True)
class AreaRule:
    """The criteria of an opening.

    Attributes:
        behind_m: cells at least this far behind the wall's face do not belong to it.
        width_least_m: side of a square that must fit into an opening.
        area_least_m2: smallest area.
        seen_least: minimum share of the outline along which the wall's face was measured.
    """

    behind_m: float
    width_least_m: float
    area_least_m2: float
    seen_least: float


@dataclass(frozen=True, kw_only=True)
class Relief:
    """The class of each cell of a wall, or of every nth of its rows and columns.

    Attributes:
        gsd_m: side of these cells.
        step: cells of the wall per cell of these.
        is_face: (rows, cols) bool, measured, and not behind the wall.
        is_open: (rows, cols) bool, behind it or empty, and not hidden.
        is_empty: (rows, cols) bool, depth unknown.
        is_crossed: (rows, cols) bool, rays passed through.
        depth_m: (rows, cols) float32 in front of the plane, NaN where empty.
        face_m: depth of the wall's face, 0 where that is the plane.
    """

    gsd_m: float
    step: int
    is_face: NDArray[np.bool_]
    is_open: NDArray[np.bool_]
    is_empty: NDArray[np.bool_]
    is_crossed: NDArray[np.bool_]
    depth_m: NDArray[np.float32]
    face_m: float


@dataclass(frozen=True, kw_only=True)
class Area:
    """An opening as cells.

    Attributes:
        corner: row and column of the first cell of `cells` in the relief.
        cells: (rows, cols) bool, those of the opening, without holes, with a margin.
        kind: see `OpeningKind`.
        depth_m: distance of its back behind the wall's face; None if nothing was measured.
    """

    corner: tuple[int, int]
    cells: NDArray[np.bool_]
    kind: OpeningKind
    depth_m: float | None


def relief_of(wall: Wall, lines: SightLines | None, rule: AreaRule) -> Relief:
    """Classify cells as face, open or hidden.

    Args:
        wall: the wall; with more than 32 million cells every nth row and column is used.
        lines: what rays show about empty cells; without them (None) no cell is hidden.
        rule: includes the depth from which on a cell is behind the wall.
    """
    import cv2

    step = 1
    while wall.mask.size // step**2 > _CELLS_TOLD:
        step += 1
    depth_m = np.ascontiguousarray(wall.depth_m[::step, ::step])
    is_empty = np.ascontiguousarray(wall.mask[::step, ::step] == SurfaceMask.VOID)
    is_crossed = is_hidden = np.zeros(is_empty.shape, dtype=np.bool_)
    if lines is not None:
        is_crossed = lines.over(lines.crossed, wall.frame.shape, step) & is_empty
        is_hidden = lines.over(lines.stopped, wall.frame.shape, step) & is_empty
    face_m = _face_m(depth_m[~is_empty], rule.behind_m)
    with np.errstate(invalid="ignore"):
        is_behind = ~is_empty & (depth_m <= face_m - rule.behind_m)
    # Single cells, from noise or between points, are ignored.
    is_open = cv2.medianBlur((is_behind | (is_empty & ~is_hidden)).astype(np.uint8), 5) > 0
    return Relief(
        gsd_m=step * wall.frame.gsd_m,
        step=step,
        is_face=~is_empty & ~is_behind,
        is_open=is_open,
        is_empty=is_empty,
        is_crossed=is_crossed,
        depth_m=depth_m,
        face_m=face_m,
    )


def _face_m(depths_m: NDArray[np.float32], behind_m: float) -> float:
    """Return the depth of a wall's face: its plane, or the median of the cells behind it.

    A detector may have placed the plane on the fronts of pilasters, or between them and the wall.
    """
    deeper = depths_m[depths_m <= -behind_m]
    return float(np.median(deeper)) if len(deeper) > _FACE_LEAST * len(depths_m) else 0.0


def open_areas(relief: Relief, rule: AreaRule) -> Iterator[Area]:
    """Return the areas that are large and wide enough, largest first."""
    import cv2

    neck = cv2.getStructuringElement(cv2.MORPH_RECT, (_NECK_CELLS, _NECK_CELLS))
    cells = cv2.morphologyEx(relief.is_open.astype(np.uint8), cv2.MORPH_OPEN, neck)
    wide = max(1, round(rule.width_least_m / relief.gsd_m))
    square = cv2.getStructuringElement(cv2.MORPH_RECT, (wide, wide))
    # Cells beyond the raster must not widen an area.
    cores = cv2.erode(cells, square, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    n_areas, labels, boxes, _ = cv2.connectedComponentsWithStats(cells, connectivity=4)
    is_wide = np.zeros(n_areas, dtype=np.bool_)
    is_wide[np.unique(labels[cores > 0])] = True
    is_wide[0] = False
    n_least = rule.area_least_m2 / relief.gsd_m**2
    sizes = boxes[:, cv2.CC_STAT_AREA]
    for label in sorted(np.flatnonzero(is_wide & (sizes >= n_least)), key=lambda k: -sizes[k]):
        left, top, width, height, _ = boxes[label]
        part = (slice(top, top + height), slice(left, left + width))
        own = labels[part] == label
        yield Area(
            corner=(int(top) - 1, int(left) - 1),
            cells=_without_holes(own),
            kind=_kind(relief, part, own),
            depth_m=_depth_m(relief, part, own),
        )


def _without_holes(own: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return cells with an empty margin of one cell; bars and panes across are included."""
    import cv2

    framed = np.pad(own, 1).astype(np.uint8)
    outside = framed.copy()
    cv2.floodFill(outside, None, (0, 0), 2)
    return np.asarray(outside != 2, dtype=np.bool_)


def _kind(relief: Relief, part: tuple[slice, slice], own: NDArray[np.bool_]) -> OpeningKind:
    n_cells = np.count_nonzero(own)
    if np.count_nonzero(relief.is_crossed[part] & own) >= _CROSSED_LEAST * n_cells:
        return "through"
    if np.count_nonzero(relief.is_empty[part] & own) >= _EMPTY_LEAST * n_cells:
        return "no data"
    return "niche"


def _depth_m(relief: Relief, part: tuple[slice, slice], own: NDArray[np.bool_]) -> float | None:
    known = relief.depth_m[part][own & ~relief.is_empty[part]]
    return relief.face_m - float(np.median(known)) if known.size else None
