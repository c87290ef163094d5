"""How long cells and runs still take, by what they took before and by how far they say they are."""

from __future__ import annotations

import pytest

from orthoflow.cli.progress import CellState, about, left_of_cell, left_of_run


def running(*, fraction: float = 0.0, took_s: float | None = None) -> CellState:
    return CellState(state="running", fraction=fraction, started=100.0, took_s=took_s)


@pytest.mark.parametrize(
    ("cell", "now_s", "left_s"),
    [
        (CellState(), 0.0, None),
        (CellState(took_s=30.0), 0.0, 30.0),
        (CellState(state="ok", took_s=30.0), 0.0, 0.0),
        (CellState(state="failed"), 0.0, 0.0),
        # What it took before counts until that is over.
        (running(took_s=30.0, fraction=0.9), 110.0, 20.0),
        (running(took_s=30.0, fraction=0.5), 130.0, 30.0),
        (running(took_s=30.0), 130.0, None),
        # Then, or where nobody knows, what it says: a quarter in ten seconds leaves thirty.
        (running(fraction=0.25), 110.0, 30.0),
        (running(fraction=0.05), 110.0, 190.0),
        (running(fraction=0.049), 110.0, None),
        (running(fraction=0.25), 101.9, None),
        (running(fraction=0.25), 102.0, 6.0),
        (running(fraction=0.09), 103.0, 3.0 * 0.91 / 0.09),
        (running(fraction=1.0), 110.0, 0.0),
    ],
)
def test_a_cell_takes_as_long_as_before_then_as_long_as_it_says(
    cell: CellState, now_s: float, left_s: float | None
) -> None:
    found = cell.left_s(now_s)
    assert found == (None if left_s is None else pytest.approx(left_s))


def test_kernels_that_are_compiled_once_are_no_share_of_the_work() -> None:
    cell = running()
    cell.hear(0.25, "compiling span_rows (1 so far)", 102.0)
    assert cell.left_s(150.0) is None
    cell.hear(0.25, "compiling claim_slab (2 so far)", 150.0)
    cell.hear(0.25, "wall 0", 160.0)
    # Four of 62 seconds were work: two before, two since.
    assert cell.left_s(162.0) == pytest.approx(12.0)


@pytest.mark.parametrize(
    ("cell", "now_s", "done"),
    [
        (CellState(fraction=0.3, took_s=10.0), 105.0, 0.3),
        (running(fraction=0.3), 105.0, 0.3),
        (running(fraction=0.3, took_s=0.0), 105.0, 0.3),
        (running(fraction=0.3, took_s=10.0), 105.0, 0.5),
        (running(fraction=0.7, took_s=10.0), 105.0, 0.7),
        (running(took_s=10.0), 109.8, 0.95),
        (running(took_s=10.0), 150.0, 0.95),
        (running(fraction=0.3, took_s=10.0), 109.9, 0.95),
        (running(fraction=0.3, took_s=10.0), 110.0, 0.95),
        (running(fraction=0.3, took_s=10.0), 110.1, 0.3),
    ],
)
def test_a_step_moves_by_the_clock_as_long_as_that_may_be_true(
    cell: CellState, now_s: float, done: float
) -> None:
    assert cell.done(now_s) == pytest.approx(done)


def test_a_run_takes_as_long_as_its_longest_cell_or_its_share_of_all() -> None:
    cells = [running(took_s=50.0), CellState(took_s=40.0), CellState(took_s=40.0)]
    done = CellState(state="ok", took_s=1000.0)
    # 50 + 40 + 40 one after the other, or two at a time; three at a time end with the longest.
    assert left_of_run([*cells, done], 100.0) == "about 2 min 10 s left"
    assert left_of_run([*cells, done], 100.0, jobs=2) == "about 1 min 10 s left"
    assert left_of_run([*cells, done], 100.0, jobs=3) == "about 50 s left"


def test_a_run_of_which_part_is_not_known_takes_at_least_the_rest() -> None:
    said = "at least 40 s left, and a step that takes nobody knows how long"
    assert left_of_run([CellState(took_s=40.0), CellState()], 100.0) == said
    both = [CellState(took_s=40.0), CellState(took_s=4.0), CellState(), CellState()]
    said = "at least 45 s left, and 2 steps that take nobody knows how long"
    assert left_of_run(both, 100.0) == said
    # Of a few seconds of one cell a run of minutes would look short.
    unknown = "time left not known yet"
    assert left_of_run([CellState(took_s=4.0), CellState(), CellState()], 100.0) == unknown
    assert left_of_run([CellState(), running()], 100.0) == unknown
    # Nor do cells that are skipped or stored make it known.
    idle = [CellState(took_s=0.0)] * 9
    assert left_of_run([*idle, CellState(took_s=4.0), CellState(), CellState()], 0.0) == unknown
    assert left_of_run(idle, 0.0) == ""
    assert left_of_run([CellState(state="ok")], 100.0) == ""
    assert left_of_run([], 100.0) == ""


def test_only_a_running_cell_has_time_left() -> None:
    assert left_of_cell(running(took_s=30.0), 110.0) == "about 20 s left"
    assert left_of_cell(running(), 110.0) == ""
    assert left_of_cell(CellState(took_s=30.0), 110.0) == ""


@pytest.mark.parametrize(
    ("seconds", "said"),
    [
        (0.0, "5 s"),
        (5.4, "5 s"),
        (5.6, "10 s"),
        (55.0, "55 s"),
        (56.0, "1 min 00 s"),
        (60.0, "1 min 00 s"),
        (61.0, "1 min 10 s"),
        (600.0, "10 min 00 s"),
        (601.0, "11 min 00 s"),
    ],
)
def test_times_are_rounded_up_the_coarser_the_longer(seconds: float, said: str) -> None:
    assert about(seconds) == said
