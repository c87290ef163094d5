"""All photos at once: adjust, reject what does not agree, weigh anew, until nothing changes."""

from __future__ import annotations

import math
from collections.abc import Sequence, Set
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import GeometryError
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.resection import Misfit, Resection, fitted, misfit, moved_origin
from orthoflow_plugins.orient.block import (
    Block,
    BlockCovariance,
    Observations,
    Points,
    block_covariance,
)
from orthoflow_plugins.orient.colmap import solve
from orthoflow_plugins.orient.lenses import UNKNOWN, LensGroups, focal_sigma
from orthoflow_plugins.orient.parameters import OrientParams
from orthoflow_plugins.orient.photo_ties import PhotoTies
from orthoflow_plugins.orient.photos import Trusted
from orthoflow_plugins.orient.pose import (
    SOFT_LIMIT,
    Estimate,
    posed,
    unit_deviation,
    without_chance,
)

_ROUNDS: Final = 5
_TIE_SIGMA_START_PX: Final = 0.5
_TIE_SIGMA_RANGE_PX: Final = (0.1, 2.0)
# Scan ties of several photos at one place of the wall are one point of the scan.
_SAME_PLACE_M: Final = 1e-6
# Of photos without EXIF nobody knows whether one lens took them. A person who takes a series seldom
# changes it, and a lens that many photos share is known far better than that of any of them. But a
# lens may have zoomed, and a program may have turned a picture. So each photo's own ties are asked.
# One photo in a thousand is given a lens of its own although it shares that of the others.
_CHANCE: Final = 1e-3
# A camera has one lens. A series that zoomed differs by more than this share of the focal length;
# what errors of the scan that neighbouring ties have in common do to the focal length of one photo
# is less (up to 0.7 % on photogrammetric clouds of 10 to 30 mm noise).
_MIN_ZOOM: Final = 0.02
_ZOOM_SIGMAS: Final = 5.0
# Those that contradict most bend the lens, so that others contradict it, too: these leave first.
_SHARE_OF_WORST: Final = 0.5


@dataclass(frozen=True, kw_only=True)
class Adjusted:
    """A block after its adjustment.

    Attributes:
        block: cameras, lenses and points, in a world shifted to `middle`.
        middle: (3,) metres.
        covariance: of all unknowns.
        estimates: one per photo, in the world.
        tie_sigma_px: standard deviation of a coordinate of a tie between photos, in pixels of the
            picture it was found in; NaN without ties.
        tie_rmse_px: root mean square of such a coordinate's residual, photo pixels; NaN without.
        n_tie_points: points that only photos see.
        n_tie_observations: in how many photos, added up.
    """

    block: Block
    middle: NDArray[np.float64]
    covariance: BlockCovariance
    estimates: tuple[Estimate, ...]
    tie_sigma_px: float
    tie_rmse_px: float
    n_tie_points: int
    n_tie_observations: int


@dataclass(frozen=True, kw_only=True)
class _State:
    """What a round of the adjustment starts from.

    Attributes:
        cameras: local.
        tie_points: (k, 3) local.
        agreeing: per photo, (n,) bool of its scan ties.
        units: standard deviation of unit weight of each photo's scan ties.
        tie_active: (m,) bool of the observations between photos.
        tie_sigma: of these, in pixels of the picture they were found in.
    """

    cameras: tuple[ViewingCamera, ...]
    tie_points: NDArray[np.float64]
    agreeing: tuple[NDArray[np.bool_], ...]
    units: tuple[float, ...]
    tie_active: NDArray[np.bool_]
    tie_sigma: float


def adjust_block(
    photos: Sequence[Trusted], ties: PhotoTies, groups: LensGroups, params: OrientParams
) -> Adjusted:
    """Adjust photos and lenses together.

    Args:
        photos: the photos.
        ties: between them, in the world.
        groups: the lenses of the photos.
        params: what is rejected.

    Raises:
        GeometryError: the ties do not determine the block.
    """
    middle = np.mean([item.tied.seen.points_world.mean(axis=0) for item in photos], axis=0)
    state = _start(photos, ties, groups, middle)
    fits: list[Misfit] = []
    limits: list[float] = []
    for nth in range(_ROUNDS):
        block = solve(_block(photos, ties, groups, state, middle), soft_limit=SOFT_LIMIT)
        fits = [
            misfit(item.tied.seen, camera.shifted(-middle))
            for item, camera in zip(photos, block.cameras, strict=True)
        ]
        before = state
        state, limits = _weighed(photos, ties, (block, fits, before), params.rejection_sigma)
        if nth >= 1 and _same(before, state):
            break
    covariance = block_covariance(block, soft_limit=SOFT_LIMIT)
    estimates = tuple(
        _estimate(at, photos[at], block, (covariance, middle), (fits[at], before, limits[at]))
        for at in range(len(photos))
    )
    lengths = _tie_residuals(ties, block)[before.tie_active]
    return Adjusted(
        block=block,
        middle=middle,
        covariance=covariance,
        estimates=estimates,
        tie_sigma_px=before.tie_sigma if len(lengths) else math.nan,
        tie_rmse_px=float(np.sqrt(np.mean(lengths**2) / 2.0)) if len(lengths) else math.nan,
        n_tie_points=len(np.unique(ties.point[before.tie_active])),
        n_tie_observations=int(before.tie_active.sum()),
    )


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
    return frozenset(
        at for at, excess in excesses.items() if excess > max(1.0, _SHARE_OF_WORST * most)
    )


