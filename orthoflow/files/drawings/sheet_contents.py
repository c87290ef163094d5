"""What stands on a sheet."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.drawings.key_plans import KeyPlan
from orthoflow.files.drawings.papers import Paper, Part, View
from orthoflow.files.drawings.title_blocks import TitleBlock


@dataclass(frozen=True, kw_only=True)
class Axes:
    """What the coordinates beside a picture are.

    Attributes:
        across: coordinate at the raster's left edge, and its change per metre to the right.
        down: coordinate at its top edge, and its change per metre downwards.
        said: what they mean, for the sheet.
    """

    across: tuple[float, float]
    down: tuple[float, float]
    said: str


@dataclass(frozen=True, kw_only=True)
class SheetText:
    """What is written on every sheet of a wall.

    Attributes:
        name: of the wall.
        block: the office's title block.
        notes: sentences: accuracy, colours, cells.
        digest: what seals the record.
        run: which run of which workflow, by which program.
    """

    name: str
    block: TitleBlock
    notes: tuple[str, ...]
    digest: str
    run: str


@dataclass(frozen=True, kw_only=True)
class MarkedArea:
    """An area that is outlined on the pictures of a wall.

    Attributes:
        text: written into it where it is wide enough, its parts (", ") below each other.
        outline_m: (n, 2) metres to the right and down from the raster's top-left corner.
    """

    text: str
    outline_m: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class WallDrawing:
    """A wall that is drawn, on one sheet or more.

    Attributes:
        number: of the wall.
        rasters: kind of picture -> GeoTIFF.
        axes: coordinates.
        plan: the key plan, None without planes.
        text: what is written.
        scale: n of 1 : n.
        grid_m: distance of the crosses, 0 for none.
        interval_m: of the contours of depth.
        depth_range_m: depths that the grey of the depth picture shows as black and as white.
        areas: openings of the wall.
        intensity_is_grey: the intensity is the grey of the scan's colours, not of its laser.
    """

    number: int
    rasters: Mapping[str, Path]
    axes: Axes
    plan: KeyPlan | None
    text: SheetText
    scale: int
    grid_m: float
    interval_m: float = 0.0
    depth_range_m: tuple[float, float] | None = None
    areas: tuple[MarkedArea, ...] = ()
    intensity_is_grey: bool = False


@dataclass(frozen=True, kw_only=True)
class Sheet:
    """One sheet.

    Attributes:
        paper: of it.
        views: pictures on it.
        number: 1 for the first; 0 for the index.
        count: how many there are besides the index.
        numbered: for the index the part of each sheet; for a sheet of several the same, as a key.
    """

    paper: Paper
    views: tuple[View, ...]
    number: int = 1
    count: int = 1
    numbered: tuple[tuple[int, Part], ...] = field(default=())
