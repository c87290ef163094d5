"""A first pose from ties of which many are wrong: random samples, scored by agreement."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import GeometryError
from orthoflow.geometry.cameras import ViewingCamera

_LEAST: Final = 4
_TRIALS_LEAST: Final = 200
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
    """Find the pose that most ties agree with (LO-RANSAC on P3P, as COLMAP has it).

    Args:
        pixels_photo: (n, 2).
        points_world: (n, 3) metres.
        lens: the camera's interior orientation; its pose is ignored.
        rule: how samples are drawn.

    Returns:
        None when no pose is found.
    """
    import pycolmap

    usable = _undistorted(pixels_photo, lens)
    inside: NDArray[np.bool_] = np.asarray(np.isfinite(usable).all(axis=1))
    if inside.sum() < _LEAST:
        return None
    middle = points_world.mean(axis=0)
    # Pixels without distortion have a pinhole's pixel frame; lens models of other programs differ
    # in their last coefficients.
    pinhole = pycolmap.Camera(
        model="PINHOLE",
        width=lens.width,
        height=lens.height,
        params=[lens.fx, lens.fy, lens.cx, lens.cy],
    )
    options: Any = {
        "ransac": {
            "max_error": rule.threshold_px,
            "confidence": _CONFIDENCE,
            "min_num_trials": _TRIALS_LEAST,
            "max_num_trials": rule.n_trials_most,
            "random_seed": rule.seed,
        }
    }
    # One thread: the sums of several come in any order.
    found: dict[str, Any] | None = pycolmap.estimate_and_refine_absolute_pose(
        usable[inside], points_world[inside] - middle, pinhole, options
    )
    if found is None:
        return None
    matrix = found["cam_from_world"].matrix()
    agreeing = np.zeros(len(inside), dtype=np.bool_)
    agreeing[np.flatnonzero(inside)] = found["inlier_mask"]
    left, _, right = np.linalg.svd(matrix[:, :3])
    local = replace(lens, rotation=left @ right, translation=matrix[:, 3])
    return RobustPose(camera=local.shifted(-middle), agreeing=agreeing)


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
