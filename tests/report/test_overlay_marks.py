"""Drawings over walls to the last letter, and a comparison's rows beside each other."""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial.transform import Rotation
from syrupy.assertion import SnapshotAssertion

from orthoflow.files.images import decode_image
from orthoflow.report.combinations import environment_words
from orthoflow.report.comparisons import comparison_table
from orthoflow.report.overlays import magnification_for, overlays, residuals_on_wall
from orthoflow.report.pictures import Picture, sliders, wall_pictures
from orthoflow.report.rankings import Mark
from tests.long_loops import seeds
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


@pytest.mark.parametrize(
    ("rms_m", "found"),
    [(0.0, 1.0), (np.nan, 1.0), (1.0, 1.0), (0.0149, 2.0), (0.006, 5.0), (3e-4, 100.0)],
)
def test_magnifications_are_one_two_or_five(rms_m: float, found: float) -> None:
    # Of a wall of 1.2 m a vector of RMS length is drawn 30 mm long at most.
    lengths_m = np.array([[rms_m, 0.0], [0.0, -rms_m], [np.nan, 5.0]])
    assert magnification_for(FRAME, lengths_m) == pytest.approx(found)


def drawn(picture: Picture) -> NDArray[np.uint8]:
    return decode_image(base64.b64decode(picture.uri.partition(",")[2]), picture.title)


def test_ties_and_displacements_are_drawn_on_the_wall_of_their_cell(tmp_path: Path) -> None:
    run = compared_run(tmp_path)
    walls = list(wall_pictures(run))
    found = list(overlays(run, walls))
    assert [(one.cell, one.title) for one in found] == [
        (f"{step}@plane={mark}", f"{what} of wall 0, {step}@plane={mark}")
        for step, what in (("orient", "Ties"), ("check", "Displacements in the orthoimage"))
        for mark in ("fine", "coarse")
    ]
    ties, _, displacements, _ = found
    assert re.fullmatch(
        r"10 control \(RMS [\d.]+ mm along u, [\d.]+ mm along v\), 10 check \(RMS .*\), "
        r"10 rejected; vectors drawn \d+ times as long",
        ties.caption,
    )
    # Of walls that no picture shows there is no drawing.
    assert list(overlays(run, [])) == []
    # One vector to the right and one down, of 1 mm and 20 times as long: 2 cells of 1.2 m / 120.
    assert "drawn 20 times" in displacements.caption
    rgb = drawn(displacements).astype(int)
    blue = (rgb[..., 2] - rgb[..., 0] > 80) & (np.arange(len(rgb)) < 0.85 * len(rgb))[:, None]
    spots, n_spots = ndimage.label(blue)
    assert n_spots == 2
    sizes = [[part.stop - part.start for part in slices] for slices in ndimage.find_objects(spots)]
    # Their feet are 80 and 40 cells apart.
    (y0, x0), (y1, x1) = ndimage.center_of_mass(blue, spots, (1, 2))
    long_px = 2.0 * np.hypot(x1 - x0, y1 - y0) / np.hypot(80.0, 40.0)
    tall, wide = sorted(sizes, reverse=True)
    mark_px = min(*tall, *wide)
    assert max(tall) - 0.5 * mark_px == pytest.approx(long_px, abs=4.0)
    assert max(wide) - 0.5 * mark_px == pytest.approx(long_px, abs=4.0)


def test_marks_are_left_out_evenly_where_there_are_many(tmp_path: Path) -> None:
    run = compared_run(tmp_path)
    place = ("orient@plane=fine", "cameras")
    cameras = run.products[place]
    ties = cameras.ties
    repeated = {
        field.name: np.concatenate([value] * 30)
        for field in fields(ties)
        if isinstance(value := getattr(ties, field.name), np.ndarray)
        and len(value) == len(ties.photo)
    }
    many = replace(cameras, ties=replace(ties, **repeated))
    crowded = replace(run, products={**run.products, place: many})
    found = next(overlays(crowded, list(wall_pictures(run))))
    assert found.caption.endswith(", 600 of them shown")


