"""Sheets as data: paper, the office's title block (a YAML file), drawings and their pictures."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from orthoflow.errors import ArgumentError, InputError
from orthoflow.files.documents import read_model
from orthoflow.files.drawings.key_plans import KeyPlan, axis_words
from orthoflow.files.drawings.pens import POINTS_PER_MM
from orthoflow.files.drawings.words import Language, Phrase
from orthoflow.files.images import decode_image
from orthoflow.geometry import CylinderBend, SphereBend, WallFrame
from orthoflow.geometry.frames import basis_from_up
from orthoflow.untrusted_text import open_file, reading, text_of_file

if TYPE_CHECKING:
    from reportlab.pdfgen.canvas import Canvas

Layout = Literal["column", "strip"]

SIZES_MM: Final = {
    "A0": (1189.0, 841.0),
    "A1": (841.0, 594.0),
    "A2": (594.0, 420.0),
    "A3": (420.0, 297.0),
    "A4": (297.0, 210.0),
}
# Elongated sizes of ISO 5457 that can be printed on rolls of 297, 420 and 594 mm.
LONG_MM: Final = {
    "A3.2": (594.0, 297.0),
    "A3.1": (841.0, 297.0),
    "A3.0": (1189.0, 297.0),
    "A2.1": (841.0, 420.0),
    "A2.0": (1189.0, 420.0),
    "A1.0": (1189.0, 594.0),
}
#: sheets into which a wall is divided
MOST_SHEETS: Final = 200
SCALES: Final = (1, 2, 5, 10, 20, 25, 50, 100, 200, 250, 500, 1000, 2000, 5000, 10_000)
# Denominators of imperial scales: architects' 12", 6", 3", 1 1/2", 1", 3/4" ... 1/16" to the foot,
# and engineers' 1" = 20 ft ...
SCALES_FT: Final = (1, 2, 4, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 240, 480, 1200, 2400, 6000)
FOOT_M: Final = 0.3048
_EDGE_MM: Final = (150.0, 5000.0)
MARGIN_MM: Final = 10.0
# Margins around a picture, for the frame, coordinates and heights.
LEFT_MM: Final = 11.0
BELOW_MM: Final = 11.0
_AROUND_MM: Final = (LEFT_MM + 24.0, BELOW_MM + 11.0)


@dataclass(frozen=True, kw_only=True)
class Paper:
    """A sheet of paper and the position of its title block.

    Attributes:
        width_mm: width of the sheet in reading direction.
        height_mm: height of the sheet.
        name: name of the paper size, empty for other sizes.
        layout: position of the title block: a column on the right or a strip along the lower edge.
        block_mm: width of the column, or height of the strip.
    """

    width_mm: float
    height_mm: float
    name: str = ""
    layout: Layout = "column"
    block_mm: float = 0.0

    @property
    def area_mm(self) -> tuple[float, float]:
        """Width and height available for pictures with their margins."""
        wide, high = self.width_mm - 2 * MARGIN_MM, self.height_mm - 2 * MARGIN_MM
        if self.layout == "column":
            return wide - self.block_mm, high
        return wide, high - self.block_mm

    @property
    def corner_mm(self) -> tuple[float, float]:
        """Bottom-left corner, on the paper, of the area for pictures."""
        return MARGIN_MM, MARGIN_MM + (self.block_mm if self.layout == "strip" else 0.0)

    @property
    def turned(self) -> Paper:
        """Return the same paper with width and height exchanged."""
        return replace(self, width_mm=self.height_mm, height_mm=self.width_mm)


@dataclass(frozen=True, kw_only=True)
class Part:
    """A part of a drawn wall, in metres right and down from the wall's top-left corner."""

    left_m: float
    top_m: float
    right_m: float
    bottom_m: float

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height."""
        return self.right_m - self.left_m, self.bottom_m - self.top_m

    @property
    def corners_m(self) -> list[tuple[float, float]]:
        """Corners of the part, metres to the right and down, clockwise from the top-left one."""
        xs, ys = (self.left_m, self.right_m), (self.top_m, self.bottom_m)
        return [(xs[0], ys[0]), (xs[1], ys[0]), (xs[1], ys[1]), (xs[0], ys[1])]


def whole_of(size_m: tuple[float, float]) -> Part:
    """Return the part that covers a whole drawing of this width and height."""
    return Part(left_m=0.0, top_m=0.0, right_m=size_m[0], bottom_m=size_m[1])


@dataclass(frozen=True, kw_only=True)
class View:
    """A picture on a sheet.

    Attributes:
        kind: name of the picture in the drawing.
        part: the part of the wall.
        corner_mm: bottom-left corner of the picture on the paper.
    """

    kind: str
    part: Part
    corner_mm: tuple[float, float]


def paper_of(text: str) -> Paper:
    """Parse a paper size: `A0` to `A4`, an elongated size such as `A3.1`, or mm such as `700x500`.

    Raises:
        ArgumentError: the text is not a paper size.
    """
    known = SIZES_MM | LONG_MM
    if (name := text.upper()) in known:
        return Paper(width_mm=known[name][0], height_mm=known[name][1], name=name)
    found = re.fullmatch(r"(\d{2,4}(?:\.\d+)?)x(\d{2,4}(?:\.\d+)?)", text)
    low, high = _EDGE_MM
    if found and all(low <= float(edge) <= high for edge in found.groups()):
        return Paper(width_mm=float(found[1]), height_mm=float(found[2]))
    raise ArgumentError(
        f"--paper must be {', '.join(known)}, or a width and height of {low:g} to {high:g} mm "
        f"each, as in 700x500; got {text[:100]!r}"
    )


def usual_papers() -> list[Paper]:
    """Return usual papers, smallest first."""
    papers = SIZES_MM | LONG_MM
    return [paper_of(name) for name in sorted(papers, key=lambda name: math.prod(papers[name]))]


def placed(kinds: Sequence[str], part: Part, paper: Paper, scale: int) -> tuple[View, ...]:
    """Place pictures of a part of a wall beside or below each other; empty if they do not fit.

    Args:
        kinds: the pictures.
        part: the part.
        paper: paper of the sheet.
        scale: denominator n of the scale 1 : n.
    """
    wide, high = (
        1e3 * edge / scale + around for edge, around in zip(part.size_m, _AROUND_MM, strict=True)
    )
    across, up = paper.area_mm
    for columns, rows in ((len(kinds), 1), (1, len(kinds))):
        # The tolerance is needed because 12.0 m at 1:50 gives 240.00000000000003 mm.
        if columns * wide > across + 1e-3 or rows * high > up + 1e-3:
            continue
        left = paper.corner_mm[0] + 0.5 * (across - columns * wide) + LEFT_MM
        bottom = paper.corner_mm[1] + 0.5 * (up + rows * high) - high + BELOW_MM
        right_mm, down_mm = (wide, 0.0) if rows == 1 else (0.0, high)
        return tuple(
            View(kind=kind, part=part, corner_mm=(left + k * right_mm, bottom - k * down_mm))
            for k, kind in enumerate(kinds)
        )
    return ()


def cut_up(
    size_m: tuple[float, float], paper: Paper, *, scale: int, grid_m: float
) -> tuple[Part, ...]:
    """Divide a wall evenly among as many sheets as it needs.

    Args:
        size_m: width and height of the drawn wall.
        paper: paper of the sheets.
        scale: denominator n of the scale 1 : n.
        grid_m: step of the grid at which the wall is cut, if the sheets have room; 0 for any
            position.

    Raises:
        ArgumentError: the wall needs more than `MOST_SHEETS` sheets.
    """
    limits = [
        1e-3 * scale * max(1.0, limit - around)
        for limit, around in zip(paper.area_mm, _AROUND_MM, strict=True)
    ]
    counts = [
        max(1, math.ceil(size / limit - 1e-6)) for size, limit in zip(size_m, limits, strict=True)
    ]
    if math.prod(counts) > MOST_SHEETS:
        raise ArgumentError(
            f"a wall of {size_m[0]:.2f} x {size_m[1]:.2f} m needs {math.prod(counts):,} sheets "
            f"at 1:{scale}; the limit is {MOST_SHEETS}: choose a larger --paper or a smaller "
            "scale (a larger --scale number)"
        )
    across, down = (
        _even_cuts(size, limit, count, grid_m)
        for size, limit, count in zip(size_m, limits, counts, strict=True)
    )
    return tuple(
        Part(left_m=left, top_m=top, right_m=right, bottom_m=bottom)
        for top, bottom in pairwise(down)
        for left, right in pairwise(across)
    )


def _even_cuts(size_m: float, limit_m: float, count: int, grid_m: float) -> list[float]:
    """Return the cuts that divide an edge equally, or at multiples of the grid if these fit."""
    step_m = size_m / count
    if grid_m > 0.0 and math.ceil(step_m / grid_m - 1e-9) * grid_m <= limit_m + 1e-9:
        step_m = math.ceil(step_m / grid_m - 1e-9) * grid_m
    return [*(place * step_m for place in range(count) if place * step_m < size_m), size_m]


def round_below(most: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten that does not exceed a value.

    >>> round_below(0.3), round_below(2.0), round_below(60.0)
    (0.2, 2.0, 50.0)
    """
    power = 10.0 ** math.floor(math.log10(most))
    return power * max(factor for factor in (1, 2, 5) if factor * power <= most * (1 + 1e-9))


