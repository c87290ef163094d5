"""Pairs of key points: who is whose clear best, and whom the neighbours believe."""

from __future__ import annotations

import dataclasses
import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.inspect import key_pairs, patches
from orthoflow_plugins.inspect.image_quality import OrthoimageGrey
from orthoflow_plugins.inspect.key_pairs import find_key_pairs
from orthoflow_plugins.inspect.patches import GreyImage

from tests import inspect_scenes
from tests.inspect_scenes import displaced


def winners(pairs: list[tuple[int, float]]) -> list[bool]:
    owner, apart = zip(*pairs, strict=True)
    return list(key_pairs._clear_winners(np.array(owner), np.array(apart), 4))


def test_the_nearest_of_an_owner_wins_where_the_second_is_clearly_farther() -> None:
    # Owner 0: 0.8 before 1.0; owner 1: 0.95 before 1.0; owner 3: the only one.
    pairs = [(0, 1.0), (0, 0.8), (1, 0.95), (1, 1.0), (3, 7.0)]
    assert winners(pairs) == [False, True, False, False, True]


def test_a_tenth_nearer_is_clear_and_a_third_one_has_no_say() -> None:
    assert winners([(2, 0.9), (2, 1.0), (2, 5.0)]) == [True, False, False]
    assert winners([(2, 5.0), (2, 0.901), (2, 1.0)]) == [False, False, False]


def points(
    places: list[tuple[float, float]],
    *,
    scale: list[float] | None = None,
    sign: list[float] | None = None,
    descriptors: list[list[float]] | None = None,
) -> key_pairs._KeyPoints:
    count = len(places)
    return key_pairs._KeyPoints(
        places=np.array(places, dtype=np.float64).reshape(count, 2),
        scale=np.array(scale or [2.0] * count),
        sign=np.array(sign or [1.0] * count),
        descriptors=np.array(descriptors or np.eye(8)[:count]),
    )


def test_points_of_like_descriptors_scale_and_sign_within_the_radius_are_pairs() -> None:
    shown = points([(10, 10), (50, 10), (90, 10), (130, 10)])
    reference = points(
        [(13, 14), (50, 16), (90, 10), (130, 10)],
        # The third is of another scale, the fourth dark instead of light.
        scale=[2.9, 2.0, 3.1, 2.0],
        sign=[1.0, 1.0, 1.0, -1.0],
    )
    assert key_pairs._matches(shown, reference, 5.5).tolist() == [[0, 0]]
    assert key_pairs._matches(shown, reference, 6.5).tolist() == [[0, 0], [1, 1]]


def test_both_must_be_each_others_best() -> None:
    shown = points([(10, 10), (12, 10)], descriptors=[[1.0, 0.0], [0.9, 0.0]])
    reference = points([(11, 10)], descriptors=[[1.0, 0.0]])
    assert key_pairs._matches(shown, reference, 5.0).tolist() == [[0, 0]]


@pytest.mark.parametrize("nothing", ["first", "second", "likes"])
def test_without_candidates_there_are_no_pairs(nothing: str) -> None:
    some, none = points([(10, 10)]), points([], descriptors=[[0.0] * 8])
    other = points([(10, 10)], sign=[-1.0])
    first, second = {"first": (none, some), "second": (some, none), "likes": (some, other)}[nothing]
    assert key_pairs._matches(first, second, 5.0).shape == (0, 2)


def test_distances_of_descriptors_are_those_of_their_pairs() -> None:
    first = np.array([[0.0, 0.0], [3.0, 4.0]])
    second = np.array([[0.0, 0.0], [0.0, 4.0], [3.0, 0.0]])
    one, other = np.array([1, 1, 0]), np.array([0, 2, 1])
    apart = key_pairs._descriptor_distances(first, second, one, other)
    np.testing.assert_allclose(apart, [5.0, 4.0, 4.0])
    # More pairs than are looked at together.
    many = np.tile([1, 0], 40_000), np.tile([0, 1], 40_000)
    apart = key_pairs._descriptor_distances(first, second, *many)
    np.testing.assert_allclose(apart, np.tile([5.0, 4.0], 40_000))


def lattice(n: int, step: float) -> NDArray[np.float64]:
    rows, columns = np.divmod(np.arange(n), 5)
    return step * np.column_stack([columns, rows]).astype(np.float64)


