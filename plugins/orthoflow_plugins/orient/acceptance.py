"""Whether an orientation may be called `ok`: every gate has a reason in one sentence."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.opencv_border import to_opencv
from orthoflow.geometry.resection import SeenPoints
from orthoflow.products import Photo
from orthoflow_plugins.orient.estimation import Estimate
from orthoflow_plugins.orient.layout import hull_area, image_cells, quadrant_counts
from orthoflow_plugins.orient.lenses import UNKNOWN
from orthoflow_plugins.orient.wall_errors import KnownWall, WallError, wall_error

_TIES_LEAST: Final = 8
_SIDE_CHECK_LEAST: Final = 4
_QUADRANT_RATIO: Final = 10
# Probability that the check points of a wrong pose agree by chance. Right ties gather close to
# where they should be, wrong ones do not: several shares of the limit are tried.
_CHANCE_MOST: Final = 1e-5
_CHANCE_RADII: Final = (0.2, 0.35, 0.6, 1.0)
_CHECK_AGREEMENT_LEAST: Final = 0.5
_CHECK_RMSE_RATIO: Final = 2.0
_PLACE_PX: Final = 8.0


@dataclass(frozen=True, kw_only=True)
class GateRule:
    """What an orientation must reach.

    Attributes:
        n_control_least: control ties that agree.
        n_quadrant_least: ties that agree in each quarter of the photo.
        quadrants_are_strict: whether a quarter with fewer is refused whatever is predicted there.
        inlier_share_least: share of all ties that agree.
        hull_ratio_least: hull of the control over the part of the photo that shows its walls.
        sigma_wall_most_gsd: predicted error on the wall, RMS over the footprint, in cells.
        sigma_corner_most_gsd: the same, worst place of the footprint.
    """

    n_control_least: int
    n_quadrant_least: int
    quadrants_are_strict: bool
    inlier_share_least: float
    hull_ratio_least: float
    sigma_wall_most_gsd: float
    sigma_corner_most_gsd: float


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
        rule: what it must reach.
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
    rule: GateRule
    search_radius_px: float = math.inf

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of the photo."""
        return self.photo.width, self.photo.height

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
        agreeing = self.seen.pixels_photo[self.estimate.agreeing]
        counts: list[int] = quadrant_counts(agreeing, self.size_px).tolist()
        return counts

    @property
    def gsd_m(self) -> float | None:
        """Smallest cell of its walls, None when the ties do not say."""
        return min((wall.gsd_m for wall in self.known if wall.gsd_m is not None), default=None)

    def worst_in_quarter_m(self, quarter: int) -> float:
        """Largest predicted error on the walls that a quarter shows; 0 when it shows none."""
        if self.error is None:
            return 0.0
        cells = image_cells(self.error.footprint_px, self.size_px, 2)
        return float(self.error.sigmas_m[cells == quarter].max(initial=0.0))

    @property
    def hull_ratio(self) -> float:
        """Hull of the control over the footprint of its walls in the photo; 0 without one."""
        if self.error is None:
            return 0.0
        footprint = hull_area(self.error.footprint_px)
        return hull_area(self.seen.pixels_photo[self.control]) / max(footprint, 1.0)


def too_few(n_ties: int) -> str:
    """Say why ties are too few for an orientation; empty when they suffice."""
    if n_ties < _TIES_LEAST:
        return (
            f"{n_ties} ties with the walls, at least {_TIES_LEAST} are needed: the photo "
            "shows none of the walls, or too differently, or in cells that are too coarse"
        )
    return ""


def reason_against(candidate: Candidate) -> str:
    """Say why an orientation is not `ok`; empty when it is."""
    for gate in _GATES_BY_HAND if candidate.estimate.without_one else _GATES:
        reason = gate(candidate)
        if reason:
            return reason
    return ""


def reason_to_leave_out(candidate: Candidate) -> str:
    """Say why an orientation would harm those of other photos; empty when it would not.

    What it lacks in exactness, the other photos may bring.
    """
    gates = (_enough_control, _enough_share, _not_by_chance, _check_agrees, _in_front)
    return next((reason for gate in gates if (reason := gate(candidate))), "")


