"""`orient.colmap-bundle`: bundle adjustment of all photos with ties to walls and photos."""

from __future__ import annotations

import math
from collections.abc import Sequence, Set
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from orthoflow.errors import GeometryError
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.key_points import Features
from orthoflow.geometry.resection import (
    Misfit,
    Resection,
    SeenPoints,
    fitted,
    misfit,
    moved_origin,
)
from orthoflow.products import JsonValue, Photo, Ties
from orthoflow.sdk import DiagnosticSpec, Method, MetricSpec, StepContext
from orthoflow.sdk.methods import Determinism
from orthoflow_plugins.orient.block import (
    Block,
    BlockCovariance,
    Observations,
    Points,
    block_covariance,
    correlation_notes,
    lens_statistics,
    lenses_json,
    solve,
)
from orthoflow_plugins.orient.gates import GATES_BEFORE_BLOCK, refusal
from orthoflow_plugins.orient.photo_ties import (
    PhotoTies,
    overlapping_pairs,
    photo_features,
    tie_photos,
)
from orthoflow_plugins.orient.photos import (
    Trusted,
    by_itself,
    candidate_of,
    looked_at,
    refused,
    require,
    scan_errors_of,
    tied_photo,
    with_believable_priors,
)
from orthoflow_plugins.orient.pose import (
    ORIENTATION_METRICS,
    SOFT_LIMIT,
    UNKNOWN,
    Estimate,
    Lens,
    OrientIn,
    OrientOut,
    OrientParams,
    Sharing,
    TiedPhoto,
    estimate_pose,
    focal_sigma,
    lens_groups,
    posed,
    unit_deviation,
    without_chance,
)
from orthoflow_plugins.orient.report import Oriented, hand_over

_SHARE_BY_ITSELF: Final = 0.4
_SHARE_FEATURES: Final = 0.7
# Two photos are matched if each of them shows at least this share of the wall points of the other.
_MIN_OVERLAP: Final = 0.2
# More tie points would only increase the computing time.
_MAX_PHOTO_POINTS: Final = 1000
# The sharing mode in which the photos of a lens are tested for a common focal length.
_TESTED: Final = "focal-group"
_ROUNDS: Final = 5
_TIE_SIGMA_START_PX: Final = 0.5
_TIE_SIGMA_RANGE_PX: Final = (0.1, 2.0)
# Points of different photos at most this far apart are the same scan point.
_SAME_PLACE_M: Final = 1e-6
# Photos without EXIF may or may not share a lens. A series is usually taken with one lens, and many
# photos determine a lens far better than one photo does. However, the photographer may have zoomed,
# and a photo may have been rotated or cropped. Therefore, the focal length computed from the ties
# of each photo is compared with the shared one. Zooming changes the focal length by more than this
# share; correlated scan errors change it by less (up to 0.7 % for photogrammetric clouds with 10 to
# 30 mm of noise).
_MIN_ZOOM: Final = 0.02
_ZOOM_SIGMAS: Final = 5.0
# The photo with the largest difference distorts the shared lens, so that other photos contradict
# that lens as well. Therefore, only photos whose difference exceeds this share of the largest are
# separated at first.
_SHARE_OF_WORST: Final = 0.5
NO_BLOCK: Final = DiagnosticSpec(
    code="bundle-without-result",
    severity="warning",
    text="the bundle adjustment failed, so each photo keeps its separate orientation: {reason}",
)


