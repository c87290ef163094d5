"""A block of photos: cameras that share lenses and points, how exact they are, and its lenses.

The covariance of all unknowns is honest about what errs together.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import GeometryError
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.covariances import (
    AdjustedPoints,
    outwards,
    widened_by_moves,
    with_common_error,
)
from orthoflow.geometry.lenses import POSE_PARAMETERS, LensFreedom, lens_values, linearised
from orthoflow.geometry.resection import whiten
from orthoflow.geometry.rows import Rows
from orthoflow.products import JsonValue, Photo
from orthoflow.sdk import DiagnosticSpec
from orthoflow_plugins.orient.lenses import Lens
from orthoflow_plugins.orient.parameters import Note
from orthoflow_plugins.orient.pose import PLACES_A_SIDE, places_in_photo

# A known point is never exact: an adjustment divides by its variance.
MIN_SIGMA_M: Final = 1e-6
_CORRELATED: Final = 0.95
_MIN_FOR_PLANE: Final = 3
_POSE_NAMES: Final = ("tilt", "pan", "roll", "x", "y", "distance")
LENS_CONFUSED: Final = DiagnosticSpec(
    code="lens-correlated-with-pose",
    severity="warning",
    text="the {parameter} of the lens of {subject} and the {pose} of its photos correlate by "
    "{correlation:.3f}",
    remedy="photos from other sides, some turned by 90 degrees, or a calibration{also} would "
    "separate them",
    rank_by="correlation",
)


@dataclass(frozen=True, kw_only=True)
class Observations(Rows):
    """Pixels at which photos see points.

    Attributes:
        photo: (m,) index of the camera.
        point: (m,) index of the point.
        pixels: (m, 2).
        sigma_px: (m,) standard deviation of each coordinate.
    """

    photo: NDArray[np.intp]
    point: NDArray[np.intp]
    pixels: NDArray[np.float64]
    sigma_px: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Points(Rows):
    """Points that photos see.

    Attributes:
        now: (k, 3) metres, where the adjustment has them.
        known: (k, 3) metres, where the scan has them; anything without the scan.
        sigma_m: (k,) standard deviation of each coordinate of `known`; inf without the scan.
    """

    now: NDArray[np.float64]
    known: NDArray[np.float64]
    sigma_m: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Block:
    """Cameras, lenses, points and what is seen of them, in a world with its origin nearby.

    Attributes:
        cameras: one per photo.
        lens_of: index of each camera's lens.
        lenses: the lenses.
        points: the points.
        seen: the observations.
    """

    cameras: tuple[ViewingCamera, ...]
    lens_of: tuple[int, ...]
    lenses: tuple[Lens, ...]
    points: Points
    seen: Observations

    @property
    def is_joint(self) -> NDArray[np.bool_]:
        """Points (k,) seen more than once: they move; the others only widen their pixel."""
        return np.bincount(self.seen.point, minlength=len(self.points)) > 1

    @property
    def column_starts(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """First columns of poses and of lenses in the block's normal matrix."""
        sizes = [lens.freedom.sigmas.size for lens in self.lenses]
        poses = 6 * np.arange(len(self.cameras) + 1, dtype=np.intp)
        lenses = poses[-1] + np.concatenate([[0], np.cumsum(sizes)]).astype(np.intp)
        return poses, lenses

    def columns(self, photo: int) -> NDArray[np.intp]:
        """Columns of a photo's pose and of its lens in the normal matrix."""
        poses, lenses = self.column_starts
        lens = self.lens_of[photo]
        return np.concatenate(
            [np.arange(poses[photo], poses[photo] + 6), np.arange(lenses[lens], lenses[lens + 1])]
        )

    def moved(self, cameras: tuple[ViewingCamera, ...], now: NDArray[np.float64]) -> Block:
        """Return the block after an adjustment."""
        return replace(self, cameras=cameras, points=replace(self.points, now=now))


@dataclass(frozen=True, kw_only=True)
class BlockCovariance:
    """The covariance of a block.

    Attributes:
        matrix: (p, p), the columns as `Block.columns` gives them.
        cofactors: (p, p) the same for sigmas taken as they are.
        sigma0: standard deviation of unit weight.
        redundancy: observations beyond what determines the unknowns.
    """

    matrix: NDArray[np.float64]
    cofactors: NDArray[np.float64]
    sigma0: float
    redundancy: float


