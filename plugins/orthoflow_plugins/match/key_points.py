"""Matching of photos with walls by key points, with mirrored photos and mixtures of colours."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from orthoflow.files.images import photo_grey, photo_rgb, reduced
from orthoflow.geometry.key_points import (
    Features,
    Matches,
    Window,
    find_features,
    mutual_matches,
    mutual_matches_within,
)
from orthoflow.products import Photo, Wall
from orthoflow.sdk import MethodParams
from orthoflow_plugins.match.pictures import CLIP_LIMIT, equalised, wall_picture

# A photo is first matched at this size, which is doubled until a wall is recognised.
_FIRST_SIDE_PX: Final = 800
# These numbers of key points, in a photo and on each wall, are enough to recognise the walls.
_FIRST_IN_PHOTO: Final = 3000
_FIRST_ON_WALL: Final = 4000
# Tolerance relative to the diagonal of the photo, since a homography is only approximate on relief.
_LOOSE_SHARE: Final = 0.02
# Scale-invariant key points tolerate a ratio of 1.4 between the sizes of pixels and cells.
_LOG_SCALE_APART: Final = 0.35
# Tolerances in the guided match for the size (log2) and the direction of a key point.
_MAX_LOG_SIZE: Final = 0.7
_MAX_ANGLE_DEG: Final = 30.0
_VOID_MARGIN_CELLS: Final = 3
MIN_AGREEING: Final = 8
"""Minimum number of matches with a common homography to recognise a wall."""
_SEED: Final = 1
_MAX_RATIO: Final = 0.85
# Several matches within a square of this side length count as one.
_PLACE_PX: Final = 2.0

# Descriptors do not depend on the strength of the contrast, but on its sign. If the relative
# brightness of materials differs between laser and photo, half of the edges may be inverted, and a
# mixture of the colours of the photo may restore most of the signs. The mixture with the most
# matches is used.
MIXTURES: Final[Mapping[str, tuple[float, float, float]]] = {
    "green less red": (-1.0, 1.0, 0.0),
    "red as dark": (-1.0, 0.0, 0.0),
    "blue less red": (-1.0, 0.0, 1.0),
    "negative": (-0.299, -0.587, -0.114),
    "red less green": (1.0, -1.0, 0.0),
}
"""Weights of red, green and blue, by name of the mixture; mixtures are tried in this order."""

# In rooms with inverted contrast, up to 15 matches agreed on a wrong position, and 19 in one case.
# A mixture needs more than 15 matches, since several mixtures are tried.
LEAST: Final = 16
# If there are this many matches, neither other mixtures nor matching by structure is tried.
CLEARLY: Final = 24
# Mixtures are only used to find the approximate position, so a reduced resolution is enough.
_LONGEST_SIDE_PX: Final = 2000
# Mixtures with less contrast than this, such as those of photos without colours, are not tried.
_MIN_GREY_LEVELS: Final = 8.0


class PairingParams(MethodParams):
    """Matching of photos with walls by key points."""

    max_features: int = Field(
        default=8000,
        ge=50,
        description="Number of key points per photo and per wall; they are evenly distributed.",
    )
    ratio: float | None = Field(
        default=None,
        gt=0,
        le=1,
        description="Maximum ratio of the distances of the best and the second best match; 1 "
        "accepts any. Default: 0.85; with preset: paper 0.8, as in openMVG.",
    )
    max_side_px: int = Field(
        default=4000,
        ge=200,
        description="Larger photos are reduced to this size for matching. Sizes from 800 px "
        "upwards are tried until a wall is recognised; then the photo is matched at the size at "
        "which a pixel is about as wide as a cell of the walls.",
    )

    @property
    def max_ratio(self) -> float:
        """Limit of the ratio test; 1 accepts all matches."""
        return _MAX_RATIO if self.ratio is None else self.ratio


@dataclass(frozen=True, kw_only=True)
class Pair:
    """Matches of a photo with one wall.

    Attributes:
        wall: index of the wall.
        matches: matched key points, `first` in the photo and `second` on the wall.
        agreeing: (n,) bool, inliers of an approximate homography.
        is_shown: whether enough matches agree and the photo shows the front of the wall.
        homography: (3, 3) approximate homography, photo pixels from wall pixels; None if the wall
            is not shown.
    """

    wall: int
    matches: Matches
    agreeing: NDArray[np.bool_]
    is_shown: bool
    homography: NDArray[np.float64] | None = None


@dataclass(frozen=True, kw_only=True)
class PhotoPairs:
    """Matches of a photo with all walls.

    Attributes:
        features: key points of the photo, in pixels of the full image.
        scale: factor by which the photo was reduced.
        pairs: one pair for each wall that has matches.
        radius_px: search radius of the guided matching; if a homography is wrong, the matches are
            evenly distributed within this radius.
        is_mirrored: whether the mirrored photo matches better; if so, no wall counts as shown.
        n_recognised: number of inliers before the guided matching, of the mirrored photo if that
            matches better.
        picture: "grey" or the name of the mixture.
    """

    features: Features
    scale: float
    pairs: tuple[Pair, ...]
    radius_px: float
    is_mirrored: bool = False
    n_recognised: int = 0
    picture: str = "grey"

    @property
    def n_verified(self) -> int:
        """Number of inliers on all walls that are shown."""
        return sum(int(pair.agreeing.sum()) for pair in self.pairs if pair.is_shown)


def wall_features(wall: Wall, max_features: int, *, as_opencv: bool = False) -> Features | None:
    """Find key points in the intensity of a wall; None if the wall has no intensity.

    Args:
        wall: the wall.
        max_features: maximum number of key points.
        as_opencv: as in `find_features`; also disables the equalisation of the intensity.
    """
    clip_limit = 0.0 if as_opencv else CLIP_LIMIT
    picture = wall_picture(wall, clip_limit=clip_limit, void_margin_cells=_VOID_MARGIN_CELLS)
    if picture is None:
        return None
    grey, usable = picture
    return find_features(
        grey, max_features, usable & np.isfinite(wall.depth_m), as_opencv=as_opencv
    )


def pair_photo(
    grey: NDArray[np.uint8], walls: Sequence[Features | None], params: PairingParams
) -> PhotoPairs:
    """Recognise walls in a photo from coarse to fine, then match the photo at their resolution.

    If the photo is much finer than the raster, most of its key points have no counterpart in the
    raster and cause false matches. At one cell per pixel, both show the same detail, which gives 2
    to 5 times as many tie points.

    Args:
        grey: (height, width) grey values of the photo.
        walls: key points per wall, None for walls without intensity.
        params: parameters of the matching.
    """
    seeker = _Seeker(grey=grey, params=params)
    first, features = seeker.first_look(walls)
    if not first.n_verified:
        return first
    n_mirrored = seeker.n_verified_mirrored(first.features, first, walls)
    if n_mirrored > first.n_verified:
        return _refused(first, n_mirrored)
    # Wall cells per pixel of the reduced photo.
    ratios = [
        wall.sizes_px[pair.matches.second[pair.agreeing]]
        / (first.features.sizes_px[pair.matches.first[pair.agreeing]] * first.scale)
        for pair in first.pairs
        if pair.is_shown and (wall := walls[pair.wall]) is not None
    ]
    scale = min(seeker.finest, first.scale * float(np.median(np.concatenate(ratios))))
    if abs(math.log(scale / first.scale)) > _LOG_SCALE_APART:
        features = seeker.key_points(scale)
    else:
        scale = first.scale
    second = seeker.pairs(features, scale, _shown(first, walls))
    best = second if second.n_verified > first.n_verified else first
    return replace(_completed(best, walls, params), n_recognised=best.n_verified)


def pair_in_colours(
    photo: Photo, walls: Sequence[Features | None], params: PairingParams
) -> PhotoPairs:
    """Match a photo with walls in grey and, if the result is unclear, in mixtures of its colours.

    Args:
        photo: the photo.
        walls: key points per wall, None for walls without intensity.
        params: parameters of the matching.

    Returns:
        The matches in grey, or in a mixture if that has more inliers than the photo in grey, also
        mirrored.
    """
    grey = photo_grey(photo)
    best = pair_photo(grey, walls, params)
    if best.n_recognised >= CLEARLY:
        return best
    smaller = params.model_copy(update={"max_side_px": min(params.max_side_px, _LONGEST_SIDE_PX)})
    rgb = photo_rgb(photo)
    for name in MIXTURES:
        picture = mixed(rgb, name)
        if picture is None:
            continue
        tried = pair_photo(picture, walls, smaller)
        if not tried.is_mirrored and tried.n_recognised >= max(LEAST, best.n_recognised + 1):
            best = replace(tried, picture=name)
        if best.n_recognised >= CLEARLY:
            break
    if best.picture == "grey":
        return best
    # A mixture may show only a symmetric part of a mirrored photo.
    seeker = _Seeker(grey=grey, params=params)
    n_mirrored = seeker.n_verified_mirrored(seeker.key_points(best.scale), best, walls)
    return _refused(best, n_mirrored) if n_mirrored > best.n_recognised else best


def mixed(rgb: NDArray[np.uint8], name: str) -> NDArray[np.uint8] | None:
    """Mix the colours of a photo, stretched to all grey levels; None if there is no contrast.

    Args:
        rgb: (height, width, 3).
        name: name of a mixture.
    """
    mixture = rgb.astype(np.float32) @ np.array(MIXTURES[name], dtype=np.float32)
    low, high = np.percentile(mixture[::4, ::4], (0.5, 99.5))
    if high - low < _MIN_GREY_LEVELS:
        return None
    stretched = (mixture - np.float32(low)) * np.float32(255.0 / (high - low))
    return np.asarray(np.rint(np.clip(stretched, 0.0, 255.0)), dtype=np.uint8)


def side_matches(
    grey: NDArray[np.uint8], walls: Sequence[Features | None], params: PairingParams
) -> NDArray[np.intp]:
    """Count the inliers of a photo on each wall, as seen from the front and from behind.

    The raster of a wall whose normal points away from the viewer is a mirror image of the photo.

    Args:
        grey: (height, width) grey values of the photo.
        walls: key points per wall, None for walls without intensity or with a known side.
        params: parameters of the matching.

    Returns:
        (walls, 2) counts from the front and from behind; counts below `MIN_AGREEING` are set to 0.
    """
    seeker = _Seeker(grey=grey, params=params)
    counts = np.zeros((len(walls), 2), dtype=np.intp)
    scale = min(seeker.finest, _FIRST_SIDE_PX / max(grey.shape))
    while True:
        # Use all key points, since a coarse raster contains few of the strongest key points of a
        # photo.
        features = seeker.key_points(scale)
        for side, seen in enumerate((features, features.mirrored(grey.shape[1]))):
            for pair in seeker.pairs(seen, scale, walls).pairs:
                if pair.is_shown:
                    counts[pair.wall, side] = max(counts[pair.wall, side], pair.agreeing.sum())
        if counts.any() or scale >= seeker.finest:
            return counts
        scale = min(seeker.finest, 2.0 * scale)


def rematched(
    matches: Matches,
    sets: tuple[Features, Features],
    expected: NDArray[np.float64],
    *,
    agreeing: NDArray[np.bool_],
    radius_px: float,
    ratio: float,
) -> Matches:
    """Add matches near their expected position, size and direction (guided matching).

    Since the ratio test ignores repetitions of a motif outside the radius, this gives several times
    as many matches.

    Args:
        matches: the matches so far, which are kept.
        sets: key points of the photo and of the wall.
        expected: (m, 2) expected photo pixels of the key points of the wall.
        agreeing: (n,) bool, inliers among the matches so far.
        radius_px: search radius in the photo.
        ratio: maximum ratio between the distances of the best and the second-best descriptor within
            the radius.
    """
    photo, wall = sets
    good = matches.take(agreeing)
    log_size = np.log2(photo.sizes_px[good.first] / wall.sizes_px[good.second])
    turn = np.exp(1j * np.radians(photo.angles_deg[good.first] - wall.angles_deg[good.second]))
    turn_deg = np.degrees(np.angle(np.median(turn.real) + 1j * np.median(turn.imag)))
    low = photo.pixels.min(axis=0) - radius_px
    high = photo.pixels.max(axis=0) + radius_px
    near = np.flatnonzero(((expected >= low) & (expected <= high)).all(axis=1))
    window = Window(
        first=photo.pixels.astype(np.float32),
        second=expected[near].astype(np.float32),
        radius=radius_px,
        first_log_size=np.log2(photo.sizes_px).astype(np.float32),
        second_log_size=(np.log2(wall.sizes_px[near]) + np.median(log_size)).astype(np.float32),
        first_angle_deg=photo.angles_deg.astype(np.float32),
        second_angle_deg=(wall.angles_deg[near] + turn_deg).astype(np.float32),
        max_log_size=_MAX_LOG_SIZE,
        max_angle_deg=_MAX_ANGLE_DEG,
    )
    found = mutual_matches_within(photo.descriptors, wall.descriptors[near], window, ratio=ratio)
    new = ~np.isin(found.first, matches.first)
    return Matches(
        first=np.concatenate([matches.first, found.first[new]]),
        second=np.concatenate([matches.second, near[found.second[new]]]),
        ratio=np.concatenate([matches.ratio, found.ratio[new]]),
    )


@dataclass(frozen=True, kw_only=True)
class _Seeker:
    grey: NDArray[np.uint8]
    params: PairingParams

    @property
    def finest(self) -> float:
        return min(1.0, self.params.max_side_px / float(max(self.grey.shape)))

    def key_points(self, scale: float) -> Features:
        """Find key points in the photo reduced by `scale`; positions refer to the full photo."""
        small = equalised(reduced(self.grey, scale), CLIP_LIMIT)
        return find_features(small, self.params.max_features).scaled(1.0 / scale)

    def first_look(self, walls: Sequence[Features | None]) -> tuple[PhotoPairs, Features]:
        """Recognise walls at increasing scales, by the strongest key points first, then by all.

        Returns:
            The best matches, and all key points at the scale of these matches.
        """
        scale = min(self.finest, _FIRST_SIDE_PX / max(self.grey.shape))
        found: tuple[PhotoPairs, Features] | None = None
        while True:
            features = self.key_points(scale)
            pairs = self.pairs(features.strongest(_FIRST_IN_PHOTO), scale, _strongest(walls))
            if pairs.n_verified < MIN_AGREEING:
                pairs = self.pairs(features, scale, walls)
            if found is None or pairs.n_verified >= found[0].n_verified:
                found = pairs, features
            if found[0].n_verified >= MIN_AGREEING or scale >= self.finest:
                return found
            scale = min(self.finest, 2.0 * scale)

    def pairs(
        self, features: Features, scale: float, walls: Sequence[Features | None]
    ) -> PhotoPairs:
        radius_px = _LOOSE_SHARE * math.hypot(*self.grey.shape)
        pairs = []
        for index, wall in enumerate(walls):
            if wall is None:
                continue
            matches = mutual_matches(
                features.descriptors, wall.descriptors, ratio=self.params.max_ratio
            )
            if len(matches):
                pairs.append(verified(index, matches, (features, wall), radius_px))
        return PhotoPairs(features=features, scale=scale, pairs=tuple(pairs), radius_px=radius_px)

    def n_verified_mirrored(
        self, features: Features, found: PhotoPairs, walls: Sequence[Features | None]
    ) -> int:
        """Count the inliers of mirrored key points on the walls that are shown.

        A symmetric facade partly matches its own mirror image, with a plausible pose.
        """
        few = len(features) <= _FIRST_IN_PHOTO
        shown = _shown(found, _strongest(walls) if few else walls)
        return self.pairs(features.mirrored(self.grey.shape[1]), found.scale, shown).n_verified


def _refused(pairs: PhotoPairs, n_mirrored: int) -> PhotoPairs:
    """Return the matches of a photo whose mirror image has more inliers."""
    refused = tuple(replace(pair, is_shown=False, homography=None) for pair in pairs.pairs)
    return replace(pairs, pairs=refused, is_mirrored=True, n_recognised=n_mirrored)


def _strongest(walls: Sequence[Features | None]) -> list[Features | None]:
    return [None if wall is None else wall.strongest(_FIRST_ON_WALL) for wall in walls]


def _shown(pairs: PhotoPairs, walls: Sequence[Features | None]) -> list[Features | None]:
    shown = {pair.wall for pair in pairs.pairs if pair.is_shown}
    return [wall if index in shown else None for index, wall in enumerate(walls)]


def verified(
    index: int, matches: Matches, sets: tuple[Features, Features], loose_px: float
) -> Pair:
    """Estimate a homography between a photo and a wall, and find its inliers.

    Args:
        index: index of the wall.
        matches: matched key points of the photo and of the wall.
        sets: these key points.
        loose_px: maximum distance of an inlier in the photo.
    """
    features, wall = sets
    source, target = wall.pixels[matches.second], features.pixels[matches.first]
    agreeing = np.zeros(len(matches), dtype=np.bool_)
    homography = None
    if len(matches) >= 4:
        homography = _homography(source, target, matches.ratio, loose_px)
    if homography is not None:
        with np.errstate(divide="ignore", invalid="ignore"):
            agreeing = np.hypot(*(mapped(homography, source) - target).T) < loose_px
    # Count distinct positions, since many key points of a texture may match a single position in
    # the other image.
    n_places = min(
        len(np.unique(np.floor(pixels[agreeing] / _PLACE_PX), axis=0))
        for pixels in (source, target)
    )
    is_shown = homography is not None and n_places >= MIN_AGREEING
    if homography is not None and is_shown:
        # Seen from behind, the wall has the opposite sense of rotation.
        middle = source[agreeing].mean(axis=0)
        here, *there = mapped(homography, middle + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
        is_shown = bool(np.linalg.det(np.array(there) - here) > 0.0)
    return Pair(
        wall=index,
        matches=matches,
        agreeing=agreeing,
        is_shown=is_shown,
        homography=homography if is_shown else None,
    )


def _completed(
    pairs: PhotoPairs, walls: Sequence[Features | None], params: PairingParams
) -> PhotoPairs:
    """Add matches near the positions expected from the homographies."""
    completed = []
    for pair in pairs.pairs:
        wall = walls[pair.wall]
        if pair.homography is None or wall is None:
            completed.append(pair)
            continue
        expected = mapped(pair.homography, wall.pixels)
        matches = rematched(
            pair.matches,
            (pairs.features, wall),
            expected,
            agreeing=pair.agreeing,
            radius_px=pairs.radius_px,
            ratio=params.max_ratio,
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

    params = sampling(loose_px, trials=10_000)
    params.confidence = 0.9999
    params.sampler = cv2.SAMPLING_PROSAC  # samples the best matches first
    order = np.argsort(ratio, kind="stable")
    try:
        found: Any = cv2.findHomography(source[order], target[order], params)[0]
    except cv2.error:  # all points on a line
        return None
    matrix: NDArray[np.float64] | None = found
    return matrix


def sampling(threshold_px: float, *, trials: int) -> Any:
    """Return OpenCV parameters for robust sampling: MSAC, local optimisation and a fixed seed."""
    import cv2

    params: Any = cv2.UsacParams()
    params.threshold = threshold_px
    params.maxIterations = trials
    params.randomGeneratorState = _SEED
    params.score = cv2.SCORE_METHOD_MSAC
    params.loMethod = cv2.LOCAL_OPTIM_INNER_LO
    return params


def mapped(homography: NDArray[np.float64], pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Map pixels (n, 2) by a homography."""
    lifted = np.column_stack([pixels, np.ones(len(pixels))]) @ homography.T
    return lifted[:, :2] / lifted[:, 2:]