def warnings_for(candidate: Candidate) -> list[str]:
    """Say what limits an orientation that is `ok`."""
    notes = []
    counts = candidate.quadrant_counts
    if max(counts) > _QUADRANT_RATIO * min(counts):
        notes.append(
            f"a quarter of the photo has {max(counts)} ties, another {min(counts)}: more than "
            f"{_QUADRANT_RATIO} times as many"
        )
    if candidate.hull_ratio < 1.5 * candidate.rule.hull_ratio_least:
        notes.append(
            f"the control covers {candidate.hull_ratio:.0%} of the part that shows the walls"
        )
    if candidate.estimate.source == UNKNOWN:
        notes.append("neither calibration nor EXIF says its focal length, which was estimated")
    return notes


def _enough_control(candidate: Candidate) -> str:
    n_control = int(candidate.control.sum())
    if n_control < candidate.rule.n_control_least:
        return (
            f"only {n_control} of {int((~candidate.is_check).sum())} control ties agree with one "
            f"pose, at least {candidate.rule.n_control_least} must"
        )
    return ""


def _enough_share(candidate: Candidate) -> str:
    share = float(candidate.estimate.agreeing.mean())
    if share < candidate.rule.inlier_share_least:
        return (
            f"only {share:.1%} of {len(candidate.seen)} ties agree with one pose, at least "
            f"{candidate.rule.inlier_share_least:.1%} must"
        )
    return ""


def _not_by_chance(candidate: Candidate) -> str:
    """A pose fitted to wrong ties fits withheld ties by chance only."""
    n_check, n_agree = int(candidate.is_check.sum()), int(candidate.withheld.sum())
    lengths = candidate.estimate.fit.normalised / candidate.estimate.limit
    probabilities = []
    for share in _CHANCE_RADII:
        near = candidate.withheld & (lengths <= share)
        by_chance = _chance_probability(candidate, share * candidate.estimate.limit)
        n_places = _n_places(candidate.seen.pixels_photo[near])
        probabilities.append(_tail(n_places, n_check, by_chance))
    if len(_CHANCE_RADII) * min(probabilities) > _CHANCE_MOST:
        return (
            f"{n_agree} of {n_check} withheld ties agree with the pose, as a wrong pose could "
            "have by chance"
        )
    return ""


def _check_agrees(candidate: Candidate) -> str:
    share_control = float(candidate.control.sum() / (~candidate.is_check).sum())
    n_check, n_agree = int(candidate.is_check.sum()), int(candidate.withheld.sum())
    if n_agree / n_check < _CHECK_AGREEMENT_LEAST * share_control and n_check >= 5:
        return (
            f"{n_agree} of {n_check} withheld ties agree with the pose, but {share_control:.0%} of "
            "the control does: the pose was fitted to chance"
        )
    lengths = candidate.estimate.fit.normalised
    rms_control = float(np.sqrt(np.mean(lengths[candidate.control] ** 2)))
    rms_check = float(np.sqrt(np.mean(lengths[candidate.withheld] ** 2))) if n_agree else math.inf
    if n_agree >= 5 and rms_check > _CHECK_RMSE_RATIO * rms_control:
        return (
            f"the check ties deviate {rms_check / rms_control:.1f} times as much as the control, "
            f"at most {_CHECK_RMSE_RATIO:g} times is plausible"
        )
    return ""