def _start(
    photos: Sequence[Trusted],
    ties: PhotoTies,
    groups: LensGroups,
    middle: NDArray[np.float64],
) -> _State:
    alone = [item.estimate.resection.camera for item in photos]
    cameras: list[ViewingCamera] = []
    for at, item in enumerate(photos):
        lens, own = groups.lenses[groups.lens_of[at]], alone[at]
        if not lens.freedom.sigmas.size:
            own = posed(lens.prior, own)
        elif lens.source == UNKNOWN:
            best = _best_known(photos, groups, at)
            own = own if best == at else _with_lens(item, alone[best])
        else:
            # Photos that share a lens start from that of the first of them.
            own = posed(alone[groups.lens_of.index(groups.lens_of[at])], own)
        cameras.append(own.shifted(middle))
    return _State(
        cameras=tuple(cameras),
        tie_points=ties.points_world - middle,
        agreeing=tuple(item.estimate.agreeing & ~item.tied.is_check for item in photos),
        units=tuple(max(item.estimate.resection.sigma0, 0.1) for item in photos),
        tie_active=np.ones(len(ties.photo), dtype=np.bool_),
        tie_sigma=_TIE_SIGMA_START_PX,
    )


def _best_known(photos: Sequence[Trusted], groups: LensGroups, at: int) -> int:
    """Index of the photo whose own ties tell most of the focal length of a photo's lens."""
    members = [k for k, lens in enumerate(groups.lens_of) if lens == groups.lens_of[at]]
    return min(members, key=lambda k: focal_sigma(photos[k].estimate.resection))


def _with_lens(item: Trusted, lens: ViewingCamera) -> ViewingCamera:
    """Pose of a photo with another lens: with another focal length it stands elsewhere."""
    estimate = item.estimate
    control = item.tied.control(estimate.agreeing)
    start = posed(lens, estimate.resection.camera)
    try:
        return fitted(control, start)
    except GeometryError:
        return start


def _block(
    photos: Sequence[Trusted],
    ties: PhotoTies,
    groups: LensGroups,
    state: _State,
    middle: NDArray[np.float64],
) -> Block:
    """Join scan ties and ties between photos."""
    used = state.agreeing
    seen = [item.tied.seen.take(chosen) for item, chosen in zip(photos, used, strict=True)]
    counts = [len(part) for part in seen]
    world = np.vstack([part.points_world for part in seen])
    sigmas = np.concatenate(
        [unit * part.sigma_m for unit, part in zip(state.units, seen, strict=True)]
    )
    _, first, place = np.unique(
        np.rint(world / _SAME_PLACE_M), axis=0, return_index=True, return_inverse=True
    )
    known = world[first] - middle
    sigma_m = np.zeros(len(first))
    np.maximum.at(sigma_m, place.ravel(), sigmas)
    active = state.tie_active
    control = Observations(
        photo=np.repeat(np.arange(len(photos)), counts),
        point=place.ravel().astype(np.intp),
        pixels=np.vstack([part.pixels_photo for part in seen]),
        sigma_px=np.concatenate(
            [max(1.0, unit) * part.sigma_px for unit, part in zip(state.units, seen, strict=True)]
        ),
    )
    return Block(
        cameras=state.cameras,
        lens_of=groups.lens_of,
        lenses=groups.lenses,
        points=Points(
            now=np.vstack([known, state.tie_points]),
            known=np.vstack([known, state.tie_points]),
            sigma_m=np.concatenate([sigma_m, np.full(len(state.tie_points), np.inf)]),
        ),
        seen=Observations(
            photo=np.concatenate([control.photo, ties.photo[active]]),
            point=np.concatenate([control.point, len(first) + ties.point[active]]),
            pixels=np.vstack([control.pixels, ties.pixels[active]]),
            sigma_px=np.concatenate([control.sigma_px, state.tie_sigma * ties.scale[active]]),
        ),
    )


