"""Plans and sections as DXF, and from it as SVG and PDF to scale (ezdxf draws all three)."""

from __future__ import annotations

import math
import random
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.drawings.dxf import DIMENSION_STYLE, add_dimension_style, save_document
from orthoflow.files.drawings.papers import (
    MARGIN_MM,
    SCALES,
    SIZES_MM,
    Paper,
    nice_step,
    paper_of,
)
from orthoflow.files.drawings.sections import CutLine, Section
from orthoflow.files.drawings.words import Language, label
from orthoflow.foreign_text import shown

if TYPE_CHECKING:
    from ezdxf.addons.drawing.config import Configuration
    from ezdxf.document import Drawing
    from ezdxf.layouts.layout import Modelspace

# Layers with names of the US National CAD Standard for sections: content, AutoCAD colour and line
# weight in hundredths of a millimetre (ISO 128: 0.5 cut, 0.25 and 0.13 the rest).
LAYERS: Final = {
    "A-SECT-MCUT": ("what is cut", 7, 50),
    "A-SECT-MBND": ("what lies beyond", 8, 13),
    "A-SECT-PATT": ("hatches of what is solid", 8, 13),
    "A-SECT-HIDN": ("stretches without points", 8, 13),
    "A-SECT-SCAN": ("points of the scan beside the lines", 9, 13),
    "A-ANNO-DIMS": ("dimensions", 7, 18),
    "A-ANNO-TEXT": ("text", 7, 18),
    "A-ANNO-SYMB": ("marks, scale bar", 7, 25),
}
# On paper, millimetres.
_TEXT_MM: Final = 2.5
_TITLE_MM: Final = 3.5
_SOLID_MM: Final = 3.0
_BELOW_MM: Final = 44.0
_TEXTS_MM: Final = 160.0
_METRES: Final = 6


@dataclass(frozen=True, kw_only=True)
class SectionDrawing:
    """A plan or section to draw.

    Attributes:
        kind: `plan` or `section`.
        section: its content.
        scale: n of 1 : n.
        paper: paper of PDF and SVG.
        origin: one line about the origin of the data.
        has_dimensions: the lengths of cut lines are written beside them.
        up_label: for a plan, the label of its upwards direction: `N`, `y`.
        language: language of labels.
    """

    kind: Literal["plan", "section"]
    section: Section
    scale: int
    paper: Paper
    origin: str
    has_dimensions: bool = False
    up_label: str = ""
    language: Language = "en"

    def mm(self, value: float) -> float:
        """Return metres in the drawing of millimetres on the paper."""
        return 1e-3 * self.scale * value


def fitted(
    section: Section, scale: int | None, paper: str | None, *, has_dimensions: bool
) -> tuple[int, Paper]:
    """Choose the largest usual scale on A3 or the given paper, and the smallest paper for it."""
    left, bottom, right, top = section.bounds_m
    # Dimensions and hatches are outside the cut lines.
    around_mm = 2 * MARGIN_MM + (24.0 if has_dimensions else 2 * _SOLID_MM)
    wide_m, high_m = right - left, top - bottom

    def fits(way: Paper, n: int) -> bool:
        high_mm = 1e3 * high_m / n + around_mm + _BELOW_MM
        wide_mm = max(1e3 * wide_m / n, _TEXTS_MM) + around_mm
        return wide_mm <= way.width_mm and high_mm <= way.height_mm

    def best(n: int) -> Paper | None:
        ways = [paper_of(name) for name in reversed(SIZES_MM)]
        ways = [paper_of(paper)] if paper else ways
        return next((w for way in ways for w in (way, way.turned) if fits(w, n)), None)

    if scale is None:
        given = paper_of(paper or "A3")
        fitting = (n for n in SCALES if fits(given, n) or fits(given.turned, n))
        scale = next(fitting, SCALES[-1])
    return scale, best(scale) or paper_of(paper or "A0")


def write_section(folder: Path, name: str, drawing: SectionDrawing) -> None:
    """Write `<name>.dxf`, `<name>.svg` and `<name>.pdf`."""
    document = _document(drawing)
    save_document(document, folder / f"{name}.dxf")
    # ezdxf shifts hatches by a small random amount; the same run must give the same picture.
    state = random.getstate()
    for suffix, write in ((".svg", _write_svg), (".pdf", _write_pdf)):
        random.seed(0)
        write(folder / f"{name}{suffix}", document, drawing)
    random.setstate(state)


