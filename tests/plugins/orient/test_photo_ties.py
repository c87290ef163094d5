"""How far rays of one photo lie from the epipolar lines of another, by algebra."""

from __future__ import annotations

import numpy as np
import pytest
from orthoflow_plugins.orient.photo_ties import _off_line_px

from orthoflow.geometry.cameras import ViewingCamera, looking_at
from tests import samples

UP = np.array([0.0, 0.0, 1.0])


def camera(centre: tuple[float, float, float], *, focal_px: float) -> ViewingCamera:
    where = np.array(centre)
    rotation = looking_at(where, np.array([0.2, 5.0, 0.3]), UP)
    return samples.camera(
        rotation, where, width=1000, height=800, fx=focal_px, fy=focal_px, cx=500.0, cy=400.0
    )


@pytest.mark.parametrize("focal_px", [500.0, 1700.0])
def test_rays_are_off_by_the_pixels_that_they_were_moved_across_the_line(focal_px: float) -> None:
    rng = np.random.default_rng(1)
    first, second = (
        camera((-1.0, 0.0, 0.0), focal_px=900.0),
        camera((1.0, 0.3, 0.2), focal_px=focal_px),
    )
    points = rng.uniform((-1.5, 4.0, -1.0), (1.5, 6.0, 1.0), (40, 3))
    seen = [(points - view.centre_world) @ view.rotation.T for view in (first, second)]
    rays = [item / item[:, 2:] for item in seen]
    none = _off_line_px((first, rays[0]), (second, rays[1]))
    np.testing.assert_allclose(none, 0.0, atol=1e-8)
    # The line of a point is the picture of its ray from the first camera: move across it by 3 px.
    farther = (points - first.centre_world) * 1.2 + first.centre_world - second.centre_world
    ahead = farther @ second.rotation.T
    along = (ahead / ahead[:, 2:] - rays[1])[:, :2]
    across = np.column_stack([-along[:, 1], along[:, 0]])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    moved = rays[1].copy()
    moved[:, :2] += across * 3.0 / focal_px
    off = _off_line_px((first, rays[0]), (second, moved))
    np.testing.assert_allclose(off, 3.0, rtol=1e-8)
