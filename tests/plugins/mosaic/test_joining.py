"""Who paints each cell: states, preferences and islands, against loops over cells."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.mosaic import joining as module
from orthoflow_plugins.mosaic.joining import (
    NOBODY,
    best_views,
    preferences,
    without_islands,
)
from orthoflow_plugins.mosaic.seams import MosaicSeams

from orthoflow.errors import MethodError
from orthoflow.geometry.bands import in_memory
from orthoflow.products import Layer, LayerMask, OrthoMask
from tests import samples
from tests.long_loops import seeds

SHAPE = (23, 17)
PLAIN = MosaicSeams.Params(island_cells_min=1)
# A cell takes the highest of these that any layer gives it.
ORDER = [
    *(OrthoMask.NONE, OrthoMask.NO_SURFACE, OrthoMask.OCCLUDED),
    *(OrthoMask.FILLED, OrthoMask.PAINTED),
]


def layer(seed: int, *, source: str = "", painted: float = 0.4, has_filled: bool = True) -> Layer:
    rng = np.random.default_rng(seed)
    states = [LayerMask.OUTSIDE, LayerMask.OCCLUDED, LayerMask.NO_SURFACE]
    mask = np.where(
        rng.random(SHAPE) < painted, LayerMask.PAINTED, rng.choice(states, SHAPE)
    ).astype(np.uint8)
    is_painted = mask == LayerMask.PAINTED
    # Few values, so that some are equal.
    quality = np.where(is_painted, rng.integers(1, 4, SHAPE) / 3.0, 0.0).astype(np.float32)
    filled = (is_painted & (rng.random(SHAPE) < 0.3)).astype(np.uint8)
    known = {"source": source or f"{seed}.jpg", "quality": quality}
    return samples.layer(mask, filled=filled if has_filled else None, **known)


def state(of: Layer, cell: tuple[int, int]) -> int:
    """Place of a layer's state of a cell in the order."""
    mask = of.mask[cell]
    if mask == LayerMask.PAINTED:
        is_filled = of.filled is not None and of.filled[cell] > 0
        return ORDER.index(OrthoMask.FILLED if is_filled else OrthoMask.PAINTED)
    return {
        LayerMask.OUTSIDE: ORDER.index(OrthoMask.NONE),
        LayerMask.OCCLUDED: ORDER.index(OrthoMask.OCCLUDED),
        LayerMask.NO_SURFACE: ORDER.index(OrthoMask.NO_SURFACE),
    }[LayerMask(int(mask))]


LAYERS = [layer(1), layer(2, has_filled=False), layer(3), layer(4, painted=0.1)]


def test_a_cell_is_painted_by_the_best_of_those_that_know_most_of_it() -> None:
    rank, source = best_views(LAYERS, [one.quality for one in LAYERS])
    for cell in np.ndindex(SHAPE):
        states = [state(one, cell) for one in LAYERS]
        highest = max(states)
        assert rank[cell] == highest
        painters = [
            k
            for k, one in enumerate(LAYERS)
            if states[k] == highest and one.mask[cell] == LayerMask.PAINTED
        ]
        # The first of equals.
        wanted = max(painters, key=lambda k: (LAYERS[k].quality[cell], -k), default=NOBODY)
        assert source[cell] == wanted


def test_ranks_become_states_of_the_orthoimage() -> None:
    mask, source = module.joined(
        LAYERS[:3],
        LAYERS[3:],
        PLAIN,
        drawn=None,
        wall=None,
        balance=None,
        allocate=in_memory,
    )
    rank, owner = best_views(LAYERS, [one.quality for one in LAYERS])
    np.testing.assert_array_equal(mask, np.array(ORDER, dtype=np.uint8)[rank])
    own = np.where(owner == 3, source, owner)
    np.testing.assert_array_equal(source, own)