def test_a_pair_is_believed_when_a_quarter_of_its_neighbours_agree() -> None:
    places = lattice(17, 10.0)
    shift = 10.0 * np.arange(34.0).reshape(17, 2)  # nobody agrees with anybody
    shift[:4] = [1.0, 1.0]
    # Sixteen neighbours each: three agree, four are needed.
    assert not key_pairs._agreed(places, shift).any()
    shift[4] = [1.9, 1.0]
    assert key_pairs._agreed(places, shift).tolist() == [True] * 5 + [False] * 12
    shift[4] = [2.1, 1.0]
    assert not key_pairs._agreed(places, shift).any()


def test_of_few_pairs_two_others_must_agree() -> None:
    shift = np.zeros((3, 2))
    assert key_pairs._agreed(lattice(3, 10.0), shift).all()
    assert not key_pairs._agreed(lattice(2, 10.0), shift[:2]).any()
    shift[2] = 5.0
    assert not key_pairs._agreed(lattice(3, 10.0), shift).any()


def test_the_same_place_at_another_scale_is_no_witness() -> None:
    assert not key_pairs._agreed(lattice(3, 3.9), np.zeros((3, 2))).any()
    assert key_pairs._agreed(lattice(3, 8.1), np.zeros((3, 2))).all()


def test_witnesses_must_be_believed_themselves() -> None:
    # A chain: each agrees with its neighbours only, so that it falls apart from its ends.
    shift = np.column_stack([0.9 * np.arange(5.0), np.zeros(5)])
    assert not key_pairs._agreed(lattice(5, 10.0), shift).any()


def test_local_mean_and_spread_become_those_of_all_pictures() -> None:
    rng = np.random.default_rng(4)
    grey = 20.0 + 3.0 * rng.normal(size=(120, 120))
    grey[:, 60:] = 200.0 + 9.0 * rng.normal(size=(120, 60))
    valid = np.ones(grey.shape, dtype=np.bool_)
    valid[:4] = False
    image = GreyImage(grey=grey, valid=valid, region=valid)
    level = key_pairs._levelled(image)
    for part in (np.s_[40:80, :30], np.s_[40:80, 90:]):
        assert level.grey[part].mean() == pytest.approx(128.0, abs=2.0)
        assert level.grey[part].std() == pytest.approx(40.0, abs=3.0)
    assert (level.grey[:4] == 128.0).all()
    assert level.grey.min() >= 0.0
    assert level.grey.max() <= 255.0


def test_what_hardly_varies_is_not_blown_up() -> None:
    grey = 100.0 + 0.1 * np.random.default_rng(5).normal(size=(100, 100))
    everywhere = np.ones(grey.shape, dtype=np.bool_)
    level = key_pairs._levelled(GreyImage(grey=grey, valid=everywhere, region=everywhere))
    # A spread of 0.1 grey is taken for two.
    assert level.grey[40:60, 40:60].std() == pytest.approx(40.0 * 0.1 / 2.0, rel=0.15)


def test_patch_means_are_shares_of_a_square_about_the_place() -> None:
    valid = np.zeros((100, 100), dtype=np.float32)
    valid[:, 50:] = 1.0
    places = np.array([[20.5, 50.5], [50.5, 50.5], [58.5, 50.5], [80.5, 50.5]])
    np.testing.assert_allclose(key_pairs._patch_means(valid, places), [0.0, 0.5, 0.75, 1.0])


def test_tiles_of_large_pictures_give_the_pairs_of_the_whole(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    shown, true = (OrthoimageGrey(displaced(*by)) for by in ((1.4, -0.6), (0.0, 0.0)))
    whole = find_key_pairs(shown, true, radius_cells=40.0)
    monkeypatch.setattr(key_pairs, "_WHOLE_CELLS", 1000)
    monkeypatch.setattr(key_pairs, "_TILE_CELLS", 150)
    # What the widest descriptors look at fits in, so that all points are those of the whole.
    monkeypatch.setattr(key_pairs, "_SURF_RIM_CELLS", 400)
    tiled = find_key_pairs(shown, true, radius_cells=40.0)
    assert tiled.n_points == whole.n_points
    assert tiled.n_matched == whole.n_matched
    assert len(tiled) == len(whole) >= 50
    by_place = [np.lexsort((*pairs.places.T, *pairs.found.T)) for pairs in (tiled, whole)]
    for name in ("places", "found", "shift"):
        one, other = (
            getattr(pairs, name)[order]
            for pairs, order in zip((tiled, whole), by_place, strict=True)
        )
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-6, err_msg=name)