def _document(drawing: SectionDrawing) -> Drawing:
    from ezdxf.filemanagement import new

    document = new("R2018", setup=True, units=_METRES)
    for name, (description, colour, weight) in LAYERS.items():
        layer = document.layers.add(name, color=colour, lineweight=weight)
        layer.description = description
    document.layers.get("A-SECT-HIDN").dxf.linetype = "DASHED"
    document.header["$LTSCALE"] = drawing.mm(8.0)
    document.header["$PDMODE"] = 0
    add_dimension_style(document, drawing.mm(_TEXT_MM))
    space = document.modelspace()
    section = drawing.section
    for line in section.lines:
        _add_solid(space, line, drawing)
    for line in section.lines:
        begin, end = line.ends_m
        space.add_line(tuple(begin), tuple(end), dxfattribs={"layer": "A-SECT-MCUT"})
        if drawing.has_dimensions and line.length_m >= drawing.mm(10.0):
            _add_dimension(space, line, drawing)
    for holder, pairs in (("A-SECT-HIDN", section.gaps_m), ("A-SECT-MBND", section.beyond_m)):
        for begin, end in pairs:
            space.add_line(tuple(begin), tuple(end), dxfattribs={"layer": holder})
    for place in section.points_m:
        space.add_point(tuple(place), dxfattribs={"layer": "A-SECT-SCAN"})
    _add_texts(space, drawing)
    return document


def _add_solid(space: Modelspace, line: CutLine, drawing: SectionDrawing) -> None:
    """Hatch behind a line: to the other side of the wall, or a strip if that is unknown.

    A wall with both sides found is hatched from the first of them.
    """
    is_known = math.isfinite(line.thickness_m)
    if is_known and line.behind @ [0.83, 0.56] < 0.0:
        return
    deep_m = line.thickness_m if is_known else drawing.mm(_SOLID_MM)
    begin, end = line.ends_m
    outline = [begin, end, end + deep_m * line.behind, begin + deep_m * line.behind]
    hatch = space.add_hatch(dxfattribs={"layer": "A-SECT-PATT"})
    # Lines of the pattern are 3.175 units apart: 1.3 mm on the paper.
    hatch.set_pattern_fill("ANSI31", scale=drawing.mm(1.3) / 3.175)
    hatch.paths.add_polyline_path([tuple(place) for place in outline], is_closed=True)


def _add_dimension(space: Modelspace, line: CutLine, drawing: SectionDrawing) -> None:
    begin, end = line.ends_m
    # From the left, or upwards: text along it is never upside down.
    if (end[0] - begin[0], end[1] - begin[1]) < (-1e-9 * line.length_m, 0.0):
        begin, end = end, begin
    direction = (end - begin) / line.length_m
    left = np.array([-direction[1], direction[0]])
    # Dimensions are outside, behind the cut lines.
    side = 1.0 if left @ line.behind >= 0.0 else -1.0
    space.add_aligned_dim(
        p1=tuple(begin),
        p2=tuple(end),
        distance=side * drawing.mm(8.0),
        dimstyle=DIMENSION_STYLE,
        dxfattribs={"layer": "A-ANNO-DIMS"},
    ).render()


