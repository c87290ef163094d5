"""Bundle adjustment of a block of photos that share lenses and points, and its covariance.

The adjustment uses COLMAP's cost functions and the Ceres solver. The covariance of the unknowns
allows for correlated errors of the observations.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import GeometryError, MethodError
from orthoflow.geometry.cameras import (
    POSE_PARAMETERS,
    LensFreedom,
    ViewingCamera,
    lens_values,
    linearised,
)
from orthoflow.geometry.covariances import (
    AdjustedPoints,
    honest_covariance,
    outwards,
)
from orthoflow.geometry.resection import whiten
from orthoflow.geometry.rows import Rows
from orthoflow.products import JsonValue, Photo
from orthoflow.sdk import DiagnosticSpec
from orthoflow_plugins.orient.pose import Lens, Note

# Lower limit of the standard deviation of a known point, to avoid a division by zero.
_MIN_SIGMA_M: Final = 1e-6
_CORRELATED: Final = 0.95
_MIN_FOR_PLANE: Final = 3
_POSE_NAMES: Final = ("tilt", "pan", "roll", "x", "y", "distance")
_ITERATIONS: Final = 60
# Relative change of the cost at which the solver stops.
_CONVERGED: Final = 1e-8
# COLMAP's order: fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6.
_MODEL: Final = "FULL_OPENCV"
_N_VALUES: Final = 12
_COLUMNS: Final = {"cx": 2, "cy": 3, "k1": 4, "k2": 5, "p1": 6, "p2": 7}
# COLMAP estimates fx and fy separately; this prior keeps their ratio fixed.
_TIED_ASPECT: Final = 1e-5
# Pixel coordinate of dummy observations, which is far outside the photo.
_FAR_PX: Final = -1e6
# Scale of a robust loss at which dummy observations have no weight.
_NOTHING: Final = 1e-9
LENS_CONFUSED: Final = DiagnosticSpec(
    code="lens-correlated-with-pose",
    severity="warning",
    text="the lens parameter {parameter} of {subject} and the {pose} of its photos have a "
    "correlation of {correlation:.3f}",
    remedy="to separate them, add photos from other directions, some rotated by 90 degrees, or "
    "give a calibration{also}",
    rank_by="correlation",
)


@dataclass(frozen=True, kw_only=True)
class Observations(Rows):
    """Observations of points in photos.

    Attributes:
        photo: (m,) index of the camera.
        point: (m,) index of the point.
        pixels: (m, 2) measured pixels.
        sigma_px: (m,) standard deviation of each pixel coordinate.
    """

    photo: NDArray[np.intp]
    point: NDArray[np.intp]
    pixels: NDArray[np.float64]
    sigma_px: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Points(Rows):
    """The points of a block.

    Attributes:
        now: (k, 3) adjusted positions in metres.
        known: (k, 3) positions in the scan in metres; arbitrary for points that are not in the
            scan.
        sigma_m: (k,) standard deviation of each coordinate of `known`, infinite for points that are
            not in the scan.
        scan_errors: as in `SeenPoints`, zero for points that are not in the scan.
    """

    now: NDArray[np.float64]
    known: NDArray[np.float64]
    sigma_m: NDArray[np.float64]
    scan_errors: NDArray[np.float64] | None = None


@dataclass(frozen=True, kw_only=True)
class Block:
    """Cameras, lenses, points and observations, in coordinates whose origin is near the points.

    Attributes:
        cameras: camera of each photo.
        lens_of: index of the lens of each camera.
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
        """Mask (k,) of the points that several photos see; only these points are adjusted.

        The uncertainty of any other point is added to that of its pixel.
        """
        return np.bincount(self.seen.point, minlength=len(self.points)) > 1

    @property
    def lens_starts(self) -> NDArray[np.intp]:
        """First column of each lens in the normal matrix, followed by the number of columns."""
        sizes = [lens.freedom.sigmas.size for lens in self.lenses]
        return POSE_PARAMETERS * len(self.cameras) + np.cumsum([0, *sizes], dtype=np.intp)

    def columns(self, photo: int) -> NDArray[np.intp]:
        """Return the columns of the normal matrix that belong to the pose and lens of a photo."""
        first, last = self.lens_starts[self.lens_of[photo] :][:2]
        pose = POSE_PARAMETERS * photo + np.arange(POSE_PARAMETERS)
        return np.concatenate([pose, np.arange(first, last)])

    def photos_of(self, lens: int) -> list[int]:
        """Return the indices of the photos that share a lens."""
        return [photo for photo, of in enumerate(self.lens_of) if of == lens]


