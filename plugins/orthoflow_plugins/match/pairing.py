"""Candidates of one photo on the walls: which walls it shows, at which scale it is matched best."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow_plugins.match.features import FeatureRule, Features, find_features
from orthoflow_plugins.match.neighbours import Matches, mutual_matches
from orthoflow_plugins.match.pictures import equalised, shrunk
from orthoflow_plugins.match.rematching import Expectation, rematched

# A photo is tried at this size first, then at twice, until a wall is recognised.
_FIRST_SIDE_PX: Final = 1000
# The homography of a wall with relief is only roughly right: share of the photo's diagonal.
_LOOSE_SHARE: Final = 0.02
_SEED: Final = 1


@dataclass(frozen=True, kw_only=True)
class PairingRule:
    """How photos are paired with walls.

    Attributes:
        features: how key points are found.
        ratio_most: of the distances of best and second best.
        n_verified_least: ties that agree with one homography, for a wall to count as shown.
        longest_side_px: larger photos are shrunk to this.
        clip_limit: of the local equalisation.
    """

    features: FeatureRule
    ratio_most: float
    n_verified_least: int
    longest_side_px: int
    clip_limit: float


@dataclass(frozen=True, kw_only=True)
class Pair:
    """Matches of a photo with one wall.

    Attributes:
        wall: index of the wall.
        matches: first = key points of the photo, second = of the wall.
        agreeing: (n,) bool, which agree with one homography, roughly.
        is_shown: enough agree, and the wall is not seen from behind.
        homography: (3, 3) photo pixels from wall pixels, roughly, of a wall that is shown.
    """

    wall: int
    matches: Matches
    agreeing: NDArray[np.bool_]
    is_shown: bool
    homography: NDArray[np.float64] | None = None


@dataclass(frozen=True, kw_only=True)
class PhotoPairs:
    """What the walls share with a photo.

    Attributes:
        features: key points of the photo, pixels of the full image.
        scale: the photo was matched shrunk by this.
        pairs: one per wall that had matches.
        radius_px: matches were also searched so far from where a homography puts them; a wrong
            one's matches lie evenly within this.
        is_mirrored: the walls recognise the mirrored photo better; then none counts as shown.
    """

    features: Features
    scale: float
    pairs: tuple[Pair, ...]
    radius_px: float
    is_mirrored: bool = False

    @property
    def n_verified(self) -> int:
        """Ties that agree, over the walls shown."""
        return sum(int(pair.agreeing.sum()) for pair in self.pairs if pair.is_shown)


def pair_photo(
    grey: NDArray[np.uint8], walls: Sequence[Features | None], rule: PairingRule
) -> PhotoPairs:
    """Match a photo with walls, coarse to fine, then once more at the walls' own resolution.

    Key points of a photo much finer than the raster find no partner there, but many false ones;
    at one cell per pixel both show the same detail (domain measurements: 2 to 5 times the ties).

    Args:
        grey: (height, width) of the photo.
        walls: key points per wall, None where it shows nothing.
        rule: how.
    """
    longest = max(grey.shape)
    finest = min(1.0, rule.longest_side_px / longest)
    scale = min(finest, _FIRST_SIDE_PX / longest)
    best = _pairs_at(grey, scale, walls, rule)
    while best.n_verified < rule.n_verified_least and scale < finest:
        scale = min(finest, 2.0 * scale)
        tried = _pairs_at(grey, scale, walls, rule)
        if tried.n_verified >= best.n_verified:
            best = tried
    wanted = min(finest, best.scale * _cells_per_pixel(best, walls))
    if best.n_verified and abs(math.log(wanted / best.scale)) > 0.15:
        tried = _pairs_at(grey, wanted, walls, rule)
        if tried.n_verified > best.n_verified:
            best = tried
    if best.n_verified and _n_verified_mirrored(best, grey.shape[1], walls, rule) > best.n_verified:
        refused = tuple(replace(pair, is_shown=False, homography=None) for pair in best.pairs)
        return replace(best, pairs=refused, is_mirrored=True)
    return _completed(best, walls, rule)


def _pairs_at(
    grey: NDArray[np.uint8], scale: float, walls: Sequence[Features | None], rule: PairingRule
) -> PhotoPairs:
    small = equalised(shrunk(grey, scale), rule.clip_limit)
    features = find_features(small, rule.features).scaled(1.0 / scale)
    loose_px = _LOOSE_SHARE * math.hypot(*grey.shape)
    pairs = []
    for index, wall in enumerate(walls):
        if wall is None:
            continue
        matches = mutual_matches(features.descriptors, wall.descriptors, ratio_most=rule.ratio_most)
        if len(matches):
            pairs.append(_verified(index, matches, features, wall, (loose_px, rule)))
    return PhotoPairs(features=features, scale=scale, pairs=tuple(pairs), radius_px=loose_px)


def _n_verified_mirrored(
    pairs: PhotoPairs, width_px: int, walls: Sequence[Features | None], rule: PairingRule
) -> int:
    """Matches that would agree, over the walls shown, had the photo been mirrored.

    A front that is symmetric matches its own mirror image in part, and the pose found would look
    right where it is.
    """
    mirrored = pairs.features.mirrored(width_px)
    total = 0
    for index, wall in enumerate(walls):
        if wall is None:
            continue
        matches = mutual_matches(mirrored.descriptors, wall.descriptors, ratio_most=rule.ratio_most)
        limits = (pairs.radius_px, rule)
        pair = _verified(index, matches, mirrored, wall, limits)
        total += int(pair.agreeing.sum()) if pair.is_shown else 0
    return total


def _verified(
    index: int,
    matches: Matches,
    features: Features,
    wall: Features,
    limits: tuple[float, PairingRule],
) -> Pair:
    loose_px, rule = limits
    source, target = wall.pixels[matches.second], features.pixels[matches.first]
    agreeing = np.zeros(len(matches), dtype=np.bool_)
    homography = None
    if len(matches) >= 4:
        homography = _homography(source, target, matches.ratio, loose_px)
    if homography is not None:
        with np.errstate(divide="ignore", invalid="ignore"):
            agreeing = np.hypot(*(_mapped(homography, source) - target).T) < loose_px
    # Many key points of a texture may fall on one place of the other image: count places.
    n_places = min(_n_places(source[agreeing], 2.0), _n_places(target[agreeing], 2.0))
    if (
        homography is None
        or n_places < rule.n_verified_least
        or not _is_from_the_front(homography, source[agreeing].mean(axis=0))
    ):
        return Pair(wall=index, matches=matches, agreeing=agreeing, is_shown=False)
    return Pair(
        wall=index, matches=matches, agreeing=agreeing, is_shown=True, homography=homography
    )


def _completed(
    pairs: PhotoPairs, walls: Sequence[Features | None], rule: PairingRule
) -> PhotoPairs:
    """Add what a second look finds, each key point only where the homography roughly puts it."""
    completed = []
    for pair in pairs.pairs:
        wall = walls[pair.wall]
        if pair.homography is None or wall is None:
            completed.append(pair)
            continue
        expected = _mapped(pair.homography, wall.pixels)
        matches = rematched(
            pair.matches,
            (pairs.features, wall),
            Expectation(pixels=expected, agreeing=pair.agreeing, radius_px=pairs.radius_px),
            ratio_most=rule.ratio_most,
        )
        offsets = expected[matches.second] - pairs.features.pixels[matches.first]
        agreeing = np.hypot(*offsets.T) < pairs.radius_px
        completed.append(replace(pair, matches=matches, agreeing=agreeing))
    return replace(pairs, pairs=tuple(completed))


def _homography(
    source: NDArray[np.float64],
    target: NDArray[np.float64],
    ratio: NDArray[np.float64],
    loose_px: float,
) -> NDArray[np.float64] | None:
    import cv2

    params: Any = cv2.UsacParams()
    params.threshold = loose_px
    params.maxIterations = 10_000
    params.confidence = 0.9999
    params.randomGeneratorState = _SEED
    params.sampler = cv2.SAMPLING_PROSAC  # takes the matches in the order of their quality
    params.score = cv2.SCORE_METHOD_MSAC
    params.loMethod = cv2.LOCAL_OPTIM_INNER_LO
    order = np.argsort(ratio, kind="stable")
    try:
        found: Any = cv2.findHomography(source[order], target[order], params)[0]
    except cv2.error:  # all points on a line
        return None
    matrix: NDArray[np.float64] | None = found
    return matrix


def _mapped(homography: NDArray[np.float64], pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    lifted = np.column_stack([pixels, np.ones(len(pixels))]) @ homography.T
    mapped: NDArray[np.float64] = lifted[:, :2] / lifted[:, 2:]
    return mapped


def _is_from_the_front(homography: NDArray[np.float64], at: NDArray[np.float64]) -> bool:
    """Whether the wall keeps its sense of rotation in the photo; from behind it is mirrored."""
    here = _mapped(homography, at[None])[0]
    right, down = _mapped(homography, at + np.eye(2)) - here
    return bool(right[0] * down[1] - right[1] * down[0] > 0.0)


def _n_places(pixels: NDArray[np.float64], cell_px: float) -> int:
    return len(np.unique(np.floor(pixels / cell_px), axis=0))


def _cells_per_pixel(pairs: PhotoPairs, walls: Sequence[Features | None]) -> float:
    """How many wall cells a pixel of the photo, as it was matched, is wide."""
    ratios = [
        wall.sizes_px[pair.matches.second[pair.agreeing]]
        / (pairs.features.sizes_px[pair.matches.first[pair.agreeing]] * pairs.scale)
        for pair in pairs.pairs
        if pair.is_shown and (wall := walls[pair.wall]) is not None
    ]
    return float(np.median(np.concatenate(ratios))) if ratios else 1.0
