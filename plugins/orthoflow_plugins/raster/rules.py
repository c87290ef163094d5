"""By which rule the depth of a cell follows from its points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Surface = Literal["median", "denoised", "nearest", "centre", "topmost", "mean", "tin"]


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