@dataclass(frozen=True, kw_only=True)
class BlockCovariance:
    """The covariance of the poses and lenses of a block.

    Attributes:
        matrix: (p, p) covariance, with columns as in `Block.columns`.
        cofactors: (p, p) the same covariance, computed from the a priori standard deviations.
        sigma0: standard deviation of unit weight.
        redundancy: number of observations minus the number of unknowns that they determine.
    """

    matrix: NDArray[np.float64]
    cofactors: NDArray[np.float64]
    sigma0: float
    redundancy: float


def solve(block: Block, *, soft_limit: float) -> Block:
    """Adjust all cameras and lenses, and all points that several photos see.

    Args:
        block: the block with its initial values.
        soft_limit: residuals of more than this many standard deviations get less weight (Huber).

    Raises:
        GeometryError: the block has no solution.
    """
    import pyceres

    ceres: Any = pyceres
    # The solver changes poses, lenses and points in place. COLMAP's adjuster must outlive the
    # solver, and one reference to the problem must be kept so that its costs and losses stay alive.
    scene, adjuster = _set_up(block)
    problem = adjuster.problem
    images = [scene.images[index + 1] for index in range(len(block.cameras))]
    poses = [image.frame.rig_from_world for image in images]
    lenses = [scene.cameras[index + 1].params for index in range(len(block.lenses))]
    joint = {int(at): block.points.now[at].copy() for at in np.flatnonzero(block.is_joint)}
    _add_observations(block, problem, ([p.params for p in poses], lenses), joint, soft_limit)
    for lens, values in zip(block.lenses, lenses, strict=True):
        _limit_lens(problem, lens, values)
    options = ceres.SolverOptions()
    options.max_num_iterations = _ITERATIONS
    options.function_tolerance = _CONVERGED
    # With several threads, the order of summation is not reproducible.
    options.num_threads = 1
    kinds = ceres.LinearSolverType
    options.linear_solver_type = kinds.DENSE_SCHUR if joint else kinds.DENSE_NORMAL_CHOLESKY
    options.logging_type = ceres.LoggingType.SILENT
    summary = ceres.SolverSummary()
    ceres.solve(options, problem, summary)
    if not summary.IsSolutionUsable() or not math.isfinite(summary.final_cost):
        raise GeometryError(f"the block of photos has no solution: {summary.BriefReport()}")
    now = block.points.now.copy()
    for at, position in joint.items():
        now[at] = position
    cameras = []
    for camera, pose, index in zip(block.cameras, poses, block.lens_of, strict=True):
        values, names = np.array(lenses[index]), block.lenses[index].freedom.names
        left, _, right = np.linalg.svd(pose.rotation.matrix())
        adjusted = replace(
            camera,
            fx=float(values[0]),
            fy=float(values[1] if "aspect" in names else values[0] * (camera.fy / camera.fx)),
            cx=float(values[2]),
            cy=float(values[3]),
            distortion=values[4:9].copy(),
            rotation=left @ right,
            translation=np.array(pose.translation),
        )
        cameras.append(adjusted)
    return replace(block, cameras=tuple(cameras), points=replace(block.points, now=now))