def pixel_covariances(block: Block, *, alone: bool = False) -> NDArray[np.float64]:
    """Covariances (m, 2, 2) of the pixels; of points seen once, with that of the point.

    Args:
        block: the block.
        alone: take every point as if it were seen once.
    """
    seen = block.seen
    covariances = (seen.sigma_px**2)[:, None, None] * np.eye(2)
    is_alone = ~block.is_joint[seen.point] | alone
    for photo, camera in enumerate(block.cameras):
        mine = np.flatnonzero(is_alone & (seen.photo == photo))
        points = seen.point[mine]
        by_point = linearised(camera, block.points.known[points], LensFreedom()).by_camera_point
        variances = (block.points.sigma_m[points] ** 2)[:, None, None]
        covariances[mine] += variances * (by_point @ by_point.transpose(0, 2, 1))
    return covariances


def block_covariance(block: Block, *, soft_limit: float) -> BlockCovariance:
    """Return the covariance of a block after its adjustment.

    Args:
        block: as adjusted.
        soft_limit: residuals beyond so many standard deviations count less (Huber).

    Raises:
        GeometryError: the observations do not determine the block.
    """
    n_free = int(block.column_starts[1][-1])
    prior = np.zeros(n_free)
    for start, lens in zip(block.column_starts[1][:-1], block.lenses, strict=True):
        sigmas = lens.freedom.sigmas
        prior[start : start + sigmas.size] = 1.0 / sigmas**2
    rows = list(_rows(block, soft_limit, _groups(block)))
    normal = np.diag(prior)
    squares, n_rows = 0.0, 0
    for part in rows:
        # Not by BLAS: its sums depend on the number of threads.
        normal[np.ix_(part.columns, part.columns)] += np.einsum(
            "ij,ik->jk", part.jacobian, part.jacobian
        )
        squares += float((part.residuals**2).sum())
        n_rows += len(part.residuals)
    try:
        cofactors = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    except np.linalg.LinAlgError as error:
        raise GeometryError("the ties do not determine the block of photos") from error
    redundancy = n_rows - n_free + float((np.diag(cofactors) * prior).sum())
    if redundancy <= 0.0 or not (np.diag(cofactors) > 0.0).all():
        raise GeometryError("the ties do not determine the block of photos")
    sigma0 = math.sqrt(squares / redundancy)
    matrix = _honest(rows, cofactors, sigma0**2 * cofactors)
    if _is_linked(block):
        # Photos of one place share the errors that the scan has there.
        shared = list(_rows(block, soft_limit, _places(block)))
        matrix = _honest(shared, cofactors, matrix)
    matrix = with_common_error(matrix, _adjusted_points(block, cofactors, soft_limit))
    return BlockCovariance(
        matrix=matrix,
        cofactors=cofactors,
        sigma0=sigma0,
        redundancy=redundancy,
    )


def lenses_json(
    block: Block, photos: Sequence[Photo], covariance: NDArray[np.float64]
) -> JsonValue:
    """Return each lens as it came out, with standard deviations where it was free."""
    entries: list[JsonValue] = []
    starts = block.column_starts[1]
    for index, lens in enumerate(block.lenses):
        members = [at for at, of in enumerate(block.lens_of) if of == index]
        camera = block.cameras[members[0]]
        columns = np.arange(starts[index], starts[index + 1])
        sigmas = np.sqrt(np.diag(covariance)[columns])
        names = lens.freedom.names
        entry: dict[str, JsonValue] = {
            "photos": [photos[at].name for at in members],
            "known_from": lens.source,
            "focal_px": camera.fx,
            "centre_px": [camera.cx, camera.cy],
            "distortion": [float(value) for value in camera.distortion],
            "free": list(names),
            "sigmas": {
                name: float(sigma * (camera.fx if name == "focal" else 1.0))
                for name, sigma in zip(names, sigmas, strict=True)
            },
        }
        entries.append(entry)
    return entries