@pytest.mark.parametrize("seed", seeds(4))
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


# --- sliders ---


def test_pictures_lie_over_the_first_of_their_place_in_shares_of_it() -> None:
    finer = replace(
        FRAME,
        origin_world=FRAME.world_from_wall(np.array([[6.0, 4.0]]))[0],
        gsd_m=0.005,
        width=240,
        height=120,
    )
    texts = [
        Picture(uri="", title=title, caption="", frame=frame)
        for title, frame in (("wall 0 (painted)", FRAME), ("no wall", None), ("depth", finer))
    ]
    (slider,) = sliders(texts, 1)
    assert (slider["name"], slider["ratio"]) == ("wall 0", 1.5)
    first, second = slider["pictures"]  # type: ignore[misc]
    assert (first["title"], second["title"]) == ("wall 0 (painted)", "depth")
    shares = [[one[side] for side in ("left", "top", "width", "height")] for one in (first, second)]
    np.testing.assert_allclose(shares, [(0, 0, 100, 100), (5, 5, 100, 75)], atol=1e-6)
    assert sliders(texts[:2], 1) == []
    # A raster alone begins no group.
    assert sliders([texts[2], texts[2]], 0) == []
    assert len(sliders([texts[2], texts[2]], 1)) == 1


# --- comparisons ---


def test_rows_of_a_comparison_stand_beside_each_other(
    tmp_path: Path, snapshot: SnapshotAssertion
) -> None:
    table = comparison_table([compared_run(tmp_path)])
    assert table is not None
    assert (table.steps, table.shows_runs, table.groups) == (("plane",), False, {})
    columns = [(one.step, one.metric, one.titled, one.better) for one in table.columns]
    assert columns == snapshot(name="columns")
    rows = [
        (row.variants, row.is_baseline, row.failure, row.remark, [one.text for one in row.values])
        for row in table.rows
    ]
    assert rows == snapshot(name="rows")
    fine, coarse, _ = table.rows
    assert {row.run for row in table.rows} == {f"toy <run>, {tmp_path.name}, r1"}
    assert {value.mark for row in (fine, coarse) for value in row.values} == {Mark.NONE, Mark.BEST}
    assert fine.values[0].note == "mean and standard deviation of 3 repeats"
    assert coarse.values[0].note == ""


def test_each_environment_and_set_of_data_has_a_letter() -> None:
    def run(name: str, *cells: object) -> HeldRun:
        held = record(cells, run_id=name, environments=(environment(name, threads=int(name[1])),))  # type: ignore[arg-type]
        return HeldRun(path=Path(f"{name}.h5"), record=held)

    def letters(*runs: HeldRun) -> tuple[list[tuple[str, ...]], Mapping[str, str]]:
        table = comparison_table(runs)
        assert table is not None
        return [row.groups for row in table.rows], table.groups

    measured = metrics(rms_mm=1.0)
    one = run("e1", cell("a@b=c", metrics=measured), cell("a@b=d", metrics=measured))
    two = run("e2", cell("a@b=d", environment="e2", metrics=measured))
    words = (
        f"Python 3.11.2, Linux, toy, 2 processors, {n} threads, code at commit {40 * 'c'}+changes"
        for n in (1, 2)
    )
    assert letters(one, two) == ([("A",), ("A",), ("B",)], dict(zip("AB", words, strict=True)))
    assert letters(one) == ([(), ()], {})
    assert environment_words(replace(environment(), git_commit="")).endswith(", 2 threads")
    # Rooms of two runs: the same data have the same letter, whichever run they are of.
    rooms = [
        run(
            name,
            *(
                cell(f"room@data={room}", outputs={"c": given("", room, "cloud")}, metrics=measured)
                for room in names
            ),
        )
        for name, names in (("r1", ("a", "b")), ("r2", ("b",)))
    ]
    found, legend = letters(*rooms)
    assert found == [("A",), ("B",), ("B",)]
    assert legend["B"] == "data of run r1, dataset b; r2, dataset b"