class OrientColmapBundle(Method):
    """Orient all photos together by a bundle adjustment with the scan as control.

    Each photo is first oriented separately. Photos are excluded if their ties agree with the pose
    no better than by chance. Key points are then matched between overlapping photos. COLMAP's cost
    functions and the Ceres solver adjust poses, lenses and points together. Ties to walls are
    weighted by the standard deviations from the matching step, and ties between photos by the
    standard deviation of their residuals. The initial values of uncalibrated lenses are taken from
    EXIF. Photos with the same focal length in EXIF share a lens, and so do photos without EXIF
    unless their ties contradict this. Gates and withheld ties are the same as in `orient.pnp`.
    """

    id: ClassVar[str] = "orient.colmap-bundle"
    determinism: ClassVar[Determinism] = "seeded"
    result_version: ClassVar[int] = 7
    metrics: ClassVar[tuple[MetricSpec, ...]] = (
        *ORIENTATION_METRICS,
        MetricSpec("n_photo_points", label="tie points visible in several photos"),
        MetricSpec(
            "photo_tie_rmse_px", label="tie points between photos, RMS residual", better="lower"
        ),
        MetricSpec("sigma0", label="standard deviation of unit weight (sigma0)"),
        MetricSpec("redundancy", label="redundancy of the adjustment"),
    )
    citations: ClassVar[tuple[str, ...]] = (
        (
            "Schoenberger, Frahm 2016, Structure-from-motion revisited (COLMAP), "
            "doi:10.1109/CVPR.2016.445"
        ),
        "Triggs et al. 2000, Bundle adjustment, a modern synthesis, doi:10.1007/3-540-44480-7_21",
        "Markiewicz, Podlasiak, Zawieska 2015, doi:10.3390/rs71215869 (4.3)",
    )

    class Params(OrientParams):
        """Lenses, ties between photos, and the parameters of `orient.pnp`."""

        intrinsics: Sharing = Field(
            default="focal-group",
            description="Which photos share a lens. focal-group: photos with the same image size "
            "and the same EXIF focal length or calibration, or with neither of these unless their "
            "ties contradict this; shared: all photos of the same size; per-photo: each photo has "
            "its own lens.",
        )
        photo_ties: bool = Field(
            default=True, description="Also match overlapping photos with each other."
        )
        max_features: int = Field(
            default=3000,
            ge=100,
            description="Number of key points per photo for ties between photos.",
        )

    In = OrientIn
    Out = OrientOut

    def run(self, inputs: OrientIn, params: Params, ctx: StepContext) -> OrientOut:
        """Orient each photo, then all of them together."""
        ties = inputs.ties
        require(ties, inputs.photos)
        photos = with_believable_priors(inputs.photos.photos, ties, params, ctx)
        scan_errors = scan_errors_of(inputs, ctx)
        tied = [tied_photo(photo, ties, params, ctx.rng, scan_errors) for photo in photos]
        looks = looked_at(
            tied, lambda one: _by_itself(one, ties, params), ctx, share=_SHARE_BY_ITSELF
        )
        found = {nth: look for nth, look in enumerate(looks) if isinstance(look, Oriented)}
        trusted = {nth: look for nth, look in enumerate(looks) if isinstance(look, Trusted)}
        details: dict[str, JsonValue] = {}
        if trusted:
            block = list(trusted.values())
            estimates = [item.estimate for item in block]
            adjusted = _adjusted(block, params, ctx)
            if adjusted is not None:
                estimates = list(adjusted.estimates)
                details = _report_block(ctx, adjusted, [item.tied.photo for item in block])
            for at, item, estimate in zip(trusted, block, estimates, strict=True):
                found[at] = item.judged(ties, params, estimate)
        every = [found[nth] for nth in range(len(photos))]
        return OrientOut(cameras=hand_over(ctx, ties, photos, every, details))

    @classmethod
    def tools(cls) -> dict[str, str]:
        """COLMAP and Ceres for the adjustment, OpenCV for the key points."""
        names = ("pycolmap", "pyceres", "scipy", "opencv-python-headless")
        return {name: version(name) for name in names}


def _by_itself(
    tied: TiedPhoto, ties: Ties, params: OrientColmapBundle.Params
) -> Trusted | Oriented:
    """Orient a photo from its own ties; reject it if the ties agree only by chance."""
    found = by_itself(tied, ties, params, estimate_pose)
    if isinstance(found, Oriented):
        return found
    # A wrong pose would distort the photos that are tied to it.
    against = refusal(candidate_of(tied, ties, params, found.estimate), GATES_BEFORE_BLOCK)
    if against is None:
        return found
    return refused(tied, against[1] if found.by_hand is None else found.by_hand.camera.status)


def _adjusted(
    block: Sequence[Trusted], params: OrientColmapBundle.Params, ctx: StepContext
) -> Adjusted | None:
    """Adjust photos with shared lenses; repeat with separate lenses if ties contradict these."""
    photos = [item.tied.photo for item in block]
    cameras = [item.estimate.resection.camera for item in block]
    between = _photo_ties(block, params, ctx)
    ctx.progress(_SHARE_FEATURES, "bundle adjustment")
    apart: Set[int] = frozenset()
    try:
        while True:
            groups = lens_groups(photos, cameras, params.intrinsics, apart)
            adjusted = adjust_block(block, between, groups, params)
            others = of_another_lens(block, adjusted) if params.intrinsics == _TESTED else apart
            if others <= apart:
                return adjusted
            for at in sorted(others):
                ctx.log(
                    f"photo {photos[at].name}: its ties contradict the lens shared by the photos "
                    "of this size, so it gets its own lens"
                )
            apart |= others
    except GeometryError as error:
        ctx.report(NO_BLOCK, reason=str(error))
        return None


