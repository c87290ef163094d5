"""Choice of the layer of each cell: states, preferences, islands and cuts; agreement of photos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.mosaic import agreement, blocks, graph_cut, joining
from orthoflow_plugins.mosaic.blocks import Blocks, depth_edges
from orthoflow_plugins.mosaic.seams import MosaicSeams
from scipy import ndimage

from orthoflow.errors import MethodError
from orthoflow.geometry.bands import in_memory
from orthoflow.geometry.levels import lit_shares
from orthoflow.products import Layer, LayerMask, OrthoMask
from tests import samples
from tests.long_loops import seeds

SHAPE = (23, 17)
PLAIN = MosaicSeams.Params(island_cells_min=1)
# A cell takes the highest of these states in any layer.
ORDER = [
    *(OrthoMask.NONE, OrthoMask.NO_SURFACE, OrthoMask.OCCLUDED),
    *(OrthoMask.FILLED, OrthoMask.PAINTED),
]


def layer(seed: int, *, source: str = "", painted: float = 0.4, has_filled: bool = True) -> Layer:
    rng = np.random.default_rng(seed)
    states = [LayerMask.OUTSIDE, LayerMask.OCCLUDED, LayerMask.NO_SURFACE]
    mask = np.where(rng.random(SHAPE) < painted, LayerMask.PAINTED, rng.choice(states, SHAPE))
    is_painted = mask == LayerMask.PAINTED
    # There are few values, so that some are equal.
    quality = np.where(is_painted, rng.integers(1, 4, SHAPE) / 3.0, 0.0).astype(np.float32)
    filled = (is_painted & (rng.random(SHAPE) < 0.3)).astype(np.uint8)
    known = {"source": source or f"{seed}.jpg", "quality": quality}
    return samples.layer(mask.astype(np.uint8), filled=filled if has_filled else None, **known)


def states_of(layers: Sequence[Layer]) -> NDArray[np.intp]:
    """Return the rank (n, rows, cols) of each layer's state."""
    order = {LayerMask.OUTSIDE: 0, LayerMask.NO_SURFACE: 1, LayerMask.OCCLUDED: 2}
    table = np.array([order.get(one, 4) for one in LayerMask])
    return np.array(
        [table[one.mask] - (0 if one.filled is None else one.filled > 0) for one in layers]
    )


LAYERS = [layer(1), layer(2, has_filled=False), layer(3), layer(4, painted=0.1)]


def test_a_cell_is_painted_by_the_best_of_those_that_know_most_of_it() -> None:
    rank, source = joining.best_views(LAYERS, [one.quality for one in LAYERS])
    states = states_of(LAYERS)
    np.testing.assert_array_equal(rank, states.max(axis=0))
    # The first of equal layers is used.
    quality = np.where(states == states.max(axis=0), [one.quality for one in LAYERS], -1.0)
    wanted = np.where(states.max(axis=0) >= ORDER.index(OrthoMask.FILLED), quality.argmax(0), -1)
    np.testing.assert_array_equal(source, wanted)
    # Ranks are converted to states of the orthoimage.
    options = {"drawn": None, "wall": None, "balance": None, "allocate": in_memory}
    mask, painted = joining.joined(LAYERS[:3], LAYERS[3:], PLAIN, **options)  # type: ignore[arg-type]
    np.testing.assert_array_equal(mask, np.array(ORDER, dtype=np.uint8)[rank])
    np.testing.assert_array_equal(painted[source != 3], source[source != 3])


@pytest.mark.parametrize("rule", ["best-view", "voronoi", "priority"])
def test_preferences_are_the_same_row_by_row(rule: str) -> None:
    options = PLAIN.model_copy(update={"seams": rule, "priority": ("3.jpg", "1.jpg")})
    whole = slice(0, SHAPE[0])
    every = [preference(whole) for preference in joining.preferences(LAYERS, options)]
    for preference, values in zip(joining.preferences(LAYERS, options), every, strict=True):
        np.testing.assert_array_equal(preference(slice(5, 9)), values[5:9])
    for one, values in zip(LAYERS, every, strict=True):
        if rule == "priority":
            bonus = {"3.jpg": 4.0, "1.jpg": 2.0}.get(one.source, 0.0)
            np.testing.assert_allclose(values, one.quality + bonus)
        elif rule == "best-view":
            np.testing.assert_array_equal(values, one.quality)
        elif rule == "voronoi":
            # Compute the distance to the nearest cell that is not painted, or to the border.
            padded = np.pad(one.mask == LayerMask.PAINTED, 1)
            others = np.argwhere(~padded)
            for cell in [(0, 0), (4, 7), (11, 3), (22, 16)]:
                away = np.hypot(*(others - np.add(cell, 1)).T).min()
                assert values[cell] == pytest.approx(away, abs=1e-3)


