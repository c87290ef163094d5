"""Plans and sections as DXF, which ezdxf draws as SVG and onto sheets."""

from __future__ import annotations

import math
import random
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.drawings import pens
from orthoflow.files.drawings.dxf import DIMENSION_STYLE, Layers, new_document, save_document
from orthoflow.files.drawings.key_plans import is_map_crs, marked_plan, up_label
from orthoflow.files.drawings.sections import CutLine, Section
from orthoflow.files.drawings.sheet_contents import (
    Axes,
    Drawing,
    Picture,
    Placed,
    SheetText,
    up_words,
)
from orthoflow.files.drawings.words import Language, Phrase, label
from orthoflow.products import Planes
from orthoflow.untrusted_text import shown

if TYPE_CHECKING:
    from ezdxf.document import Drawing as Document
    from ezdxf.layouts.layout import Modelspace
    from ezdxf.math import Vec2

LAYERS: Final[Layers] = {
    "A-SECT-MCUT": ("what is cut", 7, 50),
    "A-SECT-MBND": ("what lies beyond", 8, 13),
    "A-SECT-PATT": ("hatches of what is solid", 8, 13),
    "A-SECT-HIDN": ("stretches without points", 8, 13),
    "A-SECT-SCAN": ("points of the scan beside the lines", 9, 13),
    "A-ANNO-DIMS": ("dimensions", 7, 18),
    "A-ANNO-TEXT": ("text", 7, 18),
}
# On paper, millimetres.
_TEXT_MM: Final = 2.5
_TITLE_MM: Final = 3.5
_SOLID_MM: Final = 3.0
# Around the cut lines: for hatches, and for dimensions.
_AROUND_MM: Final = 2.0 + _SOLID_MM
_DIMENSIONS_MM: Final = 14.0
_BELOW_MM: Final = 28.0
_TEXTS_MM: Final = 160.0
# Widths of ISO 128 that a page has.
_WIDTHS_MM: Final = np.array([0.13, 0.25, 0.35, 0.5])


@dataclass(frozen=True, kw_only=True)
class SectionDrawing:
    """A plan or section to draw.

    Attributes:
        kind: `plan` or `section`.
        section: its content.
        scale: n of 1 : n.
        origin: one line about the origin of the data.
        has_dimensions: the lengths of cut lines are written beside them.
        language: language of labels.
    """

    kind: Literal["plan", "section"]
    section: Section
    scale: int
    origin: str
    has_dimensions: bool = False
    language: Language = "en"

    def mm(self, value: float) -> float:
        """Return metres in the drawing of millimetres on the paper."""
        return 1e-3 * self.scale * value

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """Left, bottom, right and top of the drawing, with what stands around the cut lines."""
        around = self.mm(_DIMENSIONS_MM if self.has_dimensions else _AROUND_MM)
        left, bottom, right, top = self.section.bounds_m
        return left - around, bottom - around, right + around, top + around

    @property
    def notes(self) -> tuple[Phrase, ...]:
        """Statements about what is drawn, and from how many points."""
        if not self.section.slab_m:
            return (Phrase(key="thickness"),)
        values = {"mm": f"{1e3 * self.section.slab_m:.0f}", "count": f"{self.section.n_points:,}"}
        return Phrase(key="slab", values=values), Phrase(key="gaps"), Phrase(key="thickness")


