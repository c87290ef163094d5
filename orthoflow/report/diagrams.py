"""The graph of a run as an SVG drawing: cells in columns, arrows for what they hand on."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Final

from orthoflow.foreign_text import shown
from orthoflow.records import RecordedCell
from orthoflow.records.runs import Run
from orthoflow.report.numbers import seconds_in_words
from orthoflow.workflow.model import (
    DATA,
)

_BOX_WIDTH: Final = 220
_BOX_HEIGHT: Final = 46
_GAP: Final = 18  # between boxes of one level
_GAP_LEVELS: Final = 44
_LANE_FIRST, _LANE_STEP = 14.0, 9.0  # how far from boxes that they pass arrows go down
_ABREAST_MOST: Final = 5  # boxes of a level that a page holds side by side, at letters one can read
_CELLS_MOST: Final = 24
_DATA: Final = re.compile(r"@data=[^,#]*$|(?<=@)data=[^,#]*,|@data=[^,#]*(?=#)")
_LETTERS: Final = 30  # that fit a box at the size of its second line
_LETTERS_ABOVE: Final = 26  # and of its first
_LETTERS_END: Final = 5  # of these: the last ones have the number of a repeat

# On white paper; the page brings its own for light and dark.
_STYLE: Final = (
    "svg{font-family:sans-serif;background:#fff}.arrow{fill:none;stroke:#5b6570}"
    "rect{fill:#f3f5f7;stroke:#b0b8c0}text{font-size:13px}.small{font-size:11px;fill:#5b6570}"
    ".failed rect{stroke:#a11616;stroke-width:2}.skipped rect{stroke-dasharray:4 3;fill:none}"
    ".cached rect{stroke:#1c6b35}"
)


@dataclass(frozen=True, kw_only=True)
class _Place:
    x: float
    y: float


def run_diagram(run: Run, *, stands_alone: bool = False) -> str:
    """Draw the cells of a run that ran or should have as an `<svg>` element.

    They go downwards where a page holds the widest level, else from left to right.

    With more cells than a reader can follow, cells of a step become one box.

    Args:
        run: the run.
        stands_alone: give the text of an SVG file; on the page its style sheet colours the parts.
    """
    boxes = _boxes(run)
    loose = _loose(boxes)
    levels = _levels({name: box.before for name, box in boxes.items() if name not in loose})
    # For want of an input nobody takes part in them: rows of their own, behind the others.
    levels += [loose[k : k + _ABREAST_MOST] for k in range(0, len(loose), _ABREAST_MOST)]
    is_down = max((len(names) for names in levels), default=0) <= _ABREAST_MOST
    places = _lay_out(levels, is_down=is_down)
    width = max(place.x for place in places.values()) + _BOX_WIDTH + 2 if places else 0
    height = max(place.y for place in places.values()) + _BOX_HEIGHT + 2 if places else 0
    pairs = [(places[before], places[name]) for name, box in boxes.items() for before in box.before]
    lanes = _lanes(pairs, list(places.values())) if is_down else {}
    arrows = [
        _around(*pair, lanes[pair]) if pair in lanes else _arrow(*pair, is_down=is_down)
        for pair in pairs
    ]
    left = min(0.0, *(lane - 2.0 for lane in lanes.values())) if lanes else 0.0
    width = max(width, *(lane + 2.0 for lane in lanes.values())) - left if lanes else width
    drawn = [_draw(box, places[name]) for name, box in boxes.items()]
    alone = f' xmlns="http://www.w3.org/2000/svg" height="{height:.0f}"' if stands_alone else ""
    style = f"<style>{_STYLE}</style>" if stands_alone else ""
    box = f"{left:.0f} 0 {width:.0f} {height:.0f}"
    return (
        f'<svg{alone} viewBox="{box}" width="{width:.0f}" role="img" '
        f'aria-label="graph of the run">{style}{"".join(arrows)}{"".join(drawn)}</svg>'
    )


@dataclass(frozen=True, kw_only=True)
class _Box:
    """What one box says, and the boxes whose products it takes."""

    title: str
    below: str
    state: str
    before: tuple[str, ...]


def _boxes(run: Run) -> dict[str, _Box]:
    groups: dict[str, list[RecordedCell]] = {}
    of_cell: dict[str, str] = {}
    is_crowded = len(run.cells) > _CELLS_MOST
    # The page of one dataset says which it is.
    is_alone = len({cell.assignment.get(DATA) for cell in run.cells.values()} - {None}) == 1
    for address, cell in run.cells.items():
        of_cell[address] = cell.step if is_crowded else address
        groups.setdefault(of_cell[address], []).append(cell)
    return {
        name: _Box(
            title=_DATA.sub("", name) if is_alone else name,
            below=_state_words(cells),
            state=_state(cells),
            before=tuple(
                dict.fromkeys(
                    of_cell[before]
                    for cell in cells
                    for before in _cells_before(run, cell)
                    if of_cell[before] != name
                )
            ),
        )
        for name, cells in groups.items()
    }


def _loose(boxes: Mapping[str, _Box]) -> list[str]:
    """Boxes that were skipped, take nothing and hand nothing on."""
    taken = {before for box in boxes.values() for before in box.before}
    return [
        name
        for name, box in boxes.items()
        if box.state == "skipped" and not box.before and name not in taken
    ]


def _cells_before(run: Run, cell: RecordedCell) -> list[str]:
    sources = (product.source.rpartition(".")[0] for product in cell.inputs.values())
    return [source for source in sources if source in run.cells]


def _state_words(cells: Sequence[RecordedCell]) -> str:
    done = [cell for cell in cells if cell.status == "ok"]
    seconds = seconds_in_words(sum(cell.wall_s for cell in done))
    if len(cells) == 1:
        return f"{cells[0].method}, {seconds}" if done else cells[0].status
    n_failed = sum(cell.status == "failed" for cell in cells)
    return f"run {len(cells)} times, {seconds}" + (f", {n_failed} failed" if n_failed else "")


def _state(cells: Sequence[RecordedCell]) -> str:
    states = {cell.status for cell in cells}
    if "failed" in states:
        return "failed"
    if "ok" not in states:
        return "skipped"
    return "cached" if all(cell.cached_from for cell in cells if cell.status == "ok") else "ok"


def _levels(sources: Mapping[str, tuple[str, ...]]) -> list[list[str]]:
    """Sort boxes into levels: each behind all that it takes from."""
    # Cells come in graph order, so each one's sources have their level already.
    level: dict[str, int] = {}
    found: list[list[str]] = []
    for name, befores in sources.items():
        level[name] = max((level[before] + 1 for before in befores), default=0)
        if level[name] == len(found):
            found.append([])
        found[level[name]].append(name)
    return found


def _lay_out(levels: Sequence[Sequence[str]], *, is_down: bool) -> dict[str, _Place]:
    widest = max((len(names) for names in levels), default=0)
    places: dict[str, _Place] = {}
    for depth, names in enumerate(levels):
        for index, name in enumerate(names):
            if is_down:
                beside = index + 0.5 * (widest - len(names))
                x, y = beside * (_BOX_WIDTH + _GAP), depth * (_BOX_HEIGHT + _GAP_LEVELS)
            else:
                x, y = depth * (_BOX_WIDTH + _GAP_LEVELS), index * (_BOX_HEIGHT + _GAP)
            places[name] = _Place(x=1 + x, y=1 + y)
    return places


def _arrow(start: _Place, end: _Place, *, is_down: bool) -> str:
    if is_down:
        x0, y0 = start.x + _BOX_WIDTH / 2, start.y + _BOX_HEIGHT
        x1, y1 = end.x + _BOX_WIDTH / 2, end.y
        bend = max(20.0, (y1 - y0) / 2)
        ways = f"{x0:.0f},{y0 + bend:.0f} {x1:.0f},{y1 - bend:.0f}"
    else:
        x0, y0 = start.x + _BOX_WIDTH, start.y + _BOX_HEIGHT / 2
        x1, y1 = end.x, end.y + _BOX_HEIGHT / 2
        bend = max(30.0, (x1 - x0) / 2)
        ways = f"{x0 + bend:.0f},{y0:.0f} {x1 - bend:.0f},{y1:.0f}"
    return f'<path class="arrow" d="M{x0:.0f},{y0:.0f} C{ways} {x1:.0f},{y1:.0f}"/>'


def _lanes(
    pairs: Sequence[tuple[_Place, _Place]], places: Sequence[_Place]
) -> dict[tuple[_Place, _Place], float]:
    """Where an arrow past other levels goes down: beside their boxes, not below them.

    Returns:
        Start and end -> x, for those that pass a level.
    """
    found: dict[tuple[_Place, _Place], float] = {}
    n_taken = {-1: 0, 1: 0}
    for start, end in pairs:
        passed = [place for place in places if start.y < place.y < end.y]
        near, far = sorted((start.x, end.x))
        # From the middle of a box to that of another: between two boxes there may be a way.
        is_free = all(
            one.x + _BOX_WIDTH / 2 < near or far + _BOX_WIDTH / 2 < one.x for one in passed
        )
        if is_free or (start, end) in found:
            continue
        left, right = min(one.x for one in passed), max(one.x for one in passed) + _BOX_WIDTH
        side = -1 if start.x + _BOX_WIDTH / 2 < (left + right) / 2 else 1
        aside = _LANE_FIRST + _LANE_STEP * n_taken[side]
        found[start, end] = left - aside if side < 0 else right + aside
        n_taken[side] += 1
    return found


def _around(start: _Place, end: _Place, lane: float) -> str:
    x0, y0 = start.x + _BOX_WIDTH / 2, start.y + _BOX_HEIGHT
    x1, y1 = end.x + _BOX_WIDTH / 2, end.y
    half = _GAP_LEVELS / 2
    return (
        f'<path class="arrow" d="M{x0:.0f},{y0:.0f} C{x0:.0f},{y0 + half:.0f} '
        f"{lane:.0f},{y0 + half:.0f} {lane:.0f},{y0 + _GAP_LEVELS:.0f} V{y1 - _GAP_LEVELS:.0f} "
        f'C{lane:.0f},{y1 - half:.0f} {x1:.0f},{y1 - half:.0f} {x1:.0f},{y1:.0f}"/>'
    )


def _draw(box: _Box, place: _Place) -> str:
    return (
        f'<g class="cell {box.state}">'
        f"<title>{escape(shown(box.title))}: {escape(shown(box.below))}</title>"
        f'<rect x="{place.x:.0f}" y="{place.y:.0f}" width="{_BOX_WIDTH}" '
        f'height="{_BOX_HEIGHT}" rx="6"/>'
        f'<text x="{place.x + 10:.0f}" y="{place.y + 19:.0f}">'
        f"{escape(_short_name(shown(box.title)))}</text>"
        f'<text class="small" x="{place.x + 10:.0f}" y="{place.y + 36:.0f}">'
        f"{escape(_short(shown(box.below)))}</text></g>"
    )


def _short_name(text: str) -> str:
    if len(text) <= _LETTERS_ABOVE:
        return text
    return f"{text[: _LETTERS_ABOVE - _LETTERS_END - 1]}…{text[-_LETTERS_END:]}"


def _short(text: str) -> str:
    return text if len(text) <= _LETTERS else text[: _LETTERS - 1] + "…"
