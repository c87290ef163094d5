"""Gates: the criteria that an orientation must meet.

Each gate declares a value of the orientation, a limit, and the reason for a rejection.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import WallFrame
from orthoflow.geometry.cameras import ViewingCamera, to_opencv
from orthoflow.geometry.resection import (
    Resection,
    SeenPoints,
    pixels_by_point,
    predicted_covariances,
)
from orthoflow.products import Photo, Ties, TieWall, plane_name
from orthoflow.sdk import DiagnosticSpec
from orthoflow_plugins.orient.pose import (
    UNKNOWN,
    Estimate,
    Note,
    OrientParams,
    camera_rays,
    image_cells,
)

_GRID_SIDE: Final = 15
# Minimum cosine of the angle of incidence; photos at more oblique angles are not used for
# orthoimages.
_GRAZING_COSINE: Final = 0.1


@dataclass(frozen=True, kw_only=True)
class KnownWall:
    """A wall as described in `Ties` or by its tie points.

    Attributes:
        index: index of the wall.
        number: number of its plane in `planes.json`, for messages.
        name: name of the wall, for messages.
        corners_world: (4, 3) corners in metres, counter-clockwise from the top left as seen by the
            viewer.
        normal: (3,) unit vector towards the viewer.
        gsd_m: cell size of its raster, or None if unknown.
        has_side: whether the normal is known to point to the viewer.
        frame: raster of a curved wall; None on a plane.
    """

    index: int
    number: int
    name: str
    corners_world: NDArray[np.float64]
    normal: NDArray[np.float64]
    gsd_m: float | None
    has_side: bool
    frame: WallFrame | None = None

    @property
    def ring_world(self) -> NDArray[np.float64]:
        """Closed outline (n, 3) of the wall."""
        if self.frame is None:
            return self.corners_world[[0, 1, 2, 3, 0]]
        return self.frame.outline_world()

    def axes_at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the axes right, down and towards the viewer, as rows, at points (n, 3).

        They are (3, 3) on a plane, and (n, 3, 3) on a cylinder.
        """
        if self.frame is not None:
            return self.frame.axes_at(self.frame.wall_from_world(points)[:, :2])
        top_left, bottom_left, _, top_right = self.corners_world
        right, down = top_right - top_left, bottom_left - top_left
        return np.vstack([right / np.linalg.norm(right), down / np.linalg.norm(down), self.normal])


@dataclass(frozen=True, kw_only=True)
class WallError:
    """Predicted error of a photo on its walls.

    Attributes:
        rms_m: standard deviation of a coordinate in the plane of the wall, as RMS over the
            footprint.
        worst_m: largest standard deviation in the footprint and at the image corners.
        corners_m: (4,) standard deviations at the top-left, top-right, bottom-left and bottom-right
            image corners; NaN if a corner shows none of the walls.
        footprint_px: (n, 2) photo pixels of the grid points on the walls that are visible in the
            photo.
        sigmas_m: (n,) standard deviation of a coordinate in the plane of the wall at these points.
    """

    rms_m: float
    worst_m: float
    corners_m: NDArray[np.float64]
    footprint_px: NDArray[np.float64]
    sigmas_m: NDArray[np.float64]


def known_walls(ties: Ties, chosen: NDArray[np.bool_]) -> list[KnownWall]:
    """Return the walls of the chosen ties, from `ties.walls` or from the points of the ties."""
    known = []
    for index in np.unique(ties.wall[chosen & (ties.wall >= 0)]).tolist():
        has_side = index < len(ties.walls)
        points = ties.points_world[chosen & (ties.wall == index)]
        if not has_side and len(points) < 3:
            continue
        wall, number = ties.walls[index] if has_side else _about(points), ties.number(index)
        known.append(
            KnownWall(
                index=index,
                number=number,
                name=wall.name or plane_name("wall", number),
                corners_world=np.array(wall.corners_world, dtype=np.float64),
                normal=np.array(wall.normal_world, dtype=np.float64),
                gsd_m=wall.gsd_m,
                has_side=has_side,
                frame=wall.frame,
            )
        )
    return known


