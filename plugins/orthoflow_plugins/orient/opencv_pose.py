"""The pose of one photo by OpenCV's solvePnP alone, as markiewicz2015 (3.6) took it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import GeometryError
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.opencv_border import opencv_matrix, to_opencv
from orthoflow.geometry.resection import SeenPoints, misfit, stated
from orthoflow.products import Photo
from orthoflow_plugins.orient.estimation import (
    Estimate,
    EstimationRule,
    expected_px,
    no_pose,
    robust_start,
    unit_deviation,
    without_chance,
)
from orthoflow_plugins.orient.layout import GROUPS, image_cells
from orthoflow_plugins.orient.lenses import intrinsics_of

# solvePnP needs six points where they do not lie in a plane.
_LEAST: Final = 6
_ROUNDS: Final = 8


def estimate_by_opencv(
    photo: Photo, seen: SeenPoints, is_check: NDArray[np.bool_], rule: EstimationRule
) -> Estimate | str:
    """Orient a photo by `cv2.solvePnP` (iterative, Levenberg-Marquardt), or say why not.

    Every tie counts alike, the lens stays as it is known, and solvePnP starts from nothing. Ties
    that deviate too much are rejected, and it is called again until they stay the same. The first
    of them are told by sampling, as everywhere here: least squares of all would not bear them.
    """
    robust = robust_start(photo, seen, is_check, rule)
    if robust is None:
        return no_pose(seen)
    # Each pixel as uncertain as is usual, the points exact.
    alike = replace(
        seen,
        sigma_px=np.full(len(seen), expected_px(seen.take(robust.agreeing & ~is_check))),
        sigma_m=np.zeros(len(seen)),
    )
    agreeing = robust.agreeing
    try:
        for _ in range(_ROUNDS):
            used = agreeing & ~is_check
            camera = _solved(alike.take(used), robust.camera)
            fit = misfit(alike, camera)
            unit = unit_deviation(fit.normalised[used])
            limit = without_chance(fit.normalised[~is_check], rule.rejection_sigma * unit)
            agreeing = fit.normalised <= limit
            if np.array_equal(agreeing & ~is_check, used):
                break
        chosen = alike.take(used)
        cells = image_cells(chosen.pixels_photo, (photo.width, photo.height), GROUPS)
        resection = stated(chosen, camera, groups=cells)
    except GeometryError as error:
        return f"{error}: use orient.pnp with method weighted"
    return Estimate(
        resection=resection,
        intrinsics=intrinsics_of(resection, robust.source),
        source=robust.source,
        fit=fit,
        agreeing=agreeing,
        limit=limit,
    )


def _solved(seen: SeenPoints, lens: ViewingCamera) -> ViewingCamera:
    """Give the camera at the pose that solvePnP finds.

    Raises:
        GeometryError: it finds none.
    """
    import cv2

    if len(seen) < _LEAST:
        raise GeometryError(f"solvePnP needs {_LEAST} ties, {len(seen)} agree with one pose")
    if lens.skew:
        raise GeometryError(f"solvePnP knows no skew, and the lens has {lens.skew:.1f} px of it")
    # Survey coordinates would cost digits.
    middle = seen.points_world.mean(axis=0)
    # Any: the stubs want one of its many array types.
    call: Any = cv2.solvePnP
    try:
        found, turn, shift = call(
            seen.points_world - middle,
            np.ascontiguousarray(to_opencv(seen.pixels_photo)),
            opencv_matrix(lens),
            lens.distortion,
            flags=cv2.SOLVEPNP_ITERATIVE,
        )
    except cv2.error as error:
        raise GeometryError(f"solvePnP gave up ({error.err})") from error
    if not found:
        raise GeometryError("solvePnP finds no pose")
    rotation = np.asarray(cv2.Rodrigues(turn)[0], dtype=np.float64)
    posed = replace(lens, rotation=rotation, translation=np.asarray(shift).ravel())
    return posed.shifted(-middle)
