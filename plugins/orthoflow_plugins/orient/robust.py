"""A first pose from ties of which many are wrong: random samples, scored by agreement."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import GeometryError
from orthoflow.geometry.cameras import ViewingCamera

_LEAST: Final = 4
_CONFIDENCE: Final = 0.99999


@dataclass(frozen=True, kw_only=True)
class RobustPose:
    """A pose and the ties that agree with it.

    Attributes:
        camera: the camera at that pose.
        agreeing: (n,) bool.
    """

    camera: ViewingCamera
    agreeing: NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class SamplingRule:
    """How samples are drawn.

    Attributes:
        threshold_px: ties agree with a pose up to this distance.
        n_trials_most: samples drawn at most.
        seed: of the samples.
    """

    threshold_px: float
    n_trials_most: int
    seed: int


def robust_pose(
    pixels_photo: NDArray[np.float64],
    points_world: NDArray[np.float64],
    lens: ViewingCamera,
    rule: SamplingRule,
) -> RobustPose | None:
    """Find the pose that most ties agree with (MSAC on P3P: Torr & Zisserman 2000).

    Args:
        pixels_photo: (n, 2).
        points_world: (n, 3) metres.
        lens: the camera's interior orientation; its pose is ignored.
        rule: how samples are drawn.

    Returns:
        None when no pose is found.
    """
    import cv2

    usable = _undistorted(pixels_photo, lens)
    inside: NDArray[np.bool_] = np.asarray(np.isfinite(usable).all(axis=1))
    if inside.sum() < _LEAST:
        return None
    middle = points_world.mean(axis=0)
    # OpenCV's (0, 0) is the centre of the first pixel, ours (0.5, 0.5).
    pixels = np.ascontiguousarray(usable[inside] - 0.5)
    points = np.ascontiguousarray(points_world[inside] - middle)
    matrix = np.array([[lens.fx, 0.0, lens.cx - 0.5], [0.0, lens.fy, lens.cy - 0.5], [0, 0, 1]])
    call: Any = cv2.solvePnPRansac
    try:
        found, _, turn, shift, agreed = call(points, pixels, matrix, None, params=_usac(rule))
    except cv2.error:  # no sample has a solution
        return None
    if not found or agreed is None:
        return None
    rotation = np.asarray(cv2.Rodrigues(turn)[0], dtype=np.float64)
    local = replace(lens, rotation=rotation, translation=np.asarray(shift).ravel())
    agreeing = np.zeros(len(inside), dtype=np.bool_)
    agreeing[np.flatnonzero(inside)[np.asarray(agreed).ravel()]] = True
    return RobustPose(camera=local.shifted(-middle), agreeing=agreeing)


def _usac(rule: SamplingRule) -> Any:
    """OpenCV's universal sampling, one thread: several give another result each time."""
    import cv2

    params: Any = cv2.UsacParams()
    params.threshold = rule.threshold_px
    params.maxIterations = rule.n_trials_most
    params.confidence = _CONFIDENCE
    params.randomGeneratorState = rule.seed
    params.isParallel = False
    params.score = cv2.SCORE_METHOD_MSAC
    # The adjustment that follows does what a local optimisation would do in thrice the time.
    params.loMethod = cv2.LOCAL_OPTIM_NULL
    return params


def _undistorted(pixels: NDArray[np.float64], lens: ViewingCamera) -> NDArray[np.float64]:
    """Pixels of a camera without distortion; NaN where the lens model cannot be undone."""
    if not lens.distortion.any():
        return pixels
    try:
        rays = lens.rays_camera(pixels)
    except GeometryError:
        rays = np.full((len(pixels), 3), np.nan)
        for index in range(len(pixels)):
            try:
                rays[index] = lens.rays_camera(pixels[index : index + 1])[0]
            except GeometryError:
                continue
    straight: NDArray[np.float64] = rays[:, :2] * [lens.fx, lens.fy] + [lens.cx, lens.cy]
    return straight