@pytest.mark.parametrize("rule", ["best-view", "voronoi", "priority"])
def test_preferences_are_the_same_row_by_row(rule: str) -> None:
    options = PLAIN.model_copy(update={"seams": rule, "priority": ("3.jpg", "1.jpg")})
    whole = slice(0, SHAPE[0])
    every = [preference(whole) for preference in preferences(LAYERS, options)]
    for preference, values in zip(preferences(LAYERS, options), every, strict=True):
        np.testing.assert_array_equal(preference(slice(5, 9)), values[5:9])
    for one, values in zip(LAYERS, every, strict=True):
        if rule == "priority":
            bonus = {"3.jpg": 4.0, "1.jpg": 2.0}.get(one.source, 0.0)
            np.testing.assert_allclose(values, one.quality + bonus)
        elif rule == "best-view":
            np.testing.assert_array_equal(values, one.quality)
        elif rule == "voronoi":
            # As far as the nearest cell that it does not paint, or the rim, is.
            padded = np.pad(one.mask == LayerMask.PAINTED, 1)
            others = np.argwhere(~padded)
            for cell in [(0, 0), (4, 7), (11, 3), (22, 16)]:
                away = np.hypot(*(others - np.add(cell, 1)).T).min()
                assert values[cell] == pytest.approx(away, abs=1e-3)


# --- islands ---


def patches(source: NDArray[np.int16], index: int) -> list[list[tuple[int, int]]]:
    """Cells of one source that are connected over sides."""
    left = {tuple(cell) for cell in np.argwhere(source == index).tolist()}
    found = []
    while left:
        new, patch = [left.pop()], []
        while new:
            row, column = new.pop()
            patch.append((row, column))
            for beside in (
                (row + 1, column),
                (row - 1, column),
                (row, column + 1),
                (row, column - 1),
            ):
                if beside in left:
                    left.remove(beside)
                    new.append(beside)
        found.append(patch)
    return found


@pytest.mark.parametrize("cells_min", [2, 9])
@pytest.mark.parametrize("seed", seeds(2))
def test_small_patches_go_to_the_source_about_them_that_shows_them_too(
    seed: int, cells_min: int
) -> None:
    rng = np.random.default_rng(seed)
    layers = [layer(10 + seed + k, painted=0.9, has_filled=False) for k in range(3)]
    # Large areas with specks in them.
    wanted = np.where(np.arange(SHAPE[1])[None] < 9, 0, 1) * np.ones(SHAPE, dtype=int)
    specks = rng.random(SHAPE) < 0.15
    wanted[specks] = rng.integers(0, 3, specks.sum())
    painted = np.array([one.mask == LayerMask.PAINTED for one in layers])
    source = np.where(np.take_along_axis(painted, wanted[None], 0)[0], wanted, NOBODY)
    rank = np.where(source >= 0, ORDER.index(OrthoMask.PAINTED), 0).astype(np.uint8)
    owner = source.astype(np.int16)
    island = np.zeros(SHAPE, dtype=bool)
    for index in range(3):
        for patch in patches(owner, index):
            if len(patch) < cells_min:
                island[tuple(np.array(patch).T)] = True
    assert 5 < island.sum() < 0.5 * island.size
    expected = owner.copy()
    reach = int(np.ceil(np.sqrt(cells_min)))
    for row, column in np.argwhere(island).tolist():
        about = (
            slice(max(0, row - reach), row + reach + 1),
            slice(max(0, column - reach), column + reach + 1),
        )
        counts = [
            np.count_nonzero((owner[about] == k) & ~island[about])
            if state(layers[k], (row, column)) == rank[row, column]
            else 0
            for k in range(3)
        ]
        if max(counts):
            # The first of equals.
            expected[row, column] = int(np.argmax(counts))
    np.testing.assert_array_equal(without_islands(rank, owner, layers, cells_min), expected)


def test_without_a_small_patch_nothing_changes() -> None:
    layers = [layer(20 + k, painted=1.0, has_filled=False) for k in range(2)]
    source = np.zeros(SHAPE, dtype=np.int16)
    source[:3, :3] = 1
    rank = np.full(SHAPE, ORDER.index(OrthoMask.PAINTED), dtype=np.uint8)
    # Nine cells are a patch of nine.
    assert without_islands(rank, source, layers, 9) is source
    assert (without_islands(rank, source, layers, 10) == 0).all()


