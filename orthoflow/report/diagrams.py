"""The graph of a run as an SVG drawing: cells in columns, arrows for what they hand on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from typing import Final

from orthoflow.records import Run

_BOX_WIDTH: Final = 190
_BOX_HEIGHT: Final = 46
_GAP_X: Final = 60
_GAP_Y: Final = 16
_LETTERS: Final = 27  # that fit a box at this size


@dataclass(frozen=True, kw_only=True)
class _Place:
    x: float
    y: float


def run_diagram(run: Run) -> str:
    """Draw the cells of a run that ran or should have, left to right, as an `<svg>` element."""
    sources = {address: _cells_before(run, address) for address in run.cells}
    places = _lay_out(sources)
    width = max(place.x for place in places.values()) + _BOX_WIDTH + 2 if places else 0
    height = max(place.y for place in places.values()) + _BOX_HEIGHT + 2 if places else 0
    arrows = [
        _arrow(places[before], places[address])
        for address, befores in sources.items()
        for before in befores
    ]
    boxes = [_box(run, address, place) for address, place in places.items()]
    return (
        f'<svg viewBox="0 0 {width:.0f} {height:.0f}" width="{width:.0f}" role="img" '
        f'aria-label="graph of the run">{"".join(arrows)}{"".join(boxes)}</svg>'
    )


def _cells_before(run: Run, address: str) -> tuple[str, ...]:
    found = []
    for product in run.cells[address].inputs.values():
        before = product.source.rpartition(".")[0]
        if before in run.cells and before not in found:
            found.append(before)
    return tuple(found)


def _lay_out(sources: Mapping[str, tuple[str, ...]]) -> dict[str, _Place]:
    # Cells come in graph order, so each one's sources have their column already.
    columns: dict[str, int] = {}
    filled: dict[int, int] = {}
    places: dict[str, _Place] = {}
    for address, befores in sources.items():
        column = max((columns[before] + 1 for before in befores), default=0)
        row = filled.get(column, 0)
        columns[address], filled[column] = column, row + 1
        places[address] = _Place(
            x=1 + column * (_BOX_WIDTH + _GAP_X), y=1 + row * (_BOX_HEIGHT + _GAP_Y)
        )
    return places


def _arrow(start: _Place, end: _Place) -> str:
    x0, y0 = start.x + _BOX_WIDTH, start.y + _BOX_HEIGHT / 2
    x1, y1 = end.x, end.y + _BOX_HEIGHT / 2
    bend = max(30.0, (x1 - x0) / 2)
    return (
        f'<path class="arrow" d="M{x0:.0f},{y0:.0f} C{x0 + bend:.0f},{y0:.0f} '
        f'{x1 - bend:.0f},{y1:.0f} {x1:.0f},{y1:.0f}"/>'
    )


def _box(run: Run, address: str, place: _Place) -> str:
    cell = run.cells[address]
    state = "cached" if cell.status == "ok" and cell.cached_from else cell.status
    below = f"{cell.method}, {cell.wall_s:.1f} s" if cell.status == "ok" else cell.status
    return (
        f'<g class="cell {state}"><title>{escape(address)}: {escape(cell.method)}</title>'
        f'<rect x="{place.x:.0f}" y="{place.y:.0f}" width="{_BOX_WIDTH}" '
        f'height="{_BOX_HEIGHT}" rx="6"/>'
        f'<text x="{place.x + 10:.0f}" y="{place.y + 19:.0f}">{escape(_short(address))}</text>'
        f'<text class="small" x="{place.x + 10:.0f}" y="{place.y + 36:.0f}">'
        f"{escape(_short(below))}</text></g>"
    )


def _short(text: str) -> str:
    return text if len(text) <= _LETTERS else text[: _LETTERS - 1] + "…"
