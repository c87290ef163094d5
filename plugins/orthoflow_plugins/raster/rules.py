"""The rules by which the depth of a cell follows from its points, and gaps close."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

Surface = Literal["median", "denoised", "nearest", "centre", "topmost", "mean", "tin"]

# Maximum distance of neighbours in the scan, in radii of a narrow gap.
_SPAN_GAPS: Final = 4
# Outliers are detected within 20 cells.
_REACH_OF_OUTLIERS: Final = 32


@dataclass(frozen=True, kw_only=True)
class SurfaceRule:
    """How the depth of a cell follows from its points.

    Attributes:
        surface: name of the rule.
        layer_m: depth step that separates two layers within a cell; for `median`.
        denoise_cells: reach of the filter of `denoised`.
        percentiles: shares (%) of a cell's points below additional depths to compute.
        threads: number of threads.
    """

    surface: Surface
    layer_m: float
    denoise_cells: int
    percentiles: tuple[float, ...]
    threads: int

    @property
    def is_of_one_point(self) -> bool:
        """Whether a cell takes the values of one of its points, not the mean of several."""
        return self.surface in {"nearest", "centre", "topmost", "tin"}


@dataclass(frozen=True, kw_only=True)
class GapRule:
    """Which gaps close.

    Attributes:
        gap_cells: no disc of this radius fits into a narrow gap; 0 closes none.
        scan_steps: maximum rows or columns of a scan between neighbours that span a gap.
        layer_m: maximum difference of their depths.
        threads: number of threads.
    """

    gap_cells: int
    scan_steps: int
    layer_m: float
    threads: int

    @property
    def span_cells(self) -> int:
        """Return the maximum distance on the wall of neighbours in the scan that span a gap."""
        return _SPAN_GAPS * self.gap_cells


@dataclass(frozen=True, kw_only=True)
class RasterRule:
    """How a wall is rastered.

    Attributes:
        surface: how depths follow from points.
        gaps: which gaps close.
    """

    surface: SurfaceRule
    gaps: GapRule

    @property
    def reach_rows(self) -> int:
        """Return how many rows away a cell may influence another."""
        # Noise is filtered twice, and a gap is as wide as what spans it plus a disc on either side
        # and a margin, between which it is interpolated.
        gaps = self.gaps.span_cells + 2 * self.gaps.gap_cells + 2
        return _REACH_OF_OUTLIERS + 2 * self.surface.denoise_cells + gaps
