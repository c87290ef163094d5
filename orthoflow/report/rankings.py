"""Best and worst of a column, among values that may be compared, by what makes a metric good."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from fnmatch import fnmatchcase
from typing import Final

from orthoflow.records.metrics import MetricRow, is_rounding

# Without repeats of both nobody knows how far values of the same method lie apart, nor where they
# all give one value. What is nearer than this share of the best is no difference then; times and
# memory scatter more, times from run to run by so much (docs/performance.md), whatever their
# repeats in one run say.
_ALIKE_SHARE: Final = 0.01
_ALIKE_COST_SHARES: Final = {"_s": 0.3, "_mib": 0.1}


class Mark(Enum):
    """How a value stands among its like."""

    NONE = ""
    BEST = "best"
    NEAR = "among the best, no difference shown"
    WORST = "worst"
    FEWER = "of fewer photos, not ranked"


@dataclass(frozen=True, kw_only=True)
class Value:
    """One place of a comparison table.

    Attributes:
        text: the number as printed, empty where there is none.
        sort: the number that the table is sorted by, NaN where there is none.
        spread: standard deviation over repeats, NaN without repeats.
        mark: how it stands among the values of its group.
        group: letters of its environment and data, empty when the table has one of each.
        note: more in words, e.g. how many repeats.
        n_photos: photos that it sums up, NaN where it sums up none.
        found_nothing: there is no number though its step was asked for one, by a failure or because
            nothing was found.
    """

    text: str = ""
    sort: float = math.nan
    spread: float = math.nan
    mark: Mark = Mark.NONE
    group: str = ""
    note: str = ""
    n_photos: float = math.nan
    found_nothing: bool = False


def rank(values: Sequence[Value], sense: Sense, metric: str = "") -> list[Value]:
    """Mark the best and the worst of each group; a group whose values are all alike has neither.

    A value whose distance from the best is not above both their standard deviations together (in
    quadrature), or where one of them has no repeats, or repeats of one value, not above a hundredth
    of the best (repeats or not a tenth of a memory, three tenths of a time), or just of rounding,
    is marked as near the best and never as worst; the best is then only among the best, too. The
    worst is marked where every other value is as far from it, and where nobody of its group found
    nothing, which is worse; costs, which a method may just not have, are ranked all the same. What
    sums up fewer photos than another of its group is not ranked: who refuses the difficult ones has
    smaller errors of the rest.

    Args:
        values: a column.
        sense: what makes its values good.
        metric: whose values they are.
    """
    if sense is Sense.NEITHER:
        return list(values)
    marked = list(values)
    for group in dict.fromkeys(value.group for value in values):
        members = [
            index
            for index, value in enumerate(values)
            if value.group == group and math.isfinite(value.sort)
        ]
        most = max((values[i].n_photos for i in members if values[i].n_photos > 0), default=0.0)
        for index in [index for index in members if values[index].n_photos < most]:
            members.remove(index)
            marked[index] = replace(values[index], mark=Mark.FEWER)
        if not members:
            continue
        scores = {index: badness(values[index].sort, sense) for index in members}
        best = values[min(members, key=scores.__getitem__)]
        leading = {i for i in members if _are_alike(values[i], best, sense, metric)}
        if len(leading) == len(members):
            continue
        worst = max(members, key=scores.__getitem__)
        is_worst = not (
            _has_found_nothing(values, group) and cost_share(metric) == 0.0
        ) and not any(
            _are_alike(values[worst], values[i], sense, metric) for i in members if i != worst
        )
        for index in members:
            mark = Mark.NONE
            if index in leading:
                # What several share nobody leads in.
                mark = Mark.NEAR if len(leading) > 1 else Mark.BEST
            elif index == worst and is_worst:
                mark = Mark.WORST
            marked[index] = replace(values[index], mark=mark)
    return marked


def _are_alike(one: Value, other: Value, sense: Sense, metric: str) -> bool:
    """Whether nothing shows that a value differs from a better one."""
    if is_rounding(badness(one.sort, sense), badness(other.sort, sense)):
        return True
    known = [
        value.spread
        for value in (one, other)
        if math.isfinite(value.spread) and not is_rounding(value.sort, value.sort + value.spread)
    ]
    share = max(cost_share(metric), 0.0 if len(known) == 2 else _ALIKE_SHARE)
    # Signed errors count by their size.
    own, better = (abs(v.sort) if sense is Sense.LESS else v.sort for v in (one, other))
    return abs(own - better) <= max(math.hypot(*known), share * abs(better))


def cost_share(metric: str) -> float:
    """By what share costs scatter; 0 for what is no cost."""
    return max(
        (share for end, share in _ALIKE_COST_SHARES.items() if metric.endswith(end)), default=0.0
    )


def _has_found_nothing(values: Sequence[Value], group: str) -> bool:
    return any(value.found_nothing and value.group == group for value in values)


class Sense(Enum):
    """What makes a value of a metric good."""

    LESS = "less is better"
    MORE = "more is better"
    ONE = "1 is best"
    NEITHER = "neither more nor less is better"


_DECLARED: Final = {
    "lower": Sense.LESS,
    "higher": Sense.MORE,
    "one": Sense.ONE,
    "": Sense.NEITHER,
}
# The first pattern that fits holds. A name that fits none is described, not judged: most metrics
# (angles, counts, shares of kinds of points) have no good side.
_PATTERNS: Final[tuple[tuple[str, Sense], ...]] = (
    ("*error_over_sigma*", Sense.ONE),
    # These ask for words like rms, but describe the data or say what the method believes.
    ("raw_omega_deg", Sense.NEITHER),
    ("raw_phi_deg", Sense.NEITHER),
    ("sigma0*", Sense.NEITHER),
    # It hangs on what ran before, not on the method.
    ("*compile_s", Sense.NEITHER),
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
    ("opening_iou_*", Sense.MORE),
    ("n_found_openings", Sense.MORE),
    ("n_false_openings", Sense.LESS),
    ("n_stray_sides", Sense.LESS),
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


def sense_of(metric: str, row: MetricRow | None = None) -> Sense:
    """Say what makes a value of the metric good: what its method declares, else what its name says.

    >>> sense_of("rmse_u_mm").name, sense_of("label_iou").name, sense_of("omega_deg").name
    ('LESS', 'MORE', 'NEITHER')
    """
    if row is not None and row.label:
        # A record may hold anything.
        return _DECLARED.get(row.better, Sense.NEITHER)
    for pattern, sense in _PATTERNS:
        if fnmatchcase(metric, pattern):
            return sense
    return Sense.NEITHER


# Numbers that sum up photos, and what counts these in the same step.
_OVER_PHOTOS: Final = {
    "check_rmse_*": "n_oriented",
    "control_rmse_*": "n_oriented",
    "sigma_wall_mm_*": "n_oriented",
    "pose_*": "n_oriented",
    "held_out_rmse_*": "n_photos_matched",
}


def count_of_photos(metric: str) -> str:
    """Name the number that says how many photos a metric sums up; empty where it sums up none.

    >>> count_of_photos("check_rmse_mm_worst"), count_of_photos("rmse_u_mm")
    ('n_oriented', '')
    """
    return next((n for pattern, n in _OVER_PHOTOS.items() if fnmatchcase(metric, pattern)), "")


_YES_OR_NO: Final = ("main_found", "is_*", "has_*")


def is_yes_or_no(metric: str) -> bool:
    """Whether a metric is 1 where something is so and 0 where not, as its name says.

    >>> is_yes_or_no("main_found"), is_yes_or_no("n_found")
    (True, False)
    """
    return any(fnmatchcase(metric, pattern) for pattern in _YES_OR_NO)


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