def section_sheet(
    stem: str,
    drawing: SectionDrawing,
    planes: Planes,
    text: SheetText,
    *,
    grid: float,
    crs: str | None = None,
) -> Drawing:
    """Return the sheet of a plan or section, with the text of its run.

    Args:
        stem: of its files.
        drawing: what is drawn.
        planes: of the room, for the key plan.
        text: of the run.
        grid: distance of the crosses, 0 for none.
        crs: coordinate system of the scan, None if it is in no map.
    """
    left, bottom, right, top = drawing.bounds_m
    cut, language = drawing.section.cut, drawing.language
    is_plan = drawing.kind == "plan"
    plan = None
    if not is_plan:
        x_m = np.array([drawing.section.bounds_m[0], drawing.section.bounds_m[2]])
        ends_world = cut.origin_world + np.outer(x_m, cut.x_world)
        plan = marked_plan(planes, ends_world, -cut.forward_world, is_map=is_map_crs(crs))
    phrase = Phrase(key="axes_level")
    if is_map_crs(crs):
        phrase = Phrase(key="axes_map", values={"crs": crs})
    if not is_plan:
        phrase = Phrase(key="axes_section", values={"up": up_words(np.array(planes.up))})
    return Drawing(
        stem=stem,
        size_m=(right - left, top - bottom),
        pictures={label(drawing.kind, language): Picture(draw=partial(_draw, drawing))},
        axes=Axes(across=(left, 1.0), down=(top, -1.0), phrase=phrase),
        text=replace(text, name=cut.title, notes=drawing.notes),
        scale=drawing.scale,
        plan=plan,
        grid=grid,
        language=language,
        north=(0.0, 1.0) if is_plan else None,
        up_label=up_label(planes.up, is_map=is_map_crs(crs)),
    )


def write_section(folder: Path, name: str, drawing: SectionDrawing) -> None:
    """Write `<name>.dxf` and `<name>.svg`."""
    document = _document(drawing)
    save_document(document, folder / f"{name}.dxf")
    _write_svg(folder / f"{name}.svg", document, drawing)


def _draw(drawing: SectionDrawing, placed: Placed) -> None:
    """Draw a plan or section, as its document has it, in the place of the picture."""
    from ezdxf.addons.drawing import recorder

    left, _, _, top = drawing.bounds_m
    found = recorder.Recorder()
    # Title and notes of the document stand on the sheet.
    _render(_document(drawing, with_texts=False), found)

    def on_paper(points: Iterable[Vec2]) -> NDArray[np.float64]:
        return placed.on_paper(np.array([(point.x - left, top - point.y) for point in points]))

    with placed.clipped() as canvas:
        for record in found.records:
            weight = found.properties[record.property_hash].lineweight
            width_mm = float(_WIDTHS_MM[np.argmin(np.abs(_WIDTHS_MM - weight))])
            filled: list[NDArray[np.float64]] = []
            if isinstance(record, recorder.FilledPathsRecord):
                filled = [on_paper(path.flattening(drawing.mm(0.05))) for path in record.paths]
            elif isinstance(record, recorder.PathRecord):
                pens.line(
                    canvas, on_paper(record.path.flattening(drawing.mm(0.05))), width_mm=width_mm
                )
            elif isinstance(record, recorder.SolidLinesRecord):
                for ends in on_paper(record.lines.vertices()).reshape(-1, 2, 2):
                    pens.line(canvas, ends, width_mm=width_mm)
            elif isinstance(record, recorder.PointsRecord):
                points = on_paper(record.points.vertices())
                if len(points) == 1:
                    pens.box(
                        canvas, (*(points[0] - 0.5 * pens.FINE_MM), pens.FINE_MM, pens.FINE_MM)
                    )
                elif len(points) == 2:
                    pens.line(canvas, points, width_mm=width_mm)
                else:
                    filled = [points]
            pens.fill(canvas, filled)


def _render(document: Document, backend: Any) -> None:
    from ezdxf.addons.drawing import config
    from ezdxf.addons.drawing.frontend import Frontend
    from ezdxf.addons.drawing.properties import RenderContext

    configuration = config.Configuration(
        background_policy=config.BackgroundPolicy.WHITE,
        color_policy=config.ColorPolicy.BLACK,
        lineweight_policy=config.LineweightPolicy.ABSOLUTE,
    )
    # ezdxf shifts hatches by a small random amount; the same run must give the same picture.
    state = random.getstate()
    random.seed(0)
    Frontend(RenderContext(document), backend, config=configuration).draw_layout(
        document.modelspace()
    )
    random.setstate(state)


