"""Pictures of walls on the page: their sizes, captions and places, and what is drawn over them."""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_provenance.document import RecordedProduct
from scipy import ndimage
from scipy.spatial.transform import Rotation
from syrupy.assertion import SnapshotAssertion

from orthoflow.files.images import decode_image
from orthoflow.products import Orthoimages, OrthoMask, SurfaceMask, Walls
from orthoflow.report.combinations import environment_words
from orthoflow.report.comparisons import comparison_table
from orthoflow.report.overlays import magnification_for, overlays, residuals_on_wall
from orthoflow.report.pictures import (
    DIVERGING,
    Picture,
    cursor_places,
    depth_colours,
    embedded_products,
    orthoimage_pictures,
    sliders,
    thumbnail,
    wall_pictures,
)
from orthoflow.report.rankings import Mark
from tests import samples
from tests.long_loops import seeds
from tests.report_runs import (
    CENTRE,
    HeldRun,
    camera,
    cell,
    compared_resolved,
    compared_run,
    environment,
    given,
    metrics,
    record,
    run_of,
)
from tests.report_runs import FRAME as WALL_FRAME

# 1200 x 300 cells of a centimetre.
FRAME = samples.facing_south(0.01, 1200, 300, (4.0e5, 5.0e6, 3.0))


def shown(one: Picture) -> tuple[int, int]:
    """Rows and columns of the picture that the page carries."""
    head, _, text = one.uri.partition(",")
    assert head == "data:image/webp;base64"
    rows, columns = decode_image(base64.b64decode(text)).shape[:2]
    return rows, columns


def orthoimages(n_images: int = 1) -> Orthoimages:
    mask = np.full(FRAME.shape, OrthoMask.PAINTED, dtype=np.uint8)
    mask[:30] = OrthoMask.FILLED
    mask[30:36] = OrthoMask.OCCLUDED
    mask[36:45] = OrthoMask.NONE
    return Orthoimages(
        images=tuple(
            samples.orthoimage(
                FRAME,
                rgb=np.full((*FRAME.shape, 3), 100, np.uint8),
                mask=mask,
                plane_index=4 + place,
                wall=place,
                name=f"wall {4 + place}",
                source=np.where(mask == OrthoMask.PAINTED, 0, -1).astype(np.int16),
            )
            for place in range(n_images)
        )
    )


def run(
    *products: Any, type_name: str = "orthoimages", variants: str = "fine coarse", log: str = ""
) -> HeldRun:
    """A product per variant of `plane`, whose first is the baseline."""
    cells, held = [], {}
    for product, variant, digest in zip(products, variants.split(), "abcdef", strict=False):
        address = f"mosaic@plane={variant}"
        cells.append(cell(f"plane@plane={variant}"))
        cells.append(cell(address, outputs={"out": given("", digest, type_name)}, log=log))
        held[address, "out"] = product
    return run_of(*cells, products=held, workflow_resolved=compared_resolved("plane.rms_mm"))


# --- sizes ---


def test_the_baseline_is_shown_down_to_its_cells() -> None:
    found = list(orthoimage_pictures(run(orthoimages(), orthoimages())))
    # The second variant is not the baseline: a thousand pixels.
    assert [shown(one) for one in found] == [(300, 1200), (250, 1000)]
    # Of a hundredth of a page's bytes, two products are like two hundred.
    few = list(orthoimage_pictures(run(orthoimages(), orthoimages()), share=0.01))
    # 120,000 cells for the baseline: four times as wide as high.
    assert [shown(one)[1] for one in few] == [692, 346]
    (one, two) = orthoimage_pictures(run(orthoimages(2)), share=0.01)
    assert shown(one)[1] == shown(two)[1] == 489


# --- what is said ---


