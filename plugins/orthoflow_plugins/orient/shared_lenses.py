"""Lenses that photos share because nothing speaks against it: which photos contradict theirs.

Of photos without EXIF nobody knows whether one lens took them. A person who takes a series seldom
changes it, and a lens that many photos share is known far better than that of any of them: the ties
of one photo, all in a part of it, leave focal length and distortion open elsewhere. But a lens may
have zoomed, and a program may have turned a picture. So each photo's own ties are asked.
"""

from __future__ import annotations

import math
from collections.abc import Sequence, Set
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import GeometryError
from orthoflow.geometry.resection import Resection, fitted, misfit
from orthoflow_plugins.orient.block_adjustment import Adjusted, Trusted
from orthoflow_plugins.orient.estimation import SOFT_LIMIT, Estimate
from orthoflow_plugins.orient.lenses import UNKNOWN, focal_sigma

# One photo in a thousand is given a lens of its own although it shares that of the others.
_CHANCE: Final = 1e-3
# A camera has one lens. A series that zoomed differs by more than this share of the focal length;
# what errors of the scan that neighbouring ties have in common do to the focal length of one photo
# is less (up to 0.7 % on photogrammetric clouds of 10 to 30 mm noise).
_ZOOM_LEAST: Final = 0.02
_ZOOM_SIGMAS: Final = 5.0
# Those that contradict most bend the lens, so that others contradict it, too: these leave first.
_OF_MOST: Final = 0.5


def of_another_lens(photos: Sequence[Trusted], adjusted: Adjusted) -> Set[int]:
    """Find the photos that cannot have the lens that they share by their size alone.

    Args:
        photos: of the block.
        adjusted: the block.

    Returns:
        Indices of those that contradict it most; of the others another adjustment tells.
    """
    lens_of = adjusted.block.lens_of
    asked = [
        at
        for at, lens in enumerate(lens_of)
        if adjusted.block.lenses[lens].source == UNKNOWN and lens_of.count(lens) > 1
    ]
    usual = _usual_widening(photos)
    excesses = {
        at: _excess(photos[at], adjusted.estimates[at], usual)
        for at in asked
        if _zoomed(photos[at].estimate.resection, adjusted.estimates[at].resection)
    }
    most = max(excesses.values(), default=0.0)
    return frozenset(at for at, excess in excesses.items() if excess > max(1.0, _OF_MOST * most))


def _zoomed(alone: Resection, shared: Resection) -> bool:
    """Whether a photo's own ties ask for another focal length than the shared one, by far."""
    off = abs(math.log(alone.camera.fx / shared.camera.fx))
    return off > max(_ZOOM_LEAST, _ZOOM_SIGMAS * focal_sigma(alone))


def _excess(item: Trusted, shared: Estimate, usual_widening: float) -> float:
    """How much worse a photo's ties fit the shared lens, at any pose, than chance has it.

    The likelihood ratio of the photo's own lens and the shared one, as chi-square over its limit.
    """
    from scipy.special import chdtri  # scipy.stats would take seconds to import

    alone = item.estimate.resection
    n_free = alone.lens.sigmas.size
    if not n_free:
        return 0.0
    control = item.tied.seen.take(item.estimate.agreeing & ~item.tied.is_check)
    limit = SOFT_LIMIT * alone.sigma0
    try:
        camera = fitted(control, shared.resection.camera, soft_limit=limit)
    except GeometryError:
        return math.inf
    own = _loss(misfit(control, alone.camera).normalised, limit)
    excess = _loss(misfit(control, camera).normalised, limit) - own
    widening = max(_widening(alone), usual_widening)
    return excess / (alone.sigma0**2 * widening * float(chdtri(n_free, _CHANCE)))


def _widening(alone: Resection) -> float:
    """By how much a photo's variances grow because residuals of neighbouring ties agree."""
    return alone.variance_factor / alone.sigma0**2


def _usual_widening(photos: Sequence[Trusted]) -> float:
    """Median over the photos whose ties lie in enough places to tell it."""
    told = [_widening(item.estimate.resection) for item in photos]
    return float(np.median([each for each in told if each > 1.0] or [1.0]))


def _loss(lengths: NDArray[np.float64], limit: float) -> float:
    """Sum of squares, of those beyond a limit less (Huber)."""
    return float(np.where(lengths <= limit, lengths**2, limit * (2.0 * lengths - limit)).sum())
