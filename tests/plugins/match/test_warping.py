"""A photo laid into walls by a pose: where cells appear, what hides them, what is too flat."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from orthoflow_plugins.match import warping
from orthoflow_plugins.match.warping import Projection

from orthoflow.files.images import encode_png
from orthoflow.geometry.cameras import ViewingCamera, looking_at
from orthoflow.geometry.occluders import occluders_before
from orthoflow.geometry.slabs import Slab
from orthoflow.products import Photo, PointCloud, Wall
from tests import samples

GSD_M = 0.01


def wall_at(y_m: float, *, width: int = 100, height: int = 80, x_m: float = -0.5) -> Wall:
    """A wall that looks to -y, its middle at z = 0."""
    frame = samples.facing_south(GSD_M, width, height, (x_m, y_m, 0.5 * height * GSD_M))
    return samples.wall(frame, name="wall")


def camera_at(x_m: float = 0.0, y_m: float = -2.0, *, size: int = 800) -> ViewingCamera:
    """Looks along y, with 400 px per radian; a wall's cell is 2 px wide 2 m away."""
    centre = np.array([x_m, y_m, 0.0])
    rotation = looking_at(centre, centre + samples.NORTH, samples.UP)
    half = 0.5 * size
    return samples.camera(
        rotation, centre, width=size, height=size, fx=400.0, fy=400.0, cx=half, cy=half
    )


def test_cells_appear_where_their_centres_are_seen() -> None:
    (projection,) = warping.project_walls(camera_at(), [wall_at(0.0)])
    assert projection is not None
    assert projection.part == (slice(0, 80), slice(0, 100))
    assert projection.corner.tolist() == [0, 0]
    # The middle of the wall is the middle of the photo; two pixels a cell.
    columns, rows = np.arange(100) + 0.5, np.arange(80) + 0.5
    np.testing.assert_allclose(projection.u[0], 400.0 + 2.0 * (columns - 50.0), atol=1e-3)
    np.testing.assert_allclose(projection.v[:, 0], 400.0 + 2.0 * (rows - 40.0), atol=1e-3)
    np.testing.assert_allclose(projection.distance, 2.0, atol=1e-6)
    assert projection.pixels_per_cell == pytest.approx(2.0, abs=1e-4)


def test_only_the_part_in_the_photo_is_projected_and_a_little_round_it() -> None:
    # The photo shows 1 m about its axis: columns 100 to 200 of a wall of 3 m.
    wide = wall_at(0.0, width=300, x_m=-1.5)
    (projection,) = warping.project_walls(camera_at(size=200), [wide])
    assert projection is not None
    rows, columns = projection.part
    assert (rows.start, rows.stop) == (0, 80)
    # Every eighth cell is asked, and one of these more is taken on both sides.
    assert (columns.start, columns.stop) == (96, 208)
    assert projection.corner.tolist() == [96, 0]
    seen = np.flatnonzero(np.isfinite(projection.u[0])) + columns.start
    assert (seen[0], seen[-1]) == (100, 199)


@pytest.mark.parametrize(
    ("camera", "wall"),
    [
        (camera_at(y_m=2.0), wall_at(0.0)),
        (camera_at(x_m=20.0), wall_at(0.0)),
        (camera_at(), wall_at(0.0, width=9, height=11)),
    ],
    ids=["from-behind", "beside", "few-cells"],
)
def test_walls_that_a_photo_does_not_show_have_no_projection(
    camera: ViewingCamera, wall: Wall
) -> None:
    assert warping.project_walls(camera, [wall]) == [None]


@pytest.mark.parametrize(("cosine", "is_shown"), [(0.14, False), (0.16, True)])
def test_views_flatter_than_one_in_seven_show_too_little(cosine: float, is_shown: bool) -> None:
    # From far to the side: all cells are seen under nearly one angle.
    away_m = 40.0
    centre = away_m * np.array([math.sqrt(1.0 - cosine**2), -cosine, 0.0])
    rotation = looking_at(centre, np.zeros(3), samples.UP)
    camera = replace(
        camera_at(), fx=20_000.0, fy=20_000.0, rotation=rotation, translation=-rotation @ centre
    )
    found = warping.project_walls(camera, [wall_at(0.0, width=20, height=20, x_m=-0.1)])
    assert (found[0] is not None) is is_shown