def _photo_ties(
    block: Sequence[Trusted], params: OrientColmapBundle.Params, ctx: StepContext
) -> PhotoTies:
    cameras = [item.estimate.resection.camera for item in block]
    shown = [item.tied.control(item.estimate.agreeing).points_world for item in block]
    pairs = overlapping_pairs(cameras, shown, _MIN_OVERLAP) if params.photo_ties else []
    needed = {at for pair in pairs for at in pair}
    features = [Features.none()] * len(block)
    for at in sorted(needed):
        photo = block[at].tied.photo
        done = _SHARE_BY_ITSELF + (_SHARE_FEATURES - _SHARE_BY_ITSELF) * at / len(block)
        ctx.progress(done, f"key points of {photo.name}")
        features[at] = photo_features(photo, params.max_features)
    return tie_photos(cameras, features, pairs, _MAX_PHOTO_POINTS)


def _report_block(
    ctx: StepContext, adjusted: Adjusted, photos: Sequence[Photo]
) -> dict[str, JsonValue]:
    block, covariance = adjusted.block, adjusted.covariance
    for photo, (note, values) in correlation_notes(block, photos, covariance.cofactors):
        ctx.report(note, subject=photo, **values)
    ctx.metric("sigma0", covariance.sigma0, "1")
    ctx.metric("redundancy", covariance.redundancy, "1")
    ctx.metric("n_photo_points", adjusted.n_tie_points, "1")
    n_ties = len(adjusted.ties_px)
    if n_ties:
        rmse_px = math.sqrt(float(np.mean(adjusted.ties_px**2)) / 2.0)
        ctx.metric("photo_tie_rmse_px", rmse_px, "px")
    return {
        "sigma0": covariance.sigma0,
        "redundancy": covariance.redundancy,
        "lenses": lenses_json(block, photos, covariance.matrix),
        "lens_statistics": lens_statistics(block),
        "photo_ties": {
            "n_points": adjusted.n_tie_points,
            "n_observations": n_ties,
            "sigma_px": adjusted.tie_sigma_px if n_ties else None,
        },
    }


@dataclass(frozen=True, kw_only=True)
class Adjusted:
    """A block after its adjustment.

    Attributes:
        block: cameras, lenses and points, in coordinates whose origin is near the points.
        covariance: covariance of all unknowns.
        estimates: the pose of each photo, in world coordinates.
        tie_sigma_px: standard deviation of a pixel coordinate of a tie between photos, in pixels of
            the (possibly reduced) image in which the key point was found.
        ties_px: (m,) lengths of the residuals of ties between photos, in photo pixels.
        n_tie_points: number of points that are not in the scan.
    """

    block: Block
    covariance: BlockCovariance
    estimates: tuple[Estimate, ...]
    tie_sigma_px: float
    ties_px: NDArray[np.float64]
    n_tie_points: int


@dataclass(kw_only=True)
class _Weights:
    """Inliers and weights of an adjustment.

    Attributes:
        agreeing: for each photo, (n,) bool, the inliers among its scan ties.
        units: for each photo, the standard deviation of unit weight of its scan ties.
        limits: for each photo, the rejection limit of its scan ties, in standard deviations.
        tie_active: (m,) bool, the inliers among the ties between photos.
        tie_sigma: standard deviation of these ties, in pixels of the (possibly reduced) image in
            which the key points were found.
    """

    agreeing: list[NDArray[np.bool_]]
    units: list[float]
    limits: list[float]
    tie_active: NDArray[np.bool_]
    tie_sigma: float


