"""The contents of a sheet: a drawing is its size, notes, legends, and functions that draw it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.drawings.key_plans import KeyPlan, axis_words
from orthoflow.files.drawings.papers import FOOT_M, Paper, Part, View
from orthoflow.files.drawings.pens import POINTS_PER_MM
from orthoflow.files.drawings.title_blocks import TitleBlock
from orthoflow.files.drawings.words import Language, Phrase
from orthoflow.geometry import WallFrame
from orthoflow.geometry.frames import basis_from_up

if TYPE_CHECKING:
    from reportlab.pdfgen.canvas import Canvas

Unit = Literal["m", "ft"]
# What draws a symbol of 14 x 4 mm at the origin, and its text.
LegendRow = tuple[Callable[["Canvas"], None], str]


@dataclass(frozen=True, kw_only=True)
class Placed:
    """A picture at its place on the paper.

    Attributes:
        canvas: the page.
        view: the picture's part, and its place.
        scale: n of 1 : n.
    """

    canvas: Canvas
    view: View
    scale: int

    @property
    def edges_mm(self) -> tuple[float, float, float, float]:
        """Left, bottom, right and top on the paper."""
        left, bottom = self.view.corner_mm
        wide, high = (1e3 * edge / self.scale for edge in self.view.part.size_m)
        return left, bottom, left + wide, bottom + high

    @contextmanager
    def clipped(self) -> Iterator[Canvas]:
        """Draw inside the picture alone."""
        left, bottom, right, top = (POINTS_PER_MM * edge for edge in self.edges_mm)
        self.canvas.saveState()
        frame = self.canvas.beginPath()
        frame.rect(left, bottom, right - left, top - bottom)
        self.canvas.clipPath(frame, stroke=0, fill=0)
        yield self.canvas
        self.canvas.restoreState()

    def on_paper(
        self, places_m: Sequence[tuple[float, float]] | NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return positions on the paper (n, 2), mm, of metres right and down from the corner."""
        part = self.view.part
        # No positions are an empty list, e.g. of a hatch too small for a line of its pattern.
        places = np.asarray(places_m, dtype=np.float64).reshape(-1, 2)
        offset = places - [part.left_m, part.bottom_m]
        return np.asarray(self.view.corner_mm + 1e3 / self.scale * offset * [1.0, -1.0])


@dataclass(frozen=True, kw_only=True)
class Picture:
    """A picture of a drawing.

    Attributes:
        draw: draws a part of it.
        legend: of its symbols.
    """

    draw: Callable[[Placed], None]
    legend: tuple[LegendRow, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Axes:
    """The coordinates beside a picture, in metres.

    Attributes:
        across: coordinate at the left edge of the drawing, and its change per metre to the right;
            None if it means nothing, as over several walls.
        down: coordinate at its top edge, and its change per metre downwards.
        phrase: their meaning, for the sheet.
    """

    across: tuple[float, float] | None
    down: tuple[float, float]
    phrase: Phrase


@dataclass(frozen=True, kw_only=True)
class SheetText:
    """Texts on every sheet of a drawing.

    Attributes:
        name: of the wall, or what is cut.
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
class Drawing:
    """What is drawn to scale, on one sheet or more.

    Attributes:
        stem: of its files.
        size_m: width and height.
        pictures: what each shows, in words -> picture; all of this size.
        axes: coordinates.
        text: its texts.
        scale: n of 1 : n.
        plan: the key plan, None without one.
        grid: distance of the crosses in `unit`, 0 for none.
        unit: unit of all numbers beside pictures.
        language: language of labels.
        heights: metres down from the top edge that have a height mark.
        north: (2,) right and up on the paper of the direction `up_label`; None with heights.
        up_label: of the key plan's up direction.
    """

    stem: str
    size_m: tuple[float, float]
    pictures: Mapping[str, Picture]
    axes: Axes
    text: SheetText
    scale: int
    plan: KeyPlan | None = None
    grid: float = 0.0
    unit: Unit = "m"
    language: Language = "en"
    heights: tuple[float, ...] = ()
    north: tuple[float, float] | None = None
    up_label: str = ""

    @property
    def unit_m(self) -> float:
        """Metres of its unit."""
        return FOOT_M if self.unit == "ft" else 1.0


@dataclass(frozen=True, kw_only=True)
class Sheet:
    """One sheet.

    Attributes:
        paper: its paper.
        views: pictures on it.
        number: 1 for the first.
        count: number of sheets.
        numbered: of one of several sheets, the part on each of them.
    """

    paper: Paper
    views: tuple[View, ...]
    number: int = 1
    count: int = 1
    numbered: tuple[tuple[int, Part], ...] = ()


def axes_of(frame: WallFrame) -> Axes:
    """Coordinates of a raster, those of its GeoTIFF; Y goes up the paper, also for ceilings."""
    left_m, top_m = frame.raster_corner_m
    if frame.raster_down > 0.0:
        top_m += frame.height * frame.gsd_m
    kind = frame.raster_axes
    values: dict[str, object] = {"crs": frame.map_crs} if kind == "map" else {}
    if kind == "wall":
        values = {"up": up_words(np.array(frame.up))}
    phrase = Phrase(key=f"axes_{kind}", values=values)
    return Axes(across=(left_m, 1.0), down=(top_m, -1.0), phrase=phrase)


def up_words(up: NDArray[np.float64]) -> str:
    """Return the scan's axis along which heights count, with its sign, or its components."""
    if up.shape != (3,):
        return "?"
    if float(np.abs(up).max()) < 1.0 - 1e-9:
        return f"({', '.join(f'{value:.3f}' for value in up.tolist())})"
    return axis_words(up)


def north_of(frame: WallFrame) -> tuple[float, float] | None:
    """Return the key plan's up direction on the drawing: right and up; None for upright walls."""
    if frame.up is None or frame.raster_axes == "wall":
        return None
    north_world = basis_from_up(np.array(frame.up))[1]
    right, down = float(north_world @ frame.u_world), float(north_world @ frame.v_world)
    upwards = down if frame.raster_down > 0.0 else -down
    length = float(np.hypot(right, upwards))
    return (right / length, upwards / length) if length > 0.5 else None