def nice_step(least: float) -> float:
    """Return the smallest 1, 2 or 5 times a power of ten that is not less than a value.

    >>> nice_step(0.3), nice_step(2.0), nice_step(60.0)
    (0.5, 2.0, 100.0)
    """
    power = 10.0 ** math.floor(math.log10(least))
    return next(factor * power for factor in (1, 2, 5, 10) if factor * power >= least * (1 - 1e-9))


#: bytes of the title block of sheets
MOST_BYTES: Final = 100_000
#: characters of one field of the title block
MOST_LETTERS: Final = 300
_MOST_LOGO_BYTES: Final = 4_000_000


def _checked_text(value: object) -> object:
    if isinstance(value, int | float) and not isinstance(value, bool):
        value = str(value)
    if isinstance(value, str) and len(value) > MOST_LETTERS:
        raise ValueError(f"has {len(value)} characters; at most {MOST_LETTERS} fit on a sheet")
    return value


_Text = Annotated[str, BeforeValidator(_checked_text)]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Revision(_Model):
    """A row of the table of revisions."""

    mark: _Text
    date: _Text = ""
    text: _Text = ""
    by: _Text = ""


class TitleBlock(_Model):
    """The content of the title block; empty fields are omitted.

    Attributes:
        layout: position of the block; None for the position that wastes less paper.
        logo: PNG or JPEG file next to the YAML file.
        project: name of the project.
        title: title of the drawing, instead of the name of the wall.
        site: location of the building.
        client: name of the client.
        organisation: organisation responsible for the drawing.
        author: author of the drawing.
        checked_by: person who checked the drawing.
        date: date of the drawing.
        drawing: drawing number, to which the numbers of wall and sheet are appended.
        revision: current revision; by default the last one in `revisions`.
        note: additional text.
        fields: further fields required by the client, by name.
        revisions: rows of the table of revisions, oldest first.
    """

    layout: Literal["column", "strip"] | None = None
    logo: Path | None = None
    project: _Text = ""
    title: _Text = ""
    site: _Text = ""
    client: _Text = ""
    organisation: _Text = ""
    author: _Text = ""
    checked_by: _Text = ""
    date: _Text = ""
    drawing: _Text = ""
    revision: _Text = ""
    note: _Text = ""
    fields: Annotated[dict[_Text, _Text], Field(max_length=12)] = {}
    revisions: Annotated[tuple[Revision, ...], Field(max_length=12)] = ()


