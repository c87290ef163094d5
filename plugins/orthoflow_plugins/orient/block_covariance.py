"""How exact a block is: the covariance of all its unknowns, honest about what errs together."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import GeometryError
from orthoflow.geometry.covariances import widened
from orthoflow.geometry.lenses import linearised
from orthoflow.geometry.resection import whiten
from orthoflow_plugins.orient.block import SIGMA_LEAST_M, Block, pixel_covariances
from orthoflow_plugins.orient.splitting import GROUPS, image_cells


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
class _Seen:
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


def block_covariance(block: Block, *, soft_limit: float) -> BlockCovariance:
    """Give the covariance of a block after its adjustment.

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
    return BlockCovariance(
        matrix=matrix,
        cofactors=cofactors,
        sigma0=sigma0,
        redundancy=redundancy,
    )


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
    spread = np.zeros_like(plain)
    for parts in by_group.values():
        columns = np.unique(np.concatenate([part.columns for part in parts]))
        normal, pull = np.zeros((columns.size, columns.size)), np.zeros(columns.size)
        for part in parts:
            at = np.searchsorted(columns, part.columns)
            normal[np.ix_(at, at)] += np.einsum("ij,ik->jk", part.jacobian, part.jacobian)
            pull[at] += np.einsum("ij,i->j", part.jacobian, part.residuals)
        inner = np.eye(columns.size) - normal @ cofactors[np.ix_(columns, columns)]
        move = cofactors[:, columns] @ (np.linalg.pinv(inner) @ pull)
        spread += np.outer(move, move)
    return widened(plain, (len(by_group) - 1) / len(by_group) * spread)


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
    stacked: dict[int, list[_Seen]] = {}
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
            one = _Seen(
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
) -> _Seen:
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
    return _Seen(
        columns=block.columns(photo),
        group=-1,
        by_camera=all_columns[:, :, 1:-3],
        by_point=all_columns[:, :, -3:],
        residuals=all_columns[:, :, 0],
    )


def _without_point(block: Block, point: int, parts: list[_Seen]) -> _Rows:
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
        least = max(sigma_m, SIGMA_LEAST_M)
        by_point[-3:] = np.eye(3) / least
        residuals[-3:] = (block.points.known[point] - block.points.now[point]) / least
    across = np.linalg.qr(by_point, mode="complete").Q[:, 3:]
    return _Rows(
        columns=columns,
        group=parts[0].group,
        jacobian=np.einsum("ij,ik->jk", across, jacobian),
        residuals=np.einsum("ij,i->j", across, residuals),
    )


def _groups(block: Block) -> NDArray[np.intp]:
    """Group (m,) of each observation: a cell of its photo."""
    groups = np.zeros(len(block.seen), dtype=np.intp)
    for photo, camera in enumerate(block.cameras):
        mine = block.seen.photo == photo
        cells = image_cells(block.seen.pixels[mine], (camera.width, camera.height), GROUPS)
        groups[mine] = photo * GROUPS**2 + cells
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
            side_px = max(camera.width, camera.height) / GROUPS
            widths.append(side_px / camera.fx * float(np.median(distances)))
    cubes = np.floor(block.points.now[seen.point] / float(np.median(widths))).astype(np.intp)
    return np.asarray(np.unique(cubes, axis=0, return_inverse=True)[1].ravel(), dtype=np.intp)