def pixel_covariances(block: Block, *, alone: bool = False) -> NDArray[np.float64]:
    """Return the covariances (m, 2, 2) of the pixels.

    The covariances include the uncertainty of points that only one photo sees.

    Args:
        block: the block.
        alone: whether to also include the uncertainty of points that several photos see.
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
        block: the adjusted block.
        soft_limit: residuals of more than this many standard deviations get less weight (Huber).

    Raises:
        GeometryError: the observations do not determine the block.
    """
    prior = np.zeros(block.lens_starts[-1])
    for start, lens in zip(block.lens_starts, block.lenses, strict=False):
        sigmas = lens.freedom.sigmas
        prior[start : start + sigmas.size] = 1.0 / sigmas**2
    rows = _rows(block, soft_limit)
    normal = np.diag(prior)
    squares, n_rows = 0.0, 0
    for columns, jacobian, residuals in rows:
        # The order of summation of einsum, unlike that of BLAS, does not depend on the number of
        # threads.
        normal[np.ix_(columns, columns)] += np.einsum("ij,ik->jk", jacobian, jacobian)
        squares += float((residuals**2).sum())
        n_rows += len(residuals)
    try:
        cofactors = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    except np.linalg.LinAlgError as error:
        raise GeometryError("the ties do not suffice to orient the block of photos") from error
    redundancy = n_rows - len(prior) + float((np.diag(cofactors) * prior).sum())
    if redundancy <= 0.0 or not (np.diag(cofactors) > 0.0).all():
        raise GeometryError("the ties do not suffice to orient the block of photos")
    sigma0 = math.sqrt(squares / redundancy)
    matrix = honest_covariance(_adjusted_points(block, cofactors, soft_limit), sigma0)
    return BlockCovariance(matrix=matrix, cofactors=cofactors, sigma0=sigma0, redundancy=redundancy)


def lenses_json(
    block: Block, photos: Sequence[Photo], covariance: NDArray[np.float64]
) -> JsonValue:
    """Return the adjusted lenses and the standard deviations of their free parameters."""
    entries: list[JsonValue] = []
    sigmas = np.sqrt(np.diag(covariance))
    for index, lens in enumerate(block.lenses):
        members, names = block.photos_of(index), lens.freedom.names
        camera = block.cameras[members[0]]
        own = sigmas[block.lens_starts[index] : block.lens_starts[index + 1]]
        own *= [camera.fx if name == "focal" else 1.0 for name in names]
        entry: dict[str, JsonValue] = {
            "photos": [photos[at].name for at in members],
            "known_from": lens.source,
            "focal_px": camera.fx,
            "centre_px": [camera.cx, camera.cy],
            "distortion": camera.distortion.tolist(),
            "free": list(names),
            "sigmas": dict(zip(names, own.tolist(), strict=True)),
        }
        entries.append(entry)
    return entries


def lens_statistics(block: Block) -> JsonValue:
    """Return the mean and SD of free parameters for each image size and set of free parameters."""
    kinds: dict[tuple[int, int, tuple[str, ...]], list[NDArray[np.float64]]] = {}
    for index, lens in enumerate(block.lenses):
        camera, names = block.cameras[block.lens_of.index(index)], lens.freedom.names
        values = lens_values(camera, lens.freedom)
        if "focal" in names:
            values[0] = camera.fx
        if names:
            kinds.setdefault((lens.prior.width, lens.prior.height, names), []).append(values)
    return [
        {
            "width": width,
            "height": height,
            "n_lenses": len(rows),
            "mean": dict(zip(names, np.mean(rows, axis=0).tolist(), strict=True)),
            "sd": dict(
                zip(names, np.std(rows, axis=0, ddof=int(len(rows) > 1)).tolist(), strict=True)
            ),
        }
        for (width, height, names), rows in kinds.items()
    ]


