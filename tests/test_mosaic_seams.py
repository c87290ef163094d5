"""`mosaic.seams`: one layer passes through, of several the best paints each cell."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.mosaic.seams import MosaicSeams

from orthoflow.errors import MethodError
from orthoflow.geometry import WallFrame, frame_over
from orthoflow.products import Layer, LayerMask, Layers, Orthoimages, OrthoMask
from tests import raster_scenes as scenes


def frame(shape: tuple[int, int] = (6, 8)) -> WallFrame:
    known = scenes.upright_wall(shape=shape)
    return frame_over(known.planes().corners[0], known.normal, gsd_m=known.gsd_m)


def random_layer(seed: int, *, wall: int = 0, filled: bool = True) -> Layer:
    rng = np.random.default_rng(seed)
    shape = frame().shape
    mask = rng.integers(0, 4, shape, dtype=np.uint8)
    is_painted = mask == LayerMask.PAINTED
    return Layer(
        frame=frame(),
        wall=wall,
        source=f"photo {seed}",
        rgb=np.where(is_painted[..., None], rng.integers(0, 256, (*shape, 3)), 0).astype(np.uint8),
        mask=mask,
        quality=np.where(is_painted, rng.random(shape), 0.0).astype(np.float32),
        filled=(is_painted & (rng.random(shape) < 0.3)).astype(np.uint8) if filled else None,
    )


def joined(layers: Layers, folder: Path) -> Orthoimages:
    ctx = scenes.context(folder)
    return MosaicSeams().run(MosaicSeams.In(layers=layers), MosaicSeams.Params(), ctx).orthoimages


def test_a_single_layer_passes_through(tmp_path: Path) -> None:
    layer = random_layer(1)
    (image,) = joined(Layers(layers=(layer,), names=("west wall",)), tmp_path).images
    np.testing.assert_array_equal(image.rgb, layer.rgb)
    table = {
        LayerMask.OUTSIDE: OrthoMask.NONE,
        LayerMask.OCCLUDED: OrthoMask.OCCLUDED,
        LayerMask.NO_SURFACE: OrthoMask.NO_SURFACE,
    }
    for state, expected in table.items():
        assert (image.mask[layer.mask == state] == expected).all()
    assert layer.filled is not None
    is_painted = layer.mask == LayerMask.PAINTED
    assert (image.mask[layer.filled > 0] == OrthoMask.FILLED).all()
    assert (image.mask[is_painted & (layer.filled == 0)] == OrthoMask.PAINTED).all()
    np.testing.assert_array_equal(image.source == 0, is_painted)
    assert (image.source[~is_painted] == -1).all()
    assert image.name == "west wall"
    assert image.sources == ("photo 1",)


def best_by_hand(layers: list[Layer], cell: tuple[int, int]) -> tuple[int, int]:
    """State and source of one cell, spelled out."""

    def candidates(*, filled: bool) -> list[tuple[float, int]]:
        return [
            (-float(layer.quality[cell]), k)
            for k, layer in enumerate(layers)
            if layer.mask[cell] == LayerMask.PAINTED
            and (layer.filled is not None and layer.filled[cell] > 0) == filled
        ]

    if candidates(filled=False):
        return OrthoMask.PAINTED, min(candidates(filled=False))[1]
    if candidates(filled=True):
        return OrthoMask.FILLED, min(candidates(filled=True))[1]
    states = {int(layer.mask[cell]) for layer in layers}
    if LayerMask.OCCLUDED in states:
        return OrthoMask.OCCLUDED, -1
    return (OrthoMask.NO_SURFACE if LayerMask.NO_SURFACE in states else OrthoMask.NONE), -1


@pytest.mark.parametrize("n_layers", [2, 3, 5])
def test_of_several_layers_the_best_paints_each_cell(tmp_path: Path, n_layers: int) -> None:
    layers = [random_layer(seed, filled=seed != 2) for seed in range(n_layers)]
    (image,) = joined(Layers(layers=tuple(layers)), tmp_path).images
    for cell in np.ndindex(image.mask.shape):
        state, source = best_by_hand(layers, (cell[0], cell[1]))
        assert (image.mask[cell], image.source[cell]) == (state, source)
        colour = layers[source].rgb[cell] if source >= 0 else np.zeros(3)
        np.testing.assert_array_equal(image.rgb[cell], colour)
    assert image.name == "wall 0"


def test_of_equal_layers_the_first_paints(tmp_path: Path) -> None:
    layer = dataclasses.replace(random_layer(3), filled=None)
    twin = dataclasses.replace(layer, source="twin", rgb=255 - layer.rgb)
    (image,) = joined(Layers(layers=(layer, twin)), tmp_path).images
    assert set(np.unique(image.source)) <= {-1, 0}


def test_every_wall_of_the_layers_gets_an_orthoimage(tmp_path: Path) -> None:
    layers = Layers(
        layers=(random_layer(1, wall=0), random_layer(2, wall=2), random_layer(3, wall=0)),
        names=("a", "b", "c"),
    )
    images = joined(layers, tmp_path).images
    assert [(image.wall, image.name, len(image.sources)) for image in images] == [
        (0, "a", 2),
        (2, "c", 1),
    ]


def test_layers_on_different_rasters_are_refused(tmp_path: Path) -> None:
    layer, other = random_layer(1), random_layer(2)
    shifted = dataclasses.replace(other.frame, origin_world=other.frame.origin_world + 1.0)
    moved = dataclasses.replace(other, frame=shifted)
    with pytest.raises(MethodError, match="lie on different rasters"):
        joined(Layers(layers=(layer, moved)), tmp_path)


def test_no_layers_give_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(MethodError, match="there is no layer"):
        joined(Layers(layers=()), tmp_path)


def share(mask: NDArray[np.uint8], state: OrthoMask) -> float:
    return float(np.mean(mask == state))


def test_shares_of_all_states_are_reported(tmp_path: Path) -> None:
    layers = Layers(layers=(random_layer(1), random_layer(2)))
    ctx = scenes.context(tmp_path)
    inputs = MosaicSeams.In(layers=layers)
    (image,) = MosaicSeams().run(inputs, MosaicSeams.Params(), ctx).orthoimages.images
    metrics = {metric.name: metric.value for metric in ctx.metrics}
    assert metrics.pop("n_orthoimages") == 1
    expected = {f"{state.name.lower()}_share": share(image.mask, state) for state in OrthoMask}
    assert metrics == pytest.approx(expected)