def _weighed(
    photos: Sequence[Trusted],
    ties: PhotoTies,
    found: tuple[Block, Sequence[Misfit], _State],
    rejection_sigma: float,
) -> tuple[_State, list[float]]:
    """Reject what disagrees with the block, and estimate how exact the rest is."""
    from scipy.special import chdtri  # scipy.stats would take seconds to import

    block, fits, state = found
    agreeing, units, limits = [], [], []
    for item, fit, used in zip(photos, fits, state.agreeing, strict=True):
        is_check = item.tied.is_check
        unit = unit_deviation(fit.normalised[used])
        limit = without_chance(fit.normalised[~is_check], rejection_sigma * unit)
        agreeing.append((fit.normalised <= limit) & ~is_check)
        units.append(unit)
        limits.append(limit)
    active, sigma = state.tie_active, state.tie_sigma
    if active.any():
        lengths = _tie_residuals(ties, block) / ties.scale
        # Of 2 m coordinates, 3 go into the point: its sum of squares is as chi-square of the rest.
        point = ties.point[active]
        squares = np.bincount(point, lengths[active] ** 2)
        n_seeing = np.bincount(point)
        is_tied = n_seeing > 1
        usual = chdtri(2 * n_seeing[is_tied] - 3, 0.5)
        sigma = math.sqrt(float(np.median(squares[is_tied] / usual)))
        sigma = float(np.clip(sigma, *_TIE_SIGMA_RANGE_PX))
        active = _in_several(ties.point, lengths <= rejection_sigma * sigma)
    return (
        _State(
            cameras=block.cameras,
            tie_points=block.points.now[len(block.points) - len(state.tie_points) :],
            agreeing=tuple(agreeing),
            units=tuple(units),
            tie_active=active,
            tie_sigma=sigma,
        ),
        limits,
    )


def _in_several(point: NDArray[np.intp], active: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Observations of points that at least two photos still see."""
    counts = np.bincount(point[active], minlength=int(point.max()) + 1)
    return active & (counts[point] > 1)


def _tie_residuals(ties: PhotoTies, block: Block) -> NDArray[np.float64]:
    """Length (m,) in pixels of the residuals of the ties between photos."""
    n_points = len(ties.points_world)
    points = block.points.now[len(block.points) - n_points :]
    lengths = np.full(len(ties.photo), np.inf)
    for at, camera in enumerate(block.cameras):
        mine = ties.photo == at
        off = camera.project(points[ties.point[mine]])[:, :2] - ties.pixels[mine]
        found = np.linalg.norm(off, axis=1)
        lengths[mine] = np.where(np.isfinite(found), found, np.inf)
    return lengths


def _same(before: _State, after: _State) -> bool:
    """Whether another round would change nothing that matters."""
    return all(
        np.array_equal(first, second)
        for first, second in zip(before.agreeing, after.agreeing, strict=True)
    ) and np.array_equal(before.tie_active, after.tie_active)


def _estimate(
    at: int,
    item: Trusted,
    block: Block,
    known: tuple[BlockCovariance, NDArray[np.float64]],
    fitted: tuple[Misfit, _State, float],
) -> Estimate:
    """Return a photo's part of the block as an orientation of its own."""
    (covariance, middle), (fit, state, limit) = known, fitted
    lens = block.lenses[block.lens_of[at]]
    columns = block.columns(at)
    own = covariance.matrix[np.ix_(columns, columns)]
    cofactors = covariance.cofactors[np.ix_(columns, columns)]
    unit = state.units[at]
    camera = block.cameras[at].shifted(-middle)
    to_world = moved_origin(camera, middle, len(columns))
    resection = Resection(
        camera=camera,
        covariance=to_world @ own @ to_world.T,
        sigma0=unit * covariance.sigma0,
        variance_factor=unit**2 * float(np.trace(np.linalg.solve(cofactors, own))) / len(columns),
        lens=lens.freedom,
    )
    return replace(
        item.estimate,
        resection=resection,
        source=lens.source,
        fit=fit,
        agreeing=fit.normalised <= limit,
        limit=limit,
    )


def _zoomed(alone: Resection, shared: Resection) -> bool:
    """Whether a photo's own ties ask for another focal length than the shared one, by far."""
    off = abs(math.log(alone.camera.fx / shared.camera.fx))
    return off > max(_MIN_ZOOM, _ZOOM_SIGMAS * focal_sigma(alone))


def _excess(item: Trusted, shared: Estimate, usual_widening: float) -> float:
    """How much worse a photo's ties fit the shared lens, at any pose, than chance has it.

    The likelihood ratio of the photo's own lens and the shared one, as chi-square over its limit.
    """
    from scipy.special import chdtri  # scipy.stats would take seconds to import

    alone = item.estimate.resection
    n_free = alone.lens.sigmas.size
    if not n_free:
        return 0.0
    control = item.tied.control(item.estimate.agreeing)
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
