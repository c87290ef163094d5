"""`ortho.dsm-backward`: which cells a photo paints, from which of its pixels, and with what."""

from __future__ import annotations

import dataclasses
from dataclasses import replace
from itertools import count
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.ortho.dsm_backward import DsmBackward
from orthoflow_plugins.ortho.dsm_forward import DsmForward
from orthoflow_plugins.ortho.layers import (
    NO_SOURCE,
    LayerStack,
    count_shown,
)
from orthoflow_plugins.ortho.photos_on_walls import warn_of_heads

from orthoflow.diagnostics import Diagnostic
from orthoflow.errors import MethodError
from orthoflow.files.images import encode_png
from orthoflow.geometry import WallFrame
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.frames import rotation_from_vector
from orthoflow.products import (
    Camera,
    Cameras,
    Layer,
    LayerMask,
    Layers,
    Photo,
    Photos,
    PointCloud,
    Walls,
)
from orthoflow.sdk import StepContext
from tests import ortho_scenes as scenes
from tests import samples
from tests.long_loops import seeds
from tests.raster_scenes import context


def painted(
    folder: Path,
    *,
    where: WallFrame | None = None,
    cloud: PointCloud | None = None,
    asides_m: tuple[float, ...] = (-0.7,),
    depths: NDArray[np.float32] | None = None,
    **params: object,
) -> Layers:
    where = where or scenes.frame()
    inputs = DsmBackward.In(
        walls=scenes.walls(where, depths),
        photos=scenes.photos(*(scenes.rendered(aside_m=aside) for aside in asides_m)),
        cameras=scenes.cameras(*(scenes.camera(where, aside_m=aside) for aside in asides_m)),
        cloud=cloud if cloud is not None else scenes.cloud(where),
    )
    return run(inputs, context(folder), **params)


def run(inputs: DsmBackward.In, ctx: StepContext, **params: object) -> Layers:
    return DsmBackward().run(inputs, DsmBackward.Params.model_validate(params), ctx).layers


@pytest.mark.parametrize("aside_m", [-0.7, 0.0, 0.9])
def test_cells_show_their_own_place_where_they_are_seen_and_nothing_where_they_are_hidden(
    tmp_path: Path, aside_m: float
) -> None:
    where = scenes.frame()
    (layer,) = painted(tmp_path, asides_m=(aside_m,), resampling="nearest").layers
    shown = layer.mask == LayerMask.PAINTED
    is_raised = scenes.depth_m() > 0.0
    expected = np.where(is_raised, scenes.BLUE[scenes.RAISED], scenes.BLUE[scenes.BASE])
    np.testing.assert_array_equal(layer.rgb[..., 2][shown], expected[shown])
    # Half a cell, and half of the quarter cell that a grey level is.
    assert np.abs(scenes.places_off(layer)[shown]).max() <= 0.5 + 0.125
    seen = scenes.truth(where, scenes.camera(where, aside_m=aside_m))
    is_visible = np.isin(seen.surface, (scenes.BASE, scenes.RAISED)).reshape(scenes.SHAPE)
    is_behind_board = (seen.surface == scenes.BOARD).reshape(scenes.SHAPE)
    assert is_behind_board.any()
    assert (layer.mask[is_behind_board] == LayerMask.OCCLUDED).all()
    assert (layer.mask[~is_visible] == LayerMask.OCCLUDED).all()
    assert np.mean(layer.mask[is_visible] == LayerMask.PAINTED) > 0.96


def test_single_points_in_the_air_hide_nothing(tmp_path: Path) -> None:
    where = scenes.frame()
    (tmp_path / "clean").mkdir()
    (clean,) = painted(tmp_path / "clean").layers
    (layer,) = painted(tmp_path, cloud=scenes.cloud(where, n_outliers=300)).layers
    np.testing.assert_array_equal(layer.mask, clean.mask)


def test_a_sparse_board_hides_as_well_as_a_dense_one(tmp_path: Path) -> None:
    where = scenes.frame()
    cloud = scenes.cloud(where, spacing_cells=3.0)
    (layer,) = painted(tmp_path, cloud=cloud, resampling="nearest").layers
    assert not (layer.rgb[..., 2] == scenes.BLUE[scenes.BOARD]).any()
    seen = scenes.truth(where, scenes.camera(where))
    is_behind_board = (seen.surface == scenes.BOARD).reshape(scenes.SHAPE)
    assert (layer.mask[is_behind_board] == LayerMask.OCCLUDED).all()


