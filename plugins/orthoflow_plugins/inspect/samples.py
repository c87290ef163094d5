"""What an orthoimage and its wall show against what they should, cell by cell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.scene_views import TrueOrthoimage
from orthoflow.products import Orthoimage, OrthoMask, SurfaceMask, Wall
from orthoflow_plugins.inspect.matching import GreyImage, PatchShifts, measure_shifts

# Neighbouring cells whose true depths differ by more make a step, reported apart.
STEP_M: Final = 0.004
STEP_BAND_CELLS: Final = 2
# A colour so far outside of all true colours within one cell has no business there.
GROSS_GREY: Final = 40.0
_LUMINANCE: Final = np.array([0.299, 0.587, 0.114])


@dataclass(frozen=True, kw_only=True)
class WallSamples:
    """Errors of one wall, or of several put together.

    Attributes:
        depth_m: (n,) measured - true depth away from true depth steps.
        sigma_m: (n,) standard deviation that the wall states for each; NaN where it states none.
        step_depth_m: (m,) the same error within 2 cells of a true depth step.
        colour: (c,) mean square error of a painted cell over the three channels, away from steps.
        filled_colour: (f,) the same for filled cells.
        step_colour: (s,) the same for painted cells at steps.
        shift_m: (p, 2) displacement of patches along u and v, shown - true.
        shift_cells: (p, 2) the same in cells.
        n_painted: painted cells.
        n_seen: cells whose true surface a viewer sees.
        n_seen_painted: those of them that are painted.
        n_seen_shown: those of them that are painted or filled.
        n_unseen_painted: painted cells whose true surface no viewer sees, away from steps.
        n_gross: painted cells of a colour that is nowhere near in the truth, away from steps.
        n_ghost: those of them where an object stands in the way.
    """

    depth_m: NDArray[np.float64]
    sigma_m: NDArray[np.float64]
    step_depth_m: NDArray[np.float64]
    colour: NDArray[np.float64]
    filled_colour: NDArray[np.float64]
    step_colour: NDArray[np.float64]
    shift_m: NDArray[np.float64]
    shift_cells: NDArray[np.float64]
    n_painted: int
    n_seen: int
    n_seen_painted: int
    n_seen_shown: int
    n_unseen_painted: int
    n_gross: int
    n_ghost: int


@dataclass(frozen=True, kw_only=True)
class WallErrors:
    """Errors of one wall in their places.

    Attributes:
        samples: the errors as numbers.
        patches: where displacements were measured.
        depth_m: (rows, cols) measured - true depth, NaN where either is missing.
        grey: (rows, cols) root mean square colour error, NaN where nothing is shown.
    """

    samples: WallSamples
    patches: PatchShifts
    depth_m: NDArray[np.float64]
    grey: NDArray[np.float64]


def wall_errors(image: Orthoimage, wall: Wall, true: TrueOrthoimage) -> WallErrors:
    """Compare an orthoimage and its wall, both on the frame of `true`, with the truth."""
    known = true.rectangle >= 0
    steps = depth_step_band(true.depth_m)
    painted = (image.mask == OrthoMask.PAINTED) & known
    filled = (image.mask == OrthoMask.FILLED) & known
    square = np.mean((image.rgb.astype(np.float64) - true.rgb) ** 2, axis=2)
    depth = np.where(
        (wall.mask == SurfaceMask.MEASURED) & known, wall.depth_m.astype(np.float64), np.nan
    ) - true.depth_m.astype(np.float64)
    patches = _shifts(image, true, steps)
    gross = _gross_colours(image, true) & painted & ~steps
    measured = np.isfinite(depth)
    samples = WallSamples(
        depth_m=depth[measured & ~steps],
        sigma_m=wall.sigma_m[measured & ~steps].astype(np.float64),
        step_depth_m=depth[measured & steps],
        colour=square[painted & ~steps],
        filled_colour=square[filled & ~steps],
        step_colour=square[painted & steps],
        shift_m=patches.shift * true.frame.gsd_m,
        shift_cells=patches.shift,
        n_painted=_count(painted),
        n_seen=_count(true.seen),
        n_seen_painted=_count(true.seen & painted),
        n_seen_shown=_count(true.seen & (painted | filled)),
        n_unseen_painted=_count(painted & ~true.seen & ~steps),
        n_gross=_count(gross),
        n_ghost=_count(gross & true.behind_object),
    )
    return WallErrors(
        samples=samples,
        patches=patches,
        depth_m=depth,
        grey=np.sqrt(np.where(painted | filled, square, np.nan)),
    )


def pooled(samples: Sequence[WallSamples]) -> WallSamples:
    """Put the errors of several walls together."""

    def joined(name: str) -> NDArray[np.float64]:
        return np.concatenate([getattr(item, name) for item in samples])

    def added(name: str) -> int:
        return sum(int(getattr(item, name)) for item in samples)

    return WallSamples(
        depth_m=joined("depth_m"),
        sigma_m=joined("sigma_m"),
        step_depth_m=joined("step_depth_m"),
        colour=joined("colour"),
        filled_colour=joined("filled_colour"),
        step_colour=joined("step_colour"),
        shift_m=joined("shift_m"),
        shift_cells=joined("shift_cells"),
        n_painted=added("n_painted"),
        n_seen=added("n_seen"),
        n_seen_painted=added("n_seen_painted"),
        n_seen_shown=added("n_seen_shown"),
        n_unseen_painted=added("n_unseen_painted"),
        n_gross=added("n_gross"),
        n_ghost=added("n_ghost"),
    )


def depth_step_band(depth_m: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Cells within 2 cells of a true depth step or of the rim of the surface."""
    from scipy.ndimage import binary_dilation, generate_binary_structure

    # Far away instead of missing, so that the rim of the surface is a step too.
    depth = np.where(np.isfinite(depth_m), depth_m, 1e3)
    edge = np.zeros(depth.shape, dtype=np.bool_)
    for axis in (0, 1):
        jump = np.abs(np.diff(depth, axis=axis)) > STEP_M
        edge |= np.pad(jump, [(0, int(axis == 0)), (0, int(axis == 1))])
        edge |= np.pad(jump, [(int(axis == 0), 0), (int(axis == 1), 0)])
    # The cells beside the edge are its first cells on each side.
    square = generate_binary_structure(2, 2)
    band: NDArray[np.bool_] = binary_dilation(edge, square, iterations=STEP_BAND_CELLS - 1)
    return band


