"""A second look for matches, each key point only where the first look roughly puts it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow_plugins.match.features import Features
from orthoflow_plugins.match.neighbours import Matches, Window, mutual_matches_within

_LOG_SIZE_MOST: Final = 0.7
_ANGLE_MOST_DEG: Final = 30.0


@dataclass(frozen=True, kw_only=True)
class Expectation:
    """What a first look says of where a wall's key points are in a photo.

    Attributes:
        pixels: (m, 2) photo pixels expected of the wall's key points.
        agreeing: (n,) bool, which of the first look's matches agree with that.
        radius_px: how wrong it may be.
    """

    pixels: NDArray[np.float64]
    agreeing: NDArray[np.bool_]
    radius_px: float


def rematched(
    matches: Matches,
    sets: tuple[Features, Features],
    expected: Expectation,
    *,
    ratio_most: float,
) -> Matches:
    """Add matches within reach of what is expected: place, size and direction of key points.

    A motif that repeats farther off no longer takes part in the ratio test, which brings several
    times the matches.

    Args:
        matches: of the first look; they stay.
        sets: key points of the photo and of the wall.
        expected: from the first look.
        ratio_most: largest distance of the best over the second best within reach.
    """
    photo, wall = sets
    good = matches.take(expected.agreeing)
    log_size = np.log2(photo.sizes_px[good.first] / wall.sizes_px[good.second])
    turn = np.exp(1j * np.radians(photo.angles_deg[good.first] - wall.angles_deg[good.second]))
    turn_deg = np.degrees(np.angle(np.median(turn.real) + 1j * np.median(turn.imag)))
    low = photo.pixels.min(axis=0) - expected.radius_px
    high = photo.pixels.max(axis=0) + expected.radius_px
    near = np.flatnonzero(((expected.pixels >= low) & (expected.pixels <= high)).all(axis=1))
    window = Window(
        first=photo.pixels.astype(np.float32),
        second=expected.pixels[near].astype(np.float32),
        radius=expected.radius_px,
        first_log_size=np.log2(photo.sizes_px).astype(np.float32),
        second_log_size=(np.log2(wall.sizes_px[near]) + np.median(log_size)).astype(np.float32),
        first_angle_deg=photo.angles_deg.astype(np.float32),
        second_angle_deg=(wall.angles_deg[near] + turn_deg).astype(np.float32),
        log_size_most=_LOG_SIZE_MOST,
        angle_most_deg=_ANGLE_MOST_DEG,
    )
    found = mutual_matches_within(
        photo.descriptors, wall.descriptors[near], window, ratio_most=ratio_most
    )
    new = ~np.isin(found.first, matches.first)
    return Matches(
        first=np.concatenate([matches.first, found.first[new]]),
        second=np.concatenate([matches.second, near[found.second[new]]]),
        ratio=np.concatenate([matches.ratio, found.ratio[new]]),
    )