def lens_statistics(block: Block) -> JsonValue:
    """Mean and SD of what is free, over lenses of one image size that are free alike."""
    kinds: dict[tuple[int, int, tuple[str, ...]], list[NDArray[np.float64]]] = {}
    for index, lens in enumerate(block.lenses):
        camera = block.cameras[block.lens_of.index(index)]
        values = lens_values(camera, lens.freedom)
        values[: 1 if "focal" in lens.freedom.names else 0] = camera.fx
        kind = (lens.prior.width, lens.prior.height, lens.freedom.names)
        kinds.setdefault(kind, []).append(values)
    table: list[JsonValue] = []
    for (width, height, names), rows in kinds.items():
        if not names:
            continue
        stacked = np.array(rows)
        spread = stacked.std(axis=0, ddof=1) if len(rows) > 1 else np.zeros(len(names))
        table.append(
            {
                "width": width,
                "height": height,
                "n_lenses": len(rows),
                "mean": dict(zip(names, stacked.mean(axis=0).tolist(), strict=True)),
                "sd": dict(zip(names, spread.tolist(), strict=True)),
            }
        )
    return table


def correlation_notes(
    block: Block, photos: Sequence[Photo], cofactors: NDArray[np.float64]
) -> list[tuple[str, Note]]:
    """Return where photos hardly tell their lens from their pose, each with the first photo."""
    notes: list[tuple[str, Note]] = []
    # Lenses of one camera, which nothing says to be one, have each to be told from its own photos.
    shared = ", or intrinsics: shared where one camera took them all at one zoom,"
    also = shared if len(block.lenses) > 1 else ""
    scale = np.sqrt(np.diag(cofactors))
    correlations = np.abs(cofactors / np.outer(scale, scale))
    for index, lens in enumerate(block.lenses):
        members = [at for at, of in enumerate(block.lens_of) if of == index]
        first = block.column_starts[1][index]
        for nth, name in enumerate(lens.freedom.names):
            rows = [correlations[6 * at : 6 * at + POSE_PARAMETERS, first + nth] for at in members]
            # Only what all its photos confuse stays unknown.
            confused = np.min(rows, axis=0)
            worst = int(confused.argmax())
            if confused[worst] > _CORRELATED:
                values = {"parameter": name, "pose": _POSE_NAMES[worst], "also": also}
                note = LENS_CONFUSED, {**values, "correlation": float(confused[worst])}
                notes.append((photos[members[0]].name, note))
    return notes


@dataclass(frozen=True, kw_only=True)
class _Rows:
    """Equations in units of standard deviations, points eliminated.

    Attributes:
        columns: (c,) of the unknowns that take part.
        group: of observations that may err together.
        jacobian: (r, c).
        residuals: (r,).
    """

    columns: NDArray[np.intp]
    group: int
    jacobian: NDArray[np.float64]
    residuals: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class _Equations:
    """Equations of one observation, or of a photo's m, with the point still in them.

    Attributes:
        columns: (c,) of the unknowns that take part.
        group: as in `_Rows`; -1 for several.
        by_camera: ([m,] 2, c) by pose and lens.
        by_point: ([m,] 2, 3).
        residuals: ([m,] 2).
    """

    columns: NDArray[np.intp]
    group: int
    by_camera: NDArray[np.float64]
    by_point: NDArray[np.float64]
    residuals: NDArray[np.float64]


