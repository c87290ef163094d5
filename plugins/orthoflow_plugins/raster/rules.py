"""By which rules the depth of a cell follows from its points, and gaps close."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

Surface = Literal["median", "denoised", "nearest", "centre", "topmost", "mean", "tin"]

# Neighbours in the scan may lie so many widths of a narrow gap's radius apart.
_SPAN_GAPS: Final = 4
# Outliers are told from 20 cells around.
_REACH_OF_OUTLIERS: Final = 32


@dataclass(frozen=True, kw_only=True)
class SurfaceRule:
    """How the depth of a cell follows from its points.

    Attributes:
        surface: name of the rule.
        layer_m: depth step that separates two layers within a cell; for `median`.
        denoise_cells: reach of the filter of `denoised`.
        percentiles: depths below which these shares (%) of a cell's points lie, wanted besides.
        threads: how many threads work.
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
        scan_steps: rows or columns of a scan between neighbours that span a gap, at most.
        layer_m: how far apart their depths are, at most.
        threads: how many threads work.
    """

    gap_cells: int
    scan_steps: int
    layer_m: float
    threads: int

    @property
    def span_cells(self) -> int:
        """How far apart on the wall neighbours in the scan lie that span a gap, at most."""
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
        """How many rows away a cell may lie that decides what becomes of another, at most."""
        # Noise is taken out twice, and a gap is as wide as what spans it and a disc on either side,
        # and a little more, between which it is interpolated.
        gaps = self.gaps.span_cells + 2 * self.gaps.gap_cells + 2
        return _REACH_OF_OUTLIERS + 2 * self.surface.denoise_cells + gaps