def adjust_block(
    photos: Sequence[Trusted],
    ties: PhotoTies,
    groups: tuple[tuple[int, ...], tuple[Lens, ...]],
    params: OrientParams,
) -> Adjusted:
    """Adjust photos and lenses together; reject and reweight ties until the inliers do not change.

    Args:
        photos: the photos with their separate orientations.
        ties: ties between the photos, in world coordinates.
        groups: index of the lens of each photo, and the lenses.
        params: parameters for the rejection of ties.

    Raises:
        GeometryError: the ties do not determine the block.
    """
    middle = np.mean([item.tied.seen.points_world.mean(axis=0) for item in photos], axis=0)
    cameras, positions = _start(photos, groups, middle), ties.points_world - middle
    weights = _Weights(
        agreeing=[item.estimate.agreeing & ~item.tied.is_check for item in photos],
        units=[max(item.estimate.resection.sigma0, 0.1) for item in photos],
        limits=[],
        tie_active=np.ones(len(ties.photo), dtype=np.bool_),
        tie_sigma=_TIE_SIGMA_START_PX,
    )
    for nth in range(_ROUNDS):
        used = weights
        block = _block(photos, ties, groups, (cameras, positions, middle), used)
        block = solve(block, soft_limit=SOFT_LIMIT)
        cameras, positions = block.cameras, block.points.now[len(block.points) - len(positions) :]
        fits = [
            misfit(item.tied.seen, camera.shifted(-middle))
            for item, camera in zip(photos, cameras, strict=True)
        ]
        lengths_px = _tie_residuals(ties, cameras, positions)
        weights = _weighed(photos, fits, used, params.rejection_sigma)
        if used.tie_active.any():
            _weigh_between(ties, lengths_px / ties.scale, weights, params.rejection_sigma)
        if nth >= 1 and all(
            np.array_equal(before, after)
            for before, after in zip(
                [*used.agreeing, used.tie_active],
                [*weights.agreeing, weights.tie_active],
                strict=True,
            )
        ):
            break
    covariance = block_covariance(block, soft_limit=SOFT_LIMIT)
    return Adjusted(
        block=block,
        covariance=covariance,
        estimates=tuple(
            replace(
                item.estimate,
                resection=_resection(block, at, covariance, middle, used.units[at]),
                source=block.lenses[block.lens_of[at]].source,
                fit=fit,
                agreeing=fit.normalised <= limit,
                limit=limit,
            )
            for at, (item, fit, limit) in enumerate(zip(photos, fits, weights.limits, strict=True))
        ),
        tie_sigma_px=used.tie_sigma,
        ties_px=lengths_px[used.tie_active],
        n_tie_points=len(np.unique(ties.point[used.tie_active])),
    )


def of_another_lens(photos: Sequence[Trusted], adjusted: Adjusted) -> Set[int]:
    """Find photos that contradict a lens that they share only because of the image size.

    Args:
        photos: photos of the block.
        adjusted: the adjusted block.

    Returns:
        Indices of the photos with the largest contradiction; the others are tested again after the
        next adjustment.
    """
    block = adjusted.block
    excesses: dict[int, float] = {}
    for at, lens in enumerate(block.lens_of):
        alone, shared = photos[at].estimate.resection, adjusted.estimates[at].resection
        if block.lenses[lens].source != UNKNOWN or block.lens_of.count(lens) < 2:
            continue
        off = abs(math.log(alone.camera.fx / shared.camera.fx))
        excesses[at] = off / max(_MIN_ZOOM, _ZOOM_SIGMAS * focal_sigma(alone))
    most = max(excesses.values(), default=0.0)
    return frozenset(
        at for at, excess in excesses.items() if excess > max(1.0, _SHARE_OF_WORST * most)
    )


def _start(
    photos: Sequence[Trusted],
    groups: tuple[tuple[int, ...], tuple[Lens, ...]],
    middle: NDArray[np.float64],
) -> tuple[ViewingCamera, ...]:
    """Return the initial cameras, in coordinates whose origin is `middle`."""
    alone = [item.estimate.resection.camera for item in photos]
    cameras: list[ViewingCamera] = []
    lens_of, lenses = groups
    for at, item in enumerate(photos):
        lens, own = lenses[lens_of[at]], alone[at]
        members = [k for k, of in enumerate(lens_of) if of == lens_of[at]]
        if not lens.freedom.sigmas.size:
            own = posed(lens.prior, own)
        elif lens.source == UNKNOWN:
            # Use the lens of the photo whose ties determine the focal length best.
            best = min(members, key=lambda k: focal_sigma(photos[k].estimate.resection))
            if best != at:
                # The position of a camera depends on the focal length.
                own = posed(alone[best], own)
                with suppress(GeometryError):
                    own = fitted(item.tied.control(item.estimate.agreeing), own)
        cameras.append(own.shifted(middle))
    return tuple(cameras)


