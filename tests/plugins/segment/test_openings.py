"""Openings of a wall with known cells and rays, and their figure."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from orthoflow_plugins.segment.openings import SegmentOpenings, outline_map

from orthoflow.errors import MethodError
from orthoflow.files.images import decode_image
from orthoflow.products import OpeningKind, Openings, Orthoimages, OutlineSource, PointCloud, Walls
from orthoflow.sdk import StepContext
from tests import opening_scenes as scenes
from tests import samples
from tests.method_runs import run
from tests.raster_scenes import context, numbers


def found(
    folder: Path,
    walls: Walls | None = None,
    cloud: PointCloud | None = None,
    images: Orthoimages | None = None,
    **params: object,
) -> tuple[Openings, StepContext]:
    ctx = context(folder)
    inputs = {"walls": walls or scenes.walls(), "cloud": cloud, "orthoimages": images}
    return run(SegmentOpenings, ctx, inputs, **params).openings, ctx


def test_each_area_is_what_the_rays_say(tmp_path: Path) -> None:
    openings, ctx = found(tmp_path, cloud=scenes.cloud())
    assert [opening.kind for opening in openings.openings] == ["niche", "through", "no data"]
    assert openings.walls == (4,)
    niche, window, mirror = openings.openings
    assert niche.depth_m == pytest.approx(scenes.NICHE_M, abs=0.0005)
    assert window.depth_m is None
    assert mirror.depth_m is None
    found_of = numbers(ctx)
    assert [found_of[name] for name in ("n_openings", "n_through", "n_no_data")] == [3, 1, 1]
    assert [figure.name for figure in ctx.figures] == ["wall_4_openings"]
    assert ctx.warnings == []


def test_what_a_screen_hides_is_an_opening_only_for_want_of_rays(tmp_path: Path) -> None:
    openings, ctx = found(tmp_path)
    assert [opening.kind for opening in openings.openings] == ["niche", *["no data"] * 3]
    hidden = openings.openings[2]
    assert OutlineSource.UNSEEN in hidden.side_source.tolist()
    assert any("without the cloud" in warning for warning in ctx.warnings)
    # Seen perpendicularly, the screen covers some of the areas that it hides from the station, and
    # some others.
    square, _ = found(tmp_path, cloud=scenes.cloud(knows_stations=False))
    assert sum(opening.area_m2 for opening in square.openings) < sum(
        opening.area_m2 for opening in openings.openings
    )


def test_an_empty_area_as_shadows_have_it_is_none(tmp_path: Path) -> None:
    walls = scenes.walls()
    (wall,) = walls.walls
    rows, columns = np.indices(scenes.SHAPE)
    # Below the mirror, surrounded by the wall.
    is_shadow = (rows > 130) & (columns > 290 + (rows - 130)) & (columns < 380)
    is_plain = np.zeros(scenes.SHAPE, dtype=np.bool_)
    is_plain[110:, 285:] = True
    depth = np.where(is_plain, np.float32(0.0), wall.depth_m)
    mask = np.where(is_plain, np.uint8(1), wall.mask)
    depth[is_shadow], mask[is_shadow] = np.nan, 0
    shaded = replace(walls, walls=(replace(wall, depth_m=depth, mask=mask),))
    openings, ctx = found(tmp_path, walls=shaded)
    assert [opening.kind for opening in openings.openings] == ["niche", "no data", "no data"]
    assert numbers(ctx)["n_unbounded"] == 1


def test_a_plane_before_the_wall_is_not_its_face_and_far_before_it_of_something_else(
    tmp_path: Path,
) -> None:
    openings, ctx = found(tmp_path, walls=scenes.walls(face_m=-0.1), cloud=scenes.cloud())
    assert [opening.kind for opening in openings.openings] == ["niche", "through", "no data"]
    assert openings.openings[0].depth_m == pytest.approx(scenes.NICHE_M, abs=0.001)
    assert any("is 0.10 m behind its plane" in warning for warning in ctx.warnings)
    openings, ctx = found(tmp_path, walls=scenes.walls(face_m=-0.35), cloud=scenes.cloud())
    assert (openings.openings, openings.walls) == ((), (4,))
    assert any("it is another surface, with no openings" in text for text in ctx.warnings)


def test_parameters_leave_out_what_is_less_deep_wide_or_large(tmp_path: Path) -> None:
    for params, kinds in (
        ({"behind_m": 0.25}, ["through", "no data"]),
        ({"width_least_m": 0.6}, ["niche", "through"]),
        ({"area_least_m2": 0.5}, ["niche", "through"]),
    ):
        openings, _ = found(tmp_path, cloud=scenes.cloud(), **params)
        assert [opening.kind for opening in openings.openings] == kinds


def image(source: str, out_cells: float = 0.35) -> Orthoimages:
    """Return a dark window on a grey wall, with its border farther out than that of the depth."""
    low, high = scenes.WINDOW.min(axis=0) - out_cells, scenes.WINDOW.max(axis=0) + out_cells
    places = scenes.centres()
    # Share of the cell that the window covers.
    covered = np.minimum(places + 0.5, high) - np.maximum(places - 0.5, low)
    noise = 3.0 * np.random.default_rng(5).normal(size=scenes.SHAPE)
    grey = 170.0 - 110.0 * np.clip(covered, 0.0, 1.0).prod(axis=2) + noise
    rgb = np.repeat(np.rint(grey).astype(np.uint8)[:, :, None], 3, axis=2)
    made = samples.orthoimage(scenes.frame(), rgb=rgb, sources=(source,), plane_index=4)
    return Orthoimages(images=(made,))


def test_photos_place_sides_that_the_scan_is_too_coarse_for(tmp_path: Path) -> None:
    openings, ctx = found(
        tmp_path, walls=scenes.walls(sparse=True), cloud=scenes.cloud(), images=image("a.jpg")
    )
    niche, window, _ = openings.openings
    assert set(window.side_source.tolist()) == {OutlineSource.IMAGE}
    assert set(niche.side_source.tolist()) == {OutlineSource.DEPTH}
    cells = window.outline_m / [scenes.GSD_M, -scenes.GSD_M]
    sides = (cells.min(axis=0), cells.max(axis=0))
    true = (scenes.WINDOW.min(axis=0) - 0.35, scenes.WINDOW.max(axis=0) + 0.35)
    np.testing.assert_allclose(sides, true, atol=0.15)
    assert (window.side_sigma_m / scenes.GSD_M).max() <= 0.55
    assert (niche.side_sigma_m / scenes.GSD_M).min() >= 0.7
    assert numbers(ctx)["image_side_share"] == pytest.approx(4 / 12)


@pytest.mark.parametrize(
    ("source", "out_cells"), [("a.jpg", 2.0), ("a.jpg", -2.0), ("cloud", 0.35)]
)
def test_an_edge_elsewhere_and_what_the_cloud_painted_move_no_side(
    tmp_path: Path, source: str, out_cells: float
) -> None:
    without, _ = found(tmp_path, cloud=scenes.cloud())
    painted, _ = found(tmp_path, cloud=scenes.cloud(), images=image(source, out_cells))
    for one, other in zip(without.openings, painted.openings, strict=True):
        np.testing.assert_array_equal(one.outline_m, other.outline_m)


def leaning(rise_deg: float) -> Walls:
    """Return the wall in a room where it is inclined by an angle."""
    walls, rise = scenes.walls(), np.radians(rise_deg)
    frame = walls.walls[0].frame
    return replace(walls, up=np.sin(rise) * frame.normal_world - np.cos(rise) * frame.v_world)


@pytest.mark.parametrize("rise_deg", [90.0, 33.0, -33.0])
def test_floors_and_slopes_alone_are_refused_unless_asked_for_and_a_wall_may_lean(
    tmp_path: Path, rise_deg: float
) -> None:
    with pytest.raises(
        MethodError, match="none of the 1 walls is a vertical plane; set level: true"
    ):
        found(tmp_path, walls=leaning(rise_deg))
    if rise_deg == 90.0:
        assert found(tmp_path, walls=leaning(rise_deg), level=True)[0].openings
    assert found(tmp_path, walls=leaning(27.0))[0].openings


@pytest.mark.parametrize("factor", [1, 3])
@pytest.mark.parametrize(("kind", "channel"), [("through", 2), ("niche", 0), ("no data", 0)])
def test_an_outline_lies_on_its_corners_in_the_colour_of_its_kind(
    kind: OpeningKind, channel: int, factor: int
) -> None:
    corners = factor * np.array([[40.0, 60.0], [40.0, 150.0], [120.0, 150.0], [120.0, 60.0]])
    grey = np.full((600 * factor, 700 * factor), 0.5, dtype=np.float32)
    plain, picture = (
        decode_image(outline_map(grey, outlines), "a figure").astype(int)
        for outlines in ([], [(kind, corners)])
    )
    changed = np.abs(picture - plain).max(axis=2) > 60
    rows, columns = np.nonzero(changed)
    corners *= min(1.0, 1004 / (700 * factor))
    low, high = corners.min(axis=0), corners.max(axis=0)
    np.testing.assert_allclose([columns.min(), rows.min()], low, atol=3)
    np.testing.assert_allclose([columns.max(), rows.max()], high, atol=3)
    # All four sides are drawn.
    middles = np.rint(0.5 * (corners + np.roll(corners, -1, axis=0))).astype(int)
    for column, row in middles:
        part = np.s_[row - 2 : row + 3, column - 2 : column + 3]
        assert picture[part][..., channel].max() >= 140
        assert changed[part].any()
    # Its number is inside, at the upper left.
    left, top = np.rint(low).astype(int)
    assert changed[top + 5 : top + 30, left + 5 : left + 30].sum() > 20
