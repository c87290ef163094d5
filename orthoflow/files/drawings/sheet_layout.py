"""The paper of a drawing, and the division of those that fit on none."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

from orthoflow.errors import ArgumentError
from orthoflow.files.drawings.papers import (
    SCALES,
    SCALES_FT,
    Layout,
    Paper,
    Part,
    View,
    cut_up,
    paper_of,
    together,
    usual_papers,
    whole_of,
)
from orthoflow.files.drawings.sheet_blocks import Furniture, furnished
from orthoflow.files.drawings.sheet_contents import Drawing, Sheet
from orthoflow.files.drawings.title_blocks import TitleBlock

# A wall that fits on no paper is divided into sheets of this one.
_CUT_PAPER: Final = "A1"


@dataclass(frozen=True, kw_only=True)
class Sheets:
    """The sheets of a drawing.

    Attributes:
        drawing: the drawing.
        furniture: blocks beside the pictures of each sheet.
        sheets: each with its pictures.
        index: the drawing and sheet that show the division of the wall, at a smaller scale.
    """

    drawing: Drawing
    sheets: tuple[tuple[Sheet, Furniture], ...]
    index: tuple[Drawing, Sheet, Furniture] | None = None


def _ways(paper: Paper, block: TitleBlock) -> list[Paper]:
    """Yield a paper with the title block in each permitted position."""
    layouts: tuple[Layout, ...] = (block.layout,) if block.layout else ("column", "strip")
    return [replace(paper, layout=layout) for layout in layouts]


def _on_one(
    drawing: Drawing,
    papers: Sequence[Paper],
    *,
    is_brief: bool = False,
) -> tuple[Sheet, Furniture] | None:
    """Return all pictures of a wall on one sheet of the first of some papers that fits."""
    kinds, size_m = tuple(drawing.pictures), drawing.size_m
    for paper in papers:
        for way in _ways(paper, drawing.text.block):
            views = together(kinds, size_m, way, drawing.scale)
            if not views:
                continue
            furniture = furnished(way, drawing, Sheet(paper=way, views=views), is_brief=is_brief)
            if furniture is None:
                continue
            views = together(kinds, size_m, furniture.paper, drawing.scale)
            if views:
                return Sheet(paper=furniture.paper, views=views), furniture
    return None


def fitting_scale(
    drawn: Callable[[int], Sequence[Drawing]], scales: Sequence[int], papers: Sequence[Paper]
) -> int:
    """Return n of the largest scale 1 : n at which each wall fits on one sheet.

    Args:
        drawn: returns the drawings at a scale.
        scales: largest first.
        papers: available papers.
    """
    ways = [way for paper in papers for way in (paper, paper.turned)]
    for scale in scales:
        if all(_on_one(drawing, ways) for drawing in drawn(scale)):
            return scale
    return scales[-1]


def paper_for_one(drawings: Sequence[Drawing]) -> str:
    """Return the name of the smallest usual paper that fits each drawing on one sheet, or ""."""
    for paper in usual_papers()[::2]:
        ways = (paper, paper.turned)
        if all(_on_one(drawing, ways) for drawing in drawings):
            return paper.name
    return ""


def lay_out(drawing: Drawing, given: Sequence[Paper] = ()) -> Sheets:
    """Place a wall on one sheet, or divide it into several of the same size.

    Args:
        drawing: the drawing.
        given: permitted papers; without any the smallest usual one that fits the wall.

    Raises:
        ArgumentError: the title block does not fit on the paper, or the wall needs too many sheets.
    """
    papers = [way for paper in given for way in (paper, paper.turned)] or usual_papers()
    # Key plans are omitted only if the office's paper has no room for them.
    for is_brief in (False, True) if given else (False,):
        if (alone := _on_one(drawing, papers, is_brief=is_brief)) is not None:
            return Sheets(drawing=drawing, sheets=(alone,))
    paper = given[0] if given else paper_of(_CUT_PAPER)
    ways: list[tuple[tuple[Sheet, Furniture], ...]] = []
    for is_brief in (False, True):
        for way in (paper, paper.turned):
            for one in _ways(way, drawing.text.block):
                ways += [] if ways and is_brief else _cut(drawing, one, is_brief=is_brief)
    if not ways:
        raise ArgumentError(
            f"--paper {paper.name or f'{paper.width_mm:g}x{paper.height_mm:g}'} has no room for "
            "the title block, the legend and notes beside a picture: take a larger one, or shorten "
            "the title block"
        )
    sheets = min(ways, key=len)
    kind = next(iter(drawing.pictures))
    numbered = tuple(
        (sheet.number, sheet.views[0].part) for sheet, _ in sheets if sheet.views[0].kind == kind
    )
    return Sheets(
        drawing=drawing, sheets=sheets, index=_index(drawing, paper, numbered, len(sheets))
    )


def _cut(
    drawing: Drawing, paper: Paper, *, is_brief: bool
) -> list[tuple[tuple[Sheet, Furniture], ...]]:
    """Return the sheets of a divided wall; none if the paper has no room for them."""
    whole = whole_of(drawing.size_m)
    # As much text as on any of them: with a key of several sheets.
    views = (View(kind=next(iter(drawing.pictures)), part=whole, corner_mm=(0.0, 0.0)),)
    several = ((1, whole), (2, whole))
    longest = Sheet(paper=paper, views=views, count=99, numbered=several)
    first = furnished(paper, drawing, longest, is_brief=is_brief)
    if first is None:
        return []
    laid = cut_up(
        tuple(drawing.pictures),
        drawing.size_m,
        first.paper,
        scale=drawing.scale,
        grid_m=drawing.grid * drawing.unit_m,
    )
    sheets = [
        Sheet(
            paper=first.paper,
            views=shown,
            number=number,
            count=len(laid),
            numbered=_numbered(laid, shown[0].kind),
        )
        for number, shown in enumerate(laid, start=1)
    ]
    furniture = [furnished(first.paper, drawing, sheet, is_brief=is_brief) for sheet in sheets]
    if any(one is None or one.paper.block_mm > first.paper.block_mm for one in furniture):
        return []
    return [
        tuple(
            (sheet, replace(one, paper=first.paper))
            for sheet, one in zip(sheets, furniture, strict=True)
            if one is not None
        )
    ]


def _numbered(views: Sequence[tuple[View, ...]], kind: str) -> tuple[tuple[int, Part], ...]:
    """Return the part of a wall on each of the sheets of one picture; empty if undivided."""
    parts = tuple(
        (number, sheet[0].part)
        for number, sheet in enumerate(views, start=1)
        if sheet[0].kind == kind
    )
    return parts if len(parts) > 1 else ()


def _index(
    drawing: Drawing,
    paper: Paper,
    numbered: tuple[tuple[int, Part], ...],
    count: int,
) -> tuple[Drawing, Sheet, Furniture] | None:
    """Wall as large as fits on one sheet; None if it is undivided, or at no usual scale."""
    first = next(iter(drawing.pictures))
    whole = replace(drawing, grid=0.0, heights=(), pictures={first: drawing.pictures[first]})
    if len(numbered) < 2:
        return None
    for scale in SCALES_FT if drawing.unit == "ft" else SCALES:
        small = replace(whole, scale=scale)
        ways = (paper, paper.turned)
        if scale > drawing.scale and (found := _on_one(small, ways, is_brief=True)):
            sheet = replace(found[0], number=0, count=count, numbered=numbered)
            furniture = furnished(found[0].paper, small, sheet, is_brief=True)
            return None if furniture is None else (small, sheet, furniture)
    return None
