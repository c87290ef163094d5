"""What COLMAP and Ceres may change of a lens, and what they find of it in exact observations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from orthoflow_plugins.orient.block import Block, Observations, Points, solve
from orthoflow_plugins.orient.pose import Lens

from orthoflow.errors import MethodError
from orthoflow.geometry.cameras import LensFreedom, ViewingCamera
from orthoflow.testing import photographed as ms
from tests import block_scenes as bs

TRUE = {"fx": 840.0, "fy": 882.0, "cx": 457.0, "cy": 315.0}
DISTORTION = np.array([-0.09, 0.03, 6e-4, -4e-4, 0.01])
# Loose: what the observations say outweighs it by far.
LOOSE = {"focal": 0.2, "aspect": 0.2, "centre_px": 60.0, "k1": 0.5, "k2": 0.5, "tangential": 0.05}


def true_cameras() -> tuple[ViewingCamera, ...]:
    return tuple(
        replace(camera, distortion=DISTORTION, **TRUE)  # type: ignore[arg-type]
        for camera in bs.viewers()[:3]
    )


def freedom(*names: str, times: float = 1.0) -> LensFreedom:
    of = {"centre_px": "centre_sigma_px"}
    return LensFreedom(
        **{of.get(name, f"{name}_sigma"): times * LOOSE[name] for name in names}  # type: ignore[arg-type]
    )


def block_of(
    believed: dict[str, float], distortion: np.ndarray, free: LensFreedom, *, moved_m: float = 0.01
) -> Block:
    """Exact observations, by cameras of one lens that is believed to be another, stood aside."""
    true = true_cameras()
    points = np.random.default_rng(3).uniform([0.4, -0.6, 0.3], [2.6, 0.1, 1.7], (90, 3))
    photo, point, pixels = bs.observed(true, points)
    # Each point of the scan is seen once: a point of its own for every observation.
    own = np.arange(len(photo))
    cameras = tuple(
        replace(
            ms.nudged(camera, (0.002, -0.001, 0.002, moved_m, -moved_m, moved_m)),
            distortion=distortion,
            **believed,  # type: ignore[arg-type]
        )
        for camera in true
    )
    known = points[point]
    return Block(
        cameras=cameras,
        lens_of=(0, 0, 0),
        lenses=(Lens(prior=cameras[0], freedom=free, source="exif"),),
        points=Points(now=known, known=known, sigma_m=np.full(len(own), 1e-5)),
        seen=Observations(
            photo=photo,
            point=own,
            pixels=pixels,
            sigma_px=np.full(len(own), 0.1),
        ),
    )


@pytest.mark.parametrize(
    ("names", "off", "distortion_off"),
    [
        ((), {}, (0.0,) * 4),
        # The ratio of both focal lengths stays as it is believed.
        (("focal",), {"fx": 1.02, "fy": 1.02}, (0.0,) * 4),
        (("k1",), {}, (0.02, 0.0, 0.0, 0.0)),
        (
            ("focal", "aspect", "centre_px", "k1", "k2", "tangential"),
            {"fx": 1.02, "fy": 1.01, "cx": 1.01, "cy": 0.99},
            (0.01, -0.01, 3e-4, 3e-4),
        ),
    ],
)
def test_what_is_free_of_a_lens_is_found_and_the_rest_stays(
    names: tuple[str, ...], off: dict[str, float], distortion_off: tuple[float, ...]
) -> None:
    believed = {name: off.get(name, 1.0) * value for name, value in TRUE.items()}
    distortion = DISTORTION + np.array([*distortion_off, 0.0])
    solved = solve(block_of(believed, distortion, freedom(*names)), soft_limit=3.0)
    for found, camera in zip(solved.cameras, true_cameras(), strict=True):
        for name, value in TRUE.items():
            assert getattr(found, name) == pytest.approx(value, abs=0.05), name
        np.testing.assert_allclose(found.distortion, DISTORTION, atol=5e-5)
        assert found.distortion[4] == DISTORTION[4]
        np.testing.assert_allclose(found.centre_world, camera.centre_world, atol=2e-4)
        np.testing.assert_allclose(found.rotation @ found.rotation.T, np.eye(3), atol=1e-14)


def test_what_is_known_of_a_lens_beforehand_holds_it() -> None:
    off = {"fx": 1.02, "fy": 1.02, "cx": 1.02, "cy": 0.98}
    believed = {key: off[key] * value for key, value in TRUE.items()}
    distortion = DISTORTION + np.array([0.02, 0.02, 5e-4, 5e-4, 0.0])
    sure = freedom("focal", "centre_px", "k1", "k2", "tangential", times=1e-6)
    found = solve(block_of(believed, distortion, sure), soft_limit=3.0).cameras[0]
    for key, value in believed.items():
        assert getattr(found, key) == pytest.approx(value, abs=0.01), key
    np.testing.assert_allclose(found.distortion, distortion, atol=1e-5)


def test_a_wrong_observation_pulls_no_more_than_its_limit() -> None:
    block = block_of(TRUE, DISTORTION, LensFreedom())
    block.seen.pixels[5] += [300.0, -200.0]
    offs = [
        np.linalg.norm(
            solve(block, soft_limit=limit).cameras[0].centre_world - true_cameras()[0].centre_world
        )
        for limit in (1.0, 1e6)
    ]
    assert offs[0] < 0.05 * offs[1]


def test_a_lens_with_skew_is_refused() -> None:
    block = block_of(TRUE, DISTORTION, LensFreedom())
    skewed = tuple(replace(camera, skew=2.0) for camera in block.cameras)
    with pytest.raises(MethodError, match=r"has a skew of 2\.0 px"):
        solve(replace(block, cameras=skewed), soft_limit=3.0)