def correlation_notes(
    block: Block, photos: Sequence[Photo], cofactors: NDArray[np.float64]
) -> list[tuple[str, Note]]:
    """Return a note for each lens parameter that is correlated with the poses.

    Each note names the first photo of the lens.
    """
    notes: list[tuple[str, Note]] = []
    # Without sharing, each lens is determined only by its own photos, even if the same camera took
    # all photos.
    shared = ", or set intrinsics: shared if one camera took all photos at the same zoom"
    also = shared if len(block.lenses) > 1 else ""
    scale = np.sqrt(np.diag(cofactors))
    correlations = np.abs(cofactors / np.outer(scale, scale))
    for index, lens in enumerate(block.lenses):
        members = block.photos_of(index)
        for column, name in enumerate(lens.freedom.names, block.lens_starts[index]):
            of_poses = correlations[: POSE_PARAMETERS * len(block.cameras), column]
            # A parameter is undetermined only if it is correlated with the poses of all photos of
            # the lens.
            confused = of_poses.reshape(-1, POSE_PARAMETERS)[members].min(axis=0)
            worst = int(confused.argmax())
            if confused[worst] > _CORRELATED:
                values = {"parameter": name, "pose": _POSE_NAMES[worst], "also": also}
                note = LENS_CONFUSED, {**values, "correlation": float(confused[worst])}
                notes.append((photos[members[0]].name, note))
    return notes


_Rows = tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64]]
"""Whitened equations after elimination of the points: columns (c,) of the unknowns, Jacobian (r, c)
and residuals (r,).
"""


def _adjusted_points(
    block: Block, cofactors: NDArray[np.float64], soft_limit: float
) -> AdjustedPoints:
    known = np.isfinite(block.points.sigma_m[block.seen.point])
    # Compare points that several photos see with the scan, too.
    at_scan = replace(block.points, now=block.points.known)
    block = replace(block, points=at_scan, seen=block.seen.take(known))
    seen, n_known = block.seen, len(block.seen)
    jacobian, pulls = (np.zeros((n_known, k, len(cofactors))) for k in (2, 3))
    residuals, by_place = np.zeros((n_known, 2)), np.zeros((n_known, 2, 3))
    towards, information = np.zeros((n_known, 3)), np.zeros((len(block.points), 3, 3))
    follows = np.zeros((len(block.cameras), len(cofactors), 3))
    of_pixels = (seen.sigma_px**2)[:, None, None] * np.eye(2)
    with_places = pixel_covariances(block, alone=True)
    for photo, camera in enumerate(block.cameras):
        mine, own = np.flatnonzero(seen.photo == photo), block.columns(photo)
        by_camera, by_point, off = _seen_by(block, photo, mine, with_places[mine], soft_limit)
        residuals[mine], by_place[mine] = off, by_point
        jacobian[mine[:, None, None], [[0], [1]], own] = by_camera
        # The error of a point is the same in all photos that see the point.
        by_camera, by_point, _ = _seen_by(block, photo, mine, of_pixels[mine], math.inf)
        pulls[mine[:, None, None], [[0], [1], [2]], own] = np.einsum(
            "nip,nid->ndp", by_camera, by_point
        )
        np.add.at(information, seen.point[mine], np.einsum("nid,nie->nde", by_point, by_point))
        follows[photo, own[3:POSE_PARAMETERS]] = camera.rotation
        if len(mine) >= _MIN_FOR_PLANE:
            towards[mine] = outwards(at_scan.known[seen.point[mine]], camera.centre_world)
    variances = np.where(np.isfinite(at_scan.sigma_m), at_scan.sigma_m, 0.0) ** 2
    held = np.linalg.inv(np.eye(3) + variances[:, None, None] * information)
    return AdjustedPoints(
        photo=seen.photo,
        places=at_scan.known[seen.point],
        residuals=residuals,
        jacobian=jacobian,
        by_place=by_place,
        pulls=np.einsum("ndp,nde->npe", pulls, held[seen.point]),
        follows=follows,
        towards=towards,
        cofactors=cofactors,
        scan_errors=None if at_scan.scan_errors is None else at_scan.scan_errors[seen.point],
    )


def _rows(block: Block, soft_limit: float) -> list[_Rows]:
    """Return the equations of the remaining unknowns after eliminating all points."""
    seen = block.seen
    joint = block.is_joint[seen.point]
    covariances = pixel_covariances(block)
    rows: list[_Rows] = []
    stacked: dict[int, list[tuple[_Rows, NDArray[np.float64]]]] = {}
    for photo in range(len(block.cameras)):
        mine, columns = np.flatnonzero(seen.photo == photo), block.columns(photo)
        by_camera, by_point, off = _seen_by(block, photo, mine, covariances[mine], soft_limit)
        alone = ~joint[mine]
        rows.append((columns, by_camera[alone].reshape(-1, columns.size), off[alone].ravel()))
        for nth in np.flatnonzero(joint[mine]):
            one = columns, by_camera[nth], off[nth]
            stacked.setdefault(int(seen.point[mine[nth]]), []).append((one, by_point[nth]))
    return rows + [_without_point(block, point, parts) for point, parts in stacked.items()]