@pytest.mark.parametrize("cells_min", [2, 9])
@pytest.mark.parametrize("seed", seeds(2))
def test_small_patches_go_to_the_most_frequent_source_nearby(seed: int, cells_min: int) -> None:
    rng = np.random.default_rng(seed)
    layers = [layer(10 + seed + k, painted=0.9, has_filled=False) for k in range(3)]
    # Large areas with specks.
    wanted = np.where(np.arange(SHAPE[1])[None] < 9, 0, 1) * np.ones(SHAPE, dtype=int)
    specks = rng.random(SHAPE) < 0.15
    wanted[specks] = rng.integers(0, 3, specks.sum())
    painted = np.array([one.mask == LayerMask.PAINTED for one in layers])
    source = np.where(np.take_along_axis(painted, wanted[None], 0)[0], wanted, joining.NOBODY)
    rank = np.where(source >= 0, ORDER.index(OrthoMask.PAINTED), 0).astype(np.uint8)
    owner = source.astype(np.int16)
    island = np.zeros(SHAPE, dtype=bool)
    for index in range(3):
        # A patch consists of cells of one source that are connected by their sides.
        patch, _ = ndimage.label(owner == index)
        island |= (patch > 0) & (np.bincount(patch.ravel())[patch] < cells_min)
    assert 5 < island.sum() < 0.5 * island.size
    expected = owner.copy()
    reach = int(np.ceil(np.sqrt(cells_min)))
    is_known = states_of(layers) == rank
    for row, column in np.argwhere(island).tolist():
        about = tuple(slice(max(0, at - reach), at + reach + 1) for at in (row, column))
        counts = [np.count_nonzero((owner[about] == k) & ~island[about]) for k in range(3)]
        counts = np.where(is_known[:, row, column], counts, 0)
        if counts.max():
            # The first of equal sources is used.
            expected[row, column] = int(np.argmax(counts))
    np.testing.assert_array_equal(joining.without_islands(rank, owner, layers, cells_min), expected)


@pytest.mark.parametrize("cells_min", [1, 7])
def test_bands_give_the_same_islands(monkeypatch: pytest.MonkeyPatch, cells_min: int) -> None:
    layers = [layer(30 + k, painted=0.8, has_filled=False) for k in range(3)]
    options = PLAIN.model_copy(update={"island_cells_min": cells_min})
    given = {"drawn": None, "wall": None, "balance": None, "allocate": in_memory}
    whole = joining.joined(layers, [], options, **given)  # type: ignore[arg-type]
    monkeypatch.setattr(joining, "BAND_CELLS", SHAPE[1])
    banded = joining.joined(layers, [], options, **given)  # type: ignore[arg-type]
    np.testing.assert_array_equal(banded, whole)


# --- colours ---


@pytest.mark.parametrize("is_deep", [False, True])
@pytest.mark.parametrize("band_cells", [20, 1 << 25])
def test_each_cell_has_the_colour_of_its_layer(
    monkeypatch: pytest.MonkeyPatch, band_cells: int, *, is_deep: bool
) -> None:
    monkeypatch.setattr(joining, "BAND_CELLS", band_cells)
    rng = np.random.default_rng(6)
    layers = [
        replace(one, rgb=rng.integers(0, 256, (*SHAPE, 3)).astype(np.uint8)) for one in LAYERS[:2]
    ]
    if is_deep:
        deep = rng.integers(0, 65536, (*SHAPE, 3)).astype(np.uint16)
        layers[1] = replace(layers[1], rgb=deep)
    source = rng.integers(-1, 2, SHAPE).astype(np.int16)
    rgb = joining.coloured(layers, source, None, allocate=in_memory)
    assert rgb.dtype == (np.uint16 if is_deep else np.uint8)
    assert not rgb[source == joining.NOBODY].any()
    np.testing.assert_array_equal(rgb[source == 1], layers[1].rgb[source == 1])
    # 8 bits are converted to 16 bits in such a way that white remains white.
    scale = 257 if is_deep else 1
    np.testing.assert_array_equal(rgb[source == 0], scale * layers[0].rgb[source == 0].astype(int))


