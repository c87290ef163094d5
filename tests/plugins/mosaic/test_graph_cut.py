"""What graph cuts are made of: blocks, depth edges and the costs of seams."""

from __future__ import annotations

import itertools
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from orthoflow_plugins.mosaic import blocks, graph_cut
from orthoflow_plugins.mosaic.blocks import Blocks, depth_edges, depth_edges_in

from orthoflow.geometry.levels import lit_shares
from orthoflow.products import LayerMask


def test_means_of_blocks_do_not_hang_on_the_bands(monkeypatch: pytest.MonkeyPatch) -> None:
    values = np.random.default_rng(1).normal(size=(48, 70))
    of = Blocks.over((48, 70), 10)
    monkeypatch.setattr(blocks, "row_bands", lambda _: [slice(0, 2), slice(2, 3), slice(3, 5)])
    found = blocks.block_means(lambda rows: values[rows], of)
    for row, column in np.ndindex(of.shape):
        cells = of.cells((slice(row, row + 1), slice(column, column + 1)))
        assert found[row, column] == pytest.approx(values[cells].mean())


def test_depth_edges_of_some_rows_are_those_of_the_whole() -> None:
    depth_m = np.random.default_rng(2).choice([0.0, 0.02, 0.05], (12, 7)).astype(np.float32)
    one = depth_edges(depth_m)
    # On either side of an edge: right and down, left and up.
    either = one | depth_edges(depth_m[::-1, ::-1])[::-1, ::-1]
    for parts in ((0, 12), (0, 1, 5, 12), (0, 3, 4, 11, 12)):
        found = [
            depth_edges_in(depth_m, slice(start, stop)) for start, stop in itertools.pairwise(parts)
        ]
        np.testing.assert_array_equal(np.concatenate(found), either)


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


def scene(edges: tuple[float, float] = (0.0, 0.0)) -> graph_cut._Scene:
    """Two layers of two cells: grey 0.2 and 0.5 in the first, 0.2 and 0.9 in the second cell."""
    colours = np.array([[[0.2, 0.2]], [[0.5, 0.9]]], dtype=np.float32)
    return graph_cut._Scene(
        colours=np.repeat(colours[..., None], 3, axis=3),
        views=np.zeros((2, 1, 2)),
        edges=np.array([edges]),
    )


def cost(of: graph_cut._Scene, one: int, other: int) -> float:
    p, q = np.array([0]), np.array([1])
    (found,) = graph_cut._seam_cost(of, p, q, np.array([one]), np.array([other]))
    return float(found)


def test_a_seam_costs_differences_on_both_sides_its_length_and_depth_edges() -> None:
    plain = cost(scene(), 0, 1)
    assert plain == cost(scene(), 1, 0) == pytest.approx(1000 * (0.3 + 0.7 + 0.01))
    assert cost(scene(), 0, 0) == cost(scene(), 1, 1) == 0.0
    # A depth edge on either side makes it dear.
    for edges in ((1.0, 0.0), (0.0, 1.0), (1.0, 1.0)):
        assert cost(scene(edges=edges), 0, 1) == plain + 1000 * sum(edges)
    # Where only one layer paints no difference is seen.
    half = scene()
    half.views[1, 0, 0] = graph_cut._FORBIDDEN
    assert cost(half, 0, 1) == pytest.approx(1000 * (0.7 + 0.01))


def test_a_layer_takes_over_what_it_shows_better_for_less_than_the_seam() -> None:
    # Both show the same; the second is the better one in the right half of a row of ten.
    colours = np.full((2, 1, 10, 3), 0.5, dtype=np.float32)
    views = np.zeros((2, 1, 10))
    views[0, 0, 5:], views[1, 0, :5] = 0.1, 0.1
    flat = graph_cut._Scene(colours=colours, views=views, edges=np.zeros((1, 10)))
    labels = graph_cut._expanded(flat, np.zeros((1, 10), dtype=np.int64), 1)
    assert labels.tolist() == [[0] * 5 + [1] * 5]
    # For one cell that is better by less than the length of its two seams nothing moves.
    views[0] = 0.0
    views[0, 0, 4], views[1] = 0.015, 0.1
    views[1, 0, 4] = 0.0
    assert not graph_cut._expanded(flat, np.zeros((1, 10), dtype=np.int64), 1).any()