def wall_error(resection: Resection, walls: Sequence[KnownWall]) -> WallError | None:
    """Predict the error on the walls from the covariance; None if the photo shows no wall."""
    parts = [_variances(resection, wall, _grid(wall, (_GRID_SIDE, _GRID_SIDE))) for wall in walls]
    variances = np.concatenate([np.empty(0), *(part[0] for part in parts)])
    shown = np.isfinite(variances)
    if not shown.any():
        return None
    variances, corners = variances[shown], _at_corners(resection, walls)
    return WallError(
        rms_m=float(np.sqrt(variances.mean())),
        worst_m=float(np.sqrt(np.fmax.reduce(corners, initial=variances.max()))),
        corners_m=np.sqrt(corners),
        footprint_px=np.vstack([part[1] for part in parts])[shown],
        sigmas_m=np.sqrt(variances),
    )


def sigmas_on_wall(
    resection: Resection, wall: KnownWall, shape: tuple[int, int]
) -> NDArray[np.float64]:
    """Predict the standard deviation of a coordinate in the plane of a wall, on a grid.

    Returns:
        (rows, cols) standard deviations in metres, first row at the top; NaN where the photo does
        not show the wall.
    """
    variances, _ = _variances(resection, wall, _grid(wall, shape))
    return np.sqrt(variances).reshape(shape)


def _at_corners(resection: Resection, walls: Sequence[KnownWall]) -> NDArray[np.float64]:
    """Return variances (4,) at the image corners, each the largest on the walls shown there."""
    camera, worst = resection.camera, np.full(4, np.nan)
    corners_px = np.array(
        [[u, v] for v in (0.5, camera.height - 0.5) for u in (0.5, camera.width - 0.5)]
    )
    rays = camera_rays(camera, corners_px) @ camera.rotation
    for wall in walls:
        if wall.frame is not None:
            met = wall.frame.met_by(camera.centre_world, rays)
            hit = np.flatnonzero(np.isfinite(met[:, 0]))
            worst[hit] = np.fmax(worst[hit], _variances(resection, wall, met[hit])[0])
            continue
        top_left, bottom_left, _, top_right = wall.corners_world
        sides = np.array([top_right - top_left, bottom_left - top_left])
        with np.errstate(divide="ignore", invalid="ignore"):
            along = ((top_left - camera.centre_world) @ wall.normal) / (rays @ wall.normal)
            points = camera.centre_world + along[:, None] * rays
        shares = ((points - top_left) @ sides.T) / (sides**2).sum(axis=1)
        hit = np.flatnonzero((along > 0.0) & ((shares >= 0.0) & (shares <= 1.0)).all(axis=1))
        variances, _ = _variances(resection, wall, points[hit])
        worst[hit] = np.fmax(worst[hit], variances)
    return worst


def _before_m(centre: NDArray[np.float64], wall: KnownWall) -> float:
    """Return how far a camera is in front of a wall, or in front of any part of a curved one."""
    if wall.frame is None:
        return float((centre - wall.corners_world.mean(axis=0)) @ wall.normal)
    points = _grid(wall, (_GRID_SIDE, _GRID_SIDE))
    lifts_m = np.einsum("ij,ij->i", centre - points, wall.axes_at(points)[:, 2])
    return float(np.nanmax(lifts_m))


def _grid(wall: KnownWall, shape: tuple[int, int]) -> NDArray[np.float64]:
    """Return the cell centres (rows * cols, 3) of a grid over the rectangle of a wall.

    Those beside the sector of a cone are NaN.
    """
    top_left, bottom_left, _, top_right = wall.corners_world
    down, along = (
        axis.ravel()
        for axis in np.meshgrid(*((np.arange(n) + 0.5) / n for n in shape), indexing="ij")
    )
    if (frame := wall.frame) is not None:
        cells = np.column_stack([along * frame.width, down * frame.height])
        return np.where(frame.shows(cells)[:, None], frame.world_from_wall(cells), np.nan)
    points: NDArray[np.float64] = (
        top_left
        + along[:, None] * (top_right - top_left)
        + down[:, None] * (bottom_left - top_left)
    )
    return points