@pytest.mark.parametrize("cells_min", [1, 7])
def test_bands_decide_islands_as_the_whole_does(
    monkeypatch: pytest.MonkeyPatch, cells_min: int
) -> None:
    layers = [layer(30 + k, painted=0.8, has_filled=False) for k in range(3)]
    options = PLAIN.model_copy(update={"island_cells_min": cells_min})
    given = {"drawn": None, "wall": None, "balance": None, "allocate": in_memory}
    mask, source = module.joined(layers, [], options, **given)  # type: ignore[arg-type]
    monkeypatch.setattr(module, "_BAND_CELLS", SHAPE[1])
    banded = module.joined(layers, [], options, **given)  # type: ignore[arg-type]
    np.testing.assert_array_equal(banded[0], mask)
    np.testing.assert_array_equal(banded[1], source)
    if cells_min == 1:
        _, best = best_views(layers, [one.quality for one in layers])
        np.testing.assert_array_equal(source, best)


# --- colours ---


@pytest.mark.parametrize("is_deep", [False, True])
@pytest.mark.parametrize("band_cells", [20, 1 << 25])
def test_each_cell_has_the_colour_of_its_layer(
    monkeypatch: pytest.MonkeyPatch, band_cells: int, *, is_deep: bool
) -> None:
    monkeypatch.setattr(module, "_BAND_CELLS", band_cells)
    rng = np.random.default_rng(6)
    layers = [
        replace(one, rgb=rng.integers(0, 256, (*SHAPE, 3)).astype(np.uint8)) for one in LAYERS[:2]
    ]
    if is_deep:
        deep = rng.integers(0, 65536, (*SHAPE, 3)).astype(np.uint16)
        layers[1] = replace(layers[1], rgb=deep)
    source = rng.integers(-1, 2, SHAPE).astype(np.int16)
    rgb = module.coloured(layers, source, None, allocate=in_memory)
    assert rgb.dtype == (np.uint16 if is_deep else np.uint8)
    assert not rgb[source == NOBODY].any()
    np.testing.assert_array_equal(rgb[source == 1], layers[1].rgb[source == 1])
    # 8 bits become 16 so that white stays white.
    scale = 257 if is_deep else 1
    np.testing.assert_array_equal(rgb[source == 0], scale * layers[0].rgb[source == 0].astype(int))


def test_layers_of_a_wall_share_its_raster() -> None:
    one, other = layer(40, source="a.jpg"), layer(41, source="b.jpg")
    module.require_one_raster([one, other], "wall 0")
    moved = replace(other, frame=replace(other.frame, gsd_m=0.02))
    # Any of them, not only the second.
    for layers in ([one, moved], [one, other, moved]):
        with pytest.raises(MethodError) as caught:
            module.require_one_raster(layers, "wall 0")
        assert str(caught.value) == (
            "the layers a.jpg and b.jpg of wall 0 have different rasters: all layers must be "
            "made from the same walls"
        )
    with pytest.raises(
        MethodError, match=r"^priority refers to c\.jpg, but the layers are of a\.jpg, b"
    ):
        module.require_sources([other, one], ["b.jpg", "c.jpg"])
    module.require_sources([other, one], ["b.jpg"])


def test_distances_inside_a_large_layer_are_linear_between_every_so_many_cells(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    shape = (120, 150)
    mask = np.full(shape, LayerMask.PAINTED, dtype=np.uint8)
    mask[:, :30] = LayerMask.OUTSIDE
    large = samples.layer(mask)
    options = PLAIN.model_copy(update={"seams": "voronoi"})
    (whole,) = preferences([large], options)
    monkeypatch.setattr(module, "_BAND_CELLS", shape[0] * shape[1] // 8)
    (reduced,) = preferences([large], options)
    rows = slice(0, shape[0])
    # Every third cell: what is painted may end two cells beside.
    np.testing.assert_allclose(reduced(rows), whole(rows), atol=3.0)
    np.testing.assert_array_equal(reduced(slice(31, 60)), reduced(rows)[31:60])