def test_an_orthoimage_says_what_became_of_its_cells() -> None:
    one, _ = orthoimage_pictures(run(orthoimages(), orthoimages()))
    assert one.caption == (
        "12.00 x 3.00 m at 10 mm, 1200 x 300 cells, of which 85.0 % covered, 10.0 % interpolated "
        "from neighbours, 2.0 % hidden in every photo, 3.0 % outside all oriented photos"
    )
    assert (one.title, one.name, one.wall, one.number) == ("wall 4 (plane=fine)", "wall 4", 0, 4)
    assert (one.cell, one.frame, one.file) == ("mosaic@plane=fine", FRAME, "")
    # A bar of at most three tenths of it.
    assert (one.width_m, one.scale) == (pytest.approx(12.0), ("2 m", pytest.approx(100 / 6)))
    assert one.layer == "orthoimage (plane=fine)"
    # What cannot be seen is transparent.
    content = base64.b64decode(one.uri.partition(",")[2])
    alpha = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)[..., 3]
    assert (alpha[:30] == 255).all()
    assert (alpha[31:44] == 0).all()
    assert (alpha[46:] == 255).all()


def walls(*, source: str = "laser") -> Walls:
    depth_m = np.zeros(FRAME.shape, dtype=np.float32)
    # One row of 300 is 5 cm before the plane: less than a hundredth of the cells.
    depth_m[:2] = 0.05
    depth_m[2] = np.nan
    mask = np.ones(FRAME.shape, dtype=np.uint8)
    mask[2:14] = SurfaceMask.VOID
    shades = np.linspace(0, 1, depth_m.size, dtype=np.float32).reshape(FRAME.shape)
    wall = samples.wall(
        FRAME,
        depth_m=depth_m,
        sigma_m=np.zeros_like(depth_m),
        mask=mask,
        intensity=None if source == "none" else shades,
        name="wall 8",
        plane_index=8,
    )
    up = np.array([0.0, 0.0, 1.0])
    buffers_m = {"buffer_front_m": 0.1, "buffer_behind_m": 0.1}
    return Walls(walls=(wall,), up=up, intensity_source=source, **buffers_m)


def test_a_wall_has_pictures_of_its_intensity_and_its_depth() -> None:
    def pictured(source: str, **more: Any) -> list[Picture]:
        made = walls(source=source)
        log = "4.0% show nothing" if source == "none" else ""
        recorded = run(made, type_name="walls", variants="fine", log=log)
        return list(wall_pictures(recorded, **more))

    intensity, depth = pictured("laser")
    titles = [f"wall 8, {what} (plane=fine)" for what in ("intensity", "depth")]
    assert [intensity.title, depth.title] == titles
    assert (intensity.caption, depth.caption) == ("laser intensity", "96.0 % of the depths known")
    for one in (intensity, depth):
        assert (one.wall, one.number, one.name, one.frame) == (0, 8, "wall 8", FRAME)
        assert one.cell == "mosaic@plane=fine"
        assert shown(one) == (250, 1000)
    # 99 of 100 cells lie on the plane: the scale is the smallest that there is.
    assert depth.depth_limit_m == 0.001
    assert (intensity.depths is None, depth.depths is None) == (True, False)
    # Only half as large where a page gives them a fiftieth of its bytes: one product is fifty.
    assert shown(pictured("laser", share=0.02)[0])[1] == 490
    assert pictured("luminance")[0].caption == (
        "grey of the scan's colours, because the scan has no laser intensity"
    )
    # Causes of unknown cells are found where the step reported them.
    (alone,) = pictured("none")
    reasons = "for the reasons, see the log of mosaic@plane=fine"
    assert (alone.title, alone.caption) == (titles[1], f"96.0 % of the depths known; {reasons}")


