"""How photos are planned and developed: lenses, places, rolls, exposures, and what films suffer."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.simulate import photographs
from orthoflow_plugins.simulate.building import SceneDraft
from orthoflow_plugins.simulate.photographs import Film, planned_shots, take_photos
from orthoflow_plugins.simulate.room_model import DESIGNED

from orthoflow.files.images import decode_image
from tests.raster_scenes import context

UP = np.array([0.0, 0.0, 1.0])
# Where photos of the main wall aim: metres to the right of its foot, and above it.
LATTICES = {
    "quick": ((-1.75, 0.0, 1.75), (-0.65, 0.75)),
    "variant2": ((-1.8, -1.08, -0.36, 0.36, 1.08, 1.8), (-0.8, 0.1, 1.0)),
}
PLAIN = Film(noise_grey=0.0, vignetting=0.0, supersample=1, exposures=0.0)


def rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def developed(image: NDArray[np.floating], **film: float) -> NDArray[np.uint8]:
    given: dict[str, Any] = {**vars(PLAIN), **film}
    return photographs._developed(image.astype(np.float32), Film(**given), rng(1))


@pytest.mark.parametrize("share", [0.1, 0.5])
def test_light_is_lost_towards_the_corners_by_the_fourth_power(share: float) -> None:
    image = np.full((60, 100, 3), 200.0)
    found = developed(image, vignetting=share).astype(np.float64)
    rows, columns = np.mgrid[:60, :100] + 0.5
    # 1 in the corners, whatever the shape of the photo.
    square = 0.5 * ((rows / 30.0 - 1.0) ** 2 + (columns / 50.0 - 1.0) ** 2)
    expected = 200.0 * (1.0 - share * square**2)
    np.testing.assert_allclose(found, np.repeat(expected[..., None], 3, axis=2), atol=0.51)


def test_noise_is_as_large_as_asked_and_of_each_channel_its_own() -> None:
    off = developed(np.full((200, 200, 3), 120.0), noise_grey=4.0).astype(np.float64) - 120.0
    assert off.std() == pytest.approx(np.hypot(4.0, 1.0 / np.sqrt(12.0)), rel=0.02)
    assert off.mean() == pytest.approx(0.0, abs=0.05)
    channels = off.reshape(-1, 3).T
    assert np.abs(np.corrcoef(channels) - np.eye(3)).max() < 0.02


@pytest.mark.parametrize(
    ("layout", "size_m", "distance_m"),
    [("quick", (2.4, 1.8), 2.6), ("variant1", (5.9, 3.5), 3.95), ("variant2", (2.4, 1.8), 2.6)],
)
def test_lenses_of_a_layout_hold_its_footprint_and_differ_a_little(
    layout: Any, size_m: tuple[float, float], distance_m: float
) -> None:
    plan = partial(planned_shots, layout, gsd_m=0.01, obliquity_deg=10.0)
    lenses = [plan(rng(seed))[0].camera for seed in range(150)]
    width, height = (round(side / 0.01) for side in size_m)
    assert {(lens.width, lens.height) for lens in lenses} == {(width, height)}
    assert {(lens.fx, lens.fy) for lens in lenses} == {(distance_m / 0.01, distance_m / 0.01)}
    off = np.array([[lens.cx - width / 2, lens.cy - height / 2] for lens in lenses]) / width
    assert 0.0055 < np.abs(off).max() <= 0.006
    distortion = np.array([lens.distortion for lens in lenses])
    np.testing.assert_array_equal(distortion[:, 4], 0.0)
    for values, middle, scatter in zip(
        distortion.T, (-0.08, 0.02, 0.0, 0.0), (0.01, 0.005, 5e-4, 5e-4), strict=False
    ):
        assert 0.93 * scatter < np.abs(values - middle).max() <= scatter
    # No photo is so small that nothing is on it.
    coarse = partial(planned_shots, layout, gsd_m=1.0, obliquity_deg=10.0)
    shot = coarse(rng(0))[0]
    assert (shot.camera.width, shot.camera.height) == (16, 16)


@pytest.mark.parametrize("layout", ["quick", "variant2"])
def test_photos_look_at_their_walls_as_askew_as_planned(layout: Any) -> None:
    sides = DESIGNED.sides(SceneDraft())
    plan = partial(planned_shots, layout, gsd_m=0.01, obliquity_deg=8.0)
    rolls, tilts = [], []
    columns, rows = LATTICES[layout]
    targets = [(a, b) for b in rows for a in columns]
    for seed in range(20):
        for target, shot in zip(targets, plan(rng(seed)), strict=True):
            camera, taken = shot.camera, shot.taken
            tilt = np.degrees(np.arccos(-camera.rotation[2] @ sides[0].normal))
            assert taken.wall == "main wall"
            assert taken.obliquity_deg == pytest.approx(tilt)
            # The axis meets the wall where the photographer aims, so far away.
            along = (sides[0].foot - camera.centre_world) @ sides[0].normal
            reach = along / (camera.rotation[2] @ sides[0].normal)
            assert taken.gsd_m == pytest.approx(reach / camera.fx)
            aimed = camera.centre_world + reach * camera.rotation[2] - sides[0].foot
            off = np.array([aimed @ sides[0].axis_a, aimed @ sides[0].axis_b]) - target
            assert (np.abs(off) <= np.array([0.02 * 2.4, 0.02 * 1.8]) + 1e-9).all()
            rolls.append(taken.roll_deg)
            tilts.append(tilt)
    assert 2.8 < np.abs(rolls).max() <= 3.0
    # From four tenths of it on, but where one cannot stand there.
    assert np.quantile(tilts, 0.5) < 8.0
    assert np.mean((np.array(tilts) > 3.19) & (np.array(tilts) < 8.01)) > 0.5
    assert planned_shots("none", rng(0), gsd_m=0.01, obliquity_deg=8.0) == ()


@pytest.mark.parametrize("exposures", [0.0, 0.3])
def test_photos_get_more_or_less_light_and_files_say_a_wrong_focal_length(
    tmp_path: Path, exposures: float
) -> None:
    plan = partial(planned_shots, "variant2", gsd_m=0.05, obliquity_deg=8.0)
    shots = plan(rng(1))
    seeds: list[int] = []

    def expose(camera: Any, *, supersample: int, seed: int) -> NDArray[np.float32]:
        assert supersample == 3
        seeds.append(seed)
        return np.full((camera.height, camera.width, 3), 120.0, dtype=np.float32)

    views: Any = SimpleNamespace(expose=expose)
    film = Film(noise_grey=0.0, vignetting=0.0, supersample=3, exposures=exposures)
    photos = take_photos(views, shots, film, context(tmp_path), rng(7)).photos
    assert [photo.name for photo in photos] == [f"photo_{k:02d}.jpg" for k in range(18)]
    assert len(set(seeds)) == 18
    (focal_px,) = {photo.exif_focal_px for photo in photos}
    assert 0.0 < abs(focal_px / shots[0].camera.fx - 1.0) <= 0.02
    levels = np.array([decode_image(photo.encoded, "a").mean() for photo in photos])
    light = (levels / 120.0) ** 2.2
    if not exposures:
        np.testing.assert_allclose(levels, 120.0, atol=0.5)
        return
    assert light.min() >= 0.69
    assert light.max() <= 1.31
    assert np.ptp(light) > 0.4
    assert take_photos(views, (), film, context(tmp_path), rng(7)).photos == ()
