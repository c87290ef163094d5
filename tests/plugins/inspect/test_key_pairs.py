"""Pairs of key points: who is whose clear best, and whom the neighbours believe."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.inspect import key_pairs
from orthoflow_plugins.inspect.image_quality import OrthoimageGrey
from orthoflow_plugins.inspect.key_pairs import find_key_pairs

from tests.inspect_scenes import displaced


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


@pytest.mark.parametrize("nothing", ["first", "second", "likes"])
def test_without_candidates_there_are_no_pairs(nothing: str) -> None:
    some, none = points([(10, 10)]), points([], descriptors=[[0.0] * 8])
    other = points([(10, 10)], sign=[-1.0])
    first, second = {"first": (none, some), "second": (some, none), "likes": (some, other)}[nothing]
    assert key_pairs._matches(first, second, 5.0).shape == (0, 2)


def lattice(n: int, step: float) -> NDArray[np.float64]:
    rows, columns = np.divmod(np.arange(n), 5)
    return step * np.column_stack([columns, rows]).astype(np.float64)


def test_of_few_pairs_two_others_must_agree() -> None:
    shift = np.zeros((3, 2))
    assert key_pairs._agreed(lattice(3, 10.0), shift).all()
    assert not key_pairs._agreed(lattice(2, 10.0), shift[:2]).any()
    shift[2] = 5.0
    assert not key_pairs._agreed(lattice(3, 10.0), shift).any()


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