# --- the smaller picture ---


def two_layers(shape: tuple[int, int], greys: tuple[int, int]) -> list[Any]:
    """Two layers of even greys, the second half as good, with nothing in its first two columns."""
    found = []
    for grey, quality in zip(greys, (2.0, 1.0), strict=True):
        mask = np.full(shape, LayerMask.PAINTED, dtype=np.uint8)
        if quality == 1.0:
            mask[:, :2] = LayerMask.OUTSIDE
        found.append(
            SimpleNamespace(
                frame=SimpleNamespace(shape=shape),
                rgb=np.full((*shape, 3), grey, dtype=np.uint8),
                mask=mask,
                quality=np.full(shape, quality, dtype=np.float32),
            )
        )
    return found


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_blocks_have_the_mean_colour_of_what_is_painted_as_it_is_balanced(
    dtype: type[np.unsignedinteger],
) -> None:
    rng = np.random.default_rng(3)
    highest = int(np.iinfo(dtype).max)
    layers = two_layers((4, 6), (0, 0))
    for layer in layers:
        layer.rgb = rng.integers(0, highest // 2, (4, 6, 3)).astype(dtype)
        layer.mask[1, 3:] = layer.mask[3, 5] = LayerMask.OCCLUDED
        layer.rgb[layer.mask != LayerMask.PAINTED] = 0
    blocks_of = Blocks.over((4, 6), 2)
    means = np.zeros((2, 2, 3, 3))
    for k, row, column in np.ndindex(2, 2, 3):
        part = np.s_[2 * row : 2 * row + 2, 2 * column : 2 * column + 2]
        known = layers[k].rgb[part][layers[k].mask[part] == LayerMask.PAINTED]
        means[k, row, column] = known.mean(axis=0) / highest if len(known) else 0.0
    plain = graph_cut._reduced(layers, None, blocks_of, None)
    np.testing.assert_allclose(plain.colours, means, atol=1e-6)
    # Each in the cell in the middle of its block.
    balance: Any = SimpleNamespace(
        log_gains=lambda k, rows, columns: (
            (0.1 * k + 0.2 * rows - 0.1 * columns)[:, None] * np.ones(3)
        )
    )
    balanced = graph_cut._reduced(layers, None, blocks_of, balance)
    for k, row, column in np.ndindex(2, 2, 3):
        gain = np.full((1, 3), 0.1 * k + 0.2 * (2 * row + 1) - 0.1 * (2 * column + 1))
        wanted = lit_shares(means[k, row, column][None], gain)[0]
        np.testing.assert_allclose(balanced.colours[k, row, column], wanted, atol=1e-6)


@pytest.mark.parametrize(
    ("shape", "small"), [((100, 300), (100, 300)), ((200, 300), (100, 150)), ((8, 9), (8, 9))]
)
def test_cuts_are_made_on_some_ten_thousand_cells_that_a_layer_paints(
    monkeypatch: pytest.MonkeyPatch, shape: tuple[int, int], small: tuple[int, int]
) -> None:
    monkeypatch.setattr(graph_cut, "_expanded", lambda _scene, labels, _alpha: labels)
    layers = two_layers(shape, (9, 9))
    for layer in layers:
        layer.mask[:, -2:] = LayerMask.OUTSIDE
    labels = graph_cut.cut_labels(layers, None)
    assert labels.small.shape == small
    # What is left where nothing moves: the better one everywhere, none where none paints.
    assert not labels.small[:, :-2].any()
    assert (labels.in_rows(slice(0, 2)).shape, labels.small[0, -1]) == ((2, shape[1]), -1)