def test_depths_take_the_colours_between_those_of_the_classes() -> None:
    depth_m = np.linspace(-0.02, 0.02, 801, dtype=np.float32)
    found = depth_colours(depth_m, 0.01).astype(float)
    place = 2.0 + 2.0 * np.clip(depth_m / 0.01, -1.0, 1.0)
    wanted = np.column_stack([np.interp(place, np.arange(5), channel) for channel in DIVERGING.T])
    # A step of 254 is at most one and a half of a channel's 151.
    assert np.abs(found - wanted).max() <= 2.0
    np.testing.assert_array_equal(found[[0, 400, -1]], DIVERGING[[0, 2, 4]])
    assert len(np.unique(found, axis=0)) > 200
    assert (
        depth_colours(np.full((2, 3), np.nan, np.float32), 0.01).tolist() == [[[247] * 3] * 3] * 2
    )


# --- which products ---


def test_equal_products_and_repeats_are_shown_once() -> None:
    def made(digest: str, type_name: str = "walls") -> dict[str, RecordedProduct]:
        return {"walls": given("", digest, type_name)}

    named = {"walls": replace(given("", "d", "walls"), embedded=False)}
    cells = [
        cell("wall@plane=fine", outputs={**made("a"), "more": given("", "b", "walls")}),
        cell("wall@plane=other", outputs=made("a")),
        cell("wall@plane=fine#1", outputs=made("c")),
        cell("wall@plane=named", outputs=named),
        cell("mosaic", outputs=made("e", "orthoimages")),
    ]
    recorded = run_of(*cells)
    found = [("wall@plane=fine", "walls"), ("wall@plane=fine", "more")]
    assert [*embedded_products(recorded, "walls")] == found
    assert embedded_products(recorded, "orthoimages") == (("mosaic", "walls"),)


def test_a_thumbnail_is_the_last_of_some_cells() -> None:
    recorded = run(orthoimages(), orthoimages())
    both = {"mosaic@plane=fine", "mosaic@plane=coarse"}
    small = thumbnail(recorded, both, longest_side_px=120)
    assert shown(Picture(uri=small, title="", caption="")) == (30, 120)
    assert thumbnail(recorded, {"plane@plane=fine"}, longest_side_px=120) == ""


# --- one place ---


def moved(metres: float) -> Any:
    return replace(FRAME, origin_world=FRAME.origin_world + metres * FRAME.u_world)


def of_size(columns: int, rows: int, corner: tuple[float, float]) -> Any:
    origin = FRAME.world_from_wall(np.array([corner]))[0]
    return replace(FRAME, origin_world=origin, width=columns, height=rows)


def turned(degrees: float, axis: str) -> Any:
    about = {"u": FRAME.u_world, "normal": FRAME.normal_world}[axis]
    turn = Rotation.from_rotvec(np.radians(degrees) * about)
    centre = FRAME.world_from_wall(np.array([[600.0, 150.0]]))[0]
    u, v, normal = (turn.apply(v) for v in (FRAME.u_world, FRAME.v_world, FRAME.normal_world))
    origin = centre - 6.0 * u - 1.5 * v
    return replace(FRAME, origin_world=origin, u_world=u, v_world=v, normal_world=normal)


@pytest.mark.parametrize(
    ("frame", "is_same"),
    [
        # A tenth of 12 m between their centres.
        (moved(1.19), True),
        (moved(1.21), False),
        # Half as large about the same centre, or from the same corner.
        (of_size(600, 150, (300.0, 75.0)), True),
        (of_size(600, 300, (0.0, 0.0)), False),
        (turned(4.9, "u"), True),
        (turned(5.1, "u"), False),
        (turned(4.9, "normal"), True),
        (turned(5.1, "normal"), False),
    ],
    ids=["near", "far", "smaller", "beside", "tilted", "tilted-more", "rolled", "rolled-more"],
)
def test_rasters_of_one_wall_lie_within_five_degrees_and_a_tenth(
    frame: Any, *, is_same: bool
) -> None:
    recorded = [
        Picture(uri="", title=title, caption="", frame=one)
        for title, one in (("wall 4", FRAME), ("wall 4, depth", frame))
    ]
    assert len(sliders(recorded, 1)) == is_same


