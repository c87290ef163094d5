"""The colouring rules of `ortho.pointcloud-direct`, against a loop over the cells."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.ortho.pointcloud_direct import PointcloudDirect

from orthoflow.products import Layer, LayerMask
from tests import raster_scenes as scenes
from tests.plugins.ortho.test_direct import bare_walls

N_TOP = 5


def painted(
    folder: Path, colouring: str, inpaint: str = "none"
) -> tuple[Layer, dict[int, list[int]]]:
    """A wall with two layers of random colours, and its points by cell."""
    known = scenes.leaning_wall(shape=(20, 30))
    rng = np.random.default_rng(8)
    n_points = 6000
    places = rng.uniform([0, 0], [30, 20], (n_points, 2))
    depths_m = rng.choice([-0.06, 0.05], n_points) + rng.uniform(0.0, 0.009, n_points)
    rgb = rng.integers(0, 256, (n_points, 3), dtype=np.uint8)
    cloud = scenes.cloud_of(known.world(*places.T, depths_m), rgb=rgb)
    chosen = PointcloudDirect.Params.model_validate({"colouring": colouring, "inpaint": inpaint})
    inputs = PointcloudDirect.In(walls=bare_walls(known), cloud=cloud)
    ctx = scenes.context(folder)
    layer = PointcloudDirect().run(inputs, chosen, ctx).layers.layers[0]
    tops: dict[int, list[int]] = {}
    cells = np.floor(places[:, 1]).astype(int) * 30 + np.floor(places[:, 0]).astype(int)
    for cell in np.unique(cells):
        own = np.flatnonzero(cells == cell)
        own = own[np.argsort(-depths_m[own], kind="stable")]
        tops[int(cell)] = [int(k) for k in own if depths_m[own[0]] - depths_m[k] <= 0.02]
    return layer, {
        cell: _expected(colouring, np.array(own), places, rgb) for cell, own in tops.items()
    }


def _expected(
    colouring: str, own: NDArray[np.int64], places: NDArray[np.float64], rgb: NDArray[np.uint8]
) -> list[int]:
    squares = ((places[own] % 1.0 - 0.5) ** 2).sum(axis=1)
    if colouring == "topmost":
        colour = rgb[own[0]].astype(float)
    elif colouring == "centre":
        colour = rgb[own[np.argmin(squares)]].astype(float)
    elif colouring == "gaussian":
        weights = np.exp(-squares / (2 * 0.36**2))
        colour = weights @ rgb[own] / weights.sum()
    else:
        colour = np.floor(np.median(rgb[own[:N_TOP]], axis=0) + 0.5)
    return [round(float(value)) for value in colour]


@pytest.mark.parametrize("colouring", ["topmost", "centre", "gaussian", "median"])
def test_colours_follow_their_rule(tmp_path: Path, colouring: str) -> None:
    layer, expected = painted(tmp_path, colouring)
    shown = layer.mask.ravel() == LayerMask.PAINTED
    np.testing.assert_array_equal(np.flatnonzero(shown), sorted(expected))
    colours = np.array([expected[cell] for cell in sorted(expected)])
    # One grey level: positions went through float32 offsets.
    assert np.abs(layer.rgb.reshape(-1, 3)[shown].astype(int) - colours).max() <= 1


@pytest.mark.parametrize(
    ("colouring", "inpaint"),
    [("topmost", "between"), ("centre", "telea"), ("gaussian", "none"), ("median", "between")],
)
def test_bands_do_not_show_in_colours(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, colouring: str, inpaint: str
) -> None:
    (tmp_path / "banded").mkdir()
    whole, _ = painted(tmp_path, colouring, inpaint=inpaint)
    # Fronts of this wall are short.
    monkeypatch.setattr("orthoflow_plugins.ortho.filling._FRONT_CELLS", 2)
    monkeypatch.setattr("orthoflow_plugins.ortho.pointcloud_direct._BAND_CELLS", 30 * 24)
    monkeypatch.setattr("orthoflow_plugins.ortho.point_colours._POINTS_AT_ONCE", 100)
    banded, _ = painted(tmp_path / "banded", colouring, inpaint=inpaint)
    for name in ("rgb", "mask", "filled"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(banded, name), err_msg=name)
    # Places are counted from the band's own corner: the last digit of float32.
    np.testing.assert_allclose(whole.quality, banded.quality, atol=1e-6)
