"""The direct linear transform: exact for exact points, wrong at the corners without distortion."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.orient.dlt import (
    Distortion,
    OrientDlt,
    estimate_dlt,
)
from orthoflow_plugins.orient.gates import known_walls, wall_error
from orthoflow_plugins.orient.pose import Estimate, TiedPhoto

from orthoflow.files.images import encode_png
from orthoflow.geometry.cameras import ViewingCamera, looking_at
from orthoflow.geometry.resection import SeenPoints
from orthoflow.products import Cameras, Photo, Photos, Ties, TieWall
from orthoflow.sdk import StepContext
from orthoflow.testing import photographed as ms
from tests import samples
from tests.long_loops import seeds

SIZE_PX = (4000, 3000)
# A grey photo: what it shows is in the ties.
ENCODED = encode_png(np.zeros((SIZE_PX[1] // 10, SIZE_PX[0] // 10), np.uint8))


def camera(*, k1: float = -0.08, full: bool = False) -> ViewingCamera:
    """A wide camera 2.6 m before the middle of a wall in the plane y = 0."""
    centre = np.array([0.15, -2.6, 0.1])
    rotation = looking_at(centre, np.array([0.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    return samples.camera(
        rotation,
        centre,
        width=SIZE_PX[0],
        height=SIZE_PX[1],
        fx=3200.0,
        fy=3204.0,
        cx=2012.0,
        cy=1490.0,
        distortion=np.array([k1, 0.03, 4e-4, -3e-4, 0.0] if full else [k1, 0.0, 0.0, 0.0, 0.0]),
    )


def points_in_view(
    viewer: ViewingCamera, n: int, *, relief_m: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Points all over the photo, up to `relief_m` before the wall."""
    pixels = rng.uniform([0.0, 0.0], SIZE_PX, (n, 2))
    rays = viewer.rays_world(pixels)
    depth = -relief_m * rng.random(n)
    reach = (depth - viewer.centre_world[1]) / rays[:, 1]
    return viewer.centre_world + reach[:, None] * rays


def ties_of(
    viewer: ViewingCamera,
    seed: int,
    *,
    n: int = 300,
    relief_m: float = 0.12,
    noise_px: float = 1.5,
    noise_m: float = 0.0,
) -> Ties:
    rng = np.random.default_rng(seed)
    points = points_in_view(viewer, n, relief_m=relief_m, rng=rng)
    pixels = viewer.project(points)[:, :2] + noise_px * rng.normal(size=(n, 2))
    half = (1.9, 1.5)
    return samples.ties(
        pixels,
        points_world=points + noise_m * rng.normal(size=points.shape),
        sigma_px=np.full(n, max(noise_px, 0.01)),
        sigma_m=np.full(n, max(noise_m, 1e-5)),
        walls=(
            TieWall(
                gsd_m=0.003,
                normal_world=(0.0, -1.0, 0.0),
                corners_world=(
                    (-half[0], 0.0, half[1]),
                    (-half[0], 0.0, -half[1]),
                    (half[0], 0.0, -half[1]),
                    (half[0], 0.0, half[1]),
                ),
            ),
        ),
    )


def photos() -> Photos:
    photo = Photo(
        name="a.png", encoded=ENCODED, width=SIZE_PX[0], height=SIZE_PX[1], exif_focal_px=3150.0
    )
    return ms.photos(photo)


def context(tmp_path: Path) -> StepContext:
    return StepContext(rng=np.random.default_rng(1), cores=2, scratch=tmp_path)


def orient(ties: Ties, ctx: StepContext, **params: object) -> Cameras:
    inputs = OrientDlt.In(ties=ties, photos=photos())
    return OrientDlt().run(inputs, OrientDlt.Params(**params), ctx).cameras


def frame_errors_px(found: ViewingCamera, true: ViewingCamera) -> NDArray[np.float64]:
    """Where the wall's points of a grid over the frame go, found less true: (21 x 21,) lengths."""
    steps = [np.linspace(0.0, side, 21) for side in SIZE_PX]
    pixels = np.stack(np.meshgrid(*steps), axis=-1).reshape(-1, 2)
    rays = true.rays_world(pixels)
    points = true.centre_world - (true.centre_world[1] / rays[:, 1])[:, None] * rays
    return np.linalg.norm(found.project(points)[:, :2] - pixels, axis=1)


