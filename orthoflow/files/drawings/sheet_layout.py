"""The paper of a drawing, and the division of those that fit on none."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Final, TypeAlias

from orthoflow.errors import ArgumentError
from orthoflow.files.drawings.papers import (
    Layout,
    Paper,
    View,
    cut_up,
    paper_of,
    placed,
    usual_papers,
    whole_of,
)
from orthoflow.files.drawings.sheet_blocks import Furniture, furnished
from orthoflow.files.drawings.sheet_contents import Drawing, Sheet

# A wall that fits on no paper is divided into sheets of this one.
_CUT_PAPER: Final = "A1"
#: a sheet with its pictures, and the blocks beside them
LaidOut: TypeAlias = tuple[Sheet, Furniture]


def fitting_scale(
    drawn: Callable[[int], Sequence[Drawing]], scales: Sequence[int], papers: Sequence[Paper]
) -> int:
    """Return n of the largest scale 1 : n at which each wall fits on one sheet.

    Args:
        drawn: returns the drawings at a scale.
        scales: largest first.
        papers: available papers.
    """
    for scale in scales:
        if all(_on_one(drawing, papers) for drawing in drawn(scale)):
            return scale
    return scales[-1]


def lay_out(drawing: Drawing, given: Sequence[Paper] = ()) -> tuple[LaidOut, ...]:
    """Place a wall on one sheet, or divide it into several of the same size.

    Args:
        drawing: the drawing.
        given: permitted papers; without any the smallest usual one that fits the wall.

    Raises:
        ArgumentError: the title block does not fit on the paper, or the wall needs too many sheets.
    """
    # Key plans are omitted only if the office's paper has no room for them.
    for is_brief in (False, True) if given else (False,):
        if alone := _on_one(drawing, given or usual_papers(), is_brief=is_brief):
            return (alone,)
    paper = given[0] if given else paper_of(_CUT_PAPER)
    for is_brief in (False, True):
        divided = (_cut(drawing, way, is_brief=is_brief) for way in _ways(drawing, [paper]))
        if fitting := [sheets for sheets in divided if sheets]:
            return min(fitting, key=len)
    raise ArgumentError(
        f"--paper {paper.name or f'{paper.width_mm:g}x{paper.height_mm:g}'} has no room for "
        "the title block, the legend and notes beside a picture: take a larger one, or shorten "
        "the title block"
    )


def _ways(drawing: Drawing, papers: Sequence[Paper]) -> Iterator[Paper]:
    """Yield papers, landscape before portrait, with the title block in each permitted position."""
    given = drawing.text.block.layout
    layouts: tuple[Layout, ...] = (given,) if given else ("column", "strip")
    for paper in papers:
        for turned in (paper, paper.turned):
            yield from (replace(turned, layout=layout) for layout in layouts)


def _on_one(drawing: Drawing, papers: Sequence[Paper], *, is_brief: bool = False) -> LaidOut | None:
    """Return all pictures of a wall on one sheet of the first of some papers that fits."""
    content = (tuple(drawing.pictures), whole_of(drawing.size_m))
    for paper in _ways(drawing, papers):
        if views := placed(*content, paper, drawing.scale):
            sheet = Sheet(paper=paper, views=views)
            furniture = furnished(paper, drawing, sheet, is_brief=is_brief)
            if furniture and (views := placed(*content, furniture.paper, drawing.scale)):
                return Sheet(paper=furniture.paper, views=views), furniture
    return None


def _cut(drawing: Drawing, paper: Paper, *, is_brief: bool) -> tuple[LaidOut, ...]:
    """Return the sheets of a divided wall; none if the paper has no room for them."""
    kinds, whole = tuple(drawing.pictures), whole_of(drawing.size_m)
    # As much text as on any of them: with a key of several sheets.
    view = View(kind=max(kinds, key=len), part=whole, corner_mm=(0.0, 0.0))
    longest = Sheet(paper=paper, views=(view,), count=99, numbered=((1, whole), (2, whole)))
    first = furnished(paper, drawing, longest, is_brief=is_brief)
    if first is None:
        return ()
    grid_m = drawing.grid * drawing.unit_m
    parts = cut_up(drawing.size_m, first.paper, scale=drawing.scale, grid_m=grid_m)
    found = []
    for place, kind in enumerate(kinds):
        numbered = tuple(enumerate(parts, start=1 + place * len(parts)))
        for number, part in numbered:
            sheet = Sheet(
                paper=first.paper,
                views=placed([kind], part, first.paper, drawing.scale),
                number=number,
                count=len(kinds) * len(parts),
                numbered=numbered if len(parts) > 1 else (),
            )
            furniture = furnished(first.paper, drawing, sheet, is_brief=is_brief)
            if furniture is None or not sheet.views:
                return ()
            found.append((sheet, furniture))
    return tuple(found)
