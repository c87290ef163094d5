"""`orient.poselib`: orient each photo with PoseLib's `estimate_absolute_pose`."""

from __future__ import annotations

from dataclasses import replace
from importlib.metadata import version

import numpy as np
from orthoflow.products import Camera, Cameras, Photos, Ties
from orthoflow.sdk import Method, MethodParams, Ports, StepContext
from pydantic import Field


class OrientPoselib(Method):
    """Orient each calibrated photo separately with PoseLib's LO-RANSAC and refinement."""

    id = "orient.poselib"
    result_version = 1
    determinism = "seeded"
    citations = (
        "PoseLib, https://github.com/PoseLib/PoseLib",
        "Persson, Nordberg 2018: Lambda Twist, doi:10.1007/978-3-030-01225-0_20",
    )

    class Params(MethodParams):
        """Tolerance and minimum number of ties that agree."""

        tolerance_px: float = Field(
            2.0, gt=0, description="Ties that deviate more from a pose do not count for it."
        )
        n_ties_min: int = Field(12, ge=6, description="Ties that must agree with a pose.")

    class In(Ports):
        """The ties and the photos."""

        ties: Ties
        photos: Photos

    class Out(Ports):
        """The orientations."""

        cameras: Cameras

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Orient the photos one by one."""
        ties = inputs.ties
        names = np.array(ties.photo_names)
        cameras = []
        for index, photo in enumerate(inputs.photos.photos):
            ctx.progress(index / len(inputs.photos.photos), photo.name)
            own = names[ties.photo] == photo.name if len(names) else np.zeros(0, dtype=bool)
            seed = int(ctx.rng.integers(2**31))
            cameras.append(
                oriented(photo, ties.pixels_photo[own], ties.points_world[own], params, seed)
            )
        n_oriented = sum(camera.status == "ok" for camera in cameras)
        ctx.metric("n_oriented", n_oriented, "1")
        return self.Out(cameras=Cameras(cameras=tuple(cameras)))

    @classmethod
    def tools(cls) -> dict[str, str]:
        """Return the version of the library that determines the results."""
        return {"poselib": version("poselib")}


def oriented(photo, pixels, points, params, seed):
    """Return the orientation of one photo, or the reason why it has none."""
    import poselib

    lens = photo.intrinsics
    if lens is None:
        return Camera(photo=photo.name, status="the photo has no calibration")
    if len(pixels) < params.n_ties_min:
        return Camera(photo=photo.name, status=f"{len(pixels)} ties are too few")
    k1, k2, p1, p2, k3 = lens.distortion
    # The centre of the first pixel is at (0.5, 0.5). PoseLib accepts any convention as long as
    # pixels and camera use the same one.
    camera = {
        "model": "FULL_OPENCV",
        "width": lens.width,
        "height": lens.height,
        "params": [lens.fx, lens.fy, lens.cx, lens.cy, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0],
    }
    centre = points.mean(axis=0)
    pose, told = poselib.estimate_absolute_pose(
        pixels, points - centre, camera, {"max_reproj_error": params.tolerance_px, "seed": seed}
    )
    if told["num_inliers"] < params.n_ties_min:
        return Camera(photo=photo.name, status=f"only {told['num_inliers']} ties agree with a pose")
    found = Camera(
        photo=photo.name,
        status="ok",
        intrinsics=lens,
        rotation_camera_from_world=np.array(pose.R),
        translation_camera_from_world=np.array(pose.t) - pose.R @ centre,
    )
    agreeing = np.array(told["inliers"], dtype=bool)
    computed = found.viewing().project(points[agreeing])[:, :2]
    return replace(found, sigma0_px=float(np.sqrt(np.mean((pixels[agreeing] - computed) ** 2))))
