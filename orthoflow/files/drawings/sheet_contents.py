"""The contents of a sheet."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.drawings.key_plans import KeyPlan
from orthoflow.files.drawings.papers import Paper, Part, View
from orthoflow.files.drawings.title_blocks import TitleBlock
from orthoflow.files.drawings.words import Language, Phrase
from orthoflow.geometry import WallFrame
from orthoflow.geometry.directions import basis_from_up

Unit = Literal["m", "ft"]


@dataclass(frozen=True, kw_only=True)
class Axes:
    """The coordinates beside a picture, in metres.

    Attributes:
        across: coordinate at the left edge of the drawn wall, and its change per metre to the
            right.
        down: coordinate at its top edge, and its change per metre downwards.
        phrase: their meaning, for the sheet.
    """

    across: tuple[float, float]
    down: tuple[float, float]
    phrase: Phrase


@dataclass(frozen=True, kw_only=True)
class SheetText:
    """Texts on every sheet of a wall.

    Attributes:
        name: of the wall.
        block: the office's title block.
        notes: accuracy, colours, cells.
        digest: seal of the record.
        run: run, workflow and program.
    """

    name: str
    block: TitleBlock
    notes: tuple[Phrase, ...]
    digest: str
    run: str


@dataclass(frozen=True, kw_only=True)
class MarkedArea:
    """An area outlined on the pictures of a wall.

    Attributes:
        text: written into it if it is wide enough, its parts (", ") below each other.
        outline_m: (n, 2) metres to the right and down from the top-left corner of the drawn wall.
    """

    text: str
    outline_m: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class WallDrawing:
    """A wall drawn on one sheet or more.

    Attributes:
        number: of the wall.
        rasters: kind of picture -> GeoTIFF.
        axes: coordinates.
        plan: the key plan, None without planes.
        text: its texts.
        scale: n of 1 : n.
        grid: distance of the crosses in `unit`, 0 for none.
        unit: unit of all numbers beside pictures.
        language: language of labels.
        interval_m: interval of the contours of depth.
        depth_range_m: depths that are black and white in the grey of the depth picture.
        areas: openings of the wall.
        heights: metres down from the top edge that have a height mark.
        north: (2,) right and up on the paper of the up direction of the key plan; None with
            heights.
        is_flipped: the rows of the rasters go up the paper, as those of ceilings do.
        intensity_is_grey: the intensity is the grey of the scan's colours, not of its laser.
    """

    number: int
    rasters: Mapping[str, Path]
    axes: Axes
    plan: KeyPlan | None
    text: SheetText
    scale: int
    grid: float
    unit: Unit = "m"
    language: Language = "en"
    interval_m: float = 0.0
    depth_range_m: tuple[float, float] | None = None
    areas: tuple[MarkedArea, ...] = ()
    heights: tuple[float, ...] = ()
    north: tuple[float, float] | None = None
    is_flipped: bool = False
    intensity_is_grey: bool = False


@dataclass(frozen=True, kw_only=True)
class Sheet:
    """One sheet.

    Attributes:
        paper: its paper.
        views: pictures on it.
        number: 1 for the first; 0 for the index.
        count: number of sheets without the index.
        numbered: for the index the part of each sheet; for one of several sheets the same, as a
            key.
    """

    paper: Paper
    views: tuple[View, ...]
    number: int = 1
    count: int = 1
    numbered: tuple[tuple[int, Part], ...] = field(default=())


def axes_of(frame: WallFrame) -> Axes:
    """Coordinates of a raster, those of its GeoTIFF; Y goes up the paper, also for ceilings."""
    left_m, top_m = frame.raster_corner_m
    if frame.raster_down > 0.0:
        top_m += frame.height * frame.gsd_m
    kind = frame.raster_axes
    values: dict[str, object] = {"crs": frame.map_crs} if kind == "map" else {}
    if kind == "wall":
        values = {"up": _axis_words(np.array(frame.up))}
    phrase = Phrase(key=f"axes_{kind}", values=values)
    return Axes(across=(left_m, 1.0), down=(top_m, -1.0), phrase=phrase)


def _axis_words(up: NDArray[np.float64]) -> str:
    """Return the scan's axis along which heights count, with its sign."""
    if up.shape != (3,):
        return "?"
    axis = int(np.argmax(np.abs(up)))
    if abs(float(up[axis])) < 1.0 - 1e-9:
        return f"({', '.join(f'{value:.3f}' for value in up.tolist())})"
    return f"{'-' if up[axis] < 0.0 else ''}{'xyz'[axis]}"


def north_of(frame: WallFrame) -> tuple[float, float] | None:
    """Return the key plan's up direction on the drawing: right and up; None for upright walls."""
    if frame.up is None or frame.raster_axes == "wall":
        return None
    north_world = basis_from_up(np.array(frame.up))[1]
    right, down = float(north_world @ frame.u_world), float(north_world @ frame.v_world)
    upwards = down if frame.raster_down > 0.0 else -down
    length = float(np.hypot(right, upwards))
    return (right / length, upwards / length) if length > 0.5 else None
