"""`ortho.dsm-backward`: the cells that a photo paints, their pixels and colours."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from orthoflow_plugins.ortho import painting
from orthoflow_plugins.ortho.dsm_backward import DsmBackward
from orthoflow_plugins.ortho.dsm_forward import DsmForward
from orthoflow_plugins.ortho.layers import NO_SOURCE, LayerStack, count_shown

from orthoflow.errors import MethodError
from orthoflow.files.images import encode_png
from orthoflow.geometry import WallFrame
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.frames import rotation_from_vector
from orthoflow.products import Camera, Cameras, Layer, LayerMask, Layers, Photos, Walls
from orthoflow.sdk import StepContext
from tests import ortho_scenes as scenes
from tests import samples
from tests.raster_scenes import context

OUTSIDE, PAINTED, HIDDEN, VOID = LayerMask
laid = partial(scenes.laid, DsmBackward)


def layer_of(folder: Path, given: dict[str, Any] | None = None, **params: Any) -> Layer:
    ((layer,), _) = laid(folder, given, **params)
    return layer


def of_depths(depths: np.ndarray, **known: Any) -> dict[str, Any]:
    return scenes.inputs(walls=scenes.walls(scenes.frame(), depths), **known)


@pytest.mark.parametrize("aside_m", [-0.7, 0.0, 0.9])
def test_visible_cells_show_their_own_place(tmp_path: Path, aside_m: float) -> None:
    viewer = scenes.camera(scenes.frame(), aside_m=aside_m)
    given = scenes.inputs(scenes.rendered(aside_m=aside_m), viewers=[viewer])
    layer = layer_of(tmp_path, given, resampling="nearest")
    shown = layer.mask == PAINTED
    is_raised = scenes.depth_m() > 0.0
    expected = np.where(is_raised, scenes.BLUE[scenes.RAISED], scenes.BLUE[scenes.BASE])
    np.testing.assert_array_equal(layer.rgb[..., 2][shown], expected[shown])
    # The limit is half a cell plus half of a grey level, which corresponds to a quarter of a cell.
    assert np.abs(scenes.places_off(layer)[shown]).max() <= 0.5 + 0.125
    is_visible, is_behind_board = scenes.visible(viewer)
    assert is_behind_board.any()
    assert (layer.mask[~is_visible] == HIDDEN).all()
    assert np.mean(layer.mask[is_visible] == PAINTED) > 0.96
    assert not layer.rgb[~shown].any()
    assert not layer.quality[~shown].any()


def test_stray_points_hide_nothing_and_a_sparse_board_does(tmp_path: Path) -> None:
    where, clean = scenes.frame(), layer_of(tmp_path)
    stray = scenes.inputs(cloud=scenes.cloud(where, n_outliers=300))
    np.testing.assert_array_equal(layer_of(tmp_path, stray).mask, clean.mask)
    sparse = scenes.inputs(cloud=scenes.cloud(where, spacing_cells=3.0))
    layer = layer_of(tmp_path, sparse, resampling="nearest")
    assert not (layer.rgb[..., 2] == scenes.BLUE[scenes.BOARD]).any()
    assert (layer.mask[scenes.visible(scenes.camera(where))[1]] == HIDDEN).all()


def test_tiles_do_not_show(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = layer_of(tmp_path)
    monkeypatch.setattr(painting, "TILE_CELLS", 50)
    tiled = layer_of(tmp_path)
    # Colours may differ, because each tile has a separate filter.
    np.testing.assert_array_equal(tiled.mask, whole.mask)
    np.testing.assert_array_equal(tiled.quality, whole.quality)


def test_cells_beside_hidden_ones_are_hidden(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    eroded = layer_of(tmp_path)
    monkeypatch.setattr(painting, "EROSION_CELLS", 0)
    plain = layer_of(tmp_path)
    hidden = (plain.mask == HIDDEN).astype(np.uint8)
    # Each patch here is wide; a single cell would be ignored.
    _, labels, stats, _ = cv2.connectedComponentsWithStats(hidden)
    assert stats[:, cv2.CC_STAT_WIDTH].min() >= 2
    assert labels.max() == 1
    near = cv2.dilate(hidden, np.ones((3, 3), np.uint8)) > 0
    expected = np.where(near & (plain.mask == PAINTED), HIDDEN, plain.mask)
    np.testing.assert_array_equal(eroded.mask, expected)


def test_cells_without_a_surface_and_outside_the_photo_say_so(tmp_path: Path) -> None:
    depths = scenes.depth_m()
    depths[200:220, 20:60] = np.nan
    viewer = scenes.camera(scenes.frame())
    photos = scenes.photos(scenes.rendered()[:, :500])
    given = of_depths(depths, viewers=[replace(viewer, width=500)], photos=photos)
    layer = layer_of(tmp_path, given)
    assert (layer.mask[200:220, 20:60] == VOID).all()
    u = scenes.seen_at(viewer)[..., 0]
    has_surface = ~np.isnan(depths)
    np.testing.assert_array_equal((layer.mask == OUTSIDE)[has_surface], (u >= 500)[has_surface])


def turned_away(where: WallFrame, aside_m: float = -0.7) -> ViewingCamera:
    viewer = scenes.camera(where, aside_m=aside_m)
    rotation = np.diag([-1.0, 1.0, -1.0]) @ viewer.rotation
    return replace(viewer, rotation=rotation, translation=-rotation @ viewer.centre_world)


def test_photos_that_paint_nothing_are_left_out_and_walls_keep_their_index(tmp_path: Path) -> None:
    where = scenes.frame()
    walls = scenes.walls(where)
    (wall,) = walls.walls
    # Add a wall behind the camera that faces it but is not visible.
    behind = replace(
        where,
        origin_world=where.world_from_wall(np.array([[where.width, 0.0]]), 4.0)[0],
        u_world=-where.u_world,
        normal_world=-where.normal_world,
    )
    both = replace(walls, walls=(replace(wall, frame=behind, name="wall 1"), wall))
    pictures = scenes.rendered(), scenes.rendered(aside_m=0.0)
    viewers = scenes.camera(where), turned_away(where, 0.0)
    layers, ctx = laid(tmp_path, scenes.inputs(*pictures, viewers=viewers, walls=both))
    # The turned camera paints the other wall, so both walls have a layer.
    assert [(layer.wall, layer.source) for layer in layers] == [(0, "1.png"), (1, "0.png")]
    assert ctx.warnings == []
    _, ctx = laid(tmp_path, scenes.inputs(*pictures, viewers=viewers))
    (diagnostic,) = ctx.diagnostics
    assert (diagnostic.code, diagnostic.values["n"]) == ("photos-show-no-wall", 1)
    assert diagnostic.values["names"] == "1.png"


def test_metrics_tell_what_was_painted_and_from_how_far(tmp_path: Path) -> None:
    # Use a clock that advances by one second per call.
    clock = count()
    ctx = replace(context(tmp_path), clock_s=lambda: float(next(clock)))
    inputs = DsmBackward.In(**scenes.inputs())
    (layer,) = DsmBackward().run(inputs, DsmBackward.Params(), ctx).layers.layers
    metrics = {metric.name: metric.value for metric in ctx.metrics}
    assert metrics["n_layers"] == 1
    # Occluders are collected once and used for each photo.
    seconds = [metrics[f"{name}_s"] for name in ("occluders", "decoding", "painting")]
    assert seconds == [2.0, 1.0, 1.0]
    assert ctx.warnings == []
    assert metrics["painted_share"] == np.mean(layer.mask == PAINTED)
    assert metrics["occluded_share"] == np.mean(layer.mask == HIDDEN)
    # The distance along the axis is 2.1 m (0.7 m to the side, 2 m in front), the focal length 1505
    # pixels.
    assert metrics["photo_gsd_mm"] == pytest.approx(1e3 * 2.1 / 1505, rel=0.02)
    assert metrics["obliquity_deg"] == pytest.approx(np.degrees(np.arctan2(0.7, 2.0)), abs=2.0)


def test_what_cannot_be_painted_is_refused_with_the_reason(tmp_path: Path) -> None:
    where = scenes.frame()
    good, walls = scenes.cameras(scenes.camera(where)).cameras[0], scenes.walls(where)
    lost = Cameras(cameras=(Camera(photo="0.png", status="only 3 ties agree"),))
    other = Cameras(cameras=(replace(good, photo="x.png"),))
    behind = scenes.camera(where).shifted(4.0 * where.normal_world)
    for known, reason in (
        ({"cameras": lost}, "no photo is oriented.*0.png: only 3 ties agree"),
        ({"cameras": scenes.cameras(turned_away(where))}, "no oriented photo shows a wall"),
        ({"cameras": scenes.cameras(behind)}, "no oriented photo shows a wall"),
        ({"cameras": other}, "x.png, which are not among the photos"),
        ({"photos": scenes.photos(scenes.rendered()[:-1])}, "0.png has 1000 x 799 pixels"),
        ({"walls": replace(walls, walls=())}, "there are no walls"),
    ):
        for method in (DsmBackward, DsmForward):
            with pytest.raises(MethodError, match=reason):
                scenes.laid(method, tmp_path, scenes.inputs(**known))


# --- masked photos, and photos upside down ---


@pytest.mark.parametrize("method", [DsmBackward, DsmForward])
def test_masked_pixels_paint_nothing_and_others_what_they_did(tmp_path: Path, method: Any) -> None:
    def painted(photos: Photos) -> Layer:
        ((layer,), _) = scenes.laid(method, tmp_path, scenes.inputs(photos=photos))
        return layer

    photos = scenes.photos(scenes.rendered())
    used = np.full(scenes.rendered().shape[:2], 255, dtype=np.uint8)
    used[300:420, 400:600] = 0
    before = painted(photos)
    after = painted(Photos(photos=(replace(photos.photos[0], mask=encode_png(used)),)))
    # A picture of the inverted mask shows which cells have masked pixels.
    seen = painted(scenes.photos(np.dstack([255 - used] * 3))).rgb[..., 0]
    shows, near = (
        cv2.morphologyEx((seen == 255).astype(np.uint8), way, np.ones((side, side))) > 0
        for way, side in ((cv2.MORPH_ERODE, 5), (cv2.MORPH_DILATE, 9))
    )
    was, is_painted = (layer.mask == PAINTED for layer in (before, after))
    assert (was & shows).sum() > 500
    assert not is_painted[shows].any()
    # Away from the border of the mask, nothing changes.
    np.testing.assert_array_equal(after.mask[~near], before.mask[~near])
    np.testing.assert_array_equal(after.rgb[~near & was], before.rgb[~near & was])


@pytest.mark.parametrize(
    ("turns_deg", "sign", "opposite"),
    [
        # The number of photos that are upside down decides whether up seems inverted.
        ((0.0, 10.0, -20.0, 180.0), -1.0, "z"),
        ((180.0,), 1.0, "-z"),
        *(((0.0, 0.0), 1.0, None), ((90.0, -90.0), 1.0, None)),
        *(((180.0, 0.0), 1.0, None), ((110.0, 115.0), 1.0, None)),
    ],
    ids=str,
)
def test_a_scan_whose_up_is_down_is_told_by_its_photos(
    tmp_path: Path, turns_deg: tuple[float, ...], sign: float, opposite: str | None
) -> None:
    viewer, turned = scenes.camera(scenes.frame(), width=100), []
    for turn_deg in turns_deg:
        turn = rotation_from_vector(np.array([0.0, 0.0, np.radians(turn_deg)]))
        turned.append(
            replace(viewer, rotation=turn @ viewer.rotation, translation=turn @ viewer.translation)
        )
    pictures = [scenes.rendered(width=100)] * len(turned)
    walls = scenes.walls(scenes.frame())
    given = scenes.inputs(*pictures, viewers=turned, walls=replace(walls, up=sign * walls.up))
    _, ctx = laid(tmp_path, given)
    found = [one for one in ctx.diagnostics if one.code == "photos-upside-down"]
    assert [one.severity for one in found] == ["error"] * (opposite is not None)
    if opposite:
        n_photos = len(turns_deg)
        expected = {"n_down": max(1, n_photos - 1), "n_photos": n_photos, "opposite": opposite}
        assert {name: found[0].values[name] for name in expected} == expected


# --- layers, joined by wall ---

SHAPE = (4, 6)


def three_walls() -> Walls:
    frame = samples.facing_south(0.01, SHAPE[1], SHAPE[0])
    depths = np.zeros(SHAPE, dtype=np.float32)
    depths[3] = np.nan
    return samples.walls(
        *(
            samples.wall(frame, name=f"wall {k}", plane_index=k + 4, depth_m=depths)
            for k in range(3)
        )
    )


def mask_of(*rows: LayerMask) -> np.ndarray:
    """Return a mask with given states of the first rows; the last row is void."""
    return np.repeat(np.array([[*rows, VOID]], dtype=np.uint8).T, SHAPE[1], axis=1)


SHOWN = mask_of(PAINTED, HIDDEN, OUTSIDE)


def layer(wall: int, source: str, mask: np.ndarray = SHOWN, level: Any = np.uint8) -> Layer:
    return samples.layer(mask, wall=wall, source=source, rgb=np.zeros((*SHAPE, 3), level))


def stacked(ctx: StepContext, *found: Layer) -> LayerStack:
    stack = LayerStack(three_walls(), ctx)
    for each in found:
        stack.add(each)
    return stack


def test_layers_come_by_wall_and_then_by_photo(tmp_path: Path) -> None:
    of = ((2, "a"), (0, "a"), (1, "b"), (0, "b"))
    ctx = context(tmp_path)
    found = stacked(ctx, *(layer(*each) for each in of)).joined(np.uint8)
    by_wall = [(each.wall, each.source) for each in found.layers]
    assert by_wall == [(0, "a"), (0, "b"), (1, "b"), (2, "a")]
    assert found.names == ("wall 0", "wall 1", "wall 2")
    assert found.plane_indices == (4, 5, 6)
    assert ctx.warnings == []


def test_a_wall_that_no_photo_paints_is_bare(tmp_path: Path) -> None:
    shown, ctx = layer(0, "a", level=np.uint16), context(tmp_path)
    stack = stacked(ctx, shown)
    first, second, third = stack.joined(np.uint16).layers
    assert first is shown
    assert [one.subject for one in ctx.diagnostics] == ["wall 1", "wall 2"]
    assert (second.wall, second.source, third.wall, third.source) == (1, NO_SOURCE, 2, NO_SOURCE)
    for bare in (second, third):
        np.testing.assert_array_equal(bare.mask, mask_of(OUTSIDE, OUTSIDE, OUTSIDE))
        np.testing.assert_array_equal(bare.rgb, shown.rgb, strict=True)
        assert not bare.quality.any()


def test_cells_are_counted_once_however_many_photos_show_them() -> None:
    layered = Layers(
        layers=(
            layer(0, "a"),
            layer(0, "b", mask_of(PAINTED, PAINTED, HIDDEN)),
            layer(1, "a", mask_of(HIDDEN, HIDDEN, OUTSIDE)),
            layer(2, "b", mask_of(OUTSIDE, OUTSIDE, OUTSIDE)),
        ),
        names=("wall 0", "wall 1", "wall 2"),
        plane_indices=(4, 5, 6),
    )
    # Three of four rows have a depth; on the first wall, two are painted and one is hidden; on the
    # second wall, two are painted.
    assert count_shown(three_walls(), layered) == (3 * 18, 12, 6 + 12)