def _seen_by(
    block: Block,
    photo: int,
    mine: NDArray[np.intp],
    covariances: NDArray[np.float64],
    soft_limit: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the whitened and robustly weighted equations of the m observations in a photo.

    Returns:
        Derivatives with respect to pose and lens (m, 2, c), derivatives with respect to the points
        (m, 2, 3), and residuals (m, 2).
    """
    camera, seen = block.cameras[photo], block.seen
    points = seen.point[mine]
    at = np.where(
        block.is_joint[points, None], block.points.now[points], block.points.known[points]
    )
    linear = linearised(camera, at, block.lenses[block.lens_of[photo]].freedom)
    by_point = linear.by_camera_point @ camera.rotation
    residuals = seen.pixels[mine] - linear.pixels
    columns = np.concatenate([residuals[:, :, None], linear.by_parameters, by_point], axis=2)
    columns = whiten(covariances, columns)
    lengths = np.linalg.norm(columns[:, :, 0], axis=1)
    columns *= np.sqrt(np.minimum(1.0, soft_limit / np.maximum(lengths, 1e-12)))[:, None, None]
    return columns[:, :, 1:-3], columns[:, :, -3:], columns[:, :, 0]


def _without_point(
    block: Block, point: int, parts: list[tuple[_Rows, NDArray[np.float64]]]
) -> _Rows:
    """Eliminate a point that several photos see from the equations of these photos."""
    columns = np.unique(np.concatenate([one[0] for one, _ in parts]))
    sigma_m = float(block.points.sigma_m[point])
    n_known = 3 if math.isfinite(sigma_m) else 0
    jacobian = np.zeros((2 * len(parts) + n_known, columns.size))
    by_point = np.zeros((len(jacobian), 3))
    residuals = np.zeros(len(jacobian))
    for nth, ((own, by_camera, off), of_point) in enumerate(parts):
        two = slice(2 * nth, 2 * nth + 2)
        jacobian[two, np.searchsorted(columns, own)] = by_camera
        by_point[two], residuals[two] = of_point, off
    if n_known:
        least = max(sigma_m, _MIN_SIGMA_M)
        by_point[-3:] = np.eye(3) / least
        residuals[-3:] = (block.points.known[point] - block.points.now[point]) / least
    across = np.linalg.qr(by_point, mode="complete").Q[:, 3:]
    remaining = np.einsum("ij,ik->jk", across, jacobian)
    return columns, remaining, np.einsum("ij,i->j", across, residuals)


def _set_up(block: Block) -> tuple[Any, Any]:
    """Build COLMAP's scene and adjuster from the poses and lenses.

    The manifold of a pose is only available from COLMAP's adjuster, which requires observations.
    Each photo therefore gets two dummy observations, whose residuals are so large that the robust
    loss gives them no weight.
    """
    import pycolmap

    colmap: Any = pycolmap
    scene, config = colmap.Reconstruction(), colmap.BundleAdjustmentConfig()
    for index, lens in enumerate(block.lenses):
        camera = colmap.Camera(
            model=_MODEL,
            width=lens.prior.width,
            height=lens.prior.height,
            params=_values(block.cameras[block.lens_of.index(index)]),
            camera_id=index + 1,
        )
        scene.add_camera_with_trivial_rig(camera)
    for at, (viewer, lens_of) in enumerate(zip(block.cameras, block.lens_of, strict=True), 1):
        image = colmap.Image(name=str(at), camera_id=lens_of + 1, image_id=at)
        image.points2D = colmap.Point2DList([colmap.Point2D([_FAR_PX, _FAR_PX])] * 2)
        pose = colmap.Rigid3d(colmap.Rotation3d(viewer.rotation), viewer.translation)
        scene.add_image_with_trivial_frame(image, pose)
        track = colmap.Track()
        track.add_element(at, 0)
        track.add_element(at, 1)
        ahead = viewer.rotation.T @ (np.array([0.0, 0.0, 1.0]) - viewer.translation)
        config.add_image(at)
        config.add_constant_point(scene.add_point3D(ahead, track, np.zeros(3, np.uint8)))
    options = colmap.BundleAdjustmentOptions()
    options.ceres.loss_function_type = colmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = _NOTHING
    return scene, colmap.create_default_ceres_bundle_adjuster(options, config, scene)


def _add_observations(
    block: Block,
    problem: Any,
    parameters: tuple[list[Any], list[Any]],
    joint: dict[int, NDArray[np.float64]],
    soft_limit: float,
) -> None:
    """Add the observations to the problem.

    If only one photo sees a point, the observation includes the covariance of the point.
    """
    import pyceres
    import pycolmap
    from pycolmap import cost_functions

    ceres, costs = pyceres, cost_functions
    poses, lenses = parameters
    model = getattr(pycolmap.CameraModelId, _MODEL)
    loss, whole = ceres.HuberLoss(soft_limit), ceres.TrivialLoss()
    seen, covariances = block.seen, pixel_covariances(block)
    for nth in range(len(seen)):
        photo, point = int(seen.photo[nth]), int(seen.point[nth])
        camera = [poses[photo], lenses[block.lens_of[photo]]]
        if point in joint:
            cost = costs.ReprojErrorCost(model, covariances[nth], seen.pixels[nth])
            problem.add_residual_block(cost, loss, [joint[point], *camera])
        else:
            known = block.points.known[point]
            cost = costs.ReprojErrorCost(model, covariances[nth], seen.pixels[nth], known)
            problem.add_residual_block(cost, loss, camera)
    for point, values in joint.items():
        sigma_m = float(block.points.sigma_m[point])
        if math.isfinite(sigma_m):
            covariance = np.eye(3) * max(sigma_m, _MIN_SIGMA_M) ** 2
            prior = ceres.factors.NormalPrior(block.points.known[point], covariance)
            problem.add_residual_block(prior, whole, [values])


def _values(camera: ViewingCamera) -> NDArray[np.float64]:
    if camera.skew:
        raise MethodError(
            f"a lens of the block has a skew of {camera.skew:.1f} px, which COLMAP's camera models "
            "do not support: calibrate it without skew, or use orient.dlt or orient.pnp"
        )
    values = [camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion]
    return np.pad(np.array(values), (0, _N_VALUES - len(values)))


def _limit_lens(problem: Any, lens: Lens, values: NDArray[np.float64]) -> None:
    """Fix the parameters of a lens that are not free, and constrain the others by priors."""
    import pyceres

    ceres: Any = pyceres
    sigmas = dict(zip(lens.freedom.names, lens.freedom.sigmas.tolist(), strict=True))
    if not sigmas:
        problem.set_parameter_block_constant(values)
        return
    covariance = np.eye(_N_VALUES)
    held = set(range(_N_VALUES))
    for name, column in _COLUMNS.items():
        if name in sigmas:
            covariance[column, column] = sigmas[name] ** 2
            held.discard(column)
    prior = _values(lens.prior)
    if "focal" in sigmas or "aspect" in sigmas:
        focal = prior[:2]
        shared = sigmas.get("focal", _TIED_ASPECT) ** 2
        own = np.diag([0.0, sigmas.get("aspect", _TIED_ASPECT) ** 2])
        covariance[:2, :2] = np.outer(focal, focal) * (shared + own)
        held -= {0, 1}
    problem.set_manifold(values, ceres.SubsetManifold(_N_VALUES, sorted(held)))
    cost = ceres.factors.NormalPrior(prior, covariance)
    problem.add_residual_block(cost, ceres.TrivialLoss(), [values])