# --- scales and depths for the cursor ---


@pytest.mark.parametrize("width_m", [0.013, 0.9, 5.4, 31.0, 740.0])
def test_a_bar_is_as_long_as_it_says(width_m: float) -> None:
    frame = samples.facing_south(width_m / 1000, 1000, 10)
    words, percent = Picture(uri="", title="", caption="", frame=frame).scale
    number, unit = words.split()
    said_m = float(number) * (0.01 if unit == "cm" else 1.0)
    assert percent / 100 * width_m == pytest.approx(said_m)
    assert 10 <= percent <= 30


def test_an_orthoimage_has_the_depths_of_the_wall_with_its_cells() -> None:
    def picture(name: str, gsd_m: float = 0.5, depths: Any = None) -> Picture:
        frame = samples.facing_east(gsd_m, 4, 2, (1.0, 2.0, 3.0))
        return Picture(
            uri="", title="", caption="", id=name, number=7, name="floor 7", frame=frame,
            depths=depths,
        )  # fmt: skip

    depths = {"columns": 2, "rows": 1, "mm": [5, None]}
    walls = [picture("fine", 0.25, {"columns": 1, "rows": 1, "mm": [9]}), picture("intensity")]
    unplaced = replace(picture("unplaced"), frame=None)
    [place] = cursor_places([picture("ortho"), unplaced], [*walls, picture("depth", 0.5, depths)])
    assert place == {
        **depths,
        "id": "ortho",
        "wall": 7,
        "name": "floor 7",
        "origin": [1.0, 2.0, 3.0],
        "u": [0.0, 1.0, 0.0],
        "v": [0.0, 0.0, -1.0],
        "n": [1.0, 0.0, 0.0],
        "gsd": 0.5,
        "width": 4,
        "height": 2,
    }
    [place] = cursor_places([picture("ortho")], walls)
    assert (place["columns"], place["rows"], place["mm"]) == (0, 0, [])


# What is drawn over walls -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rms_m", "found"),
    [(0.0, 1.0), (np.nan, 1.0), (1.0, 1.0), (0.0149, 2.0), (0.006, 5.0), (3e-4, 100.0)],
)
def test_magnifications_are_one_two_or_five(rms_m: float, found: float) -> None:
    # Of a wall of 1.2 m a vector of RMS length is drawn 30 mm long at most.
    lengths_m = np.array([[rms_m, 0.0], [0.0, -rms_m], [np.nan, 5.0]])
    assert magnification_for(WALL_FRAME, lengths_m) == pytest.approx(found)


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
    points_world = WALL_FRAME.world_from_wall(rng.uniform((30, 20), (90, 60), (20, 2)))
    moved_m = rng.normal(0.0, 1e-5, (20, 2))
    moved_world = points_world + moved_m @ np.array([WALL_FRAME.u_world, WALL_FRAME.v_world])
    viewing = tilted.viewing().shifted(WALL_FRAME.origin_world)
    before, after = (
        viewing.project(points - WALL_FRAME.origin_world)[:, :2]
        for points in (points_world, moved_world)
    )
    found = residuals_on_wall(tilted, points_world, after - before, WALL_FRAME)
    # A hundredth of a millimetre; derivatives over a millimetre are good to a thousandth.
    np.testing.assert_allclose(found, moved_m, atol=1e-7)


# --- sliders ---


def test_pictures_lie_over_the_first_of_their_place_in_shares_of_it() -> None:
    finer = replace(
        WALL_FRAME,
        origin_world=WALL_FRAME.world_from_wall(np.array([[6.0, 4.0]]))[0],
        gsd_m=0.005,
        width=240,
        height=120,
    )
    texts = [
        Picture(uri="", title=title, caption="", frame=frame)
        for title, frame in (
            ("wall 0 (painted)", WALL_FRAME),
            ("no wall", None),
            ("depth", finer),
        )
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
