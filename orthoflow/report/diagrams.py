"""The graph of a run: cells as boxes in levels, arrows for what they hand on."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from orthoflow.records import RecordedCell
from orthoflow.records.runs import Run
from orthoflow.report.numbers import seconds_in_words
from orthoflow.workflow.model import DATA

BOX: Final = (220.0, 46.0)
_GAP, _GAP_LEVELS = 18.0, 44.0  # between boxes of one level, and between levels
_ABREAST_MOST: Final = 5  # boxes of a level that a page holds side by side, at letters one can read
_CELLS_MOST: Final = 24
_DATA: Final = re.compile(r"@data=[^,#]*$|(?<=@)data=[^,#]*,|@data=[^,#]*(?=#)")
# Letters that fit a box in its first and its second line; the last ones of a long name stay:
# they have the number of a repeat.
_LETTERS: Final = (26, 30)
_LETTERS_END: Final = 5


@dataclass(frozen=True, kw_only=True)
class Diagram:
    """Boxes and arrows.

    Attributes:
        boxes: (left, top, state, name, its short form, method and time).
        arrows: SVG paths.
        size: width and height.
    """

    boxes: Sequence[tuple[float, float, str, str, str, str]]
    arrows: Sequence[str]
    size: tuple[float, float]


def run_diagram(run: Run) -> Diagram:
    """Arrange the cells of a run that ran or should have.

    They go downwards where a page holds the widest level, else from left to right. With more cells
    than a reader can follow, cells of a step become one box.
    """
    groups: dict[str, list[RecordedCell]] = {}
    is_crowded = len(run.cells) > _CELLS_MOST
    group_of = {name: cell.step if is_crowded else name for name, cell in run.cells.items()}
    for address, cell in run.cells.items():
        groups.setdefault(group_of[address], []).append(cell)
    before = {
        name: tuple(
            dict.fromkeys(
                group_of[source]
                for cell in cells
                for product in cell.inputs.values()
                if group_of.get(source := product.source.rpartition(".")[0], name) != name
            )
        )
        for name, cells in groups.items()
    }
    levels = _levels(before, {name: _state(cells) for name, cells in groups.items()})
    is_down = max(map(len, levels), default=0) <= _ABREAST_MOST
    widest = max(map(len, levels), default=0)
    places: dict[str, tuple[float, float]] = {}
    depths: dict[str, int] = {}
    for depth, names in enumerate(levels):
        for index, name in enumerate(names):
            beside = index + 0.5 * (widest - len(names)) * is_down
            x, y = (beside, depth) if is_down else (depth, beside)
            gaps = (_GAP, _GAP_LEVELS) if is_down else (_GAP_LEVELS, _GAP)
            places[name] = (1 + x * (BOX[0] + gaps[0]), 1 + y * (BOX[1] + gaps[1]))
            depths[name] = depth
    # The page of one dataset names it.
    is_alone = len({cell.assignment.get(DATA) for cell in run.cells.values()} - {None}) == 1
    boxes = []
    for name, cells in groups.items():
        title = _DATA.sub("", name) if is_alone else name
        short = title
        if len(title) > _LETTERS[0]:
            short = f"{title[: _LETTERS[0] - _LETTERS_END - 1]}…{title[-_LETTERS_END:]}"
        boxes.append((*places[name], _state(cells), title, short, _words(cells)))
    return Diagram(
        boxes=boxes,
        arrows=[
            _arrow(places[source], places[name], depths[name] - depths[source], is_down=is_down)
            for name, sources in before.items()
            for source in sources
        ],
        # Arrows that pass a level bulge beyond the boxes.
        size=(
            max((x for x, _ in places.values()), default=0.0) + BOX[0] * (1.6 if is_down else 1.0),
            max((y for _, y in places.values()), default=0.0) + BOX[1] + 2,
        ),
    )


def _levels(before: Mapping[str, tuple[str, ...]], states: Mapping[str, str]) -> list[list[str]]:
    """Sort boxes into levels: each behind all that it takes from."""
    taken = {source for sources in before.values() for source in sources}
    # For want of an input nobody takes part in them: rows of their own, behind the others.
    loose = [
        name
        for name in before
        if states[name] == "skipped" and not before[name] and name not in taken
    ]
    level: dict[str, int] = {}
    found: list[list[str]] = []
    for name in [name for name in before if name not in loose]:
        # Cells come in graph order, so each one's sources have their level already.
        level[name] = max((level[source] + 1 for source in before[name]), default=0)
        if level[name] == len(found):
            found.append([])
        found[level[name]].append(name)
    return found + [loose[k : k + _ABREAST_MOST] for k in range(0, len(loose), _ABREAST_MOST)]


def _arrow(
    start: tuple[float, float], end: tuple[float, float], n_levels: int, *, is_down: bool
) -> str:
    """An SVG path; one past other levels bulges, so that it is seen beside their boxes."""
    if is_down:
        x0, y0, x1, y1 = start[0] + BOX[0] / 2, start[1] + BOX[1], end[0] + BOX[0] / 2, end[1]
        bulge = (BOX[0] / 2 + 9.0 * n_levels) / 0.75 if n_levels > 1 else 0.0
        bend = max(20.0, (y1 - y0) / 2) if n_levels < 2 else _GAP_LEVELS
        ways = f"{x0 + bulge:.0f},{y0 + bend:.0f} {x1 + bulge:.0f},{y1 - bend:.0f}"
    else:
        x0, y0, x1, y1 = start[0] + BOX[0], start[1] + BOX[1] / 2, end[0], end[1] + BOX[1] / 2
        bulge = BOX[1] * (n_levels > 1)
        bend = max(30.0, (x1 - x0) / 2)
        ways = f"{x0 + bend:.0f},{y0 + bulge:.0f} {x1 - bend:.0f},{y1 + bulge:.0f}"
    return f"M{x0:.0f},{y0:.0f} C{ways} {x1:.0f},{y1:.0f}"


def _words(cells: Sequence[RecordedCell]) -> str:
    done = [cell for cell in cells if cell.status == "ok"]
    seconds = seconds_in_words(sum(cell.wall_s for cell in done))
    if len(cells) == 1:
        text = f"{cells[0].method}, {seconds}" if done else cells[0].status
    else:
        n_failed = sum(cell.status == "failed" for cell in cells)
        text = f"run {len(cells)} times, {seconds}" + (f", {n_failed} failed" if n_failed else "")
    return text if len(text) <= _LETTERS[1] else f"{text[: _LETTERS[1] - 1]}…"


def _state(cells: Sequence[RecordedCell]) -> str:
    states = {cell.status for cell in cells}
    if "failed" in states:
        return "failed"
    if "ok" not in states:
        return "skipped"
    return "cached" if all(cell.cached_from for cell in cells if cell.status == "ok") else "ok"