def _block(
    photos: Sequence[Trusted],
    ties: PhotoTies,
    groups: tuple[tuple[int, ...], tuple[Lens, ...]],
    state: tuple[tuple[ViewingCamera, ...], NDArray[np.float64], NDArray[np.float64]],
    weights: _Weights,
) -> Block:
    """Assemble the block from scan ties, ties between photos, and current cameras and points."""
    cameras, positions, middle = state
    seen = [
        item.tied.seen.take(chosen) for item, chosen in zip(photos, weights.agreeing, strict=True)
    ]
    counts = [len(part) for part in seen]
    units = np.repeat(weights.units, counts)
    scan = SeenPoints.joined(seen)
    _, first, place = np.unique(
        np.rint(scan.points_world / _SAME_PLACE_M), axis=0, return_index=True, return_inverse=True
    )
    place = place.ravel().astype(np.intp)
    sigma_m = np.zeros(len(first))
    np.maximum.at(sigma_m, place, units * scan.sigma_m)
    points = np.vstack([scan.points_world[first] - middle, positions])
    active, scan_errors = weights.tie_active, None
    if scan.scan_errors is not None:
        n_more = [(0, len(positions)), (0, 0), (0, 0)]
        scan_errors = np.pad(scan.scan_errors[first], n_more)
    return Block(
        cameras=cameras,
        lens_of=groups[0],
        lenses=groups[1],
        points=Points(
            now=points,
            known=points,
            sigma_m=np.concatenate([sigma_m, np.full(len(positions), np.inf)]),
            scan_errors=scan_errors,
        ),
        seen=Observations(
            photo=np.concatenate([np.repeat(np.arange(len(photos)), counts), ties.photo[active]]),
            point=np.concatenate([place, len(first) + ties.point[active]]),
            pixels=np.vstack([scan.pixels_photo, ties.pixels[active]]),
            sigma_px=np.concatenate(
                [np.maximum(1.0, units) * scan.sigma_px, weights.tie_sigma * ties.scale[active]]
            ),
        ),
    )


def _weighed(
    photos: Sequence[Trusted], fits: Sequence[Misfit], used: _Weights, rejection_sigma: float
) -> _Weights:
    """Reject outliers among the scan ties, and estimate the standard deviation of the inliers."""
    agreeing, units, limits = [], [], []
    for item, fit, some in zip(photos, fits, used.agreeing, strict=True):
        is_check = item.tied.is_check
        unit = unit_deviation(fit.normalised[some])
        limit = without_chance(fit.normalised[~is_check], rejection_sigma * unit)
        agreeing.append((fit.normalised <= limit) & ~is_check)
        units.append(unit)
        limits.append(limit)
    return replace(used, agreeing=agreeing, units=units, limits=limits)


def _weigh_between(
    ties: PhotoTies, lengths: NDArray[np.float64], weights: _Weights, rejection_sigma: float
) -> None:
    """Reject outliers among ties between photos, and estimate the standard deviation of inliers.

    Args:
        ties: ties between photos.
        lengths: (m,) lengths of their residuals, in pixels of the reduced images.
        weights: current inliers and weights, updated in place.
        rejection_sigma: limit in standard deviations.
    """
    from scipy.special import chdtri  # importing scipy.stats would take seconds

    active = weights.tie_active
    # The m observations of a point have 2 m coordinates, 3 of which determine the point, so the sum
    # of squares has a chi-square distribution with 2 m - 3 degrees of freedom.
    squares = np.bincount(ties.point[active], lengths[active] ** 2)
    n_seeing = np.bincount(ties.point[active])
    is_tied = n_seeing > 1
    usual = chdtri(2 * n_seeing[is_tied] - 3, 0.5)
    sigma = math.sqrt(float(np.median(squares[is_tied] / usual)))
    weights.tie_sigma = float(np.clip(sigma, *_TIE_SIGMA_RANGE_PX))
    near = lengths <= rejection_sigma * weights.tie_sigma
    # Keep only points with inliers in at least two photos.
    counts = np.bincount(ties.point[near], minlength=len(ties.points_world))
    weights.tie_active = near & (counts[ties.point] > 1)


def _tie_residuals(
    ties: PhotoTies, cameras: Sequence[ViewingCamera], positions: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the lengths (m,) of the residuals of ties between photos, in pixels."""
    lengths = np.full(len(ties.photo), np.inf)
    for at, camera in enumerate(cameras):
        mine = ties.photo == at
        off = camera.project(positions[ties.point[mine]])[:, :2] - ties.pixels[mine]
        found = np.linalg.norm(off, axis=1)
        lengths[mine] = np.where(np.isfinite(found), found, np.inf)
    return lengths


def _resection(
    block: Block,
    at: int,
    covariance: BlockCovariance,
    middle: NDArray[np.float64],
    unit: float,
) -> Resection:
    columns = block.columns(at)
    own = covariance.matrix[np.ix_(columns, columns)]
    cofactors = covariance.cofactors[np.ix_(columns, columns)]
    camera = block.cameras[at].shifted(-middle)
    to_world = moved_origin(camera, middle, len(columns))
    return Resection(
        camera=camera,
        covariance=to_world @ own @ to_world.T,
        sigma0=unit * covariance.sigma0,
        variance_factor=unit**2 * float(np.trace(np.linalg.solve(cofactors, own))) / len(columns),
        lens=block.lenses[block.lens_of[at]].freedom,
    )
