"""Drawings over walls to the last letter, and a comparison's rows beside each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from orthoflow.records.runs import Run
from orthoflow.report.combinations import combinations_of
from orthoflow.report.comparisons import Origins, _letter, comparison_table
from orthoflow.report.environments import environment_words
from orthoflow.report.overlays import (
    Vectors,
    _counts,
    _Frames,
    _spread_evenly,
    draw_vectors,
    magnification_for,
    overlays,
    residuals_on_wall,
)
from orthoflow.report.pictures import Picture, sliders
from orthoflow.report.rankings import Mark, Sense
from tests.report_runs import (
    CENTRE,
    FRAME,
    HeldRun,
    camera,
    cell,
    compared_run,
    environment,
    given,
    metrics,
    record,
)


def vectors(*kinds: str, lengths_m: list[list[float]]) -> Vectors:
    n = len(kinds)
    feet = np.column_stack([10.0 * np.arange(1, n + 1), 5.0 * np.arange(1, n + 1)])
    return Vectors(pixels_wall=feet, lengths_m=np.array(lengths_m), kinds=np.array(kinds))


def test_each_kind_has_a_mark_and_a_line_to_its_end() -> None:
    # Cells of 1 cm: a centimetre, ten times as long, is ten cells. The mark is 120 / 260 cells.
    shown = vectors(
        *("control", "check", "rejected", "shown"),
        lengths_m=[[0.01, 0.0], [0.0, -0.02], [0.0, 0.0], [0.001, 0.002]],
    )
    assert draw_vectors(FRAME, shown, label="a < b", magnification=10.0) == (
        '<svg class="over" viewBox="0 0 120 80" role="img" aria-label="a &lt; b" '
        'stroke-width="0.231">'
        '<circle class="control" cx="10.0" cy="5.0" r="0.462"/>'
        '<path class="control" d="M10.0 5.0L20.0 5.0"/>'
        '<rect class="check" x="19.5" y="9.5" width="0.923" height="0.923"/>'
        '<path class="check" d="M20.0 10.0L20.0 -10.0"/>'
        '<path class="rejected" d="M29.5 14.5L30.5 15.5M29.5 15.5L30.5 14.5"/>'
        '<circle class="shown" cx="40.0" cy="20.0" r="0.462"/>'
        '<path class="shown" d="M40.0 20.0L41.0 22.0"/></svg>'
    )


def test_vectors_are_counted_by_kind_with_their_errors() -> None:
    shown = vectors(
        *("control", "rejected", "control"), lengths_m=[[0.003, 0.0], [9.0, 9.0], [0.003, 0.002]]
    )
    assert _counts(shown) == ("2 control (RMS 3.00 mm along u, 1.41 mm along v), 1 rejected")


@pytest.mark.parametrize(("most", "chosen"), [(7, range(7)), (6, (0, 1, 2, 3, 4, 6)), (2, (0, 6))])
def test_marks_are_left_out_evenly(most: int, chosen: tuple[int, ...]) -> None:
    shown = vectors(*"abcdefg", lengths_m=[[0.1 * k, 0.0] for k in range(7)])
    kept = _spread_evenly(shown, most)
    assert kept.kinds.tolist() == ["abcdefg"[k] for k in chosen]
    np.testing.assert_array_equal(kept.pixels_wall, shown.pixels_wall[list(chosen)])
    np.testing.assert_array_equal(kept.lengths_m, shown.lengths_m[list(chosen)])


@pytest.mark.parametrize(
    ("rms_m", "wanted", "found"),
    [
        (0.0, 1.0, 1.0),
        (np.nan, 1.0, 1.0),
        (1.0, 1.0, 1.0),
        (0.001, 1.0, 1.0),
        (0.001, 1.99, 1.0),
        (0.001, 2.0, 2.0),
        (0.001, 4.99, 2.0),
        (0.001, 5.0, 5.0),
        (0.001, 9.99, 5.0),
        (0.001, 10.0, 10.0),
        (0.001, 700.0, 500.0),
    ],
)
def test_magnifications_are_one_two_or_five(rms_m: float, wanted: float, found: float) -> None:
    from orthoflow.report.overlays import _RMS_SHARE

    # As large a wall as asks for this magnification.
    gsd_m = max(wanted * rms_m, 1e-3) / (_RMS_SHARE * 120) if np.isfinite(rms_m) else 0.01
    lengths_m = np.array([[rms_m, 0.0], [0.0, -rms_m], [np.nan, 5.0]])
    if rms_m == 1.0:
        gsd_m = 1e-3
    assert magnification_for(replace(FRAME, gsd_m=gsd_m), lengths_m) == pytest.approx(found)


def test_ties_and_displacements_lie_over_the_wall_of_their_cell(tmp_path: Path) -> None:
    run = compared_run(tmp_path)
    pictures = [
        Picture(
            uri="",
            title="",
            caption="",
            cell=f"wall@plane={mark}",
            wall=0,
            number=8,
            name="wall 8",
            frame=FRAME,
        )
        for mark in ("fine", "coarse")
    ]
    found = list(overlays(run, pictures))
    assert [(one.cell, one.walls_cell, one.wall) for one in found] == [
        (f"{step}@plane={mark}", f"wall@plane={mark}", 0)
        for step in ("orient", "check")
        for mark in ("fine", "coarse")
    ]
    assert found[0].title == "Ties of wall 8, orient@plane=fine"
    assert found[2].title == "Displacements in the orthoimage of wall 8, check@plane=fine"
    assert found[2].caption == (
        "2 patch (RMS 0.71 mm along u, 0.71 mm along v), beside depth steps, too; "
        "vectors drawn 20 times as long"
    )
    assert found[0].caption.startswith("10 control (RMS ")
    assert found[0].caption.endswith(" times as long")
    assert found[0].name == "wall 8"
    assert found[0].check_rms_mm is not None
    u, v = found[0].check_rms_mm
    assert f"10 check (RMS {u:.2f} mm along u, {v:.2f} mm along v)" in found[0].caption
    assert found[2].check_rms_mm is None
    assert found[0].svg.count("<circle") == found[0].svg.count("<rect") == 10


@pytest.mark.parametrize("seed", range(4))
def test_what_moves_a_pixel_is_as_long_on_the_wall(seed: int) -> None:
    rng = np.random.default_rng(seed)
    upright = camera()
    rotation = upright.rotation_camera_from_world
    assert rotation is not None
    # Rolled about its axis by any angle, and a little oblique.
    turn = Rotation.from_euler("zxy", [rng.uniform(0, 360), *rng.uniform(-8, 8, 2)], degrees=True)
    turned = turn.as_matrix() @ rotation
    tilted = replace(
        upright,
        rotation_camera_from_world=turned,
        translation_camera_from_world=-turned @ CENTRE,
    )
    points_world = FRAME.world_from_wall(rng.uniform((30, 20), (90, 60), (20, 2)))
    moved_m = rng.normal(0.0, 1e-5, (20, 2))
    moved_world = points_world + moved_m @ np.array([FRAME.u_world, FRAME.v_world])
    viewing = tilted.viewing().shifted(FRAME.origin_world)
    before, after = (
        viewing.project(points - FRAME.origin_world)[:, :2]
        for points in (points_world, moved_world)
    )
    found = residuals_on_wall(tilted, points_world, after - before, FRAME)
    # A hundredth of a millimetre; derivatives over a millimetre are good to a thousandth.
    np.testing.assert_allclose(found, moved_m, atol=1e-7)


@pytest.mark.parametrize(
    ("share", "n_walls", "most"),
    [(1.0, 1, 600), (0.02, 1, 240), (0.02, 2, 120), (0.0025, 1, 50), (1e-6, 1, 50), (1.0, 40, 300)],
)
def test_marks_are_shared_out_over_the_drawings_of_a_page(
    tmp_path: Path, share: float, n_walls: int, most: int
) -> None:
    run = compared_run(tmp_path)
    told = [
        Picture(uri="", title="", caption="", cell="wall@plane=fine", wall=wall, frame=FRAME)
        for wall in range(n_walls)
    ]
    frames = _Frames.of(run, told, share=share)
    assert frames.marks_most == most
    walls_cell, known = frames.behind("check@plane=fine")
    assert (walls_cell, list(known)) == ("wall@plane=fine", list(range(n_walls)))
    assert frames.behind("check@plane=coarse") == ("", {})
    assert frames.behind("scan") == ("", {})


def test_orientations_and_inspections_share_the_bytes_of_a_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[float] = []
    of = _Frames.of

    def noting(run: Run, pictures: Sequence[Picture], *, share: float) -> _Frames:
        asked.append(share)
        return of(run, pictures, share=share)

    monkeypatch.setattr(_Frames, "of", staticmethod(noting))
    run = compared_run(tmp_path)
    # Two orientations and two inspections, over no wall that is known.
    assert list(overlays(run, [], share=0.5)) == []
    assert list(overlays(run, [])) == []
    assert asked == [0.125, 0.25]


# --- sliders ---


def test_pictures_lie_over_the_first_of_their_place_in_shares_of_it() -> None:
    finer = replace(
        FRAME,
        origin_world=FRAME.world_from_wall(np.array([[6.0, 4.0]]))[0],
        gsd_m=0.005,
        width=240,
        height=120,
    )
    told = [
        Picture(uri="", title=title, caption="", frame=frame)
        for title, frame in (("wall 0 (painted)", FRAME), ("no wall", None), ("depth", finer))
    ]
    (slider,) = sliders(told, 1)
    assert (slider.name, slider.ratio) == ("wall 0", 1.5)
    first, second = slider.pictures
    assert (first.picture, first.title, second.picture, second.title) == (
        *(0, "wall 0 (painted)", 2, "depth"),
    )
    shares = [(one.left, one.top, one.width, one.height) for one in slider.pictures]
    np.testing.assert_allclose(shares, [(0, 0, 100, 100), (5, 5, 100, 75)], atol=1e-6)
    assert sliders(told[:2], 1) == ()
    # A raster alone begins no group.
    assert sliders([told[2], told[2]], 0) == ()
    assert len(sliders([told[2], told[2]], 1)) == 1


# --- comparisons ---


def test_rows_of_a_comparison_stand_beside_each_other(tmp_path: Path) -> None:
    table = comparison_table([compared_run(tmp_path)])
    assert table is not None
    assert (table.steps, table.shows_runs, table.groups) == (("plane",), False, {})
    assert [(one.step, one.metric, one.label, one.sense) for one in table.columns] == [
        ("plane", "rms_mm", "points to the first plane, RMS / mm", Sense.LESS),
        ("plane", "omega_deg", "direction of the first normal (omega) / deg", Sense.NEITHER),
        ("check", "rmse_u_mm", "error along u, RMS / mm", Sense.LESS),
        (
            "check",
            "completeness",
            "painted, not filled, of the visible surface",
            Sense.MORE,
        ),
        ("check", "wall_s", "time / s", Sense.LESS),
        ("check", "cpu_s", "processor time / s", Sense.LESS),
        ("check", "peak_rss_mib", "memory / MiB", Sense.LESS),
        ("check", "compile_s", "loading and compiling / s", Sense.NEITHER),
    ]
    fine, coarse, broken = table.rows
    here = tmp_path.name
    assert {row.run for row in table.rows} == {f"toy <run>, {here}, r1"}
    assert [row.variants for row in table.rows] == [("fine",), ("coarse",), ("broken",)]
    assert [row.is_baseline for row in table.rows] == [True, False, False]
    assert broken.failure == "plane@plane=broken: no plane & no <wall>"
    assert {value.text for value in broken.values} == {""}
    assert (broken.time.text, broken.memory.text, broken.remark) == ("", "", "")
    assert (fine.failure, coarse.failure) == ("", "")
    assert [value.text for value in fine.values[:4]] == ["1.10 ± 0.10", "10", "0.4", "0.9931"]
    assert [value.text for value in coarse.values[:4]] == ["4", "11", "60.4", "0.9931"]
    # Of `coarse` there is a single run, so that nothing is ranked.
    assert {value.mark for row in (fine, coarse) for value in row.values} == {Mark.NONE}
    assert fine.values[0].note == "mean and standard deviation of 3 repeats"
    assert coarse.values[0].note == ""
    assert (fine.time.text, coarse.time.text) == ("5.0", "4.2")
    # Times that differ by less than 30 % are not told apart.
    assert (fine.memory.text, fine.time.mark, coarse.time.mark) == ("0", Mark.NONE, Mark.NONE)
    assert fine.remark == "1 of 5 steps cached, with their time in run r0"


def test_letters_go_on_behind_z() -> None:
    assert [_letter(k) for k in (0, 25, 26, 27, 52)] == ["A", "Z", "AA", "AB", "BA"]


def test_environments_and_data_have_letters_of_their_own() -> None:
    def run(name: str, *cells: object) -> HeldRun:
        told = record(cells, run_id=name, environments=(environment(name, threads=int(name[1])),))  # type: ignore[arg-type]
        return HeldRun(path=Path(f"{name}.h5"), record=told)

    one, two = run("e1", cell("a@b=c")), run("e2", cell("a@b=d", environment="e2"))
    origins = Origins.of([one, two])
    words = (
        f"Python 3.11.2, Linux, toy, 2 processors, {n} threads, code at commit {40 * 'c'}+changes"
        for n in (1, 2)
    )
    assert origins.legend == dict(zip("AB", words, strict=True))
    (first,), (second,) = combinations_of(one), combinations_of(two)
    assert (origins.letters(first, "e1"), origins.letters(second, "e2")) == ("A", "B")
    assert origins.letters(first, "e9") == "?"
    bare = replace(environment(), git_commit="")
    assert environment_words(bare).endswith(", 2 threads")
    alone = Origins.of([one])
    assert (dict(alone.legend), alone.letters(first, "e1")) == ({}, "")
    # Rooms of two runs: the same data have the same letter, whichever run they are of.
    rooms = [
        run(
            name,
            *(cell(f"room@data={room}", outputs={"c": given("", room, "cloud")}) for room in names),
        )
        for name, names in (("r1", ("a", "b")), ("r2", ("b",)))
    ]
    of_rooms = Origins.of(rooms)
    told = [of_rooms.letters(one, "e1") for room in rooms for one in combinations_of(room)]
    assert [sign[-1] for sign in told] == ["a", "b", "b"]
    assert of_rooms.legend["b"] == "data of run r1, dataset b; r2, dataset b"


def test_one_combination_is_no_comparison() -> None:
    alone = HeldRun(path=Path("a.h5"), record=record([cell("plane", metrics=metrics(rms_mm=1.0))]))
    assert comparison_table([alone]) is None
    both = comparison_table([alone, replace(alone, path=Path("b.h5"))])
    assert both is not None
    assert both.shows_runs
    assert [one.metric for one in both.columns] == ["rms_mm"]
