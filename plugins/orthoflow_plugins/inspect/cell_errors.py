"""Comparison of an orthoimage and its wall with the truth, cell by cell.

On small walls, all cells are compared; on large walls, an evenly spread sample. Colours are
rendered in whole blocks, since patches need neighbouring cells. Visibility is tested on a regular
lattice, which covers every area wider than the lattice spacing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.levels import REC_601, eight_bits
from orthoflow.geometry.robust import NMAD_FACTOR, median_deviation
from orthoflow.products import (
    Finding,
    Orthoimage,
    OrthoMask,
    SurfaceMask,
    Wall,
    is_painted,
    is_shown,
)
from orthoflow_plugins.inspect.findings import Number, count_true, findings_of, rms
from orthoflow_plugins.inspect.image_quality import n_shown as n_shown_of
from orthoflow_plugins.inspect.patches import GreyImage, PatchShifts, measure_shifts

if TYPE_CHECKING:
    from orthoflow.geometry.scene_views import TrueOrthoimage

# Neighbouring cells whose true depths differ by more than this form a depth step, near which errors
# are reported separately.
_STEP_M: Final = 0.004
_STEP_BAND_CELLS: Final = 2
# Side of a block. It is a multiple of the patch size (32 cells), and large enough that few cells
# are lost at the border.
BLOCK_CELLS: Final = 96
# Maximum number of cells, on all walls together, for which colours are compared.
COLOUR_CELLS: Final = 250_000
# Maximum number of cells, on all walls together, for which visibility is tested.
_SEEN_CELLS: Final = 600_000
# Maximum number of errors (32 bytes each) that are kept for all walls together. The standard error
# of the median of so many values is 1/2000 of their standard deviation.
MAX_KEPT_ERRORS: Final = 1 << 23
# Multiples of these numbers, modulo 1, are evenly distributed (R2 sequence, Roberts 2018).
_SPREAD: Final = (0.7548776662466927, 0.5698402909980532)
_NAMES_BESIDE_TRACED: Final = {
    "rmse_u_mm": "patch_rmse_u_mm",
    "rmse_v_mm": "patch_rmse_v_mm",
    "mean_u_mm": "patch_mean_u_mm",
    "mean_v_mm": "patch_mean_v_mm",
}


@dataclass(frozen=True, kw_only=True)
class Sampling:
    """Selection of the cells of an orthoimage that are compared.

    Attributes:
        coloured: (rows, cols) bool, cells whose colours are compared.
        lattice: (rows, cols) bool, cells whose visibility is tested.
    """

    coloured: NDArray[np.bool_]
    lattice: NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class SamplingRule:
    """Sampling density of the walls.

    Attributes:
        colour_share: share of blocks whose colours are compared.
        lattice_step: n if visibility is tested in every nth row and column.
        error_step: n if every nth error of a depth or traced cell is kept.
    """

    colour_share: float
    lattice_step: int
    error_step: int

    @classmethod
    def of(cls, images: Sequence[Orthoimage]) -> SamplingRule:
        """Choose densities that limit the number of cells of all images together."""
        n_shown = sum(n_shown_of(image) for image in images)
        n_cells = sum(image.mask.size for image in images)
        return cls(
            colour_share=min(1.0, COLOUR_CELLS / max(1, n_shown)),
            lattice_step=max(1, math.ceil(math.sqrt(n_cells / _SEEN_CELLS))),
            error_step=max(1, n_cells // MAX_KEPT_ERRORS),
        )


def sampling(image: Orthoimage, rule: SamplingRule, first_row: int) -> Sampling:
    """Select the cells of an image that are compared; blocks without coloured cells are omitted.

    Args:
        image: orthoimage of a wall, or a band of it.
        rule: the sampling densities.
        first_row: row of the wall at which the band starts, a multiple of `BLOCK_CELLS`.
    """
    shows = is_shown(image.mask)
    coloured = np.zeros(shows.shape, dtype=np.bool_)
    for i in range(-(-shows.shape[0] // BLOCK_CELLS)):
        for j in range(-(-shows.shape[1] // BLOCK_CELLS)):
            block = (
                slice(i * BLOCK_CELLS, (i + 1) * BLOCK_CELLS),
                slice(j * BLOCK_CELLS, (j + 1) * BLOCK_CELLS),
            )
            place = (first_row // BLOCK_CELLS + i) * _SPREAD[0] + j * _SPREAD[1]
            is_chosen = place % 1.0 < rule.colour_share
            coloured[block] = is_chosen and shows[block].any()
    lattice = np.zeros(shows.shape, dtype=np.bool_)
    first = rule.lattice_step // 2
    lattice[
        (first - first_row) % rule.lattice_step :: rule.lattice_step, first :: rule.lattice_step
    ] = True
    return Sampling(coloured=coloured, lattice=lattice)


@dataclass(frozen=True, kw_only=True)
class WallSamples:
    """Errors of one wall, or of several walls together.

    Attributes:
        depth_m: (n,) measured minus true depth, away from true depth steps.
        sigma_m: (n,) predicted standard deviation of each depth; NaN if unknown.
        step_depth_m: (m,) measured minus true depth within 2 cells of a true depth step.
        colour: (c,) mean squared error, over the three channels, of each coloured cell away from
            depth steps.
        shift_m: (p, 2) displacement of patches along u and v in metres, measured minus true
            position.
        shift_cells: (p, 2) the same displacement in cells.
        n_seen: number of tested cells whose true surface is visible from a station.
        n_seen_painted: number of these cells that are coloured.
        n_seen_shown: number of these cells that are coloured or filled.
    """

    depth_m: NDArray[np.float64]
    sigma_m: NDArray[np.float64]
    step_depth_m: NDArray[np.float64]
    colour: NDArray[np.float64]
    shift_m: NDArray[np.float64]
    shift_cells: NDArray[np.float64]
    n_seen: int
    n_seen_painted: int
    n_seen_shown: int


@dataclass(frozen=True, kw_only=True)
class WallErrors:
    """Errors of one wall, cell by cell.

    Attributes:
        samples: the errors for statistics.
        patches: patches whose displacement was measured.
        depth_m: (rows, cols) measured minus true depth, NaN where either is missing.
        grey: (rows, cols) RMS colour error, NaN where not compared.
        steps: (rows, cols) mask of the cells within 2 cells of a true depth step.
    """

    samples: WallSamples
    patches: PatchShifts
    steps: NDArray[np.bool_]
    depth_m: NDArray[np.float64]
    grey: NDArray[np.float64]


def wall_errors(
    image: Orthoimage,
    wall: Wall,
    true: TrueOrthoimage,
    chosen: Sampling,
    inner: slice = slice(None),
    error_step: int = 1,
) -> WallErrors:
    """Compare an orthoimage and its wall, both in the frame of `true`, with the truth.

    Depths are compared in all cells; colours and visibility are compared in the chosen cells.

    Args:
        image: the orthoimage.
        wall: the wall.
        true: the true orthoimage.
        chosen: cells whose colours are compared, and cells whose visibility is tested.
        inner: rows to compare; their number is a multiple of the patch size, and the other rows are
            a margin.
        error_step: n if every nth depth error is kept.
    """
    known = true.rectangle >= 0
    steps = depth_step_band(true.depth_m)
    painted = is_painted(image.mask) & known
    filled = (image.mask == OrthoMask.FILLED) & known
    square = _square_errors(image, true, chosen.coloured & (painted | filled))
    depth = np.where(
        (wall.mask == SurfaceMask.MEASURED) & known, wall.depth_m.astype(np.float64), np.nan
    ) - true.depth_m.astype(np.float64)
    patches = _shifts(image, true, chosen.coloured & known & ~steps).within(inner)
    seen = (true.seen & chosen.lattice)[inner]
    sigma_m = wall.sigma_m[inner]
    depth, square = depth[inner], square[inner]
    painted, filled, steps = painted[inner], filled[inner], steps[inner]
    measured = np.isfinite(depth)
    compares = np.isfinite(square)
    samples = WallSamples(
        depth_m=depth[measured & ~steps][::error_step],
        sigma_m=sigma_m[measured & ~steps][::error_step].astype(np.float64),
        step_depth_m=depth[measured & steps][::error_step],
        colour=square[compares & painted & ~steps],
        shift_m=patches.shift * true.frame.gsd_m,
        shift_cells=patches.shift,
        n_seen=count_true(seen),
        n_seen_painted=count_true(seen & painted),
        n_seen_shown=count_true(seen & (painted | filled)),
    )
    return WallErrors(
        samples=samples, patches=patches, steps=steps, depth_m=depth, grey=np.sqrt(square)
    )


def depth_step_band(depth_m: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return a mask of the cells within 2 cells of a depth step or the border of the surface."""
    import cv2

    # Replace missing depths with a very large depth, so that the border of the surface is also a
    # step.
    depth = np.where(np.isfinite(depth_m), depth_m, np.float32(1e3))
    edge = np.zeros(depth.shape, dtype=np.uint8)
    down = np.abs(np.diff(depth, axis=0)) > _STEP_M
    right = np.abs(np.diff(depth, axis=1)) > _STEP_M
    # Mark the cells on both sides of each edge.
    edge[1:] |= down
    edge[:-1] |= down
    edge[:, 1:] |= right
    edge[:, :-1] |= right
    window = np.ones((2 * _STEP_BAND_CELLS - 1,) * 2, dtype=np.uint8)
    return np.asarray(cv2.dilate(edge, window), dtype=np.bool_)