def _variances(
    resection: Resection, wall: KnownWall, points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return variances (n,) and pixels (n, 2) of wall points; NaN where not visible."""
    axes = wall.axes_at(points)
    pixels = _seen(resection.camera, points, axes[..., 2, :])
    variances = np.full(len(points), np.nan)
    shown = np.isfinite(pixels[:, 0])
    if not shown.any():
        return variances, pixels
    along = axes[shown, :2] if axes.ndim > 2 else axes[:2]
    along = np.swapaxes(along, -1, -2)
    plane_by_pixel = np.linalg.inv(pixels_by_point(resection.camera, points[shown]) @ along)
    covariances = plane_by_pixel @ predicted_covariances(resection, points[shown])
    covariances = covariances @ plane_by_pixel.transpose(0, 2, 1)
    variances[shown] = 0.5 * np.trace(covariances, axis1=1, axis2=2)
    return variances, pixels


def _seen(
    camera: ViewingCamera, points: NDArray[np.float64], normal: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return pixels (n, 2) of wall points; NaN outside the image or at grazing angles."""
    pixels = camera.project(points)[:, :2]
    towards = camera.centre_world - points
    if normal.ndim > 1:
        # The far side of a tower faces away.
        cosine = np.einsum("ij,ij->i", towards, normal) / np.linalg.norm(towards, axis=1)
    else:
        cosine = np.abs(towards @ normal) / np.linalg.norm(towards, axis=1)
    pixels[~camera.sees(pixels) | (cosine < _GRAZING_COSINE)] = np.nan
    return pixels


def _about(points: NDArray[np.float64]) -> TieWall:
    """Return the bounding rectangle of points, in the plane that fits them best, as a wall."""
    middle = points.mean(axis=0)
    axes = np.linalg.svd(points - middle, full_matrices=False)[2]
    local = (points - middle) @ axes[:2].T
    low, high = local.min(axis=0), local.max(axis=0)
    order = np.array([[low[0], low[1]], [low[0], high[1]], high, [high[0], low[1]]])
    return TieWall(
        corners_world=tuple(map(tuple, (middle + order @ axes[:2]).tolist())),
        normal_world=tuple(axes[2].tolist()),
    )


_MIN_TIES: Final = 8
_CROWDED_RATIO: Final = 10
# Residuals of correct ties are concentrated near 0, unlike those of wrong ties. Therefore, several
# radii are tested, which are given as shares of the limit.
_CHANCE_RADII: Final = (0.2, 0.35, 0.6, 1.0)
_PLACE_PX: Final = 8.0
_MIN_CHECKS: Final = 5
_MIN_ON_WALL: Final = 4
CROWDED: Final = DiagnosticSpec(
    code="ties-crowded",
    severity="warning",
    text="photo {subject}: the ties are unevenly distributed; one quarter of the photo has "
    "{n_most}, another only {n_least} (a ratio of more than {ratio})",
    remedy="{unless[match.guided]:match the photo again with match.guided, or }measure points "
    "there (input ties)",
    settled_by=("match.guided",),
)
SMALL_HULL: Final = DiagnosticSpec(
    code="control-covers-little",
    severity="warning",
    text="photo {subject}: its control ties cover only {share:.0%} of the part of the photo that "
    "shows the walls",
    rank_by="-share",
)
FOCAL_ESTIMATED: Final = DiagnosticSpec(
    code="focal-length-estimated",
    severity="warning",
    text="photo {subject}: its focal length was estimated, since neither calibration nor "
    "EXIF contains it",
    remedy="provide a calibration file for higher accuracy",
)


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """An orientation and the values that the gates test; undefined values are None.

    Attributes:
        photo: the photo.
        seen: ties of the photo.
        is_check: (n,) True for check points.
        walls: (n,) index of the wall of each tie.
        estimate: the estimated pose.
        known: the walls of the inliers.
        error: predicted error on these walls; None if the photo shows none of them.
        params: parameters that contain the limits.
        search_radius_px: radius around the expected positions within which ties were searched for;
            infinite if the whole photo was searched. Wrong ties are also within this radius.
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

    @cached_property
    def control(self) -> NDArray[np.bool_]:
        """Mask (n,) of the inliers among the control points."""
        return self.estimate.agreeing & ~self.is_check

    @cached_property
    def withheld(self) -> NDArray[np.bool_]:
        """Mask (n,) of the inliers among the check points."""
        return self.estimate.agreeing & self.is_check

    @cached_property
    def checked(self) -> NDArray[np.bool_]:
        """Mask (n,) of the inliers among the check points that do not duplicate a control point.

        A key point with two main directions has two features at the same position, and both may be
        matched with the same point.
        """
        places = np.column_stack([self.seen.pixels_photo, self.seen.points_world])
        place = np.unique(places, axis=0, return_inverse=True)[1].ravel()
        return self.withheld & ~np.isin(place, place[~self.is_check])

    @cached_property
    def quadrant_counts(self) -> list[int]:
        """Number of inliers in each quarter of the photo, in the order of `image_cells`."""
        cells = self._quarters(self.seen.pixels_photo[self.estimate.agreeing])
        return [int((cells == quarter).sum()) for quarter in range(4)]

    @cached_property
    def gsd_m(self) -> float | None:
        """Smallest cell size of the walls in metres; None if unknown."""
        return min((wall.gsd_m for wall in self.known if wall.gsd_m is not None), default=None)

    @property
    def chance(self) -> float:
        """Probability that at least as many check points agree with a wrong pose (binomial)."""
        from scipy.special import bdtrc  # importing scipy.stats would take seconds

        fit, limit = self.estimate.fit, self.estimate.limit
        inside = self.estimate.agreeing & (fit.normalised > 0.0)
        lengths_px = np.linalg.norm(fit.residuals_px[inside], axis=1)
        px = float(np.median(lengths_px / fit.normalised[inside]))
        # Wrong ties occur only in textured areas.
        textured = max(hull_area(self.seen.pixels_photo), 1.0) / 4.0
        area = min(textured, (2.0 * self.search_radius_px) ** 2)
        found = []
        for share in _CHANCE_RADII:
            near = self.withheld & (fit.normalised / limit <= share)
            places = np.floor(self.seen.pixels_photo[near] / _PLACE_PX)
            by_chance = min(0.5, math.pi * (share * limit * px) ** 2 / area)
            n_places = len(np.unique(places, axis=0))
            found.append(float(bdtrc(n_places - 1, self.is_check.sum(), by_chance)))
        return len(found) * min(found)

    @property
    def control_share(self) -> float:
        """Share of inliers among the control points."""
        return float(self.estimate.agreeing[~self.is_check].mean())

    @property
    def check_over_control(self) -> float | None:
        """Share of inliers among check points, divided by that among control points."""
        if self.is_check.sum() < _MIN_CHECKS:
            return None
        return float(self.estimate.agreeing[self.is_check].mean()) / self.control_share

    @property
    def check_rms_over_control(self) -> float | None:
        """RMS residual of check points, divided by that of control points."""
        if self.withheld.sum() < _MIN_CHECKS:
            return None
        squares = self.estimate.fit.normalised**2
        return math.sqrt(squares[self.withheld].mean() / squares[self.control].mean())

    def in_cells(self, length_m: float) -> float | None:
        """Convert a length on the wall to raster cells; None if the cell size is unknown."""
        return length_m / self.gsd_m if self.gsd_m else None

    @cached_property
    def poor_quarter(self) -> tuple[int, str] | None:
        """Number of ties in the first quarter of the photo with too few ties, and the reason.

        In markiewicz2015, each quarter needs two ties. However, a quarter without ties may only
        show an obstacle or an area beyond the end of the wall. Such a photo is usable if its other
        quarters determine the pose well enough: the largest predicted error on the walls in the
        quarter without ties must be below the limit for the average over the photo. A quarter that
        shows no wall needs no ties. `strict` applies the rule of the paper.
        """
        params = self.params
        for quarter, count in enumerate(self.quadrant_counts):
            if count >= params.min_quadrant_ties:
                continue
            if params.quadrants == "strict":
                return count, ""
            worst_m = 0.0
            if self.error is not None:
                here = self._quarters(self.error.footprint_px) == quarter
                worst_m = float(self.error.sigmas_m[here].max(initial=0.0))
            most_m = params.max_sigma_wall_cells * (self.gsd_m or 0.0)
            if worst_m > most_m:
                allowed = f"; the limit is {1000 * most_m:.1f} mm" if self.gsd_m else ""
                return count, (
                    ": the pose would be extrapolated there, with a predicted error of "
                    f"{1000 * worst_m:.1f} mm{allowed}"
                )
        return None

    @property
    def before_wall_m(self) -> float | None:
        """Distance in metres to the nearest wall with control points and a known side."""
        centre = self.estimate.resection.camera.centre_world
        used = self.walls[self.control]
        return min(
            (
                _before_m(centre, wall)
                for wall in self.known
                if wall.has_side and (used == wall.index).sum() >= _MIN_ON_WALL
            ),
            default=None,
        )

    @cached_property
    def hull_ratio(self) -> float:
        """Area of the hull of the control points relative to that of the walls in the photo.

        The value is 0 if the photo shows none of the walls.
        """
        if self.error is None:
            return 0.0
        footprint = hull_area(self.error.footprint_px)
        return hull_area(self.seen.pixels_photo[self.control]) / max(footprint, 1.0)

    @cached_property
    def needed_tie(self) -> tuple[float, NDArray[np.float64]] | None:
        """Largest predicted error, in cells, if one tie is omitted, and the pixel of that tie.

        An undetected error of a tie displaces the pose at most by the uncertainty of the pose
        without that tie.
        """
        without = [wall_error(one, self.known) for one in self.estimate.without_one]
        if self.gsd_m is None or not without:
            return None
        cells = [0.0 if one is None else one.rms_m / self.gsd_m for one in without]
        worst = int(np.argmax(np.nan_to_num(cells, nan=math.inf)))
        pixels = self.seen.pixels_photo[self.estimate.agreeing]
        return float(np.nan_to_num(cells[worst], nan=math.inf)), to_opencv(pixels[worst])

    def _quarters(self, pixels: NDArray[np.float64]) -> NDArray[np.intp]:
        return image_cells(pixels, (self.photo.width, self.photo.height), 2)


@dataclass(frozen=True, kw_only=True)
class Gate:
    """A criterion for an orientation.

    Attributes:
        name: name of the gate in the record.
        value: function that computes the tested value; None passes the gate.
        limit: the smallest value that passes, or the name of the parameter that contains this
            value.
        is_upper: whether the limit is the largest value that passes, not the smallest.
        reason: function that returns the reason for a rejection, given the candidate, its value and
            the limit.
    """

    name: str
    value: Callable[[Candidate], float | None]
    limit: float | str
    is_upper: bool = False
    reason: Callable[[Candidate, float, float], str]


def _checks(c: Candidate) -> str:
    return f"{c.withheld.sum()} of {c.is_check.sum()} withheld ties agree with the pose"


CONTROL_GATES: Final = (
    Gate(
        name="control",
        value=lambda c: int(c.control.sum()),
        limit=12,  # twice the unknowns of a pose
        reason=lambda c, value, limit: (
            f"only {value} of {(~c.is_check).sum()} control ties agree with one pose; at least "
            f"{limit} are required"
        ),
    ),
    Gate(
        name="share",
        value=lambda c: float(c.estimate.agreeing.mean()),
        limit=0.04,  # robust sampling tolerates these outliers (benchmarks/robust_pose.py)
        reason=lambda c, value, limit: (
            f"only {value:.1%} of {len(c.seen)} ties agree with one pose; at least {limit:.1%} are "
            "required"
        ),
    ),
    Gate(
        name="chance",
        value=lambda c: c.chance,
        limit=1e-5,
        is_upper=True,
        reason=lambda c, *_: f"{_checks(c)}, no more than would agree with a wrong pose by chance",
    ),
    Gate(
        name="check-share",
        value=lambda c: c.check_over_control,
        limit=0.5,
        reason=lambda c, *_: (
            f"{_checks(c)}, but {c.control_share:.0%} of the control ties do: the pose was "
            "fitted to ties that agree by chance"
        ),
    ),
    Gate(
        name="check-rms",
        value=lambda c: c.check_rms_over_control,
        limit=2.0,
        is_upper=True,
        reason=lambda _, value, limit: (
            f"the withheld ties deviate {value:.1f} times as much as the control ties; the limit "
            f"is {limit:g} times"
        ),
    ),
)
"""Gates that test the agreement of the ties."""

_SIDE: Final = Gate(
    name="side",
    value=lambda c: c.before_wall_m,
    limit=0.0,
    reason=lambda *_: "the camera would be behind the wall it shows, so the pose is wrong",
)


def _too_inexact(of: str, c: Candidate, value: float, limit: float) -> str:
    gsd_mm = 1000.0 * (c.gsd_m or math.nan)
    return (
        f"its predicted error {of} is {value * gsd_mm:.1f} mm; the limit is {limit:g} cells of "
        f"{gsd_mm:g} mm"
    )


_ON_WALLS: Final = (
    Gate(
        name="accuracy",
        value=lambda c: c.in_cells(c.error.rms_m) if c.error else None,
        limit="max_sigma_wall_cells",
        is_upper=True,
        reason=partial(_too_inexact, "on the wall"),
    ),
    Gate(
        name="accuracy-at-worst",
        value=lambda c: c.in_cells(c.error.worst_m) if c.error else None,
        limit="max_sigma_corner_cells",
        is_upper=True,
        reason=partial(_too_inexact, "at the worst position on the wall"),
    ),
)
_SHOWN: Final = Gate(
    name="shown",
    value=lambda c: c.error is not None,
    limit=1.0,
    reason=lambda *_: (
        "with this pose, the photo would show none of the walls that contain its ties"
    ),
)

GATES: Final = (
    *CONTROL_GATES,
    Gate(
        name="quarters",
        value=lambda c: c.poor_quarter[0] if c.poor_quarter else None,
        limit="min_quadrant_ties",
        reason=lambda c, value, limit: (
            f"one quarter of the photo has too few ties ({value}; each needs at least {limit:g})"
            f"{c.poor_quarter[1] if c.poor_quarter else ''}"
        ),
    ),
    _SIDE,
    _SHOWN,
    Gate(
        name="hull",
        value=lambda c: c.hull_ratio,
        limit="min_hull_ratio",
        reason=lambda _, value, limit: (
            f"the control ties cover {value:.1%} of the part of the photo that shows the walls; "
            f"at least {limit:.1%} is required"
        ),
    ),
    *_ON_WALLS,
)
"""Gates for an orientation from a matcher's ties, in order."""

GATES_BEFORE_BLOCK: Final = (*CONTROL_GATES, _SIDE)
"""Gates before a bundle adjustment; accuracy is not tested, since other photos may improve it."""


def _unchecked_tie(c: Candidate, value: float, limit: float) -> str:
    u, v = (math.nan, math.nan) if c.needed_tie is None else c.needed_tie[1]
    return (
        f"without the tie at (u {u:.0f}, v {v:.0f}), the predicted error on the wall would be "
        f"{value:.1f} cells of {1000.0 * (c.gsd_m or math.nan):g} mm; the limit is {limit:g} "
        "cells. An error of that tie could not be detected: measure more ties, farther apart"
    )


GATES_BY_HAND: Final = (
    _SIDE,
    _SHOWN,
    *_ON_WALLS,
    Gate(
        name="each-other",
        value=lambda c: c.needed_tie[0] if c.needed_tie else None,
        limit="max_sigma_corner_cells",
        is_upper=True,
        reason=_unchecked_tie,
    ),
)
"""Gates for a pose from ties measured by hand."""


def refusal(candidate: Candidate, gates: Sequence[Gate] | None = None) -> tuple[str, str] | None:
    """Test an orientation.

    Args:
        candidate: the orientation.
        gates: the gates, in order; if None, they depend on whether the ties were measured by hand.

    Returns:
        Name of the first gate that the orientation does not pass, and the reason; None if it passes
        all.
    """
    if gates is None:
        gates = GATES_BY_HAND if candidate.estimate.without_one else GATES
    for gate in gates:
        limit, value = gate.limit, gate.value(candidate)
        if isinstance(limit, str):
            limit = float(getattr(candidate.params, limit))
        if value is not None and (value > limit if gate.is_upper else value < limit):
            return gate.name, gate.reason(candidate, value, limit)
    return None


def too_few(n_ties: int) -> str:
    """Return why there are too few ties for an orientation; empty if there are enough."""
    if n_ties >= _MIN_TIES:
        return ""
    return (
        f"too few ties to the walls were found ({n_ties}; at least {_MIN_TIES} are required): the "
        "photo shows none of the walls, its colours differ too much from the intensity, the cells "
        "are too coarse, or the scan has too much noise"
    )


def warnings_for(candidate: Candidate) -> list[Note]:
    """Return warnings about an accepted orientation."""
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
    """Return the area of the convex hull of points (n, 2); 0 if they are collinear."""
    from scipy.spatial import ConvexHull, QhullError

    if len(pixels) < 3:
        return 0.0
    try:
        return float(ConvexHull(pixels).volume)
    except QhullError:
        return 0.0