def _shifts(image: Orthoimage, true: TrueOrthoimage, steps: NDArray[np.bool_]) -> PatchShifts:
    known = (true.rectangle >= 0) & ~steps
    painted = image.mask == OrthoMask.PAINTED
    filled = image.mask == OrthoMask.FILLED
    # Two centimetres is far beyond any fair error; further off is reported as gross colour.
    reach = int(np.clip(np.ceil(0.02 / true.frame.gsd_m), 3, 8))
    return measure_shifts(
        GreyImage(
            grey=image.rgb @ _LUMINANCE, valid=painted & known, region=(painted | filled) & known
        ),
        GreyImage(
            grey=np.where(known, np.nan_to_num(true.rgb).astype(np.float64) @ _LUMINANCE, 0.0),
            valid=known,
            region=known,
        ),
        reach_cells=reach,
    )


def _gross_colours(image: Orthoimage, true: TrueOrthoimage) -> NDArray[np.bool_]:
    """Cells whose colour lies outside of the range of the true colours within one cell."""
    from scipy.ndimage import maximum_filter, minimum_filter

    known = (true.rectangle >= 0)[:, :, None]
    size = (3, 3, 1)
    low = minimum_filter(np.where(known, true.rgb, np.float32(np.inf)), size=size)
    high = maximum_filter(np.where(known, true.rgb, np.float32(-np.inf)), size=size)
    rgb = image.rgb.astype(np.float32)
    outside: NDArray[np.bool_] = np.any(
        (rgb < low - GROSS_GREY) | (rgb > high + GROSS_GREY), axis=2
    )
    return outside


def _count(mask: NDArray[np.bool_]) -> int:
    return int(np.count_nonzero(mask))