def read_title_block(path: Path) -> TitleBlock:
    """Read a title block.

    Raises:
        InputError: the file cannot be read, or a field is invalid; the message is one sentence
            about the first problem.
    """
    text = text_of_file(path, MOST_BYTES, "a title block (YAML)")
    block, problems = read_model(text, TitleBlock)
    if block is None:
        position, message = problems[0]
        raise InputError(f"{path.name}:{position.line}:{position.column}: {message}")
    if block.logo is None:
        return block
    logo = path.parent / block.logo
    with reading(logo, _MOST_LOGO_BYTES, "a logo (PNG or JPEG)"), open_file(logo) as stream:
        decode_image(stream.read(_MOST_LOGO_BYTES), logo.name)
    return block.model_copy(update={"logo": logo})


Unit = Literal["m", "ft"]
# Function that draws a 14 x 4 mm symbol at the origin, and its text.
LegendRow = tuple[Callable[["Canvas"], None], str]


@dataclass(frozen=True, kw_only=True)
class Placed:
    """A picture at its position on the paper.

    Attributes:
        canvas: the page.
        view: part and position of the picture.
        scale: denominator n of the scale 1 : n.
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
        """Restrict drawing to the picture."""
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
        """Return paper positions (n, 2), mm, of points in metres right and down on the wall."""
        part = self.view.part
        # The list may be empty, e.g. for a hatch that is too small for a line of its pattern.
        places = np.asarray(places_m, dtype=np.float64).reshape(-1, 2)
        offset = places - [part.left_m, part.bottom_m]
        return np.asarray(self.view.corner_mm + 1e3 / self.scale * offset * [1.0, -1.0])


@dataclass(frozen=True, kw_only=True)
class Picture:
    """A picture of a drawing.

    Attributes:
        draw: function that draws a part of the picture.
        legend: rows of the legend.
    """

    draw: Callable[[Placed], None]
    legend: tuple[LegendRow, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Axes:
    """The coordinates beside a picture, in metres.

    Attributes:
        across: coordinate at the left edge of the drawing, and its change per metre to the right;
            None if the coordinate has no meaning, as for several walls.
        down: coordinate at the top edge of the drawing, and its change per metre downwards.
        phrase: description of the coordinates, for the notes.
    """

    across: tuple[float, float] | None
    down: tuple[float, float]
    phrase: Phrase


@dataclass(frozen=True, kw_only=True)
class SheetText:
    """Text on every sheet of a drawing.

    Attributes:
        name: name of the wall or cut.
        block: the office's title block.
        notes: notes on accuracy, colours and cells.
        digest: checksum that seals the record.
        run: names of run, workflow and program.
    """

    name: str
    block: TitleBlock
    notes: tuple[Phrase, ...]
    digest: str
    run: str


@dataclass(frozen=True, kw_only=True)
class Drawing:
    """A drawing to scale on one or more sheets.

    Attributes:
        stem: name of its files without suffix.
        size_m: width and height.
        pictures: pictures by the name of their content; all have the size `size_m`.
        axes: coordinates beside the pictures.
        text: text on every sheet.
        scale: denominator n of the scale 1 : n.
        plan: key plan, or None.
        grid: spacing of the grid crosses in `unit`; 0 for no crosses.
        unit: unit of all numbers beside pictures.
        language: language of labels.
        heights: positions of height marks, in metres down from the top edge.
        north: (2,) direction of `up_label` on the paper (right, up); None if there are heights.
        up_label: label of the upwards direction of the key plan.
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
        """Length of `unit` in metres."""
        return FOOT_M if self.unit == "ft" else 1.0


