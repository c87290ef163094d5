"""What is known of lenses beforehand, and which photos share one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from orthoflow_plugins.orient import pose as lenses
from orthoflow_plugins.orient.pose import Sharing

from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.products import Intrinsics, Photo
from orthoflow.testing import photographed as ms

CALIBRATED = Intrinsics(
    width=600, height=400, fx=510.0, fy=512.0, cx=303.0, cy=197.0,
    distortion=(-0.1, 0.02, 1e-4, 2e-4, 0.0),
)  # fmt: skip
OF_EXIF = [0.05, 1e-3, 6.0, 6.0, 0.1, 0.1, 1e-3, 1e-3]
FREE = ("focal", "aspect", "cx", "cy", "k1", "k2", "p1", "p2")


def photo(name: str = "a.jpg", size: tuple[int, int] = (600, 400), **known: Any) -> Photo:
    return Photo(name=name, encoded=b"", width=size[0], height=size[1], **known)


def oriented(*focal_px: float) -> list[ViewingCamera]:
    camera = ms.camera_before(ms.photographed_scene())
    return [replace(camera, fx=focal, fy=focal) for focal in focal_px]


def test_exif_is_believed_to_a_twentieth_and_tried_a_little_shorter_and_longer() -> None:
    prior = lenses.lens_prior(photo(exif_focal_px=500.0))
    assert [guess.fx for guess in (prior.prior, *prior.guesses)] == pytest.approx(
        [500.0, 470.0, 530.0]
    )
    assert prior.source == "exif"
    for guess in (prior.prior, *prior.guesses):
        assert (guess.fy, guess.cx, guess.cy) == (guess.fx, 300.0, 200.0)
        assert not any(guess.distortion)
    assert prior.freedom.names == FREE
    # The principal point to a hundredth of the longer side.
    assert prior.freedom.sigmas.tolist() == OF_EXIF


@pytest.mark.parametrize("size", [(600, 400), (400, 600)])
def test_without_exif_lenses_from_wide_to_long_are_tried(size: tuple[int, int]) -> None:
    prior = lenses.lens_prior(photo(size=size))
    shares = [guess.fx / 600.0 for guess in (prior.prior, *prior.guesses)]
    assert shares == pytest.approx([0.6, 0.75, 0.95, 1.2, 1.6, 2.2])
    assert {(guess.cx, guess.cy) for guess in (prior.prior, *prior.guesses)} == {
        (size[0] / 2, size[1] / 2)
    }
    assert (prior.source, prior.freedom.names) == ("none", FREE)
    assert prior.freedom.sigmas.tolist() == [0.35, *OF_EXIF[1:]]


@pytest.mark.parametrize(
    ("sharing", "lens_of"),
    [
        ("per-photo", (0, 1, 2, 3, 4, 5)),
        ("shared", (0, 0, 0, 0, 0, 1)),
        # Two of one focal length; a third of another; two of none known; another size.
        ("focal-group", (0, 0, 1, 2, 2, 3)),
    ],
)
def test_photos_share_a_lens_by_size_and_known_focal_length(
    sharing: Sharing, lens_of: tuple[int, ...]
) -> None:
    photos = [
        photo("a", exif_focal_px=500.0),
        photo("b", exif_focal_px=500.0),
        photo("c", exif_focal_px=700.0),
        photo("d"),
        photo("e"),
        photo("f", exif_focal_px=500.0, size=(400, 600)),
    ]
    lens_of_photos, found = lenses.lens_groups(photos, oriented(*[500.0] * 6), sharing)
    assert lens_of_photos == lens_of
    assert len(found) == max(lens_of) + 1


def test_photos_that_are_set_apart_share_no_lens() -> None:
    # An index is no focal length.
    photos = [photo("a"), photo("b"), photo("c"), photo("d", exif_focal_px=1.0)]
    cameras = oriented(*[500.0] * 4)
    for sharing, lens_of in (("focal-group", (0, 1, 0, 2)), ("shared", (0, 1, 0, 0))):
        assert lenses.lens_groups(photos, cameras, sharing, {1})[0] == lens_of


def test_of_photos_that_share_a_lens_the_best_known_one_tells_it() -> None:
    photos = [photo("a"), photo("b", exif_focal_px=520.0), photo("c", intrinsics=CALIBRATED)]
    cameras = oriented(480.0, 500.0, 510.0)
    for n_photos, source, focal_px in ((3, "calibration", 510.0), (2, "exif", 520.0)):
        _, found = lenses.lens_groups(photos[:n_photos], cameras[:n_photos], "shared")
        (lens,) = found
        assert (lens.source, lens.prior.fx) == (source, focal_px)


def test_calibrated_lenses_are_held() -> None:
    photos = [photo("a", exif_focal_px=500.0), photo("b", intrinsics=CALIBRATED)]
    _, found = lenses.lens_groups(photos, oriented(500.0, 510.0), "per-photo")
    assert [lens.freedom.sigmas.tolist() for lens in found] == [OF_EXIF, []]


def test_a_pixel_beyond_what_a_lens_bends_has_no_ray() -> None:
    camera = replace(
        ms.camera_before(ms.photographed_scene()), distortion=np.array([-0.5, 0.0, 0.0, 0.0, 0.0])
    )
    # With k1 = -0.5 no ray comes out farther than 0.54 focal lengths from the axis.
    rays = lenses.camera_rays(
        camera,
        np.array([[camera.cx + 0.5 * camera.fx, camera.cy], [camera.cx + camera.fx, camera.cy]]),
    )
    assert np.isfinite(rays[0]).all()
    assert np.isnan(rays[1]).all()
