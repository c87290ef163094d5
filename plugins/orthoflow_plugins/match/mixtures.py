"""Photos paired with walls in mixtures of their colours, where grey shows no wall clearly.

Key points bear another strength of contrast, not another sign. A laser that sees red dark, or
bright what the eye sees dark, shows half of all edges the other way round than grey does; in a
mixture of the photo's colours most are as the laser sees them. Which mixture that is nobody knows
beforehand: the one is taken in which most key points agree.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.products import Photo
from orthoflow_plugins.match.features import Features
from orthoflow_plugins.match.pairing import PairingRule, PhotoPairs, pair_photo
from orthoflow_plugins.match.pictures import photo_grey, photo_rgb

MIXTURES: Final[Mapping[str, tuple[float, float, float]]] = {
    "green less red": (-1.0, 1.0, 0.0),
    "red as dark": (-1.0, 0.0, 0.0),
    "blue less red": (-1.0, 0.0, 1.0),
    "negative": (-0.299, -0.587, -0.114),
    "red less green": (1.0, -1.0, 0.0),
}
"""By name, weights of red, green and blue, in the order in which they are tried."""

# Measured in rooms of inverted contrast: up to 15 matches agreed on a wrong place, and once 19. A
# mixture that recognises a wall needs more than 15, as there are several of them.
LEAST: Final = 16
# From so many on, neither another mixture is tried nor structure.
CLEARLY: Final = 24
# A mixture is there to find the place, not to measure it.
_LONGEST_SIDE_PX: Final = 2000
# A photo without colours has but one mixture.
_GREY_LEVELS_LEAST: Final = 8.0


def pair_in_colours(
    photo: Photo, walls: Sequence[Features | None], rule: PairingRule
) -> PhotoPairs:
    """Pair a photo with walls in grey; where that shows none clearly, in mixtures of its colours.

    Args:
        photo: the photo.
        walls: key points per wall, None where it shows nothing.
        rule: how.

    Returns:
        What most key points agree in, grey where no mixture has more.
    """
    best = pair_photo(photo_grey(photo), walls, rule)
    if best.n_recognised >= CLEARLY:
        return best
    smaller = replace(rule, longest_side_px=min(rule.longest_side_px, _LONGEST_SIDE_PX))
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
    return best


def mixed(rgb: NDArray[np.uint8], name: str) -> NDArray[np.uint8] | None:
    """Mix a photo's colours, stretched to all grey levels; None for what shows nothing.

    Args:
        rgb: (height, width, 3).
        name: of a mixture.
    """
    mixture = rgb.astype(np.float32) @ np.array(MIXTURES[name], dtype=np.float32)
    low, high = np.percentile(mixture[::4, ::4], (0.5, 99.5))
    if high - low < _GREY_LEVELS_LEAST:
        return None
    stretched = (mixture - np.float32(low)) * np.float32(255.0 / (high - low))
    return np.asarray(np.rint(np.clip(stretched, 0.0, 255.0)), dtype=np.uint8)