@dataclass(frozen=True, kw_only=True)
class Sheet:
    """A sheet of a drawing.

    Attributes:
        paper: paper of the sheet.
        views: pictures on the sheet.
        number: number of the sheet, 1 for the first.
        count: number of sheets.
        numbered: number and part of each sheet of the drawing, if there are several.
    """

    paper: Paper
    views: tuple[View, ...]
    number: int = 1
    count: int = 1
    numbered: tuple[tuple[int, Part], ...] = ()


def axes_of(frame: WallFrame) -> Axes:
    """Return the GeoTIFF coordinates of a raster; Y points up the paper, also for ceilings."""
    left_m, top_m = frame.raster_corner_m
    if frame.raster_down > 0.0:
        top_m += frame.height * frame.gsd_m
    values = {"crs": frame.map_crs, "up": up_words(np.array(frame.up))}
    phrase = Phrase(key=f"axes_{frame.raster_axes}", values=values)
    if isinstance(frame.bend, CylinderBend):
        radius = f"{abs(frame.bend.radius_m):.3f}"
        phrase = Phrase(key="axes_unrolled", values={"radius": radius})
    elif isinstance(frame.bend, SphereBend):
        values = {
            "radius": f"{frame.bend.radius_m:.3f}",
            "stretch": f"{frame.bend.largest_stretch:.2f}",
        }
        phrase = Phrase(key="axes_developed_sphere", values=values)
    elif frame.bend is not None:
        angle = f"{math.degrees(frame.bend.half_angle_rad):.2f}"
        phrase = Phrase(key="axes_unrolled_cone", values={"angle": angle})
    return Axes(across=(left_m, 1.0), down=(top_m, -1.0), phrase=phrase)


def up_words(up: NDArray[np.float64]) -> str:
    """Return the up direction as text.

    This is the signed axis of the scan, such as `-z`, or the components of the vector if it is not
    parallel to an axis.
    """
    if up.shape != (3,):
        return "?"
    if float(np.abs(up).max()) < 1.0 - 1e-9:
        return f"({', '.join(f'{value:.3f}' for value in up.tolist())})"
    return axis_words(up)


def north_of(frame: WallFrame) -> tuple[float, float] | None:
    """Return the paper direction (right, up) of the key plan's top; None for upright walls."""
    if frame.up is None or frame.raster_axes == "wall" or frame.bend is not None:
        return None
    north_world = basis_from_up(np.array(frame.up))[1]
    right, down = float(north_world @ frame.u_world), float(north_world @ frame.v_world)
    upwards = down if frame.raster_down > 0.0 else -down
    length = float(np.hypot(right, upwards))
    return (right / length, upwards / length) if length > 0.5 else None