@pytest.mark.parametrize("seed", seeds(3))
def test_noise_and_spikes_of_the_surface_hide_little(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    noisy = scenes.depth_m() + rng.normal(0.0, 0.002, scenes.SHAPE).astype(np.float32)
    spikes = rng.random(scenes.SHAPE) < 0.001
    noisy[spikes] += 0.1
    where = scenes.frame()
    (layer,) = painted(tmp_path, depths=noisy, resampling="nearest").layers
    seen = scenes.truth(where, scenes.camera(where))
    is_visible = np.isin(seen.surface, (scenes.BASE, scenes.RAISED)).reshape(scenes.SHAPE)
    assert np.mean(layer.mask[is_visible] == LayerMask.PAINTED) > 0.96
    is_behind_board = (seen.surface == scenes.BOARD).reshape(scenes.SHAPE)
    assert (layer.mask[is_behind_board & ~spikes] == LayerMask.OCCLUDED).all()


@pytest.mark.parametrize("distorted", [True, False])
def test_nearest_paints_the_source_pixel_itself(tmp_path: Path, distorted: bool) -> None:
    where = scenes.frame()
    viewer = scenes.camera(where, distorted=distorted)
    noise = np.random.default_rng(1).integers(1, 256, (viewer.height, viewer.width, 3), np.uint8)
    inputs = scenes.inputs(DsmBackward.In, noise, viewers=[viewer])
    (layer,) = run(inputs, context(tmp_path), resampling="nearest").layers
    rows, columns = np.nonzero(layer.mask == LayerMask.PAINTED)
    points = where.world_from_wall(
        np.column_stack([columns, rows]) + 0.5, scenes.depth_m()[rows, columns].astype(np.float64)
    )
    pixels = viewer.project(points)[:, :2]
    # Within a thousandth of a pixel of its border, rounding decides which pixel it is.
    clear = (np.abs(pixels - np.rint(pixels)) > 1e-3).all(axis=1)
    assert clear.mean() > 0.99
    u, v = np.floor(pixels[clear]).astype(int).T
    np.testing.assert_array_equal(layer.rgb[rows[clear], columns[clear]], noise[v, u])
    assert (layer.rgb[layer.mask != LayerMask.PAINTED] == 0).all()
    assert (layer.quality[layer.mask != LayerMask.PAINTED] == 0.0).all()


@pytest.mark.parametrize("resampling", ["bilinear", "lanczos"])
def test_what_is_finer_than_a_cell_gives_its_mean_grey(tmp_path: Path, resampling: str) -> None:
    where = scenes.frame()
    viewer = scenes.camera(where, width=2000)
    rows, columns = np.mgrid[: viewer.height, : viewer.width]
    grey = 40 + 160 * ((rows + columns) % 2)
    picture = np.dstack([grey.astype(np.uint8)] * 3)
    inputs = scenes.inputs(DsmBackward.In, picture, viewers=[viewer])
    (layer,) = run(inputs, context(tmp_path), resampling=resampling).layers
    shown = layer.mask == LayerMask.PAINTED
    assert shown.sum() > 3000
    contrast = np.abs(layer.rgb[shown].astype(float) - 120.0)
    assert contrast.max() < 0.1 * 80.0
    (tmp_path / "raw").mkdir()
    (raw,) = run(inputs, context(tmp_path / "raw"), resampling=resampling, antialias=False).layers
    assert raw.rgb[shown].astype(float).std() > 20.0  # what it protects from


def test_survey_coordinates_change_nothing(tmp_path: Path) -> None:
    layers = []
    for at_survey in (False, True):
        folder = tmp_path / str(at_survey)
        folder.mkdir()
        layers.append(painted(folder, where=scenes.frame(at_survey=at_survey)).layers[0])
    local, survey = layers
    # Positions of 10^6 m carry 1e-10 m, so a cell in a hundred thousand may fall on the other side.
    assert np.mean(local.mask != survey.mask) < 1e-4
    same = (local.mask == LayerMask.PAINTED) & (survey.mask == LayerMask.PAINTED)
    difference = local.rgb[same].astype(int) - survey.rgb[same].astype(int)
    assert np.mean(difference != 0) < 1e-3
    np.testing.assert_allclose(local.quality[same], survey.quality[same], rtol=2.0**-11)


def test_threads_and_tiles_do_not_show(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from orthoflow_plugins.ortho import painting

    inputs = scenes.inputs(DsmBackward.In)
    found = []
    for cores in (1, 2, 5):
        folder = tmp_path / str(cores)
        folder.mkdir()
        found.append(run(inputs, context(folder, cores=cores)).layers[0])
    folder = tmp_path / "tiles"
    folder.mkdir()
    monkeypatch.setattr(painting, "TILE_CELLS", 50)
    tiled = run(inputs, context(folder)).layers[0]
    for layer in found[1:]:
        np.testing.assert_array_equal(layer.mask, found[0].mask)
        np.testing.assert_array_equal(layer.rgb, found[0].rgb)
        np.testing.assert_array_equal(layer.quality, found[0].quality)
    np.testing.assert_array_equal(tiled.mask, found[0].mask)
    np.testing.assert_array_equal(tiled.quality, found[0].quality)


def test_erosion_takes_the_cells_beside_hidden_patches(tmp_path: Path) -> None:
    import cv2

    layers = []
    for cells in (0, 2):
        folder = tmp_path / str(cells)
        folder.mkdir()
        layers.append(painted(folder, erosion_cells=cells).layers[0])
    plain, eroded = layers
    hidden = (plain.mask == LayerMask.OCCLUDED).astype(np.uint8)
    # Each patch here is wide; a cell alone would not count.
    _, labels, stats, _ = cv2.connectedComponentsWithStats(hidden)
    assert stats[:, cv2.CC_STAT_WIDTH].min() >= 2
    assert labels.max() == 1
    near = cv2.dilate(hidden, np.ones((5, 5), np.uint8)) > 0
    expected = np.where(near & (plain.mask == LayerMask.PAINTED), LayerMask.OCCLUDED, plain.mask)
    np.testing.assert_array_equal(eroded.mask, expected)


def test_a_single_cell_of_wrong_depth_hides_nothing_but_itself(tmp_path: Path) -> None:
    pits = np.zeros(scenes.SHAPE, dtype=np.bool_)
    pits[200:230:10, 20:120:10] = True
    depths = scenes.depth_m()
    depths[pits] -= 0.08
    layers = []
    for name, surface in (("clean", scenes.depth_m()), ("pits", depths)):
        (tmp_path / name).mkdir()
        layers.append(painted(tmp_path / name, depths=surface).layers[0])
    expected = np.where(pits, LayerMask.OCCLUDED, layers[0].mask)
    np.testing.assert_array_equal(layers[1].mask, expected)


def test_cells_without_a_surface_and_outside_the_photo_say_so(tmp_path: Path) -> None:
    where = scenes.frame()
    depths = scenes.depth_m()
    depths[200:220, 20:60] = np.nan
    viewer = scenes.camera(where)
    inputs = scenes.inputs(
        DsmBackward.In,
        scenes.rendered()[:, :500],
        viewers=[dataclasses.replace(viewer, width=500)],
        walls=scenes.walls(where, depths),
    )
    (layer,) = run(inputs, context(tmp_path)).layers
    assert (layer.mask[200:220, 20:60] == LayerMask.NO_SURFACE).all()
    rows, columns = np.mgrid[: scenes.SHAPE[0], : scenes.SHAPE[1]] + 0.5
    points = where.world_from_wall(
        np.column_stack([columns.ravel(), rows.ravel()]), scenes.depth_m().ravel().astype(float)
    )
    u = viewer.project(points)[:, 0].reshape(scenes.SHAPE)
    has_surface = ~np.isnan(depths)
    np.testing.assert_array_equal(
        (layer.mask == LayerMask.OUTSIDE)[has_surface], (u >= 500)[has_surface]
    )


def turned_away(viewer: ViewingCamera, where: WallFrame) -> ViewingCamera:
    turn = np.diag([-1.0, 1.0, -1.0])
    rotation = turn @ viewer.rotation
    return dataclasses.replace(
        viewer, rotation=rotation, translation=-rotation @ viewer.centre_world
    )


def test_photos_that_paint_nothing_are_left_out_and_walls_keep_their_index(tmp_path: Path) -> None:
    where = scenes.frame()
    viewer = scenes.camera(where)
    walls = scenes.walls(where)
    (wall,) = walls.walls
    # A wall behind the camera that faces it, out of its sight.
    behind = dataclasses.replace(
        where,
        origin_world=where.world_from_wall(np.array([[where.width, 0.0]]), 4.0)[0],
        u_world=-where.u_world,
        normal_world=-where.normal_world,
    )
    other = dataclasses.replace(wall, frame=behind, name="wall 1")
    walls = dataclasses.replace(walls, walls=(other, wall))
    ctx = context(tmp_path)
    inputs = DsmBackward.In(
        walls=walls,
        photos=scenes.photos(scenes.rendered(), scenes.rendered(aside_m=0.0)),
        cameras=scenes.cameras(viewer, turned_away(scenes.camera(where, aside_m=0.0), where)),
        cloud=scenes.cloud(where),
    )
    layers = run(inputs, ctx)
    # The turned camera paints the other wall: both walls have a layer.
    assert [(layer.wall, layer.source) for layer in layers.layers] == [(0, "1.png"), (1, "0.png")]
    assert layers.names == ("wall 1", "wall 0")
    assert list(ctx.warnings) == []
    without = dataclasses.replace(walls, walls=(wall,))
    ctx = context(tmp_path)
    run(dataclasses.replace(inputs, walls=without), ctx)
    (told,) = ctx.diagnostics
    assert (told.code, told.values["n"]) == ("photos-show-no-wall", 1)
    assert told.values["names"] == "1.png"


def test_metrics_tell_what_was_painted_and_from_how_far(tmp_path: Path) -> None:
    # A clock that goes on by a second when it is asked.
    clock = count()
    ctx = dataclasses.replace(context(tmp_path), clock_s=lambda: float(next(clock)))
    inputs = scenes.inputs(DsmBackward.In)
    (layer,) = run(inputs, ctx).layers
    metrics = {metric.name: metric.value for metric in ctx.metrics}
    assert metrics["n_layers"] == 1
    # What stands about is gathered once, and looked at from each photo.
    seconds = [metrics[f"{name}_s"] for name in ("occluders", "decoding", "painting")]
    assert seconds == [2.0, 1.0, 1.0]
    assert ctx.warnings == []
    assert metrics["painted_share"] == np.mean(layer.mask == LayerMask.PAINTED)
    assert metrics["occluded_share"] == np.mean(layer.mask == LayerMask.OCCLUDED)
    # 2.1 m along the axis, a focal length of 1505 pixels; 0.7 m aside of 2 m before the wall.
    assert metrics["photo_gsd_mm"] == pytest.approx(1e3 * 2.1 / 1505, rel=0.02)
    assert metrics["obliquity_deg"] == pytest.approx(np.degrees(np.arctan2(0.7, 2.0)), abs=2.0)


def refused(cameras: Cameras, folder: Path, **changes: object) -> str:
    inputs = scenes.inputs(DsmBackward.In, cameras=cameras)
    with pytest.raises(MethodError) as caught:
        run(dataclasses.replace(inputs, **changes), context(folder))
    return str(caught.value)


def test_what_cannot_be_painted_is_refused_with_the_reason(tmp_path: Path) -> None:
    where = scenes.frame()
    viewer = scenes.camera(where)
    lost = Cameras(cameras=(Camera(photo="0.png", status="only 3 ties agree"),))
    assert "no photo is oriented" in refused(lost, tmp_path)
    assert "0.png: only 3 ties agree" in refused(lost, tmp_path)
    good = scenes.cameras(viewer)
    assert "no oriented photo sees a wall" in refused(
        scenes.cameras(turned_away(viewer, where)), tmp_path
    )
    renamed = Cameras(cameras=(dataclasses.replace(good.cameras[0], photo="x.png"),))
    assert "x.png, which are not among the photos" in refused(renamed, tmp_path)
    small = scenes.photos(scenes.rendered()[:-1])
    assert "0.png has 1000 x 799 pixels" in refused(good, tmp_path, photos=small)
    none = dataclasses.replace(scenes.walls(where), walls=())
    assert "there are no walls" in refused(good, tmp_path, walls=none)


MASKED = np.s_[300:420, 400:600]


def painted_by(method: type[DsmBackward] | type[DsmForward], photos: Photos, folder: Path) -> Layer:
    # Layers lie in files of the scratch folder.
    folder.mkdir()
    inputs = scenes.inputs(method.In, photos=photos)
    (layer,) = method().run(inputs, method.Params(), context(folder)).layers.layers
    return layer


@pytest.mark.parametrize("method", [DsmBackward, DsmForward])
def test_masked_pixels_paint_nothing_and_others_what_they_did(
    tmp_path: Path, method: type[DsmBackward] | type[DsmForward]
) -> None:
    photos = scenes.photos(scenes.rendered())
    used = np.full(scenes.rendered().shape[:2], 255, dtype=np.uint8)
    used[MASKED] = 0
    masked = dataclasses.replace(photos.photos[0], mask=encode_png(used))
    before = painted_by(method, photos, tmp_path / "before")
    after = painted_by(method, Photos(photos=(masked,)), tmp_path / "after")
    # A bright picture of the mask says which cells show masked pixels.
    picture = scenes.photos(np.dstack([255 - used] * 3))
    seen = painted_by(method, picture, tmp_path / "seen").rgb[..., 0]
    shows, near = (
        cv2.morphologyEx((seen == 255).astype(np.uint8), way, np.ones((side, side))) > 0
        for way, side in ((cv2.MORPH_ERODE, 5), (cv2.MORPH_DILATE, 9))
    )
    was, is_painted = (layer.mask == LayerMask.PAINTED for layer in (before, after))
    assert (was & shows).sum() > 500
    assert not is_painted[shows].any()
    # Farther off than the rim of the mask nothing changes.
    np.testing.assert_array_equal(after.mask[~near], before.mask[~near])
    np.testing.assert_array_equal(after.rgb[~near & was], before.rgb[~near & was])


def posed(*turns_deg: float) -> list[tuple[Photo, Camera]]:
    """Photos of the board, turned about their axes."""
    where = scenes.frame()
    viewer = scenes.camera(where)
    turned = []
    for turn_deg in turns_deg:
        turn = rotation_from_vector(np.array([0.0, 0.0, np.radians(turn_deg)]))
        turned.append(
            replace(viewer, rotation=turn @ viewer.rotation, translation=turn @ viewer.translation)
        )
    pictures = [np.zeros((8, 8, 3), np.uint8)] * len(turned)
    photos, cameras = scenes.photos(*pictures).photos, scenes.cameras(*turned).cameras
    return list(zip(photos, cameras, strict=True))


def said(folder: Path, *turns_deg: float, sign: float = 1.0) -> list[Diagnostic]:
    ctx: StepContext = context(folder)
    warn_of_heads(sign * scenes.walls(scenes.frame()).up, posed(*turns_deg), ctx)
    return ctx.diagnostics


def test_a_scan_whose_up_is_down_is_told_by_its_photos(tmp_path: Path) -> None:
    (told,) = said(tmp_path, 0.0, 10.0, -20.0, 180.0, sign=-1.0)
    assert (told.values["n_down"], told.values["n_photos"], told.values["opposite"]) == (3, 4, "z")
    (told,) = said(tmp_path, 180.0)
    assert told.values["opposite"] == "-z"


@pytest.mark.parametrize(
    "turns_deg", [(0.0, 0.0), (90.0, -90.0), (180.0, 0.0), (110.0, 115.0)], ids=str
)
def test_upright_sideways_and_divided_photos_say_nothing(
    tmp_path: Path, turns_deg: tuple[float, float]
) -> None:
    assert said(tmp_path, *turns_deg) == []


@pytest.mark.parametrize("method", [DsmBackward, DsmForward])
def test_methods_that_lay_photos_tell_it(
    tmp_path: Path, method: type[DsmBackward] | type[DsmForward]
) -> None:
    where = scenes.frame()
    walls = replace(scenes.walls(where), up=-scenes.walls(where).up)
    ctx = context(tmp_path)
    method().run(scenes.inputs(method.In, walls=walls), method.Params(), ctx)
    assert "photos-upside-down" in [one.code for one in ctx.diagnostics]


SHAPE = (4, 6)
OUTSIDE, PAINTED, HIDDEN, VOID = (
    LayerMask.OUTSIDE,
    LayerMask.PAINTED,
    LayerMask.OCCLUDED,
    LayerMask.NO_SURFACE,
)


def walls(n: int = 3) -> Walls:
    frame = samples.facing_south(0.01, SHAPE[1], SHAPE[0])
    depths = np.zeros(SHAPE, dtype=np.float32)
    depths[3] = np.nan
    return samples.walls(
        *(
            samples.wall(frame, name=f"wall {k}", plane_index=k + 4, depth_m=depths)
            for k in range(n)
        )
    )


def mask_of(**rows: LayerMask) -> np.ndarray:
    """States of the first rows; the last one is void."""
    mask = np.full(SHAPE, VOID, dtype=np.uint8)
    mask[:3] = [[state] for state in rows.values()]
    return mask


def layer(wall: int, source: str, mask: np.ndarray, *, deep: bool = False) -> Layer:
    rgb = np.zeros((*SHAPE, 3), dtype=np.uint16 if deep else np.uint8)
    return samples.layer(mask, wall=wall, source=source, rgb=rgb)


def stacked(ctx: StepContext, *found: Layer) -> LayerStack:
    stack = LayerStack(walls(), ctx)
    for each in found:
        stack.add(each)
    return stack


def test_layers_come_by_wall_and_then_by_photo(tmp_path: Path) -> None:
    shown = mask_of(a=PAINTED, b=HIDDEN, c=OUTSIDE)
    photos = (layer(wall, name, shown) for wall, name in ((2, "a"), (0, "a"), (1, "b"), (0, "b")))
    ctx = context(tmp_path)
    found = stacked(ctx, *photos).joined(np.uint8)
    assert [(each.wall, each.source) for each in found.layers] == [
        (0, "a"), (0, "b"), (1, "b"), (2, "a"),
    ]  # fmt: skip
    assert found.names == ("wall 0", "wall 1", "wall 2")
    assert found.plane_indices == (4, 5, 6)
    assert ctx.warnings == []
    with pytest.raises(MethodError, match="no oriented photo sees a wall"):
        stacked(ctx).joined(np.uint8)


def test_a_wall_that_no_photo_paints_is_bare_but_states_what_is_hidden(tmp_path: Path) -> None:
    shown = layer(0, "a", mask_of(a=PAINTED, b=HIDDEN, c=OUTSIDE), deep=True)
    ctx = context(tmp_path)
    stack = stacked(ctx, shown)
    mask = mask_of(a=HIDDEN, b=OUTSIDE, c=OUTSIDE)
    stack.note_reached(1, mask)
    # The mask of the next photo lies where that of the first did.
    mask[:3] = [[OUTSIDE], [HIDDEN], [OUTSIDE]]
    stack.note_reached(1, mask)
    # A photo paints this wall.
    stack.note_reached(0, mask_of(a=HIDDEN, b=HIDDEN, c=HIDDEN))
    found = stack.joined(np.uint16)
    first, second, third = found.layers
    assert first is shown
    assert [one.values["walls"] for one in ctx.diagnostics] == ["wall 1, wall 2"]
    assert (second.wall, second.source, third.wall, third.source) == (1, NO_SOURCE, 2, NO_SOURCE)
    np.testing.assert_array_equal(second.mask, mask_of(a=HIDDEN, b=HIDDEN, c=OUTSIDE))
    np.testing.assert_array_equal(third.mask, mask_of(a=OUTSIDE, b=OUTSIDE, c=OUTSIDE))
    for bare in (second, third):
        assert bare.rgb.dtype == shown.rgb.dtype
        assert not bare.rgb.any()
        assert not bare.quality.any()
        assert bare.rgb.shape == (*SHAPE, 3)


def test_cells_are_counted_once_however_many_photos_show_them() -> None:
    layered = Layers(
        layers=(
            layer(0, "a", mask_of(a=PAINTED, b=HIDDEN, c=OUTSIDE)),
            layer(0, "b", mask_of(a=PAINTED, b=PAINTED, c=HIDDEN)),
            layer(1, "a", mask_of(a=HIDDEN, b=HIDDEN, c=OUTSIDE)),
            layer(2, "b", mask_of(a=OUTSIDE, b=OUTSIDE, c=OUTSIDE)),
        ),
        names=("wall 0", "wall 1", "wall 2"),
        plane_indices=(4, 5, 6),
    )
    # Three of four rows have a depth; two are painted on the first wall, one hidden, and two on
    # the second one.
    assert count_shown(walls(), layered) == (3 * 18, 12, 6 + 12)