def test_what_another_surface_hides_is_left_out() -> None:
    # A screen half a metre before the left half of the wall.
    screen = wall_at(-0.5, width=30, x_m=-0.35)
    behind, before = warping.project_walls(camera_at(), [wall_at(0.0), screen])
    assert behind is not None
    assert before is not None
    assert np.isfinite(before.u).all()
    # Seen from 2 m it hides its place enlarged by 2 / 1.5.
    x_m = -0.5 + GSD_M * (np.arange(100) + 0.5)
    inside = (x_m > -0.35 * 4 / 3 + 0.03) & (x_m < -0.05 * 4 / 3 - 0.03)
    outside = (x_m < -0.35 * 4 / 3 - 0.03) | (x_m > -0.05 * 4 / 3 + 0.03)
    assert np.isnan(behind.u[40, inside]).all()
    assert np.isfinite(behind.u[40, outside]).all()
    np.testing.assert_array_equal(np.isnan(behind.u), np.isnan(behind.v))


@pytest.mark.parametrize(("apart_cells", "is_hidden"), [(5.0, False), (7.0, True)])
def test_six_cells_behind_a_surface_are_hidden(apart_cells: float, is_hidden: bool) -> None:
    behind, _ = warping.project_walls(camera_at(), [wall_at(apart_cells * GSD_M), wall_at(0.0)])
    assert behind is not None
    assert np.isnan(behind.u[40, 50]) == is_hidden


def board_before(wall: Wall, camera: ViewingCamera) -> warping.Before:
    # A board half a metre before the left half of the wall, in no wall's raster.
    across, down = np.meshgrid(np.arange(-0.35, -0.05, 0.005), np.arange(-0.5, 0.5, 0.005))
    x = across.ravel().astype(np.float32)
    cloud = PointCloud(
        origin=np.array([0.0, -0.5, 0.0]),
        x=x,
        y=np.zeros_like(x),
        z=down.ravel().astype(np.float32),
        up=samples.UP,
    )
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
    name="a.png",
    encoded=encode_png(np.full((800, 800), 90, dtype=np.uint8)),
    width=800,
    height=800,
)


def test_what_only_the_cloud_holds_hides_the_wall_and_cells_near_it() -> None:
    camera, wall = camera_at(), wall_at(0.0)
    before = board_before(wall, camera)
    x_m = -0.5 + GSD_M * (np.arange(100) + 0.5)
    inside = (x_m > -0.35 * 4 / 3 - 0.02) & (x_m < -0.05 * 4 / 3 + 0.02)
    outside = (x_m < -0.35 * 4 / 3 - 0.08) | (x_m > -0.05 * 4 / 3 + 0.08)
    view = warping.view_of(0, PHOTO, camera, [wall], before)
    for looked in (view, view.posed(camera_at(0.01), [wall])):
        shown = looked.projections[0]
        assert shown is not None
        assert np.isnan(shown.u[40, inside]).all()
        assert np.isfinite(shown.u[40, outside]).all()
        np.testing.assert_array_equal(np.isnan(shown.u), np.isnan(shown.v))
    everywhere = warping.view_of(0, PHOTO, camera, [wall]).projections[0]
    assert everywhere is not None
    assert np.isfinite(everywhere.u).all()


def test_a_cell_that_rounds_onto_the_far_border_of_the_photo_is_in_it() -> None:
    # The last row of cells lies 79 px below the middle, a millionth of a pixel inside the photo.
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


def test_a_wall_far_from_where_coordinates_begin_appears_as_any_other() -> None:
    y_m = 100.0
    (near,) = warping.project_walls(camera_at(), [wall_at(0.0)])
    (far,) = warping.project_walls(camera_at(y_m=y_m - 2.0), [wall_at(y_m)])
    assert near is not None
    assert far is not None
    np.testing.assert_allclose(far.u, near.u, atol=1e-3)
    assert warping.project_walls(camera_at(y_m=y_m + 2.0), [wall_at(y_m)]) == [None]