def sample_findings(samples: WallSamples, wall: int, *, sources_are_traced: bool) -> list[Finding]:
    """Return the metrics of the cells of one wall, or of all walls (wall -1); empty if none.

    Metrics of patch displacements get a prefix if displacements are also computed from the cameras,
    which is more accurate.
    """
    renamed = _NAMES_BESIDE_TRACED if sources_are_traced else {}
    numbers = (
        *_depth_numbers(samples),
        *_shift_numbers(samples),
        *_share_numbers(samples),
    )
    return findings_of(
        ((renamed.get(name, name), value, unit) for name, value, unit in numbers), wall
    )


def _square_errors(
    image: Orthoimage, true: TrueOrthoimage, chosen: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Return the mean squared error (rows, cols) over the channels; NaN in cells not chosen."""
    square = np.full(chosen.shape, np.nan)
    difference = eight_bits(image.rgb[chosen]).astype(np.float64) - true.rgb[chosen]
    square[chosen] = np.mean(difference**2, axis=1)
    return square


def _shifts(image: Orthoimage, true: TrueOrthoimage, known: NDArray[np.bool_]) -> PatchShifts:
    """Measure the displacements of patches; only `known` cells are used."""
    painted = is_painted(image.mask)
    filled = image.mask == OrthoMask.FILLED
    # Displacements of two centimetres are far larger than any plausible error.
    reach = int(np.clip(np.ceil(0.02 / true.frame.gsd_m), 3, 8))
    grey, true_grey = np.zeros(known.shape), np.zeros(known.shape)
    grey[known] = eight_bits(image.rgb[known]) @ REC_601
    true_grey[known] = true.rgb[known].astype(np.float64) @ REC_601
    return measure_shifts(
        GreyImage(grey=grey, valid=painted & known, region=(painted | filled) & known),
        GreyImage(grey=true_grey, valid=known, region=known),
        reach_cells=reach,
    )


def _depth_numbers(samples: WallSamples) -> list[Number]:
    if samples.depth_m.size == 0:
        return []
    errors_mm = 1e3 * samples.depth_m
    middle = float(np.median(errors_mm))
    numbers = [
        ("depth_median_mm", middle, "mm"),
        ("depth_nmad_mm", median_deviation(errors_mm, middle), "mm"),
        ("depth_rmse_mm", rms(errors_mm), "mm"),
    ]
    stated = samples.sigma_m > 0.0
    if stated.any():
        is_inside = np.abs(samples.depth_m[stated]) <= 3.0 * samples.sigma_m[stated]
        numbers.append(("depth_within_3sigma", float(is_inside.mean()), "1"))
    if samples.step_depth_m.size:
        numbers.append(("depth_step_rmse_mm", 1e3 * rms(samples.step_depth_m), "mm"))
    return numbers


def _shift_numbers(samples: WallSamples) -> list[Number]:
    kept = _kept_shifts(samples)
    numbers: list[Number] = [("n_patches", float(len(kept)), "1")]
    if not kept.any():
        return numbers
    shifts = 1e3 * samples.shift_m[kept]
    for axis, name in enumerate(("u", "v")):
        numbers += [
            (f"rmse_{name}_mm", rms(shifts[:, axis]), "mm"),
            (f"mean_{name}_mm", float(shifts[:, axis].mean()), "mm"),
        ]
    numbers.append(("displaced_share", 1.0 - float(kept.mean()), "1"))
    return numbers


def _kept_shifts(samples: WallSamples) -> NDArray[np.bool_]:
    """Return a mask of the patches within 4 NMAD (at least 1/4 cell) of the median."""
    cells = samples.shift_cells
    if len(cells) == 0:
        return np.zeros(0, dtype=np.bool_)
    middle = np.median(cells, axis=0)
    nmad = NMAD_FACTOR * np.median(np.abs(cells - middle), axis=0)
    kept: NDArray[np.bool_] = np.all(np.abs(cells - middle) <= np.maximum(4.0 * nmad, 0.25), axis=1)
    return kept


def _share_numbers(samples: WallSamples) -> list[Number]:
    numbers: list[Number] = []
    if samples.colour.size:
        numbers.append(("colour_rmse_grey", float(np.sqrt(samples.colour.mean())), "grey"))
    if samples.n_seen:
        numbers += [
            ("completeness", samples.n_seen_painted / samples.n_seen, "1"),
            ("completeness_filled", samples.n_seen_shown / samples.n_seen, "1"),
        ]
    return numbers
