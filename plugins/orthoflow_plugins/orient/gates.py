"""What an orientation must meet before its photo may be called `ok`: a table of gates.

Each gate has a name, its limits, where these come from, and the sentence of a refusal.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.opencv_border import to_opencv
from orthoflow.geometry.resection import SeenPoints
from orthoflow.products import Photo
from orthoflow.sdk import DiagnosticSpec
from orthoflow_plugins.orient.lenses import UNKNOWN
from orthoflow_plugins.orient.parameters import (
    Note,
    OrientParams,
)
from orthoflow_plugins.orient.pose import Estimate, image_cells
from orthoflow_plugins.orient.wall_errors import KnownWall, WallError, wall_error

_MIN_TIES: Final = 8
_CROWDED_RATIO: Final = 10
# Right ties gather close to where they should be, wrong ones do not: several shares of the limit
# are tried.
_CHANCE_RADII: Final = (0.2, 0.35, 0.6, 1.0)
_PLACE_PX: Final = 8.0
_MIN_CHECKS: Final = 5
_MIN_ON_WALL: Final = 4
CROWDED: Final = DiagnosticSpec(
    code="ties-crowded",
    severity="warning",
    text="photo {subject}: a quarter of it has {n_most} ties, another {n_least}: more than "
    "{ratio} times as many",
)
SMALL_HULL: Final = DiagnosticSpec(
    code="control-covers-little",
    severity="warning",
    text="photo {subject}: the control points cover {share:.0%} of the part that shows the walls",
    rank_by="-share",
)
FOCAL_ESTIMATED: Final = DiagnosticSpec(
    code="focal-length-estimated",
    severity="warning",
    text="photo {subject}: neither calibration nor EXIF states its focal length, which was "
    "estimated",
    remedy="a calibration file makes it more certain",
)


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """An orientation to judge.

    Attributes:
        photo: the photo.
        seen: its ties.
        is_check: (n,) withheld ties.
        walls: index of the wall of each tie (n,).
        estimate: the pose found.
        known: the walls of the ties that agree.
        error: predicted error on these walls, None when the photo shows none of them.
        params: limits among them.
        search_radius_px: the matcher looked for ties so far from where it expected them, so that
            wrong ones lie within this, too; inf when it looked everywhere.
    """

    photo: Photo
    seen: SeenPoints
    is_check: NDArray[np.bool_]
    walls: NDArray[np.int32]
    estimate: Estimate
    known: Sequence[KnownWall]
    error: WallError | None
    params: OrientParams
    search_radius_px: float = math.inf

    @property
    def control(self) -> NDArray[np.bool_]:
        """Control ties that agree."""
        return self.estimate.agreeing & ~self.is_check

    @property
    def withheld(self) -> NDArray[np.bool_]:
        """Withheld ties that agree."""
        return self.estimate.agreeing & self.is_check

    @property
    def checked(self) -> NDArray[np.bool_]:
        """Withheld ties that agree and are none of the control once more, which checks nothing.

        A key point whose gradients have two directions is two features in one place, and both may
        be matched with the same point.
        """
        places = np.column_stack([self.seen.pixels_photo, self.seen.points_world])
        place = np.unique(places, axis=0, return_inverse=True)[1].ravel()
        return self.withheld & ~np.isin(place, place[~self.is_check])

    @property
    def quadrant_counts(self) -> list[int]:
        """Ties that agree in the quarters of the photo, as `image_cells` numbers them."""
        cells = self._quarters(self.seen.pixels_photo[self.estimate.agreeing])
        return [int((cells == quarter).sum()) for quarter in range(4)]

    @property
    def gsd_m(self) -> float | None:
        """Smallest cell of its walls, None when the ties do not say."""
        return min((wall.gsd_m for wall in self.known if wall.gsd_m is not None), default=None)

    def worst_in_quarter_m(self, quarter: int) -> float:
        """Largest predicted error on the walls that a quarter shows; 0 when it shows none."""
        if self.error is None:
            return 0.0
        here = self._quarters(self.error.footprint_px) == quarter
        return float(self.error.sigmas_m[here].max(initial=0.0))

    @property
    def hull_ratio(self) -> float:
        """Hull of the control over the footprint of its walls in the photo; 0 without one."""
        if self.error is None:
            return 0.0
        footprint = hull_area(self.error.footprint_px)
        return hull_area(self.seen.pixels_photo[self.control]) / max(footprint, 1.0)

    def _quarters(self, pixels: NDArray[np.float64]) -> NDArray[np.intp]:
        return image_cells(pixels, (self.photo.width, self.photo.height), 2)


Values = Mapping[str, Any]
"""What a gate found, by the names in its sentence."""


@dataclass(frozen=True, kw_only=True)
class Gate:
    """A condition that an orientation has to meet.

    Attributes:
        name: for the record.
        limits: numbers, or names of the parameters that hold them, by what the test calls them.
        source: where the limits come from.
        refuses: gives what the sentence needs where the condition is not met, else None.
        text: the sentence; it may use the limits, too.
    """

    name: str
    limits: Mapping[str, float | str]
    source: str
    refuses: Callable[..., Values | None]
    text: str


@dataclass(frozen=True, kw_only=True)
class Refusal:
    """Why an orientation is not `ok`.

    Attributes:
        gate: name of the gate that refused.
        values: what it found, and its limits.
        text: the reason as a sentence.
    """

    gate: str
    values: Values
    text: str


def refusal(candidate: Candidate, gates: Sequence[Gate] | None = None) -> Refusal | None:
    """Judge an orientation; None where it meets all gates.

    Args:
        candidate: the orientation.
        gates: of these the first that refuses; without them, all that its ties ask for.
    """
    if gates is None:
        gates = GATES_BY_HAND if candidate.estimate.without_one else GATES
    for gate in gates:
        limits = {
            name: getattr(candidate.params, limit) if isinstance(limit, str) else limit
            for name, limit in gate.limits.items()
        }
        values = gate.refuses(candidate, **limits)
        if values is not None:
            found = limits | dict(values)
            return Refusal(gate=gate.name, values=found, text=gate.text.format(**found))
    return None


def too_few(n_ties: int) -> str:
    """State why ties are too few for an orientation; empty when they suffice."""
    if n_ties < _MIN_TIES:
        return (
            f"{n_ties} ties with the walls, at least {_MIN_TIES} are needed: the photo "
            "shows none of the walls, or too differently, or in cells that are too coarse"
        )
    return ""


def warnings_for(candidate: Candidate) -> list[Note]:
    """State what limits an orientation that is `ok`."""
    notes: list[Note] = []
    counts = candidate.quadrant_counts
    if max(counts) > _CROWDED_RATIO * min(counts):
        values = {"n_most": max(counts), "n_least": min(counts), "ratio": _CROWDED_RATIO}
        notes.append((CROWDED, values))
    if candidate.hull_ratio < 1.5 * candidate.params.min_hull_ratio:
        notes.append((SMALL_HULL, {"share": candidate.hull_ratio}))
    if candidate.estimate.source == UNKNOWN:
        notes.append((FOCAL_ESTIMATED, {}))
    return notes


def hull_area(pixels: NDArray[np.float64]) -> float:
    """Area of the convex hull of points (n, 2); 0 for fewer than three or points on a line."""
    from scipy.spatial import ConvexHull, QhullError

    if len(pixels) < 3:
        return 0.0
    try:
        return float(ConvexHull(pixels).volume)
    except QhullError:
        return 0.0


def _control(candidate: Candidate, *, at_least: int) -> Values | None:
    n = int(candidate.control.sum())
    return {"n": n, "n_all": int((~candidate.is_check).sum())} if n < at_least else None


def _share(candidate: Candidate, *, at_least: float) -> Values | None:
    share = float(candidate.estimate.agreeing.mean())
    return {"share": share, "n_all": len(candidate.seen)} if share < at_least else None


def _chance(candidate: Candidate, *, at_most: float) -> Values | None:
    """A pose fitted to wrong ties fits withheld ties by chance only."""
    n_check = int(candidate.is_check.sum())
    lengths = candidate.estimate.fit.normalised / candidate.estimate.limit
    probabilities = []
    for share in _CHANCE_RADII:
        near = candidate.withheld & (lengths <= share)
        by_chance = _chance_probability(candidate, share * candidate.estimate.limit)
        places = np.floor(candidate.seen.pixels_photo[near] / _PLACE_PX)
        probabilities.append(_tail(len(np.unique(places, axis=0)), n_check, by_chance))
    if len(_CHANCE_RADII) * min(probabilities) > at_most:
        return {"n_agree": int(candidate.withheld.sum()), "n_check": n_check}
    return None


def _check_share(candidate: Candidate, *, of_control: float) -> Values | None:
    share = float(candidate.control.sum() / (~candidate.is_check).sum())
    n_check, n_agree = int(candidate.is_check.sum()), int(candidate.withheld.sum())
    if n_agree / n_check < of_control * share and n_check >= _MIN_CHECKS:
        return {"n_agree": n_agree, "n_check": n_check, "share": share}
    return None


def _check_rms(candidate: Candidate, *, of_control: float) -> Values | None:
    if candidate.withheld.sum() < _MIN_CHECKS:
        return None
    squares = candidate.estimate.fit.normalised**2
    control, check = (
        float(np.sqrt(np.mean(squares[some]))) for some in (candidate.control, candidate.withheld)
    )
    return {"times": check / control} if check > of_control * control else None


def _quarters(candidate: Candidate, *, at_least: int, cells: float) -> Values | None:
    """Hold each quarter of the photo to its ties, or else to what the others say about it.

    After markiewicz2015 each quarter needs two ties. But an obstacle before the wall, or a view
    past the end of the wall, may fill a quarter in which no tie can be. A surveyor keeps such a
    photo when the rest of it fixes the pose: the error predicted for the walls in that quarter must
    be as small at its worst place as it has to be on the average of the photo. A quarter that shows
    no wall is painted nowhere and needs nothing. Only strictly the paper's rule holds as it stands.
    """
    for quarter, count in enumerate(candidate.quadrant_counts):
        if count >= at_least:
            continue
        if candidate.params.quadrants == "strict":
            return {"n": count, "why": ""}
        worst_m = candidate.worst_in_quarter_m(quarter)
        most_m = cells * candidate.gsd_m if candidate.gsd_m else 0.0
        if worst_m > most_m:
            allowed = f", at most {1000 * most_m:.1f} mm is allowed" if candidate.gsd_m else ""
            why = (
                ": the pose would be extrapolated there, with a predicted error of "
                f"{1000 * worst_m:.1f} mm{allowed}"
            )
            return {"n": count, "why": why, "worst_mm": 1000 * worst_m}
    return None


def _side(candidate: Candidate) -> Values | None:
    centre = candidate.estimate.resection.camera.centre_world
    for wall in candidate.known:
        n_used = int((candidate.walls[candidate.control] == wall.index).sum())
        before_m = float((centre - wall.corners_world.mean(axis=0)) @ wall.normal)
        if wall.has_side and n_used >= _MIN_ON_WALL and before_m <= 0.0:
            return {"before_m": before_m}
    return None


def _shown(candidate: Candidate) -> Values | None:
    return {} if candidate.error is None else None


def _hull(candidate: Candidate, *, at_least: float) -> Values | None:
    ratio = candidate.hull_ratio
    return {"ratio": ratio} if ratio < at_least else None


def _accuracy(candidate: Candidate, *, cells: float) -> Values | None:
    return _beyond(candidate, None if candidate.error is None else candidate.error.rms_m, cells)


def _accuracy_at_worst(candidate: Candidate, *, cells: float) -> Values | None:
    return _beyond(candidate, None if candidate.error is None else candidate.error.worst_m, cells)


def _beyond(candidate: Candidate, error_m: float | None, cells: float) -> Values | None:
    gsd_m = candidate.gsd_m
    if error_m is None or gsd_m is None or error_m <= cells * gsd_m:
        return None
    return {"error_mm": 1000 * error_m, "gsd_mm": 1000 * gsd_m}


def _each_other(candidate: Candidate, *, cells: float) -> Values | None:
    """Hold a pose from few ties to what it would be worth without any of them.

    A wrong tie that the others cannot tell does no more harm than the pose without it is uncertain.
    """
    if candidate.gsd_m is None:
        return None
    most_m = cells * candidate.gsd_m
    pixels = candidate.seen.pixels_photo[candidate.estimate.agreeing]
    errors = [
        wall_error(resection, candidate.known) for resection in candidate.estimate.without_one
    ]
    for (u, v), error in zip(to_opencv(pixels).tolist(), errors, strict=True):
        if error is not None and not error.rms_m <= most_m:
            return {"u": u, "v": v, "error_mm": 1000 * error.rms_m, "allowed_mm": 1000 * most_m}
    return None


CONTROL_GATES: Final = (
    Gate(
        name="control",
        limits={"at_least": 12},
        source="twice the unknowns of a pose",
        refuses=_control,
        text="only {n} of {n_all} control ties agree with one pose, at least {at_least} must",
    ),
    Gate(
        name="share",
        limits={"at_least": 0.04},
        source="robust sampling finds a pose among so few right ties (benchmarks/robust_pose.py)",
        refuses=_share,
        text="only {share:.1%} of {n_all} ties agree with one pose, at least {at_least:.1%} must",
    ),
    Gate(
        name="chance",
        limits={"at_most": 1e-5},
        source="one wrong pose in a hundred thousand may look right (binomial test)",
        refuses=_chance,
        text="{n_agree} of {n_check} withheld ties agree with the pose, as a wrong pose could "
        "have by chance",
    ),
    Gate(
        name="check-share",
        limits={"of_control": 0.5},
        source="withheld ties agree as often as the control of a right pose",
        refuses=_check_share,
        text="{n_agree} of {n_check} withheld ties agree with the pose, but {share:.0%} of "
        "the control does: the pose was fitted to chance",
    ),
    Gate(
        name="check-rms",
        limits={"of_control": 2.0},
        source="withheld ties deviate as much as the control of a right pose",
        refuses=_check_rms,
        text="the check ties deviate {times:.1f} times as much as the control, at most "
        "{of_control:g} times is plausible",
    ),
)
"""What the ties themselves must show."""

_SIDE: Final = Gate(
    name="side",
    limits={},
    source="a photo shows the front of a wall",
    refuses=_side,
    text="the pose lies behind the wall it would show, so it must be wrong",
)
_ON_WALLS: Final = (
    Gate(
        name="accuracy",
        limits={"cells": "max_sigma_wall_cells"},
        source="the job",
        refuses=_accuracy,
        text="its predicted error on the wall is {error_mm:.1f} mm, at most {cells:g} cells of "
        "{gsd_mm:g} mm are allowed",
    ),
    Gate(
        name="accuracy-at-worst",
        limits={"cells": "max_sigma_corner_cells"},
        source="the job",
        refuses=_accuracy_at_worst,
        text="its predicted error at the worst place of the wall is {error_mm:.1f} mm, at most "
        "{cells:g} cells of {gsd_mm:g} mm are allowed",
    ),
)
_SHOWN: Final = Gate(
    name="shown",
    limits={},
    source="a photo that shows no wall paints nothing",
    refuses=_shown,
    text="with this pose the photo would show no wall that its ties lie on",
)

GATES: Final = (
    *CONTROL_GATES,
    Gate(
        name="quarters",
        limits={"at_least": "min_quadrant_ties", "cells": "max_sigma_wall_cells"},
        source="markiewicz2015, 4.3",
        refuses=_quarters,
        text="a quarter of the photo has {n} ties, each needs {at_least}{why}",
    ),
    _SIDE,
    _SHOWN,
    Gate(
        name="hull",
        limits={"at_least": "min_hull_ratio"},
        source="the job",
        refuses=_hull,
        text="the control covers {ratio:.1%} of the part of the photo that shows the walls, at "
        "least {at_least:.1%} is needed",
    ),
    *_ON_WALLS,
)
"""All that an orientation by ties of a matcher must meet, in the order in which it is asked."""

GATES_BEFORE_BLOCK: Final = (*CONTROL_GATES, _SIDE)
"""What keeps a photo from harming others; what it lacks in exactness, these may bring."""

GATES_BY_HAND: Final = (
    _SIDE,
    _SHOWN,
    *_ON_WALLS,
    Gate(
        name="each-other",
        limits={"cells": "max_sigma_corner_cells"},
        source="the job",
        refuses=_each_other,
        text="without the tie at (u {u:.0f}, v {v:.0f}) its predicted error on the wall would be "
        "{error_mm:.1f} mm, at most {allowed_mm:.1f} mm is allowed: if that tie were wrong, "
        "the others could "
        "not reveal it; measure more of them, farther apart",
    ),
)
"""What a pose from ties that a person measured must meet."""


def _chance_probability(candidate: Candidate, limit: float) -> float:
    """Probability that a wrong tie falls within a limit of a pose it has nothing to do with."""
    residuals, lengths = candidate.estimate.fit.residuals_px, candidate.estimate.fit.normalised
    inside = candidate.estimate.agreeing & (lengths > 0.0)
    radius = limit * float(np.median(np.linalg.norm(residuals[inside], axis=1) / lengths[inside]))
    # Wrong ties gather where the texture is, not all over the photo.
    textured = max(hull_area(candidate.seen.pixels_photo), 1.0) / 4.0
    searched = (2.0 * candidate.search_radius_px) ** 2
    return min(0.5, math.pi * radius**2 / min(textured, searched))


def _tail(n_least: int, n_all: int, probability: float) -> float:
    """Probability of at least n_least successes in n_all trials (binomial)."""
    from scipy.special import bdtrc  # scipy.stats would take seconds to import

    return float(bdtrc(n_least - 1, n_all, probability))