@pytest.mark.parametrize("seed", seeds(3))
def test_eleven_parameters_miss_the_corners_of_a_distorted_photo_by_ten_pixels(
    tmp_path: Path, seed: int
) -> None:
    true = camera()
    ctx = context(tmp_path)
    gates = {"max_sigma_wall_cells": 50.0, "max_sigma_corner_cells": 500.0}
    found = orient(ties_of(true, seed), ctx, **gates).cameras[0]
    assert found.status == "ok"
    assert frame_errors_px(found.viewing(), true).max() >= 10.0
    assert "dlt-without-distortion" in [each.code for each in ctx.diagnostics]


@pytest.mark.parametrize("seed", seeds(3))
@pytest.mark.parametrize(
    ("distortion", "full", "most_px", "rms_px"),
    [("k1", False, 4.0, 0.7), ("k1 k2 p1 p2", True, 4.0, 0.7)],
    ids=["k1", "k1 k2 p1 p2"],
)
def test_with_distortion_the_corners_are_right(
    tmp_path: Path, seed: int, distortion: str, full: bool, most_px: float, rms_px: float
) -> None:
    true = camera(full=full)
    found = orient(ties_of(true, seed), context(tmp_path), distortion=distortion).cameras[0]
    assert found.status == "ok"
    errors = frame_errors_px(found.viewing(), true)
    assert errors.max() <= most_px
    assert np.sqrt(np.mean(errors**2)) <= rms_px


@pytest.mark.parametrize("distortion", ["none", "k1"])
def test_a_lens_with_more_distortion_than_the_model_has_is_stated_wider(
    distortion: Distortion,
) -> None:
    true = replace(camera(), distortion=np.array([-0.08, 0.02, 0.0, 0.0, 0.0]))
    params = OrientDlt.Params(distortion=distortion)
    ratios, at_worst = [], []
    for seed in range(6):
        ties = ties_of(true, seed, noise_px=0.7)
        seen = SeenPoints(
            pixels_photo=ties.pixels_photo,
            points_world=ties.points_world,
            sigma_px=ties.sigma_px,
            sigma_m=ties.sigma_m,
        )
        is_check = np.arange(len(seen)) % 5 == 0
        tied = TiedPhoto(
            photo=photos().photos[0],
            chosen=np.arange(len(seen)),
            seen=seen,
            is_check=is_check,
            by_hand=np.zeros(len(seen), dtype=np.bool_),
            seed=1,
        )
        found = estimate_dlt(tied, params)
        assert isinstance(found, Estimate)
        stated = wall_error(found.resection, known_walls(ties, np.ones(len(seen), np.bool_)))
        assert stated is not None
        errors_m = frame_errors_px(found.resection.camera, true) * 2.6 / 3200.0 / np.sqrt(2.0)
        ratios.append(np.sqrt(np.mean(errors_m**2)) / stated.rms_m)
        at_worst.append(errors_m.max() / stated.worst_m)
    # Measured: 1.37 and 1.28, at the worst place 1.54 and 1.53; unless the fuller model is asked,
    # 8 and 3.3.
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 1.8
    assert np.sqrt(np.mean(np.square(at_worst))) < 2.5


def test_control_points_in_a_plane_are_refused(tmp_path: Path) -> None:
    found = orient(ties_of(camera(), 1, relief_m=0.0), context(tmp_path), distortion="k1")
    assert "within 0.0 mm (RMS) of one plane" in found.cameras[0].status


def test_without_a_prior_what_exif_says_does_not_matter(tmp_path: Path) -> None:
    ties = ties_of(camera(), 2)
    found = {}
    for prior in ("lens", "none"):
        for focal_px in (3150.0, 900.0):
            photo = replace(photos().photos[0], exif_focal_px=focal_px)
            (folder := tmp_path / f"{prior}-{focal_px:g}").mkdir()
            inputs = OrientDlt.In(ties=ties, photos=ms.photos(photo))
            params = OrientDlt.Params(distortion="k1", prior=prior)
            cameras = OrientDlt().run(inputs, params, context(folder)).cameras
            found[prior, focal_px] = cameras.cameras[0]
    assert found["lens", 3150.0].status == "ok"
    # The ties contradict the wrong focal length, so it is not used.
    assert found["lens", 900.0].status == "ok"
    first, second = found["none", 3150.0], found["none", 900.0]
    assert first.status == "ok"
    np.testing.assert_array_equal(
        first.translation_camera_from_world, second.translation_camera_from_world
    )
    assert frame_errors_px(first.viewing(), camera()).max() <= 4.0
