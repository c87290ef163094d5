"""Blocks that a photo sees as a whole: what their nodes tell, and when no cell need be asked."""

from __future__ import annotations

from functools import cache
from typing import Final

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.ortho.block_kernels import (
    HIDDEN,
    PARABOLA_PX,
    SEEN,
    UNSURE,
    judge_block,
    look_at_hidden_block,
    look_at_unoccluded_block,
    parabola,
    room_for_blocks,
    span_block,
)
from orthoflow_plugins.ortho.photos_on_walls import VisibilityParams
from orthoflow_plugins.ortho.surfaces import Surface, relief_of, view_of
from orthoflow_plugins.ortho.views import (
    BLOCK_CELLS,
    NO_SURFACE,
    OCCLUDED,
    PAINTED,
    TileVisibility,
    WallView,
)

from orthoflow.geometry.depth_buffer_kernels import DepthBuffer
from tests import ortho_scenes as scenes

WHERE: Final = scenes.frame()
CAMERA: Final = scenes.camera(WHERE, aside_m=0.4)
ROWS: Final = (2 * BLOCK_CELLS, 3 * BLOCK_CELLS - 1)
COLUMNS: Final = (3 * BLOCK_CELLS, 4 * BLOCK_CELLS - 1)
WIDE: Final = (2 * BLOCK_CELLS, 6 * BLOCK_CELLS - 1)
DEPTHS: Final = (0.0, 0.02)
TOLERANCE_M: Final = 0.008


def surface_of(depths: NDArray[np.float32]) -> Surface:
    return Surface(
        frame=WHERE,
        relief=relief_of(scenes.walls(WHERE, depths).walls[0], threads=1),
        front_m=scenes.BUFFER_M,
        tolerance_m=TOLERANCE_M,
    )


@cache
def plain() -> Surface:
    return surface_of(np.zeros(scenes.SHAPE, dtype=np.float32))


def view() -> WallView:
    params = VisibilityParams(incidence_max_deg=80.0, border_share=0.05)
    return view_of(CAMERA, plain(), params, is_exact=False)


def nodes_of(
    depths: tuple[float, float] = DEPTHS, columns: tuple[int, int] = COLUMNS
) -> tuple[bool, NDArray[np.float64]]:
    nodes = np.empty((2, 3, 3, 4))
    return bool(span_block(view(), depths, ROWS, columns, nodes)), nodes


