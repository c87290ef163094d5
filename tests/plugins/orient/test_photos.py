"""Which ties a photo is oriented by, and whose word counts: a person's or the matcher's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from orthoflow_plugins.orient import photos
from orthoflow_plugins.orient.pose import OrientParams, image_cells

from orthoflow.errors import MethodError
from orthoflow.products import Photo, Photos, TieRole, Ties
from tests import samples


def ties(n: int = 12) -> Ties:
    """Ties of two photos in turn, their pixels numbered."""
    at = np.arange(n)
    return samples.ties(
        np.column_stack([at, 10.0 * at]).astype(np.float64),
        photo_names=("a", "b"),
        photo=(at % 2).astype(np.int32),
        points_world=np.zeros((n, 3)),
        sigma_px=0.1 + at,
        sigma_m=0.001 + at,
        role=np.full(n, TieRole.CONTROL, dtype=np.uint8),
    )


def photo(name: str) -> Photo:
    return Photo(name=name, encoded=b"", width=100, height=100)


def test_what_no_orientation_can_start_from_is_refused() -> None:
    both = Photos(photos=(photo("a"), photo("b")))
    photos.require(ties(), both)
    with pytest.raises(MethodError, match="there are no photos to orient"):
        photos.require(ties(), Photos(photos=()))
    with pytest.raises(MethodError, match="there are no ties between photos and walls"):
        photos.require(ties(0), both)
    with pytest.raises(MethodError, match="the ties refer to photo b, which is not among"):
        photos.require(ties(), Photos(photos=(photo("a"),)))


def test_ties_are_split_so_that_nothing_by_hand_is_withheld() -> None:
    by_hand = np.zeros(400, dtype=np.uint8)
    by_hand[:40] = 1
    of = replace(ties(400), by_hand=by_hand)
    params = OrientParams()
    tied = photos.tied_photo(photo("a"), of, params, np.random.default_rng(1))
    np.testing.assert_array_equal(tied.chosen, np.arange(0, 400, 2))
    np.testing.assert_array_equal(tied.by_hand, by_hand[::2] > 0)
    assert not (tied.is_check & tied.by_hand).any()
    share = tied.is_check.sum() / (~tied.by_hand).sum()
    assert share == pytest.approx(params.check_share, abs=0.1)
    np.testing.assert_array_equal(tied.seen.pixels_photo, of.pixels_photo[::2])
    np.testing.assert_array_equal(tied.seen.sigma_px, of.sigma_px[::2])
    np.testing.assert_array_equal(tied.seen.sigma_m, of.sigma_m[::2])
    plain = photos.tied_photo(photo("a"), ties(400), params, np.random.default_rng(1))
    assert not plain.by_hand.any()


def test_rejected_ties_are_not_used() -> None:
    of = ties(24)
    of.role[[0, 4]] = TieRole.REJECTED
    of.role[2] = TieRole.CHECK
    tied = photos.tied_photo(photo("a"), of, OrientParams(), np.random.default_rng(1))
    assert tied.chosen.tolist() == [2, 6, 8, 10, 12, 14, 16, 18, 20, 22]


@pytest.mark.parametrize(("share", "n_check"), [(0.2, 144), (0.25, 180), (0.001, 1), (0.0, 0)])
def test_check_points_are_withheld_evenly(share: float, n_check: int) -> None:
    rng = np.random.default_rng(0)
    # Twenty ties in each of six by six cells.
    corner = np.stack(np.meshgrid(np.arange(6), np.arange(6)), axis=-1).reshape(-1, 1, 2)
    pixels = (100.0 * (corner + rng.random((36, 20, 2)))).reshape(-1, 2)
    chosen = photos.withheld(pixels, (600, 600), share, rng)
    assert chosen.sum() == n_check
    counts = np.bincount(image_cells(pixels[chosen], (600, 600), 6), minlength=36)
    assert np.abs(counts - share * 20).max() <= 1.0
    # Which ones is left to chance.
    other = photos.withheld(pixels, (600, 600), share, rng)
    assert n_check == 0 or (other != chosen).any()
    assert photos.withheld(pixels[:0], (600, 600), 0.5, rng).shape == (0,)