def _honest(
    rows: list[_Rows], cofactors: NDArray[np.float64], plain: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Widen by what leaving out each group changes, see `geometry.covariances`."""
    by_group: dict[int, list[_Rows]] = {}
    for part in rows:
        by_group.setdefault(part.group, []).append(part)
    # Fewer groups than unknowns of a photo say nothing of it.
    if len(by_group) <= max(part.columns.size for part in rows):
        return plain
    moves = []
    for parts in by_group.values():
        columns = np.unique(np.concatenate([part.columns for part in parts]))
        normal, pull = np.zeros((columns.size, columns.size)), np.zeros(columns.size)
        for part in parts:
            at = np.searchsorted(columns, part.columns)
            normal[np.ix_(at, at)] += np.einsum("ij,ik->jk", part.jacobian, part.jacobian)
            pull[at] += np.einsum("ij,i->j", part.jacobian, part.residuals)
        inner = np.eye(columns.size) - normal @ cofactors[np.ix_(columns, columns)]
        moves.append(cofactors[:, columns] @ (np.linalg.pinv(inner) @ pull))
    return widened_by_moves(plain, np.array(moves))


def _adjusted_points(
    block: Block, cofactors: NDArray[np.float64], soft_limit: float
) -> AdjustedPoints:
    """The places of the scan that photos see, and how far they are from there."""
    seen = block.seen
    known = np.flatnonzero(np.isfinite(block.points.sigma_m[seen.point]))
    # Also what several photos see is compared with where the scan has it.
    as_scanned = replace(
        block,
        points=replace(block.points, now=block.points.known),
        seen=seen.take(known),
    )
    n_points, n_known = len(block.points), len(known)
    jacobian, pulls = (np.zeros((n_known, k, len(cofactors))) for k in (2, 3))
    residuals, by_place = np.zeros((n_known, 2)), np.zeros((n_known, 2, 3))
    towards, information = np.zeros((n_known, 3)), np.zeros((n_points, 3, 3))
    of_pixels = (as_scanned.seen.sigma_px**2)[:, None, None] * np.eye(2)
    with_places = pixel_covariances(as_scanned, alone=True)
    for photo, camera in enumerate(block.cameras):
        mine = np.flatnonzero(as_scanned.seen.photo == photo)
        point, own = as_scanned.seen.point[mine], block.columns(photo)
        linear = _seen_by(as_scanned, photo, mine, with_places[mine], soft_limit)
        residuals[mine], by_place[mine] = linear.residuals, linear.by_point
        jacobian[mine[:, None, None], [[0], [1]], own] = linear.by_camera
        # A place pulls with what it is known by, once for all photos that see it.
        linear = _seen_by(as_scanned, photo, mine, of_pixels[mine], math.inf)
        pulls[mine[:, None, None], [[0], [1], [2]], own] = np.einsum(
            "nip,nid->ndp", linear.by_camera, linear.by_point
        )
        squares = np.einsum("nid,nie->nde", linear.by_point, linear.by_point)
        np.add.at(information, point, squares)
        if len(mine) >= _MIN_FOR_PLANE:
            towards[mine] = outwards(block.points.known[point], camera.centre_world)
    variances = np.where(np.isfinite(block.points.sigma_m), block.points.sigma_m, 0.0) ** 2
    held = np.linalg.inv(np.eye(3) + variances[:, None, None] * information)
    return AdjustedPoints(
        photo=as_scanned.seen.photo,
        places=block.points.known[as_scanned.seen.point],
        residuals=residuals,
        jacobian=jacobian,
        by_place=by_place,
        pulls=np.einsum("ndp,nde->npe", pulls, held[as_scanned.seen.point]),
        towards=towards,
        cofactors=cofactors,
    )


def _rows(block: Block, soft_limit: float, groups: NDArray[np.intp]) -> Iterator[_Rows]:
    """Equations of the unknowns that remain when every point is eliminated.

    Args:
        block: as adjusted.
        soft_limit: residuals beyond so many standard deviations count less.
        groups: (m,) of the observations.
    """
    seen = block.seen
    joint = block.is_joint[seen.point]
    covariances = pixel_covariances(block)
    stacked: dict[int, list[_Equations]] = {}
    for photo in range(len(block.cameras)):
        mine = np.flatnonzero(seen.photo == photo)
        if not len(mine):
            continue
        linear = _seen_by(block, photo, mine, covariances[mine], soft_limit)
        for group in np.unique(groups[mine]):
            alone = (groups[mine] == group) & ~joint[mine]
            yield _Rows(
                columns=block.columns(photo),
                group=int(group),
                jacobian=linear.by_camera[alone].reshape(-1, linear.by_camera.shape[2]),
                residuals=linear.residuals[alone].ravel(),
            )
        for nth in np.flatnonzero(joint[mine]):
            one = _Equations(
                columns=block.columns(photo),
                group=int(groups[mine[nth]]),
                by_camera=linear.by_camera[nth],
                by_point=linear.by_point[nth],
                residuals=linear.residuals[nth],
            )
            stacked.setdefault(int(seen.point[mine[nth]]), []).append(one)
    for point, parts in stacked.items():
        yield _without_point(block, point, parts)


def _seen_by(
    block: Block,
    photo: int,
    mine: NDArray[np.intp],
    covariances: NDArray[np.float64],
    soft_limit: float,
) -> _Equations:
    """Equations of a photo's observations, in standard deviations, robust weights applied."""
    camera, seen = block.cameras[photo], block.seen
    points = seen.point[mine]
    at = np.where(
        block.is_joint[points, None], block.points.now[points], block.points.known[points]
    )
    linear = linearised(camera, at, block.lenses[block.lens_of[photo]].freedom)
    by_point = linear.by_camera_point @ camera.rotation
    residuals = seen.pixels[mine] - linear.pixels
    all_columns = np.concatenate([residuals[:, :, None], linear.by_parameters, by_point], axis=2)
    all_columns = whiten(covariances, all_columns)
    lengths = np.linalg.norm(all_columns[:, :, 0], axis=1)
    all_columns *= np.sqrt(np.minimum(1.0, soft_limit / np.maximum(lengths, 1e-12)))[:, None, None]
    return _Equations(
        columns=block.columns(photo),
        group=-1,
        by_camera=all_columns[:, :, 1:-3],
        by_point=all_columns[:, :, -3:],
        residuals=all_columns[:, :, 0],
    )


def _without_point(block: Block, point: int, parts: list[_Equations]) -> _Rows:
    """Eliminate a point seen by several photos: what its position cannot explain remains."""
    columns = np.unique(np.concatenate([part.columns for part in parts]))
    sigma_m = float(block.points.sigma_m[point])
    n_known = 3 if math.isfinite(sigma_m) else 0
    jacobian = np.zeros((2 * len(parts) + n_known, columns.size))
    by_point = np.zeros((len(jacobian), 3))
    residuals = np.zeros(len(jacobian))
    for nth, part in enumerate(parts):
        own = slice(2 * nth, 2 * nth + 2)
        jacobian[own, np.searchsorted(columns, part.columns)] = part.by_camera
        by_point[own], residuals[own] = part.by_point, part.residuals
    if n_known:
        least = max(sigma_m, MIN_SIGMA_M)
        by_point[-3:] = np.eye(3) / least
        residuals[-3:] = (block.points.known[point] - block.points.now[point]) / least
    across = np.linalg.qr(by_point, mode="complete").Q[:, 3:]
    remaining = np.einsum("ij,ik->jk", across, jacobian)
    return _Rows(
        columns=columns,
        group=parts[0].group,
        jacobian=remaining,
        residuals=np.einsum("ij,i->j", across, residuals),
    )


def _groups(block: Block) -> NDArray[np.intp]:
    """Group (m,) of each observation: a cell of its photo."""
    groups = np.zeros(len(block.seen), dtype=np.intp)
    for photo, camera in enumerate(block.cameras):
        mine = block.seen.photo == photo
        cells = places_in_photo(block.seen.pixels[mine], camera)
        groups[mine] = photo * PLACES_A_SIDE**2 + cells
    return groups


def _is_linked(block: Block) -> bool:
    """Whether photos have unknowns in common: points, or a lens that is free."""
    shared = [
        lens.freedom.sigmas.size > 0 and block.lens_of.count(index) > 1
        for index, lens in enumerate(block.lenses)
    ]
    return any(shared) or bool(block.is_joint.any())


def _places(block: Block) -> NDArray[np.intp]:
    """Group (m,) of each observation: a place in the world, as wide as a cell of the photos."""
    seen = block.seen
    widths = []
    for photo, camera in enumerate(block.cameras):
        distances = camera.project(block.points.now[seen.point[seen.photo == photo]])[:, 2]
        if distances.size:
            side_px = max(camera.width, camera.height) / PLACES_A_SIDE
            widths.append(side_px / camera.fx * float(np.median(distances)))
    cubes = np.floor(block.points.now[seen.point] / float(np.median(widths))).astype(np.intp)
    return np.asarray(np.unique(cubes, axis=0, return_inverse=True)[1].ravel(), dtype=np.intp)
