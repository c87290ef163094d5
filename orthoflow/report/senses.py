"""Which of two values of a metric is the better one, told by the metric's name."""

from __future__ import annotations

import math
from enum import Enum
from fnmatch import fnmatchcase
from typing import Final


class Sense(Enum):
    """What makes a value of a metric good."""

    LESS = "less is better"
    MORE = "more is better"
    ONE = "1 is best"
    NEITHER = "neither more nor less is better"


# The first pattern that fits holds. A name that fits none is described, not judged: most metrics
# (angles, counts, shares of kinds of points) have no good side.
_PATTERNS: Final[tuple[tuple[str, Sense], ...]] = (
    ("*error_over_sigma*", Sense.ONE),
    # These ask for words like rms, but describe the data or say what the method believes.
    ("raw_omega_deg", Sense.NEITHER),
    ("raw_phi_deg", Sense.NEITHER),
    ("sigma0*", Sense.NEITHER),
    ("*wrong_share*", Sense.LESS),
    ("*stretch_share", Sense.LESS),
    ("*smear_share", Sense.LESS),
    ("*ghost_share", Sense.LESS),
    ("*far_source_share", Sense.LESS),
    ("*completeness*", Sense.MORE),
    ("label_*", Sense.MORE),
    ("true_planes_found", Sense.MORE),
    ("main_found", Sense.MORE),
    ("n_oriented", Sense.MORE),
    ("rmse_*", Sense.LESS),
    ("*_rmse*", Sense.LESS),
    ("rms_*", Sense.LESS),
    ("*_rms_*", Sense.LESS),
    ("sigma_*", Sense.LESS),
    ("plane_angle_deg*", Sense.LESS),
    ("plane_offset_mm*", Sense.LESS),
    ("raw_angle_deg", Sense.LESS),
    ("raw_offset_mm", Sense.LESS),
    ("*_error_*", Sense.LESS),
    ("*nmad_*", Sense.LESS),
    ("*_s", Sense.LESS),
    ("*_mib", Sense.LESS),
)


def sense_of(metric: str) -> Sense:
    """Say what makes a value of the metric good.

    >>> sense_of("rmse_u_mm").name, sense_of("label_iou").name, sense_of("omega_deg").name
    ('LESS', 'MORE', 'NEITHER')
    """
    for pattern, sense in _PATTERNS:
        if fnmatchcase(metric, pattern):
            return sense
    return Sense.NEITHER


def badness(value: float, sense: Sense) -> float:
    """Give a number that is smaller the better the value is; signed errors count by their size.

    Raises:
        ValueError: the metric has no good side.
    """
    if sense is Sense.LESS:
        return abs(value)
    if sense is Sense.MORE:
        return -value
    if sense is Sense.ONE:
        return abs(math.log(value)) if value > 0 else math.inf
    raise ValueError("a metric without a good side cannot be ranked")
