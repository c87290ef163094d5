"""Where the boxes of a run's graph stand, and by which way arrows go from one to another."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any

import pytest

from orthoflow.report import diagrams
from orthoflow.report.diagrams import _Place

# A box is 220 x 46; 18 are between boxes of a level, 44 between levels.
BELOW, BESIDE = 90, 238


def at(column: float, row: float) -> _Place:
    """A place of a graph that goes down."""
    return _Place(x=1 + column * BESIDE, y=1 + row * BELOW)


def cell(status: str = "ok", wall_s: float = 2.0, **known: Any) -> Any:
    return SimpleNamespace(status=status, method="a.b", wall_s=wall_s, cached_from="", **known)


def test_a_box_stands_behind_all_that_it_takes_from() -> None:
    sources = {"a": (), "b": (), "c": ("a",), "d": ("a", "c"), "e": ("b",), "f": ("d", "b")}
    assert diagrams._levels(sources) == [["a", "b"], ["c", "e"], ["d"], ["f"]]
    assert diagrams._levels({}) == []


def test_levels_go_down_with_their_boxes_in_the_middle_or_to_the_right() -> None:
    levels = [["a"], ["b", "c", "d"], ["e", "f"]]
    assert diagrams._lay_out(levels, is_down=True) == {
        "a": at(1, 0), "b": at(0, 1), "c": at(1, 1), "d": at(2, 1),
        "e": at(0.5, 2), "f": at(1.5, 2),
    }  # fmt: skip
    assert diagrams._lay_out(levels, is_down=False) == {
        "a": _Place(x=1, y=1),
        "b": _Place(x=265, y=1), "c": _Place(x=265, y=65), "d": _Place(x=265, y=129),
        "e": _Place(x=529, y=1), "f": _Place(x=529, y=65),
    }  # fmt: skip
    assert diagrams._lay_out([], is_down=True) == {}


def numbers(path: str) -> list[float]:
    return [float(text) for text in re.findall(r"-?\d+", path.partition('d="')[2])]


def test_an_arrow_goes_from_the_lower_side_to_the_upper() -> None:
    # Half of the 44 between levels, and no sharper than twenty.
    found = numbers(diagrams._arrow(at(0, 0), at(1, 1), is_down=True))
    assert found == [111, 47, 111, 69, 349, 69, 349, 91]
    found = numbers(diagrams._arrow(at(0, 0), at(0, 3), is_down=True))
    assert found == [111, 47, 111, 159, 111, 159, 111, 271]
    found = numbers(diagrams._arrow(at(0, 0), _Place(x=1, y=61), is_down=True))
    assert found == [111, 47, 111, 67, 111, 41, 111, 61]


def test_an_arrow_to_the_right_goes_from_side_to_side() -> None:
    start = _Place(x=1, y=1)
    found = numbers(diagrams._arrow(start, _Place(x=265, y=65), is_down=False))
    # 44 between them: no sharper than thirty.
    assert found == [221, 24, 251, 24, 235, 88, 265, 88]
    found = numbers(diagrams._arrow(start, _Place(x=529, y=1), is_down=False))
    assert found == [221, 24, 375, 24, 375, 24, 529, 24]


def test_arrows_past_a_level_go_down_beside_its_boxes() -> None:
    top, left, middle, right, bottom = at(1, 0), at(0, 1), at(1, 1), at(2, 1), at(1, 2)
    places = [top, left, middle, right, bottom]
    pairs = [(top, middle), (top, bottom), (left, bottom)]
    # From the middle of its level the right side is taken: 14 beyond the boxes.
    lanes = diagrams._lanes(pairs, places)
    assert lanes == {(top, bottom): right.x + 220 + 14}
    # Others lie nine further out, each side by itself.
    other = at(0, 0)
    pairs = [(top, bottom), (other, bottom), (top, at(2, 2)), (top, bottom)]
    assert diagrams._lanes(pairs, [*places, other, at(2, 2)]) == {
        (top, bottom): right.x + 220 + 14,
        (other, bottom): left.x - 14,
        (top, at(2, 2)): right.x + 220 + 23,
    }


def test_between_two_boxes_there_may_be_a_way() -> None:
    # What is passed lies to the right of both ends, or to the left.
    start, end = at(0, 0), at(0, 2)
    assert diagrams._lanes([(start, end)], [start, at(1, 1), end]) == {}
    start, end = at(2, 0), at(2, 2)
    assert diagrams._lanes([(start, end)], [start, at(1, 1), end]) == {}
    # Between their middles, that is.
    for column, is_free in ((0.5, True), (0.4, False), (0.6, False)):
        start, end = at(column, 0), at(column, 2)
        lanes = diagrams._lanes([(start, end)], [start, at(0, 1), at(1, 1), end])
        assert (lanes == {}) is is_free


def test_a_lane_goes_straight_down_between_two_bends() -> None:
    found = numbers(diagrams._around(at(1, 0), at(0, 3), 500.0))
    assert found == [349, 47, 349, 69, 500, 69, 500, 91, 227, 500, 249, 111, 249, 111, 271]


def test_a_drawing_is_as_wide_as_its_boxes_and_lanes() -> None:
    sources: dict[str, tuple[str, ...]] = {
        "a": (), "b": ("a",), "c": ("b", "a"),
    }  # fmt: skip
    cells = {
        name: SimpleNamespace(
            status="ok", method="m.n", wall_s=1.0, cached_from="", step=name, assignment={},
            inputs={other: SimpleNamespace(source=f"{other}.out") for other in before},
        )
        for name, before in sources.items()
    }  # fmt: skip
    drawn = diagrams.run_diagram(SimpleNamespace(cells=cells))  # type: ignore[arg-type]
    # Two more than the boxes, and the lane 14 beside them with two more.
    assert 'viewBox="0 0 237 229" width="237"' in drawn
    alone = diagrams.run_diagram(SimpleNamespace(cells=cells), stands_alone=True)  # type: ignore[arg-type]
    assert ' height="229" viewBox="0 0 237 229" width="237"' in alone
    assert alone.startswith('<svg xmlns="http://www.w3.org/2000/svg"')
    assert ("<style>" in alone, "<style>" in drawn) == (True, False)


@pytest.mark.parametrize(
    ("cells", "words", "state"),
    [
        ([cell()], "a.b, 2 s", "ok"),
        ([cell("skipped")], "skipped", "skipped"),
        ([cell("failed")], "failed", "failed"),
        ([cell(), cell(wall_s=3.0)], "run 2 times, 5 s", "ok"),
        ([cell(), cell("failed", 9.0), cell("failed")], "run 3 times, 2 s, 2 failed", "failed"),
        ([cell("skipped"), cell("skipped")], "run 2 times, 0 s", "skipped"),
        ([cell("skipped"), cell()], "run 2 times, 2 s", "ok"),
    ],
)
def test_a_box_says_what_became_of_its_cells(cells: list[Any], words: str, state: str) -> None:
    said = diagrams._state_words(cells)
    assert re.sub(r"(\d)(\.\d+)? s", r"\1 s", said) == words
    assert diagrams._state(cells) == state


def test_cells_that_all_came_from_the_store_are_cached() -> None:
    cached = SimpleNamespace(status="ok", cached_from="r1")
    assert diagrams._state([cached, cell("skipped")]) == "cached"
    assert diagrams._state([cached, cell()]) == "ok"


def test_long_names_are_cut_at_thirty_letters() -> None:
    assert diagrams._short("a" * 30) == "a" * 30
    assert diagrams._short("a" * 31) == "a" * 29 + "\N{HORIZONTAL ELLIPSIS}"
    # The number of a repeat is at the end of its name, and that of the only dataset is told above.
    assert diagrams._short_name("check@plane=ransac-tolerance_m-0_02#2").endswith("0_02#2"[-5:])
    for name, said in (
        ("plane@data=r1,plane=ransac#2", "plane@plane=ransac#2"),
        ("room@data=r1", "room"),
        ("room@data=r1#1", "room#1"),
    ):
        assert diagrams._DATA.sub("", name) == said