def test_layers_of_a_wall_share_its_raster() -> None:
    one, other = layer(40, source="a.jpg"), layer(41, source="b.jpg")
    joining.require_one_raster([one, other], "wall 0")
    moved = replace(other, frame=replace(other.frame, gsd_m=0.02))
    # This applies to any of the layers.
    for layers in ([one, moved], [one, other, moved]):
        with pytest.raises(MethodError, match=r"a\.jpg and b\.jpg of wall 0 have different"):
            joining.require_one_raster(layers, "wall 0")
    with pytest.raises(
        MethodError, match=r"^priority refers to c\.jpg, but the layers come from a\.jpg, b"
    ):
        joining.require_sources([other, one], ["b.jpg", "c.jpg"])
    joining.require_sources([other, one], ["b.jpg"])


def test_distances_in_large_layers_are_interpolated(monkeypatch: pytest.MonkeyPatch) -> None:
    shape = (120, 150)
    mask = np.full(shape, LayerMask.PAINTED, dtype=np.uint8)
    mask[:, :30] = LayerMask.OUTSIDE
    large = samples.layer(mask)
    options = PLAIN.model_copy(update={"seams": "voronoi"})
    (whole,) = joining.preferences([large], options)
    monkeypatch.setattr(joining, "BAND_CELLS", shape[0] * shape[1] // 8)
    (reduced,) = joining.preferences([large], options)
    rows = slice(0, shape[0])
    # With every third cell, the border of the painted area may be off by two cells.
    np.testing.assert_allclose(reduced(rows), whole(rows), atol=3.0)
    np.testing.assert_array_equal(reduced(slice(31, 60)), reduced(rows)[31:60])


def test_means_of_blocks_do_not_hang_on_the_bands(monkeypatch: pytest.MonkeyPatch) -> None:
    values = np.random.default_rng(1).normal(size=(48, 70))
    of = Blocks.over((48, 70), 10)
    monkeypatch.setattr(blocks, "row_bands", lambda _: [slice(0, 2), slice(2, 3), slice(3, 5)])
    found = blocks.block_means(lambda rows: values[rows], of)
    for row, column in np.ndindex(of.shape):
        cells = of.cells((slice(row, row + 1), slice(column, column + 1)))
        assert found[row, column] == pytest.approx(values[cells].mean())


def test_a_depth_edge_is_a_step_of_more_than_three_centimetres_right_or_down() -> None:
    depth_m = np.zeros((4, 5), dtype=np.float32)
    depth_m[:, 3:] = 0.031
    depth_m[2:, 0] = -0.029
    expected = np.zeros((4, 5), dtype=np.bool_)
    expected[:, 2] = True
    np.testing.assert_array_equal(depth_edges(depth_m), expected)
    depth_m[2:, 0] = -0.031
    expected[1, 0] = expected[2:, 0] = True
    np.testing.assert_array_equal(depth_edges(depth_m), expected)


def scene(edges: tuple[float, float] = (0.0, 0.0)) -> graph_cut.CutScene:
    """Return two layers of two cells: grey 0.2 and 0.5 in the first, 0.2 and 0.9 in the second."""
    colours = np.array([[[0.2, 0.2]], [[0.5, 0.9]]], dtype=np.float32)
    return graph_cut.CutScene(
        colours=np.repeat(colours[..., None], 3, axis=3),
        views=np.zeros((2, 1, 2)),
        edges=np.array([edges]),
    )


def cost(of: graph_cut.CutScene, one: int, other: int) -> float:
    p, q = np.array([0]), np.array([1])
    (found,) = graph_cut.seam_cost(of, p, q, np.array([one]), np.array([other]))
    return float(found)


def test_a_seam_costs_differences_on_both_sides_its_length_and_depth_edges() -> None:
    plain = cost(scene(), 0, 1)
    assert plain == cost(scene(), 1, 0) == pytest.approx(1000 * (0.3 + 0.7 + 0.01))
    assert cost(scene(), 0, 0) == cost(scene(), 1, 1) == 0.0
    # A depth edge on either side increases the cost.
    for edges in ((1.0, 0.0), (0.0, 1.0), (1.0, 1.0)):
        assert cost(scene(edges=edges), 0, 1) == plain + 1000 * sum(edges)
    # Where only one layer is painted, there is no visible difference.
    half = scene()
    half.views[1, 0, 0] = graph_cut.FORBIDDEN
    assert cost(half, 0, 1) == pytest.approx(1000 * (0.7 + 0.01))


def test_a_layer_takes_over_what_it_shows_better_for_less_than_the_seam() -> None:
    # Both layers have the same colours; the second is better in the right half of a row of ten
    # cells.
    colours = np.full((2, 1, 10, 3), 0.5, dtype=np.float32)
    views = np.zeros((2, 1, 10))
    views[0, 0, 5:], views[1, 0, :5] = 0.1, 0.1
    flat = graph_cut.CutScene(colours=colours, views=views, edges=np.zeros((1, 10)))
    labels = graph_cut.expanded(flat, np.zeros((1, 10), dtype=np.int64), 1)
    assert labels.tolist() == [[0] * 5 + [1] * 5]
    # If a single cell is better by less than the cost of its two seams, nothing changes.
    views[0] = 0.0
    views[0, 0, 4], views[1] = 0.015, 0.1
    views[1, 0, 4] = 0.0
    assert not graph_cut.expanded(flat, np.zeros((1, 10), dtype=np.int64), 1).any()


# --- reduced scale ---


def two_layers(shape: tuple[int, int]) -> list[Layer]:
    """Return two black layers; the second is half as good and empty in its first two columns."""
    masks = np.full((2, *shape), LayerMask.PAINTED, dtype=np.uint8)
    masks[1, :, :2] = LayerMask.OUTSIDE
    return [
        samples.layer(mask, quality=np.full(shape, quality, dtype=np.float32))
        for mask, quality in zip(masks, (2.0, 1.0), strict=True)
    ]


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_blocks_have_the_balanced_mean_of_painted_cells(dtype: type[np.unsignedinteger]) -> None:
    rng = np.random.default_rng(3)
    highest = int(np.iinfo(dtype).max)
    layers = []
    for each in two_layers((4, 6)):
        each.mask[1, 3:] = each.mask[3, 5] = LayerMask.OCCLUDED
        rgb = rng.integers(0, highest // 2, (4, 6, 3)).astype(dtype)
        rgb[each.mask != LayerMask.PAINTED] = 0
        layers.append(replace(each, rgb=rgb))
    # Sampled at the middle cell of each block.
    balance: Any = SimpleNamespace(
        log_gains=lambda k, rows, columns: (
            (0.1 * k + 0.2 * rows - 0.1 * columns)[:, None] * np.ones(3)
        )
    )
    plain, balanced = (
        graph_cut.reduced_scene(layers, None, Blocks.over((4, 6), 2), each).colours
        for each in (None, balance)
    )
    for k, row, column in np.ndindex(2, 2, 3):
        part = np.s_[2 * row : 2 * row + 2, 2 * column : 2 * column + 2]
        known = layers[k].rgb[part][layers[k].mask[part] == LayerMask.PAINTED]
        mean = known.mean(axis=0) / highest if len(known) else np.zeros(3)
        np.testing.assert_allclose(plain[k, row, column], mean, atol=1e-6)
        gain = np.full((1, 3), 0.1 * k + 0.2 * (2 * row + 1) - 0.1 * (2 * column + 1))
        wanted = lit_shares(mean[None], gain)[0]
        np.testing.assert_allclose(balanced[k, row, column], wanted, atol=1e-6)


PATCHED = (150, 210)


def plain_layer(
    quality: NDArray[np.float64] | float = 1.0,
    *,
    grey: NDArray[np.integer] | int = 0,
    mask: NDArray[np.uint8] | tuple[int, int] = (64, 64),
) -> Layer:
    plain = samples.layer(mask)
    values = np.where(plain.mask == LayerMask.PAINTED, quality, 0.0).astype(np.float32)
    rgb = np.repeat(np.broadcast_to(grey, plain.mask.shape)[..., None], 3, axis=2)
    return replace(plain, rgb=rgb.astype(np.uint8), quality=values)


# --- patches ---


def test_the_two_best_layers_of_a_patch_are_those_that_paint_all_of_it() -> None:
    rng = np.random.default_rng(1)
    layers = []
    for _ in range(4):
        mask = np.full(PATCHED, LayerMask.PAINTED, dtype=np.uint8)
        # In some patches, a single cell is missing.
        for row, column in rng.integers(0, (128, 192), (3, 2)):
            mask[row, column] = LayerMask.OCCLUDED
        layers.append(plain_layer(rng.uniform(0.5, 1.0, PATCHED), mask=mask))
    # As many patches of 64 cells as fit.
    wanted = []
    for row in (0, 64):
        for column in (0, 64, 128):
            part = np.s_[row : row + 64, column : column + 64]
            means = {
                k: float(one.quality[part].mean(dtype=np.float64))
                for k, one in enumerate(layers)
                if (one.mask[part] == LayerMask.PAINTED).all()
            }
            best = sorted(means, key=lambda k: -means[k])
            if len(best) >= 2:
                wanted.append((row, column, best[0], best[1]))
    assert 2 < len(wanted) <= 6
    assert agreement.patch_pairs(layers, of_all_pairs=False) == wanted
    assert agreement.patch_pairs(layers[:1], of_all_pairs=False) == []
    assert agreement.patch_pairs([plain_layer(mask=(63, 300))] * 2, of_all_pairs=False) == []
    for of_all_pairs, n_pairs in ((False, 1), (True, 3)):
        assert len(agreement.patch_pairs([plain_layer()] * 3, of_all_pairs=of_all_pairs)) == n_pairs


def texture(spread_grey: float) -> NDArray[np.float64]:
    """Return blurred noise of 64 x 64 cells and a margin, with a given standard deviation."""
    noise = np.random.default_rng(2).normal(size=(64, 70))
    blurred = cv2.GaussianBlur(noise, (0, 0), 1.0)
    part = blurred[:, :64]
    return 120.0 + spread_grey * (blurred - part.mean()) / part.std()


@pytest.mark.parametrize(("spread_grey", "n_found"), [(2.5, 0), (4.0, 1), (30.0, 1)])
def test_flat_patches_tell_no_displacement(spread_grey: float, n_found: int) -> None:
    whole = np.rint(texture(spread_grey))
    found = agreement.overlaps_of(
        [plain_layer(grey=whole[:, k : k + 64]) for k in (0, 2)]
    ).shifts_cells
    assert len(found) == n_found
    if n_found:
        np.testing.assert_allclose(found, [[-2.0, 0.0]], atol=0.4)


def test_a_peak_of_a_fifth_tells_and_one_of_a_tenth_does_not() -> None:
    rng = np.random.default_rng(4)
    one = rng.integers(0, 256, (64, 64))
    window = cv2.createHanningWindow((64, 64), cv2.CV_32F)
    sources: dict[str, int] = {}
    # Compare a patch with itself, mixed with others to an increasing degree.
    for weight in np.linspace(0.5, 1.0, 41):
        mixed = np.rint((1.0 - weight) * one + weight * rng.integers(0, 256, one.shape))
        peak = cv2.phaseCorrelate(one.astype("f4"), mixed.astype("f4"), window)[1]
        found = len(agreement.overlaps_of([plain_layer(grey=part) for part in (one, mixed)]).photos)
        if 0.16 < peak < 0.28:
            sources["fifth"] = found
        elif 0.07 < peak < 0.14:
            sources["tenth"] = found
    assert sources == {"fifth": 1, "tenth": 0}


@pytest.mark.parametrize("at_once", [1, 3, 1024])
@pytest.mark.parametrize("seed", seeds(2))
def test_seams_are_where_the_right_or_lower_neighbour_is_of_another(
    monkeypatch: pytest.MonkeyPatch, seed: int, at_once: int
) -> None:
    monkeypatch.setattr(agreement, "ROWS_AT_ONCE", at_once)
    rng = np.random.default_rng(seed)
    source = rng.integers(-1, 3, (11, 9)).astype(np.int16)
    seam = np.zeros(source.shape, dtype=np.bool_)
    for axis in (0, 1):
        later = np.full_like(source, -1)
        later[np.s_[:-1] if axis == 0 else np.s_[:, :-1]] = np.delete(source, 0, axis=axis)
        before = (source != later) & (source != -1) & (later != -1)
        found = np.array(agreement.cells_before_seams(source, axis)).T
        np.testing.assert_array_equal(found[np.lexsort(found.T[::-1])], np.argwhere(before))
        seam |= before
    np.testing.assert_array_equal(agreement.is_seam(source), seam)
    depth_m = rng.uniform(0.0, 0.06, source.shape).astype(np.float32)
    n_edges = np.count_nonzero(seam & depth_edges(depth_m))
    assert agreement.count_seams(source, depth_m) == (seam.sum(), n_edges)
    assert agreement.count_seams(source, None) == (seam.sum(), 0)