def _add_texts(space: Modelspace, drawing: SectionDrawing) -> None:
    section = drawing.section
    left, bottom, _, _ = section.bounds_m
    top = bottom - drawing.mm(12.0 if drawing.has_dimensions else 2 * _SOLID_MM)
    words = drawing.language
    title = f"{label(drawing.kind, words)}: {section.cut.title}"
    notes = [label("thickness", words)]
    if section.slab_m:
        slab = f"{label('slab', words)} {1e3 * section.slab_m:.0f} mm"
        notes = [f"{slab}, {section.n_points:,} {label('points', words)}", label("gaps", words)]
        notes.append(label("thickness", words))
    lines = [(f"{title}   {label('scale', words)} 1:{drawing.scale}", _TITLE_MM)]
    lines += [(note, _TEXT_MM) for note in (*notes, drawing.origin)]
    for text, high_mm in lines:
        top -= drawing.mm(1.7 * high_mm)
        space.add_text(
            shown(text), height=drawing.mm(high_mm), dxfattribs={"layer": "A-ANNO-TEXT"}
        ).set_placement((left, top))
    top -= drawing.mm(14.0)
    step_m = nice_step(drawing.mm(18.0))
    for k in range(3):
        box = [(left + (k + i) * step_m, top + j * drawing.mm(1.2)) for i, j in _SQUARE]
        space.add_lwpolyline(box, close=True, dxfattribs={"layer": "A-ANNO-SYMB"})
        if k % 2 == 0:
            fill = space.add_hatch(dxfattribs={"layer": "A-ANNO-SYMB"})
            fill.paths.add_polyline_path(box, is_closed=True)
    space.add_text(
        f"{3 * step_m:g} m", height=drawing.mm(_TEXT_MM), dxfattribs={"layer": "A-ANNO-TEXT"}
    ).set_placement((left + 3 * step_m + drawing.mm(2.0), top))
    if drawing.up_label:
        foot = np.array([left + 3 * step_m + drawing.mm(28.0), top])
        tip = foot + np.array([0.0, drawing.mm(8.0)])
        for side in (-1.0, 1.0):
            barb = tip + np.array([side * drawing.mm(1.2), -drawing.mm(2.5)])
            space.add_line(tuple(tip), tuple(barb), dxfattribs={"layer": "A-ANNO-SYMB"})
        space.add_line(tuple(foot), tuple(tip), dxfattribs={"layer": "A-ANNO-SYMB"})
        space.add_text(
            drawing.up_label,
            height=drawing.mm(_TEXT_MM),
            dxfattribs={"layer": "A-ANNO-TEXT"},
        ).set_placement((float(tip[0] + drawing.mm(1.5)), float(foot[1])))


_SQUARE: Final = ((0, 0), (1, 0), (1, 1), (0, 1))


def _middle_m(drawing: SectionDrawing) -> NDArray[np.float64]:
    """Return the centre of the drawing."""
    left, bottom, right, top = drawing.section.bounds_m
    right = max(right, left + drawing.mm(_TEXTS_MM))
    return np.array([0.5 * (left + right), 0.5 * (bottom + top) - 0.5 * drawing.mm(_BELOW_MM)])


def _write_svg(path: Path, document: Drawing, drawing: SectionDrawing) -> None:
    from ezdxf.addons.drawing import layout
    from ezdxf.addons.drawing.frontend import Frontend
    from ezdxf.addons.drawing.properties import RenderContext
    from ezdxf.addons.drawing.svg import SVGBackend
    from ezdxf.math import BoundingBox2d

    backend = SVGBackend()
    Frontend(RenderContext(document), backend, config=_configuration()).draw_layout(
        document.modelspace()
    )
    page = layout.Page(drawing.paper.width_mm, drawing.paper.height_mm, layout.Units.mm)
    half = 0.5 * np.array([drawing.mm(page.width), drawing.mm(page.height)])
    middle = _middle_m(drawing)
    box = BoundingBox2d([tuple(middle - half), tuple(middle + half)])
    settings = layout.Settings(fit_page=False, scale=1e3 / drawing.scale)
    path.write_text(backend.get_string(page, settings=settings, render_box=box), encoding="utf-8")


def _write_pdf(path: Path, document: Drawing, drawing: SectionDrawing) -> None:
    from ezdxf.addons.drawing.frontend import Frontend
    from ezdxf.addons.drawing.matplotlib import MatplotlibBackend
    from ezdxf.addons.drawing.properties import RenderContext
    from matplotlib.figure import Figure

    size_mm = np.array([drawing.paper.width_mm, drawing.paper.height_mm])
    figure = Figure(figsize=tuple(size_mm / 25.4))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    backend = MatplotlibBackend(axes, adjust_figure=False)
    # matplotlib's lines have widths in points, the document's in millimetres.
    in_points = _configuration().with_changes(lineweight_scaling=72.0 / 25.4, min_lineweight=0.2)
    Frontend(RenderContext(document), backend, config=in_points).draw_layout(
        document.modelspace(), finalize=True
    )
    middle, half = _middle_m(drawing), 0.5e-3 * drawing.scale * size_mm
    axes.set_aspect("equal")
    axes.set_xlim(middle[0] - half[0], middle[0] + half[0])
    axes.set_ylim(middle[1] - half[1], middle[1] + half[1])
    figure.savefig(path, metadata={"CreationDate": None, "Creator": drawing.origin})


def _configuration() -> Configuration:
    from ezdxf.addons.drawing import config

    return config.Configuration(
        background_policy=config.BackgroundPolicy.WHITE,
        color_policy=config.ColorPolicy.BLACK,
        lineweight_policy=config.LineweightPolicy.ABSOLUTE,
    )