def test_large_pictures_take_the_memory_of_a_tile(monkeypatch: pytest.MonkeyPatch) -> None:
    image = displaced(1.4, -0.6)
    image = dataclasses.replace(
        image,
        frame=inspect_scenes.frame(shape=(560, 720)),
        rgb=np.tile(image.rgb, (2, 2, 1)),
        mask=np.tile(image.mask, (2, 2)),
        source=np.tile(image.source, (2, 2)),
    )
    monkeypatch.setattr(key_pairs, "_WHOLE_CELLS", 1000)
    monkeypatch.setattr(key_pairs, "_TILE_CELLS", 200)
    monkeypatch.setattr(key_pairs, "_SURF_RIM_CELLS", 64)
    monkeypatch.setattr(key_pairs, "_RIM_CELLS", 40)
    monkeypatch.setattr(patches, "_AT_ONCE", 100)
    grey = OrthoimageGrey(image)
    find_key_pairs(OrthoimageGrey(displaced(0.0, 0.0)), grey, radius_cells=30.0)  # loaded
    tracemalloc.start()
    try:
        pairs = find_key_pairs(grey, grey, radius_cells=30.0)
        # A whole picture takes more than 200 bytes a cell.
        assert tracemalloc.get_traced_memory()[1] < 70 * image.mask.size
    finally:
        tracemalloc.stop()
    assert len(pairs) > 300
    np.testing.assert_allclose(pairs.shift, 0.0, atol=1e-3)


def test_a_quarter_of_the_sixteen_nearest_must_agree() -> None:
    # In the corner of a lattice the four along one side are the 1st to the 16th nearest.
    shift = 10.0 * np.arange(60.0).reshape(30, 2)
    shift[:5] = [1.0, 1.0]
    agreed = key_pairs._agreed(lattice(30, 10.0), shift)
    assert agreed[0]
    assert not agreed[5:].any()


def test_single_bright_and_dark_cells_are_as_bright_and_dark_as_can_be() -> None:
    grey = 100.0 + 3.0 * np.random.default_rng(6).normal(size=(80, 80))
    grey[30, 30], grey[50, 50] = 250.0, 0.0
    everywhere = np.ones(grey.shape, dtype=np.bool_)
    level = key_pairs._levelled(GreyImage(grey=grey, valid=everywhere, region=everywhere))
    assert (level.grey[30, 30], level.grey[50, 50]) == (255.0, 0.0)


@pytest.mark.parametrize(
    ("shape", "n_most"), [((100, 120), 500), ((400, 500), 1000), ((4000, 4000), 40_000)]
)
def test_large_pictures_have_more_key_points_up_to_a_limit(
    shape: tuple[int, int], n_most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    from mahotas.features import surf

    asked = []

    def find(_grey: object, *, max_points: int, **_: object) -> NDArray[np.float64]:
        asked.append(max_points)
        return np.zeros((0, 70))

    monkeypatch.setattr(surf, "surf", find)
    small = np.zeros((40, 40))
    cells = SimpleNamespace(shape=shape, whole=lambda: SimpleNamespace(grey=small, valid=small))
    key_pairs._key_points(cells)  # type: ignore[arg-type]
    assert asked == [n_most]


def test_tiles_take_no_more_with_what_is_about_them_than_what_is_taken_whole() -> None:
    shape = (10_000, 7_000)
    cut = [*key_pairs._tiles(shape)]
    assert len(cut) > 1
    for tile in cut:
        rows, columns = key_pairs._widened(tile, key_pairs._SURF_RIM_CELLS, shape)
        around = (rows.stop - rows.start, columns.stop - columns.start)
        assert len([*key_pairs._tiles(around)]) == 1
    assert len([*key_pairs._tiles((4096, 4096))]) == 1
    assert len([*key_pairs._tiles((4097, 4096))]) > 1
