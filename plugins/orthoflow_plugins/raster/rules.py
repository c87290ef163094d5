"""By which rule the depth of a cell follows from its points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Surface = Literal["median", "nearest", "topmost", "mean"]


@dataclass(frozen=True, kw_only=True)
class SurfaceRule:
    """How the depth of a cell follows from its points.

    Attributes:
        surface: name of the rule.
        layer_m: depth step that separates two layers within a cell; for `median`.
        threads: how many threads work.
    """

    surface: Surface
    layer_m: float
    threads: int