def projected(
    rows: NDArray[np.float64], columns: NDArray[np.float64], depths: NDArray[np.float64] | float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pixels and depth (n, 3) of places on the wall, and the places (n, 3) in the world."""
    at = np.column_stack([columns.ravel(), rows.ravel()]) + 0.5
    points = WHERE.world_from_wall(at, np.broadcast_to(depths, len(at)))
    return CAMERA.project(points), points


def test_nodes_are_what_the_camera_makes_of_their_places() -> None:
    is_good, nodes = nodes_of()
    assert is_good
    rows, columns = np.meshgrid(np.linspace(*ROWS, 3), np.linspace(*COLUMNS, 3), indexing="ij")
    above_m = float((CAMERA.centre_world - WHERE.origin_world) @ WHERE.normal_world)
    for layer, depth in enumerate(DEPTHS):
        exact, points = projected(rows, columns, depth)
        found = nodes[layer].reshape(9, 4)
        np.testing.assert_allclose(found[:, :2], exact[:, :2], atol=1e-6)
        towards = CAMERA.centre_world - points
        cosine = towards @ WHERE.normal_world / np.linalg.norm(towards, axis=1)
        area = CAMERA.fx * CAMERA.fy * WHERE.gsd_m**2 / exact[:, 2] ** 2
        np.testing.assert_allclose(found[:, 2], cosine * area, rtol=1e-9)
        # Where the ray leaves the slab of the raster, on its way to the camera.
        left = (above_m - scenes.BUFFER_M) / (above_m - depth)
        np.testing.assert_allclose(found[:, 3], exact[:, 2] * left, rtol=1e-9)


def test_parabolas_that_are_taken_are_exact_all_over_the_block() -> None:
    is_good, nodes = nodes_of()
    assert is_good
    rng = np.random.default_rng(0)
    y, x = rng.uniform(size=(2, 50))
    exact, _ = projected(
        ROWS[0] + y * (ROWS[1] - ROWS[0]),
        COLUMNS[0] + x * (COLUMNS[1] - COLUMNS[0]),
        0.5 * sum(DEPTHS),
    )
    down, across = np.array(parabola(y)), np.array(parabola(x))
    between = np.einsum("in,jn,lijk->nk", down, across, 0.5 * nodes[..., :2])
    np.testing.assert_allclose(between, exact[:, :2], atol=1.5 * PARABOLA_PX)


def test_what_a_lens_bends_over_a_wide_block_is_no_parabola() -> None:
    is_good, nodes = nodes_of(columns=WIDE)
    y, x = np.array([0.25, 0.25, 0.75, 0.75]), np.array([0.25, 0.75, 0.25, 0.75])
    exact, _ = projected(
        ROWS[0] + y * (ROWS[1] - ROWS[0]), WIDE[0] + x * (WIDE[1] - WIDE[0]), 0.5 * sum(DEPTHS)
    )
    down, across = np.array(parabola(y)), np.array(parabola(x))
    between = np.einsum("in,jn,lijk->nk", down, across, 0.5 * nodes[..., :2])
    assert np.abs(between - exact[:, :2]).max() > PARABOLA_PX
    assert not is_good


def test_a_deep_block_and_what_no_photo_shows_have_no_parabolas() -> None:
    # Places go by the inverse of the distance: half a metre is far from linear.
    assert not nodes_of((0.0, 0.5))[0]
    behind = float((CAMERA.centre_world - WHERE.origin_world) @ WHERE.normal_world) + 1.0
    assert not nodes_of((behind, behind + 0.001))[0]


def judged(
    nearest: NDArray[np.float32] | float = np.inf,
    of: WallView | None = None,
    columns: tuple[int, int] = COLUMNS,
) -> tuple[int, NDArray[np.float64]]:
    shape = (-(-CAMERA.height // 4), -(-CAMERA.width // 4))
    # A copy, since a view cannot be written to: the kernel would be compiled once more.
    filled = np.array(np.broadcast_to(np.float32(nearest), shape), order="C")
    box = np.empty(4)
    verdict = judge_block(
        of or view(),
        DepthBuffer(nearest=filled, reduction=4.0),
        DEPTHS[1],
        ROWS,
        columns,
        nodes_of(columns=columns)[1],
        box,
    )
    return int(verdict), box


def test_a_block_is_seen_past_the_cloud_and_hidden_behind_it() -> None:
    left = nodes_of()[1][..., 3]
    assert judged()[0] == SEEN
    assert judged(left.max() - 0.5 * TOLERANCE_M)[0] == SEEN
    assert judged(left.max() - 2.0 * TOLERANCE_M)[0] == UNSURE
    assert judged(left.min() - 0.5 * TOLERANCE_M)[0] == UNSURE
    assert judged(left.min() - 2.0 * TOLERANCE_M)[0] == HIDDEN


def test_what_hides_a_part_of_a_block_leaves_it_unsure() -> None:
    clear = np.full((-(-CAMERA.height // 4), -(-CAMERA.width // 4)), np.inf, dtype=np.float32)
    for part in range(4):
        middle = np.array([WIDE[0] + (part + 0.5) * BLOCK_CELLS])
        ((column, row, _),) = (projected(np.array([sum(ROWS) / 2]), middle, 0.01)[0] / 4).astype(
            int
        )
        stray, gap = clear.copy(), np.full_like(clear, 0.5)
        stray[row, column] = 0.5
        gap[row, column] = np.inf
        assert judged(stray, columns=WIDE)[0] == UNSURE
        assert judged(gap, columns=WIDE)[0] == UNSURE
    left, right, upper, lower = (int(edge / 4) for edge in judged(columns=WIDE)[1])
    around = np.full_like(clear, 0.5)
    around[upper : lower + 1, left : right + 1] = np.inf
    assert judged(around, columns=WIDE)[0] == SEEN


@pytest.mark.parametrize("columns", [COLUMNS, WIDE], ids=["one", "four beside each other"])
def test_the_box_of_a_block_holds_its_places_and_little_more(columns: tuple[int, int]) -> None:
    _, box = judged(columns=columns)
    rows, places = np.meshgrid(
        np.arange(ROWS[0], ROWS[1] + 1.0), np.arange(columns[0], columns[1] + 1.0)
    )
    found = np.concatenate([projected(rows, places, depth)[0][:, :2] for depth in DEPTHS])
    low, high = found.min(axis=0), found.max(axis=0)
    # A pixel and a fiftieth of the longer side of a part.
    margin = 1.0 + 0.02 * (high - low).max()
    assert (box[::2] <= low - 1.0).all()
    assert (box[1::2] >= high + 1.0).all()
    assert (box[::2] >= low - margin - 0.1).all()
    assert (box[1::2] <= high + margin + 0.1).all()


def test_at_the_rim_of_a_photo_and_at_a_grazing_angle_each_cell_is_asked() -> None:
    of = view()
    _, (left, right, upper, lower) = judged()
    for edge, inner in ((21, right), (22, lower)):
        flat = of.camera.copy()
        flat[edge] = inner + 0.1
        assert judged(of=of._replace(camera=flat))[0] == SEEN
        flat[edge] = inner - 0.1
        assert judged(of=of._replace(camera=flat))[0] == UNSURE
    # The farthest corner of the block decides.
    away = [
        max(abs(foot - first), abs(foot - last)) * WHERE.gsd_m
        for foot, (first, last) in ((of.row, ROWS), (of.column, COLUMNS))
    ]
    lift = of.height_m - DEPTHS[1]
    cosine = lift / np.hypot(lift, np.hypot(*away))
    assert judged(of=of._replace(cosine_least=cosine - 1e-6))[0] == SEEN
    assert judged(of=of._replace(cosine_least=cosine + 1e-6))[0] == UNSURE
    assert left > 0.0
    assert upper > 0.0


def test_a_hidden_block_has_no_places_and_void_stays_void() -> None:
    depths = np.zeros(scenes.SHAPE, dtype=np.float32)
    depths[ROWS[0] + 1, COLUMNS[0] + 2] = np.nan
    visible = TileVisibility(
        u=np.full((8, 9), 7.0, dtype=np.float32),
        v=np.full((8, 9), 7.0, dtype=np.float32),
        mask=np.full((8, 9), 99, dtype=np.uint8),
        quality=np.zeros((8, 9), dtype=np.float32),
        summary=np.empty(8),
    )
    look_at_hidden_block(surface_of(depths).relief, visible, (*(ROWS[0], COLUMNS[0]), 3, 4, 2, 5))
    expected = np.full((8, 9), 99)
    expected[2:5, 5:9] = OCCLUDED
    expected[3, 7] = NO_SURFACE
    np.testing.assert_array_equal(visible.mask, expected)
    for values in (visible.u, visible.v):
        np.testing.assert_array_equal(values, np.where(expected == 99, 7.0, 0.0))


# A part of the block: its first and last row and column are not in the tile.
PART: Final = (ROWS[0] + 3, COLUMNS[0] + 2, 20, 25, 4, 6)


def looked_at(
    of: WallView, depths: NDArray[np.float32]
) -> tuple[int, TileVisibility, NDArray[np.float64]]:
    """What a photo that sees all of a block has of a part of it; the rest of the tile is 7."""
    shape = (30, 40)
    visible = TileVisibility(
        u=np.full(shape, 7.0, dtype=np.float32),
        v=np.full(shape, 7.0, dtype=np.float32),
        mask=np.full(shape, 99, dtype=np.uint8),
        quality=np.full(shape, 7.0, dtype=np.float32),
        summary=np.empty(8),
    )
    room = room_for_blocks(surface_of(depths).relief, visible)
    assert span_block(of, DEPTHS, ROWS, COLUMNS, room.nodes)
    nothing = DepthBuffer(nearest=np.full((1000, 1000), np.inf, dtype=np.float32), reduction=4.0)
    assert judge_block(of, nothing, DEPTHS[1], ROWS, COLUMNS, room.nodes, room.box) == SEEN
    n_known = look_at_unoccluded_block(of, room, PART, (ROWS, COLUMNS), DEPTHS)
    return int(n_known), visible, room.box.copy()


def rough() -> NDArray[np.float32]:
    depths = np.random.default_rng(4).uniform(*DEPTHS, scenes.SHAPE).astype(np.float32)
    depths[PART[0] + 5, PART[1] + 7 : PART[1] + 9] = np.nan
    depths[ROWS[0], COLUMNS[0]] = np.nan  # not in the part
    return depths


def at_the_edge(edge: str) -> WallView:
    """A photo that ends half a pixel beside what it shows of the block."""
    of = view()
    box = judged()[1]
    flat = of.camera.copy()
    if edge in ("left", "upper"):
        flat[14 + (edge == "upper")] -= box[0 if edge == "left" else 2] - 0.5
    else:
        flat[21 + (edge == "lower")] = box[1 if edge == "right" else 3] + 0.5
    return of._replace(camera=flat, border_px=40.0)


@pytest.mark.parametrize("edge", ["", "left", "right", "upper", "lower"])
def test_cells_of_a_block_that_is_seen_lie_where_the_camera_has_them(edge: str) -> None:
    of = at_the_edge(edge) if edge else view()
    depths = rough()
    n_known, visible, _ = looked_at(of, depths)
    first_row, first_column, n_rows, n_columns, tile_row, tile_column = PART
    rows, columns = np.mgrid[
        first_row : first_row + n_rows, first_column : first_column + n_columns
    ].astype(np.float64)
    at = depths[first_row : first_row + n_rows, first_column : first_column + n_columns]
    known = np.isfinite(at)
    assert n_known == known.sum() == n_rows * n_columns - 2
    exact, points = projected(rows, columns, np.where(known, at, 0.0).ravel().astype(np.float64))
    # Of the camera as it was: its centre may have been moved in the photo.
    exact[:, 0] += of.camera[14] - view().camera[14]
    exact[:, 1] += of.camera[15] - view().camera[15]
    towards = CAMERA.centre_world - points
    cosine = towards @ WHERE.normal_world / np.linalg.norm(towards, axis=1)
    quality = cosine * CAMERA.fx * CAMERA.fy * WHERE.gsd_m**2 / exact[:, 2] ** 2
    width, height = of.camera[21], of.camera[22]
    inside = np.min([exact[:, 0], exact[:, 1], width - exact[:, 0], height - exact[:, 1]], axis=0)
    quality *= np.minimum(1.0, inside / of.border_px)
    assert (inside.min() < of.border_px) == bool(edge)
    tile = (slice(tile_row, tile_row + n_rows), slice(tile_column, tile_column + n_columns))
    flat = known.ravel()
    for found, expected, slack in (
        (visible.u, exact[:, 0], 2.0 * PARABOLA_PX),
        (visible.v, exact[:, 1], 2.0 * PARABOLA_PX),
        (visible.quality, quality, 2e-3 * quality.max()),
    ):
        np.testing.assert_allclose(found[tile].ravel()[flat], expected[flat], atol=slack)
        outside = np.ones(found.shape, dtype=np.bool_)
        outside[tile] = False
        assert (found[outside] == 7.0).all()
    expected_mask = np.full((30, 40), 99)
    expected_mask[tile] = np.where(known, PAINTED, NO_SURFACE)
    np.testing.assert_array_equal(visible.mask, expected_mask)
