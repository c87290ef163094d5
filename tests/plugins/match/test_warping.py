"""Photos projected onto walls with a pose, and poses found from other photos."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.match import tracing, warping
from orthoflow_plugins.match.displacements import Displacements
from orthoflow_plugins.match.warping import Projection

from orthoflow.files.images import encode_png
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.occluders import occluders_before
from orthoflow.geometry.slabs import Slab
from orthoflow.products import Photo, Wall
from orthoflow.testing import photographed as ms
from tests import samples
from tests.raster_scenes import cloud_of
from tests.scenes import SURVEY_SHIFT_M
from tests.tied_photos import photo, seen_by

GSD_M = 0.01


def wall_at(y_m: float, *, width: int = 100, height: int = 80, x_m: float = -0.5) -> Wall:
    """Return a wall that faces -y, with its middle at z = 0."""
    frame = samples.facing_south(GSD_M, width, height, (x_m, y_m, 0.5 * height * GSD_M))
    return samples.wall(frame, name="wall")


def camera_at(x_m: float = 0.0, y_m: float = -2.0, *, size: int = 800) -> ViewingCamera:
    """Return a camera that looks along y with 400 px per radian; a cell at 2 m is 2 px wide."""
    return samples.aimed((x_m, y_m, 0.0), (x_m, y_m + 1.0, 0.0), 400.0, (size, size))


def hidden_by_screen(inner_m: float, outer_m: float) -> tuple[NDArray[np.bool_], ...]:
    """Return the columns that a screen 0.5 m in front of the wall hides, and visible ones.

    The screen extends from x = -0.35 to -0.05. Seen from 2 m, it hides its extent enlarged by 2 /
    1.5; margins inside and outside are excluded.
    """
    x_m = -0.5 + GSD_M * (np.arange(100) + 0.5)
    left, right = -0.35 * 4 / 3, -0.05 * 4 / 3
    inside = (x_m > left + inner_m) & (x_m < right - inner_m)
    return inside, (x_m < left - outer_m) | (x_m > right + outer_m)


@pytest.mark.parametrize("y_m", [0.0, 100.0])
def test_cells_appear_where_their_centres_are_seen(y_m: float) -> None:
    """The distance of the wall from the origin of coordinates does not matter."""
    (projection,) = warping.project_walls(camera_at(y_m=y_m - 2.0), [wall_at(y_m)])
    assert projection is not None
    assert projection.part == (slice(0, 80), slice(0, 100))
    assert projection.corner.tolist() == [0, 0]
    # The middle of the wall is in the middle of the photo; a cell has two pixels.
    columns, rows = np.arange(100) + 0.5, np.arange(80) + 0.5
    np.testing.assert_allclose(projection.u[0], 400.0 + 2.0 * (columns - 50.0), atol=1e-3)
    np.testing.assert_allclose(projection.v[:, 0], 400.0 + 2.0 * (rows - 40.0), atol=1e-3)
    np.testing.assert_allclose(projection.distance, 2.0, atol=1e-6)
    assert projection.pixels_per_cell == pytest.approx(2.0, abs=1e-4)
    # A wall seen from behind is not shown.
    assert warping.project_walls(camera_at(y_m=y_m + 2.0), [wall_at(y_m)]) == [None]


def test_only_the_part_in_the_photo_is_projected_and_a_little_round_it() -> None:
    # The photo shows 1 m around its axis: columns 100 to 200 of a 3 m wall.
    wide = wall_at(0.0, width=300, x_m=-1.5)
    (projection,) = warping.project_walls(camera_at(size=200), [wide])
    assert projection is not None
    rows, columns = projection.part
    assert (rows.start, rows.stop) == (0, 80)
    # Every eighth cell is tested, and one such step is added on both sides.
    assert (columns.start, columns.stop) == (96, 208)
    assert projection.corner.tolist() == [96, 0]
    seen = np.flatnonzero(np.isfinite(projection.u[0])) + columns.start
    assert (seen[0], seen[-1]) == (100, 199)


def test_walls_that_a_photo_does_not_show_have_no_projection() -> None:
    assert warping.project_walls(camera_at(x_m=20.0), [wall_at(0.0)]) == [None]
    # There are too few cells.
    assert warping.project_walls(camera_at(), [wall_at(0.0, width=9, height=11)]) == [None]


def test_what_another_surface_hides_is_left_out() -> None:
    # Put a screen half a metre in front of the left half of the wall.
    screen = wall_at(-0.5, width=30, x_m=-0.35)
    behind, before = warping.project_walls(camera_at(), [wall_at(0.0), screen])
    assert behind is not None
    assert before is not None
    assert np.isfinite(before.u).all()
    is_hidden, is_clear = hidden_by_screen(0.03, 0.03)
    assert np.isnan(behind.u[40, is_hidden]).all()
    assert np.isfinite(behind.u[40, is_clear]).all()
    np.testing.assert_array_equal(np.isnan(behind.u), np.isnan(behind.v))


def board_before(wall: Wall, camera: ViewingCamera) -> warping.Before:
    # Put a board, which is in no raster, half a metre in front of the left half of the wall.
    across, down = np.meshgrid(np.arange(-0.35, -0.05, 0.005), np.arange(-0.5, 0.5, 0.005))
    cloud = cloud_of(np.column_stack([across.ravel(), np.full(across.size, -0.5), down.ravel()]))
    occluders = occluders_before(
        cloud,
        [Slab(frame=wall.frame, front_m=0.1, behind_m=0.1)],
        [camera],
        spacing_m=0.01,
        stations_world=None,
        n_least=6,
        threads=1,
    )
    return warping.Before(occluders=occluders, front_m=(0.1,))


PHOTO = Photo(
    name="a.png", encoded=encode_png(np.full((800, 800), 90, dtype=np.uint8)), width=800, height=800
)


def test_what_only_the_cloud_holds_hides_the_wall_and_cells_near_it() -> None:
    camera, wall = camera_at(), wall_at(0.0)
    before = board_before(wall, camera)
    is_hidden, is_clear = hidden_by_screen(-0.02, 0.08)
    view = warping.view_of(0, PHOTO, camera, [wall], before)
    for looked in (view, view.posed(camera_at(0.01), [wall])):
        shown = looked.projections[0]
        assert shown is not None
        assert np.isnan(shown.u[40, is_hidden]).all()
        assert np.isfinite(shown.u[40, is_clear]).all()
        np.testing.assert_array_equal(np.isnan(shown.u), np.isnan(shown.v))
    everywhere = warping.view_of(0, PHOTO, camera, [wall]).projections[0]
    assert everywhere is not None
    assert np.isfinite(everywhere.u).all()


def test_a_cell_that_rounds_onto_the_far_border_of_the_photo_is_in_it() -> None:
    # The last row of cells is 79 px below the middle, a millionth of a pixel inside the photo.
    camera, wall = replace(camera_at(), cy=721.0 - 1e-6), wall_at(0.0)
    shown = warping.view_of(0, PHOTO, camera, [wall], board_before(wall, camera))
    assert shown.projections[0] is not None
    assert np.nanmax(shown.projections[0].v) == 800.0


def test_finer_photos_are_averaged_down_to_the_cells() -> None:
    stripes = np.tile([0, 200], 30).astype(np.uint8)[None, :].repeat(60, axis=0)
    v, u = np.meshgrid(np.arange(10) + 0.5, np.arange(12) + 0.5, indexing="ij")
    projection = Projection(
        part=(slice(0, 10), slice(0, 12)),
        u=(4.0 * u).astype(np.float32),
        v=(4.0 * v).astype(np.float32),
        distance=np.ones((10, 12), dtype=np.float32),
        pixels_per_cell=4.0,
    )
    warped = warping.warp_photo(stripes, projection)
    np.testing.assert_allclose(warped[1:-1, 1:-1], 100.0, atol=3.0)


def displacements(shifts: NDArray[np.float64]) -> Displacements:
    rows, columns = np.divmod(np.arange(len(shifts)), 5)
    return Displacements(
        places=np.column_stack([8 * columns, 8 * rows]).astype(np.intp),
        shift_cells=np.asarray(shifts, dtype=np.float64),
        score=np.ones(len(shifts)),
        sigma_cells=np.full(len(shifts), 0.1),
    )


def test_a_displacement_agrees_with_the_median_of_its_neighbours() -> None:
    shifts = np.tile([2.0, -1.0], (25, 1))
    for at, is_far in (([2.5, -1.0], False), ([2.7, -1.0], True), ([2.0, -1.7], True)):
        shifts[12] = at
        off = np.flatnonzero(~tracing.agrees_around(displacements(shifts))).tolist()
        assert off == [12] * is_far
    # If neighbours disagree with each other, no displacement is accepted; a spread of half a cell
    # allows deviations of more than one cell.
    rng = np.random.default_rng(2)
    assert not tracing.agrees_around(displacements(rng.uniform(-20, 20, (25, 2)))).any()
    loose = np.random.default_rng(3).uniform(-0.9, 0.9, (25, 2))
    assert tracing.agrees_around(displacements(loose)).sum() >= 24
    # Three neighbours are too few.
    assert not tracing.agrees_around(displacements(np.zeros((3, 2)))).any()
    assert tracing.agrees_around(displacements(np.zeros((4, 2)))).all()
    assert tracing.agrees_around(displacements(np.zeros((0, 2)))).shape == (0,)


def test_values_between_cells_are_bilinear_and_unknown_beyond_them() -> None:
    raster = np.array([[0.0, 1.0, 2.0], [10.0, 11.0, 12.0], [20.0, 21.0, np.nan]], np.float32)
    at = np.array([[0.25, 0.5], [1.0, 0.0], [0.0, 0.75], [1.5, 0.5]])
    np.testing.assert_allclose(warping.between(raster, at), [5.25, 1.0, 7.5, 6.5])
    beside = np.array([[-0.1, 0.5], [0.5, -0.1], [2.0, 0.5], [0.5, 2.0], [1.5, 1.5]])
    assert np.isnan(warping.between(raster, beside)).all()
    product = np.array([[0.0, 0.0], [0.0, 8.0]], np.float32)
    np.testing.assert_allclose(warping.between(product, np.array([[0.5, 0.25]])), [1.0])


VIEW = ms.camera_before()


OLD = {"old.png": ms.oriented(replace(VIEW, fx=1000.0, fy=1000.0), name="old.png")}


@pytest.mark.parametrize(
    ("exif_px", "is_known"),
    [(None, True), (920.0, True), (1100.0, True), (905.0, False), (1120.0, False)],
)
def test_a_lens_is_taken_from_a_photo_of_the_same_size_and_nearly_the_same_focal_length(
    exif_px: float | None, is_known: bool
) -> None:
    old, new = (photo(name=name, exif_focal_px=exif_px) for name in ("old.png", "new.png"))
    found = tracing.lens_of(new, OLD, ms.photos())
    assert (found.fx if found else None) == (1000.0 if is_known else None)
    # If EXIF contradicts the lens, that of photos with the same EXIF is used.
    found = tracing.lens_of(new, OLD, ms.photos(old, new))
    assert found is not None
    assert found.fx == 1000.0


def view_of(
    grey: float, part: tuple[slice, slice], size: float, *, unknown: tuple[int, int] | None = None
) -> Any:
    """Return a photo that shows one grey value in a part of the first of two walls."""
    projection = SimpleNamespace(part=part, pixels_per_cell=size)
    shown = np.full((part[0].stop - part[0].start, part[1].stop - part[1].start), grey, np.float32)
    if unknown is not None:
        shown[unknown] = np.nan
    return SimpleNamespace(
        projections=[projection, None], on_wall=lambda _index, _projection: shown
    )


def test_of_photos_the_one_that_shows_a_place_largest_paints_it() -> None:
    walls = [samples.wall(samples.facing_south(0.01, 30, 20)) for _ in range(2)]
    small = view_of(100.0, (slice(0, 20), slice(0, 30)), 0.5)
    large = view_of(200.0, (slice(0, 10), slice(5, 15)), 2.0, unknown=(3, 2))
    middle = view_of(50.0, (slice(5, 15), slice(0, 30)), 1.0)
    expected = np.full((20, 30), 100.0)
    expected[5:15] = 50.0
    expected[:10, 5:15] = 200.0
    # Cells missing in the photo of highest resolution come from the next one.
    expected[3, 7] = 100.0
    for order in ((small, middle, large), (large, small, middle)):
        first, second = tracing.painted_walls(order, walls)  # type: ignore[arg-type]
        assert first[0].intensity is not None
        np.testing.assert_allclose(first[0].intensity, expected / 255.0, atol=1e-6)
        assert first[1] is not None
        assert second[1] is None
        assert second[0].intensity is not None
        assert np.isnan(second[0].intensity).all()


# The lens of the view, without its pose.
LENS = replace(VIEW, rotation=np.eye(3), translation=np.zeros(3))


def test_the_pose_is_the_one_that_most_points_agree_with() -> None:
    seen = seen_by(VIEW, 80)
    points, wrong = seen.points_world + SURVEY_SHIFT_M, seen.pixels_photo.copy()
    wrong[:32] = np.random.default_rng(5).uniform([0, 0], [900, 640], (32, 2))
    found = tracing.pose_of_most(wrong, points, LENS, 2.0)
    assert found is not None
    np.testing.assert_allclose(found.centre_world, VIEW.centre_world + SURVEY_SHIFT_M, atol=2e-3)
    assert (found.fx, found.cx) == (VIEW.fx, VIEW.cx)
