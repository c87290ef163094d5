"""What is masked in a photo is painted onto no wall."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from orthoflow_plugins.ortho.dsm_backward import DsmBackward
from orthoflow_plugins.ortho.dsm_forward import DsmForward

from orthoflow.files.images import encode_png
from orthoflow.products import Layer, LayerMask, Photos
from tests import ortho_scenes as scenes
from tests.raster_scenes import context

MASKED = np.s_[300:420, 400:600]


def painted(method: type[DsmBackward] | type[DsmForward], photos: Photos, folder: Path) -> Layer:
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
    before = painted(method, photos, tmp_path / "before")
    after = painted(method, Photos(photos=(masked,)), tmp_path / "after")
    # A bright picture of the mask says which cells show masked pixels.
    picture = scenes.photos(np.dstack([255 - used] * 3))
    seen = painted(method, picture, tmp_path / "seen").rgb[..., 0]
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