def _document(drawing: SectionDrawing, *, with_texts: bool = True) -> Document:
    document = new_document(LAYERS, drawing.mm(_TEXT_MM), "R2018")
    document.layers.get("A-SECT-HIDN").dxf.linetype = "DASHED"
    document.header["$LTSCALE"] = drawing.mm(8.0)
    document.header["$PDMODE"] = 0
    space = document.modelspace()
    section = drawing.section
    for cut in section.lines:
        _add_solid(space, cut, drawing)
    for cut in section.lines:
        begin, end = cut.ends_m
        space.add_line(tuple(begin), tuple(end), dxfattribs={"layer": "A-SECT-MCUT"})
        if drawing.has_dimensions and cut.length_m >= drawing.mm(10.0):
            _add_dimension(space, cut, drawing)
    for holder, pairs in (("A-SECT-HIDN", section.gaps_m), ("A-SECT-MBND", section.beyond_m)):
        for begin, end in pairs:
            space.add_line(tuple(begin), tuple(end), dxfattribs={"layer": holder})
    for place in section.points_m:
        space.add_point(tuple(place), dxfattribs={"layer": "A-SECT-SCAN"})
    if with_texts:
        _add_texts(space, drawing)
    return document


def _add_solid(space: Modelspace, cut: CutLine, drawing: SectionDrawing) -> None:
    """Hatch behind a line: to the other side of the wall, or a strip if that is unknown.

    A wall with both sides found is hatched from the first of them.
    """
    is_known = math.isfinite(cut.thickness_m)
    if is_known and cut.behind @ [0.83, 0.56] < 0.0:
        return
    deep_m = cut.thickness_m if is_known else drawing.mm(_SOLID_MM)
    begin, end = cut.ends_m
    outline = [begin, end, end + deep_m * cut.behind, begin + deep_m * cut.behind]
    hatch = space.add_hatch(dxfattribs={"layer": "A-SECT-PATT"})
    # Lines of the pattern are 3.175 units apart: 1.3 mm on the paper.
    hatch.set_pattern_fill("ANSI31", scale=drawing.mm(1.3) / 3.175)
    hatch.paths.add_polyline_path([tuple(place) for place in outline], is_closed=True)


def _add_dimension(space: Modelspace, cut: CutLine, drawing: SectionDrawing) -> None:
    begin, end = cut.ends_m
    # From the left, or upwards: text along it is never upside down.
    if (end[0] - begin[0], end[1] - begin[1]) < (-1e-9 * cut.length_m, 0.0):
        begin, end = end, begin
    direction = (end - begin) / cut.length_m
    left = np.array([-direction[1], direction[0]])
    # Dimensions are outside, behind the cut lines.
    side = 1.0 if left @ cut.behind >= 0.0 else -1.0
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
    lines = [(f"{title}   {label('scale', words)} 1:{drawing.scale}", _TITLE_MM)]
    notes = (note.text(words) for note in drawing.notes)
    lines += [(note, _TEXT_MM) for note in (*notes, drawing.origin)]
    for text, high_mm in lines:
        top -= drawing.mm(1.7 * high_mm)
        space.add_text(
            shown(text), height=drawing.mm(high_mm), dxfattribs={"layer": "A-ANNO-TEXT"}
        ).set_placement((left, top))


def _write_svg(path: Path, document: Document, drawing: SectionDrawing) -> None:
    from ezdxf.addons.drawing import layout
    from ezdxf.addons.drawing.svg import SVGBackend
    from ezdxf.math import BoundingBox2d

    backend = SVGBackend()
    _render(document, backend)
    left, bottom, right, top = drawing.bounds_m
    bottom -= drawing.mm(_BELOW_MM)
    right = max(right, left + drawing.mm(_TEXTS_MM))
    size_mm = (1e3 * (right - left) / drawing.scale, 1e3 * (top - bottom) / drawing.scale)
    page = layout.Page(*size_mm, layout.Units.mm)
    settings = layout.Settings(fit_page=False, scale=1e3 / drawing.scale)
    shown_box = BoundingBox2d([(left, bottom), (right, top)])
    text = backend.get_string(page, settings=settings, render_box=shown_box)
    path.write_text(text, encoding="utf-8")
