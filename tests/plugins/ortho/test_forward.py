"""`ortho.dsm-forward`: each pixel paints the cell that it shows, and nothing behind it."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from itertools import count
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
import pytest
from orthoflow_plugins.ortho import dsm_forward
from orthoflow_plugins.ortho.dsm_backward import DsmBackward
from orthoflow_plugins.ortho.dsm_forward import DsmForward

from orthoflow.errors import MethodError
from orthoflow.products import Layer, LayerMask, PointCloud
from orthoflow.sdk import StepContext
from tests import ortho_scenes as scenes
from tests.raster_scenes import context


def inputs(*, aside_m: float, width: int = 1000, cloud: PointCloud | None) -> DsmForward.In:
    where = scenes.frame()
    return DsmForward.In(
        walls=scenes.walls(where),
        photos=scenes.photos(scenes.rendered(aside_m=aside_m, width=width)),
        cameras=scenes.cameras(scenes.camera(where, aside_m=aside_m, width=width)),
        cloud=cloud,
    )


def thrown(given: DsmForward.In, ctx: StepContext, **params: object) -> Layer:
    (layer,) = DsmForward().run(given, DsmForward.Params.model_validate(params), ctx).layers.layers
    return layer


@lru_cache(maxsize=4)
def layer_of(aside_m: float, width: int = 1000) -> Layer:
    given = inputs(aside_m=aside_m, width=width, cloud=scenes.cloud(scenes.frame()))
    return thrown(given, context(Path(mkdtemp())))


@pytest.mark.parametrize("aside_m", [-0.7, 0.9])
def test_every_pixel_paints_the_cell_that_it_shows(aside_m: float) -> None:
    layer = layer_of(aside_m)
    assert layer.filled is not None
    taken = (layer.mask == LayerMask.PAINTED) & (layer.filled == 0)
    is_raised = scenes.depth_m() > 0.0
    expected = np.where(is_raised, scenes.BLUE[scenes.RAISED], scenes.BLUE[scenes.BASE])
    assert np.mean(layer.rgb[..., 2][taken] == expected[taken]) > 0.999
    # Half a cell, half of the quarter cell that a grey level is, and a hundredth of a pixel.
    assert np.quantile(np.abs(scenes.places_off(layer)[taken]), 0.999) <= 0.5 + 0.125 + 0.01


@pytest.mark.parametrize("aside_m", [-0.7, 0.9])
def test_what_is_hidden_stays_unpainted_and_nearly_all_else_is_painted(aside_m: float) -> None:
    where, layer = scenes.frame(), layer_of(aside_m)
    seen = scenes.truth(where, scenes.camera(where, aside_m=aside_m))
    is_visible = np.isin(seen.surface, (scenes.BASE, scenes.RAISED)).reshape(scenes.SHAPE)
    is_behind_board = (seen.surface == scenes.BOARD).reshape(scenes.SHAPE)
    assert not (layer.rgb[..., 2] == scenes.BLUE[scenes.BOARD]).any()
    # A gap of one cell at a rim is filled.
    assert np.mean(layer.mask[is_behind_board] == LayerMask.OCCLUDED) > 0.99
    assert np.mean(layer.mask[is_visible] == LayerMask.PAINTED) > 0.96
    assert (layer.quality[layer.mask != LayerMask.PAINTED] == 0.0).all()
    assert not layer.rgb[layer.mask != LayerMask.PAINTED].any()


def test_quality_and_reach_are_those_of_the_backward_projection(tmp_path: Path) -> None:
    given, layer = inputs(aside_m=0.9, cloud=scenes.cloud(scenes.frame())), layer_of(0.9)
    looked = DsmBackward.In(
        walls=given.walls, photos=given.photos, cameras=given.cameras, cloud=given.cloud
    )
    (back,) = DsmBackward().run(looked, DsmBackward.Params(), context(tmp_path)).layers.layers
    both = (layer.mask == LayerMask.PAINTED) & (back.mask == LayerMask.PAINTED)
    assert both.sum() > 0.9 * (back.mask == LayerMask.PAINTED).sum()
    np.testing.assert_allclose(layer.quality[both], back.quality[both], rtol=1e-3, atol=1e-4)
    assert ((layer.mask == LayerMask.OUTSIDE) == (back.mask == LayerMask.OUTSIDE)).all()


def test_a_coarse_photo_leaves_gaps_that_are_filled_and_marked(tmp_path: Path) -> None:
    where = scenes.frame()
    given = inputs(aside_m=0.0, width=300, cloud=None)
    (tmp_path / "closed").mkdir()
    ctx = context(tmp_path)
    holed = thrown(given, ctx, fill_gap_cells=0)
    assert "occluders-unknown" in [one.code for one in ctx.diagnostics]
    assert holed.filled is not None
    assert not holed.filled.any()
    # Pixels of 5 mm and more on cells of 4 mm.
    gsd = 2.0 / (1.5 * 300)
    painted = np.mean(holed.mask == LayerMask.PAINTED)
    assert painted <= 1.1 * (where.gsd_m / gsd) ** 2
    clock = count()
    ctx = replace(context(tmp_path / "closed"), clock_s=lambda: float(next(clock)))
    closed = thrown(given, ctx, fill_gap_cells=2)
    # Of a clock that goes on when it is asked: once for all photos, and for each.
    told = {metric.name: metric.value for metric in ctx.metrics}
    assert (told["occluders_s"], told["painting_s"]) == (2.0, 1.0)
    assert closed.filled is not None
    assert np.mean(closed.mask == LayerMask.PAINTED) > 0.97
    is_old = (closed.mask == LayerMask.PAINTED) & (closed.filled == 0)
    np.testing.assert_array_equal(is_old, holed.mask == LayerMask.PAINTED)


def test_bands_do_not_show(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given = inputs(aside_m=0.0, width=300, cloud=None)
    layers = []
    for n_cells in (1 << 24, 25 * scenes.SHAPE[1]):
        monkeypatch.setattr(dsm_forward, "_BAND_CELLS", n_cells)
        folder = tmp_path / str(n_cells)
        folder.mkdir()
        layers.append(thrown(given, context(folder), fill_gap_cells=3))
    for name in ("rgb", "mask", "quality", "filled"):
        np.testing.assert_array_equal(*(getattr(layer, name) for layer in layers), err_msg=name)


def test_a_camera_behind_the_wall_is_refused(tmp_path: Path) -> None:
    where = scenes.frame()
    given = inputs(aside_m=0.0, width=300, cloud=None)
    behind = scenes.camera(where, width=300)
    flipped = type(behind)(
        **{
            **{name: getattr(behind, name) for name in behind.__dataclass_fields__},
            "translation": behind.translation + behind.rotation @ (4.0 * where.normal_world),
        }
    )
    moved = DsmForward.In(
        walls=given.walls, photos=given.photos, cameras=scenes.cameras(flipped), cloud=None
    )
    with pytest.raises(MethodError, match="no oriented photo sees a wall"):
        thrown(moved, context(tmp_path))
