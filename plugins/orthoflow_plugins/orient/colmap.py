"""The adjustment of a block by COLMAP's cost functions and the Ceres solver."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import GeometryError, MethodError
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow_plugins.orient.block import MIN_SIGMA_M, Block, pixel_covariances
from orthoflow_plugins.orient.lenses import Lens

_ITERATIONS: Final = 60
# Of the cost: the square of a hundredth of a standard deviation.
_CONVERGED: Final = 1e-8
# COLMAP's order: fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6.
_MODEL: Final = "FULL_OPENCV"
_N_VALUES: Final = 12
_COLUMNS: Final = {"cx": 2, "cy": 3, "k1": 4, "k2": 5, "p1": 6, "p2": 7}
# fx and fy are values of their own; so tight a prior ties them where their ratio is known.
_TIED_ASPECT: Final = 1e-5
# An observation this far off under a loss this narrow pulls with nothing.
_FAR_PX: Final = -1e6
_NOTHING: Final = 1e-9


@dataclass(frozen=True, kw_only=True)
class _Colmap:
    """What COLMAP set up of a block; the solver changes poses and lenses in place."""

    problem: Any
    scene: Any
    adjuster: Any
    poses: list[NDArray[np.float64]]
    lenses: list[NDArray[np.float64]]


def solve(block: Block, *, soft_limit: float) -> Block:
    """Adjust all cameras, lenses and jointly seen points at once.

    Args:
        block: where to start.
        soft_limit: residuals beyond so many standard deviations count less (Huber).

    Raises:
        GeometryError: the block has no solution.
    """
    import pyceres

    ceres: Any = pyceres
    colmap = _set_up(block)
    joint = {int(at): block.points.now[at].copy() for at in np.flatnonzero(block.is_joint)}
    _add_observations(block, colmap, joint, soft_limit)
    for lens, values in zip(block.lenses, colmap.lenses, strict=True):
        _limit_lens(colmap.problem, lens, values)
    options = ceres.SolverOptions()
    options.max_num_iterations = _ITERATIONS
    options.function_tolerance = _CONVERGED
    # Sums of several threads come in any order.
    options.num_threads = 1
    kinds = ceres.LinearSolverType
    options.linear_solver_type = kinds.DENSE_SCHUR if joint else kinds.DENSE_NORMAL_CHOLESKY
    options.logging_type = ceres.LoggingType.SILENT
    summary = ceres.SolverSummary()
    ceres.solve(options, colmap.problem, summary)
    if not summary.IsSolutionUsable() or not math.isfinite(summary.final_cost):
        raise GeometryError(f"the block of photos has no solution: {summary.BriefReport()}")
    now = block.points.now.copy()
    for at, values in joint.items():
        now[at] = values
    return block.moved(_cameras(block, colmap), now)


def _set_up(block: Block) -> _Colmap:
    """Let COLMAP set up poses and lenses.

    The manifold on which a pose moves is to be had from COLMAP's adjuster only, and that wants
    observations: two of one point per photo, so far off that they pull with nothing.
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
    for index, camera in enumerate(block.cameras):
        image = colmap.Image(
            name=str(index), camera_id=block.lens_of[index] + 1, image_id=index + 1
        )
        image.points2D = colmap.Point2DList([colmap.Point2D([_FAR_PX, _FAR_PX])] * 2)
        pose = colmap.Rigid3d(colmap.Rotation3d(camera.rotation), camera.translation)
        scene.add_image_with_trivial_frame(image, pose)
        track = colmap.Track()
        track.add_element(index + 1, 0)
        track.add_element(index + 1, 1)
        ahead = camera.rotation.T @ (np.array([0.0, 0.0, 1.0]) - camera.translation)
        config.add_image(index + 1)
        config.add_constant_point(scene.add_point3D(ahead, track, np.zeros(3, np.uint8)))
    options = colmap.BundleAdjustmentOptions()
    options.ceres.loss_function_type = colmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = _NOTHING
    adjuster = colmap.create_default_ceres_bundle_adjuster(options, config, scene)
    frames = [scene.images[index + 1].frame for index in range(len(block.cameras))]
    return _Colmap(
        problem=adjuster.problem,
        scene=scene,
        adjuster=adjuster,
        poses=[frame.rig_from_world.params for frame in frames],
        lenses=[scene.cameras[index + 1].params for index in range(len(block.lenses))],
    )


def _add_observations(
    block: Block, colmap: _Colmap, joint: dict[int, NDArray[np.float64]], soft_limit: float
) -> None:
    """Add what is seen: of a point of its own as a wider pixel, of a joint one as it is."""
    import pyceres
    import pycolmap
    from pycolmap import cost_functions

    ceres, costs = pyceres, cost_functions
    model = getattr(pycolmap.CameraModelId, _MODEL)
    loss, whole = ceres.HuberLoss(soft_limit), ceres.TrivialLoss()
    seen, covariances = block.seen, pixel_covariances(block)
    for nth in range(len(seen)):
        photo, point = int(seen.photo[nth]), int(seen.point[nth])
        camera = [colmap.poses[photo], colmap.lenses[block.lens_of[photo]]]
        if point in joint:
            cost = costs.ReprojErrorCost(model, covariances[nth], seen.pixels[nth])
            colmap.problem.add_residual_block(cost, loss, [joint[point], *camera])
        else:
            known = block.points.known[point]
            cost = costs.ReprojErrorCost(model, covariances[nth], seen.pixels[nth], known)
            colmap.problem.add_residual_block(cost, loss, camera)
    for point, values in joint.items():
        sigma_m = float(block.points.sigma_m[point])
        if math.isfinite(sigma_m):
            covariance = np.eye(3) * max(sigma_m, MIN_SIGMA_M) ** 2
            prior = ceres.factors.NormalPrior(block.points.known[point], covariance)
            colmap.problem.add_residual_block(prior, whole, [values])


def _values(camera: ViewingCamera) -> NDArray[np.float64]:
    if camera.skew:
        raise MethodError(
            f"a lens of the block has a skew of {camera.skew:.1f} px, which no model of COLMAP "
            "has: calibrate it without, or use orient.dlt or orient.pnp"
        )
    k1, k2, p1, p2, k3 = camera.distortion
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0])


def _limit_lens(problem: Any, lens: Lens, values: NDArray[np.float64]) -> None:
    """Hold what is not free of a lens, and pull the rest towards what is known of it."""
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


def _cameras(block: Block, colmap: _Colmap) -> tuple[ViewingCamera, ...]:
    cameras = []
    for index, (camera, lens) in enumerate(zip(block.cameras, block.lens_of, strict=True)):
        values = np.array(colmap.lenses[lens])
        names = block.lenses[lens].freedom.names
        ratio = camera.fy / camera.fx
        pose = colmap.scene.images[index + 1].frame.rig_from_world
        left, _, right = np.linalg.svd(pose.rotation.matrix())
        cameras.append(
            replace(
                camera,
                fx=float(values[0]),
                fy=float(values[1] if "aspect" in names else values[0] * ratio),
                cx=float(values[2]),
                cy=float(values[3]),
                distortion=values[4:9].copy(),
                rotation=left @ right,
                translation=np.array(pose.translation),
            )
        )
    return tuple(cameras)