def _spread(candidate: Candidate) -> str:
    """Hold each quarter of the photo to its ties, or else to what the others say about it.

    After markiewicz2015 each quarter needs two ties. But an obstacle before the wall, or a view
    past the end of the wall, may fill a quarter in which no tie can be. A surveyor keeps such a
    photo when the rest of it fixes the pose: the error predicted for the walls in that quarter must
    be as small at its worst place as it has to be on the average of the photo. A quarter that shows
    no wall is painted nowhere and needs nothing. Only strictly the paper's rule holds as it stands.
    """
    n_least = candidate.rule.n_quadrant_least
    for quarter, count in enumerate(candidate.quadrant_counts):
        if count >= n_least:
            continue
        if candidate.rule.quadrants_are_strict:
            return f"a quarter of the photo has {count} ties, each needs {n_least}"
        worst_m = candidate.worst_in_quarter_m(quarter)
        most_m = candidate.rule.sigma_wall_most_gsd * candidate.gsd_m if candidate.gsd_m else 0.0
        if worst_m > most_m:
            return (
                f"a quarter of the photo has {count} ties, each needs "
                f"{n_least}: the pose would be extrapolated there, with a "
                f"predicted error of {1000 * worst_m:.1f} mm"
                + (f", at most {1000 * most_m:.1f} mm is allowed" if candidate.gsd_m else "")
            )
    return ""


def _in_front(candidate: Candidate) -> str:
    centre = candidate.estimate.resection.camera.centre_world
    for wall in candidate.known:
        used = candidate.walls[candidate.control] == wall.index
        if not (wall.has_side and used.sum() >= _SIDE_CHECK_LEAST):
            continue
        if float((centre - wall.corners_world.mean(axis=0)) @ wall.normal) <= 0.0:
            return "the pose lies behind the wall it would show, so it must be wrong"
    return ""


def _shows_a_wall(candidate: Candidate) -> str:
    if candidate.error is None:
        return "with this pose the photo would show no wall that its ties lie on"
    return ""


def _covered(candidate: Candidate) -> str:
    if candidate.hull_ratio < candidate.rule.hull_ratio_least:
        return (
            f"the control covers {candidate.hull_ratio:.1%} of the part of the photo that shows "
            f"the walls, at least {candidate.rule.hull_ratio_least:.1%} is needed"
        )
    return ""


def _accurate(candidate: Candidate) -> str:
    if candidate.error is None or candidate.gsd_m is None:
        return ""
    for value, most, where in (
        (candidate.error.rms_m, candidate.rule.sigma_wall_most_gsd, "on the wall"),
        (
            candidate.error.worst_m,
            candidate.rule.sigma_corner_most_gsd,
            "at the worst place of the wall",
        ),
    ):
        if value > most * candidate.gsd_m:
            return (
                f"its predicted error {where} is {1000 * value:.1f} mm, at most {most:g} cells of "
                f"{1000 * candidate.gsd_m:g} mm are allowed"
            )
    return ""


_GATES: Final[tuple[Callable[[Candidate], str], ...]] = (
    _enough_control,
    _enough_share,
    _not_by_chance,
    _check_agrees,
    _spread,
    _in_front,
    _shows_a_wall,
    _covered,
    _accurate,
)


def _checked_by_each_other(candidate: Candidate) -> str:
    """Hold a pose from few ties to what it would be worth without any of them.

    A wrong tie that the others cannot tell does no more harm than the pose without it is uncertain.
    """
    if candidate.gsd_m is None:
        return ""
    most_m = candidate.rule.sigma_corner_most_gsd * candidate.gsd_m
    pixels = candidate.seen.pixels_photo[candidate.estimate.agreeing]
    errors = [
        wall_error(resection, candidate.known) for resection in candidate.estimate.without_one
    ]
    for (u, v), error in zip(to_opencv(pixels), errors, strict=True):
        if error is not None and not error.rms_m <= most_m:
            return (
                f"without the tie at (u {u:.0f}, v {v:.0f}) its predicted error on the wall would "
                f"be {1000 * error.rms_m:.1f} mm, at most {1000 * most_m:.1f} mm is allowed: were "
                "that tie wrong, the others could not tell; measure more of them, farther apart"
            )
    return ""


_GATES_BY_HAND: Final[tuple[Callable[[Candidate], str], ...]] = (
    _in_front,
    _shows_a_wall,
    _accurate,
    _checked_by_each_other,
)


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


def _n_places(pixels: NDArray[np.float64]) -> int:
    return len(np.unique(np.floor(pixels / _PLACE_PX), axis=0))
