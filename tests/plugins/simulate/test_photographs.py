"""The photos of `simulate.room`: layouts, degradation, and correct positions of their content."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.simulate import photographs
from orthoflow_plugins.simulate.building import SceneDraft
from orthoflow_plugins.simulate.photographs import Film, PhotoLayout, planned_shots, take_photos
from orthoflow_plugins.simulate.room import SimulateRoom
from orthoflow_plugins.simulate.room_model import DESIGNED, build_room

from orthoflow.files.images import decode_image
from orthoflow.geometry import frame_over
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.scene_views import SceneCameras
from orthoflow.geometry.scenes import SurfaceRole
from orthoflow.products import Truth
from orthoflow.sdk import StepContext
from tests import scenes
from tests.long_loops import seeds
from tests.method_runs import run
from tests.raster_scenes import context
from tests.scene_rays import cast, colours_at

COARSE = {"scan_step_m": 0.1, "photo_layout": "quick", "photo_gsd_m": 0.008}
GREY = np.array([0.299, 0.587, 0.114])


def simulate(folder: Path, *, seed: int = 1, cores: int = 2, **params: object) -> SimulateRoom.Out:
    folder.mkdir(parents=True, exist_ok=True)
    context = StepContext(rng=np.random.default_rng(seed), cores=cores, scratch=folder)
    made: SimulateRoom.Out = run(SimulateRoom, context, {}, **{**COARSE, **params})
    return made


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> SimulateRoom.Out:
    """Return six photos of 600 x 450 pixels of 4 mm, almost without noise."""
    return simulate(
        tmp_path_factory.mktemp("room"),
        photo_gsd_m=0.004,
        photo_noise_grey=0.0,
        photo_vignetting_share=0.0,
        photo_supersample=1,
        check_points_most=8,
    )


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> SimulateRoom.Out:
    """Return six photos of 150 x 112 pixels, each rendered in two parts by several threads."""
    return simulate(tmp_path_factory.mktemp("small"), photo_gsd_m=0.024)


def cameras_of(truth: Truth) -> tuple[ViewingCamera, ...]:
    return tuple(camera.viewing() for camera in truth.cameras.cameras)


def test_a_pixel_is_the_mean_of_what_lies_behind_it(room: SimulateRoom.Out) -> None:
    truth = room.truth
    whole = cameras_of(truth)[1]
    # Use a section of the photo that includes the object and its edges.
    camera = replace(whole, width=100, height=80, cx=whole.cx - 230.0, cy=whole.cy - 40.0)
    views = SceneCameras(truth.scene, cores=2)
    image = views.expose(camera, supersample=8)
    rng = np.random.default_rng(5)
    chosen = np.column_stack(
        [rng.integers(0, camera.width, 200), rng.integers(0, camera.height, 200)]
    )
    inside = (np.stack(np.meshgrid(np.arange(16), np.arange(16)), -1).reshape(-1, 2) + 0.5) / 16
    pixels = (chosen[:, None, :] + inside).reshape(-1, 2)
    rays = camera.rays_world(pixels)
    hits = cast(truth.scene, camera.centre_world, rays)
    points = camera.centre_world + hits.t[:, None] * rays
    means = colours_at(truth.scene, hits.rectangle, points).rgb.reshape(200, 256, 3).mean(axis=1)
    # Differences are in grey levels; at edges, means of 64 and of 256 rays differ by a small part
    # of 255.
    differences = np.abs(image[chosen[:, 1], chosen[:, 0]] - means)
    assert differences.mean() < 0.5
    assert differences.max() < 15.0
    # The section has neither a single colour nor a single rectangle.
    assert means.std() > 10.0
    assert {SurfaceRole.OBJECT, SurfaceRole.WALL} <= set(truth.scene.role[hits.rectangle])


def test_check_points_are_crossings_and_corners(room: SimulateRoom.Out) -> None:
    truth, points = room.truth, room.checkpoints
    assert points.classes == ("flat",) * 8 + ("vertical edge",) * 8
    assert points.names == tuple(f"{kind}{k:02d}" for kind in "FV" for k in range(8))
    off_m = truth.planes.plane(0).distances_m(points.points_world)
    np.testing.assert_allclose(off_m[:8], 0.0, atol=1e-9)
    # Mouldings project by 2 to 15 cm.
    assert 0.015 < off_m[8:].min() < off_m[8:].max() < 0.16
    flat = points.points_world[:8]
    apart = np.linalg.norm(flat[:, None] - flat, axis=2)
    assert apart[~np.eye(8, dtype=bool)].min() > 0.3
    # Along either line, there is still paint 3 mm from the crossing; red minus blue distinguishes
    # it from the plaster 9 mm beside both lines.
    frame, scene = (
        frame_over(truth.planes.corners[0], truth.planes.normal[0], gsd_m=1e-3),
        truth.scene,
    )
    on_wall = (scene.plane_index == 0) & (scene.role == SurfaceRole.WALL) & (scene.texture == 1)
    rectangle = np.full(8, np.flatnonzero(on_wall)[0], dtype=np.int32)
    u, v = frame.u_world, frame.v_world
    steps_m = 1e-3 * np.array([3 * u, -3 * u, 3 * v, -3 * v, 9 * (u + v), -9 * (u + v)])
    rgb = [colours_at(scene, rectangle, flat + step_m).rgb for step_m in steps_m]
    warmth = np.array([one[:, 0] - one[:, 2] for one in rgb])
    beside = np.median(warmth[4:], axis=0)
    assert (np.median(np.abs(warmth[:4] - beside), axis=1) > 5.0).all()


def test_variant_one_holds_each_wall_whole_in_two_photos(tmp_path: Path) -> None:
    truth = simulate(tmp_path, photo_layout="variant1", photo_gsd_m=0.03).truth
    names = ["main wall", "opposite wall", "right wall", "left wall"]
    views = SceneCameras(truth.scene)
    for place, camera in enumerate(cameras_of(truth)):
        plane = truth.planes.names.index(names[place // 2])
        # Use points slightly inside the corners, because other walls touch these, too.
        corners = truth.planes.corners[plane]
        corners = corners.mean(axis=0) + 0.85 * (corners - corners.mean(axis=0))
        assert camera.sees(camera.project(corners)[:, :2]).all(), names[place // 2]
        centre = np.array([[camera.width / 2, camera.height / 2]])
        assert views.trace(camera, centre).rectangle[0] >= 0


@pytest.mark.parametrize("layout", ["quick", "variant1", "variant2"])
@pytest.mark.parametrize("seed", seeds(4))
def test_nobody_stands_inside_furniture_or_walls(layout: PhotoLayout, seed: int) -> None:
    scene = build_room().scene
    views = SceneCameras(scene)
    ways = np.random.default_rng(0).normal(size=(500, 3))
    ways[0] = (0.0, 0.0, 1.0)
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    for shot in planned_shots(layout, np.random.default_rng(seed), gsd_m=0.01, obliquity_deg=30.0):
        hits = views.cast(shot.camera.centre_world, ways)
        assert hits.t.min() > 0.1, shot.taken.photo
        # Vertically above, there is the ceiling or a moulding, not the inside of a box.
        assert scene.role[hits.rectangle[0]] != SurfaceRole.OBJECT, shot.taken.photo


def test_photos_are_the_same_in_any_world(tmp_path: Path, small: SimulateRoom.Out) -> None:
    world = {"shift_world_m": tuple(scenes.SURVEY_SHIFT_M), "up": "-y"}
    far = simulate(tmp_path, cores=1, photo_gsd_m=0.024, **world)
    assert [photo.encoded for photo in small.photos.photos] == [
        photo.encoded for photo in far.photos.photos
    ]
    for one, other in zip(cameras_of(small.truth), cameras_of(far.truth), strict=True):
        marks_near = one.project(small.checkpoints.points_world)
        marks_far = other.project(far.checkpoints.points_world)
        # The tolerance is in pixels; 800 km from the origin, the precision of the camera's
        # translation is 1e-10 m.
        np.testing.assert_allclose(marks_near, marks_far, atol=1e-5)

    known, unknown = small, simulate(tmp_path / "a", photo_gsd_m=0.024, calibrated=False)
    camera = cameras_of(known.truth)[0]
    assert known.calibration.patterns == ("*",)
    assert known.calibration.intrinsics[0].fx == camera.fx
    assert -0.095 < known.calibration.intrinsics[0].distortion[0] < -0.065
    assert known.photos.photos[0].intrinsics == known.calibration.intrinsics[0]
    assert unknown.calibration.patterns == ()
    assert unknown.photos.photos[0].intrinsics is None
    assert unknown.photos.photos[0].exif_focal_px == pytest.approx(camera.fx, rel=0.02)
    assert [p.encoded for p in known.photos.photos] == [p.encoded for p in unknown.photos.photos]
    other = simulate(tmp_path / "b", seed=2, photo_gsd_m=0.024)
    for first, second in zip(cameras_of(small.truth), cameras_of(other.truth), strict=True):
        assert np.linalg.norm(first.centre_world - second.centre_world) > 0.01


@pytest.mark.parametrize(("gap", "least", "most"), [("none", 0.95, 1.0), ("hard", -0.5, 0.75)])
def test_the_spectral_gap_decorrelates(tmp_path: Path, gap: str, least: float, most: float) -> None:
    truth = simulate(tmp_path, spectral_gap=gap, photo_layout="none").truth
    scene = truth.scene
    fresco = np.flatnonzero((scene.plane_index == 0) & (scene.texture == 1))[0]
    rng = np.random.default_rng(1)
    at = rng.uniform(-1.0, 1.0, (4000, 2))
    points = (
        scene.centre[fresco] + at[:, :1] * scene.axis_a[fresco] + at[:, 1:] * scene.axis_b[fresco]
    )
    colours = colours_at(scene, np.full(4000, fresco, dtype=np.int32), points)
    correlation = np.corrcoef(colours.rgb @ GREY, colours.reflectance)[0, 1]
    assert least < correlation < most


UP = np.array([0.0, 0.0, 1.0])
# Targets of photos of the main wall: metres to the right of its foot, and above it.
LATTICES = {
    "quick": ((-1.75, 0.0, 1.75), (-0.65, 0.75)),
    "variant2": ((-1.8, -1.08, -0.36, 0.36, 1.08, 1.8), (-0.8, 0.1, 1.0)),
}
PLAIN = Film(noise_grey=0.0, vignetting=0.0, supersample=1, exposures=0.0)


def rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def developed(image: NDArray[np.floating], **film: float) -> NDArray[np.uint8]:
    given: dict[str, Any] = {**vars(PLAIN), **film}
    return photographs.developed_photo(image.astype(np.float32), Film(**given), rng(1))


@pytest.mark.parametrize("share", [0.1, 0.5])
def test_light_is_lost_towards_the_corners_by_the_fourth_power(share: float) -> None:
    image = np.full((60, 100, 3), 200.0)
    found = developed(image, vignetting=share).astype(np.float64)
    rows, columns = np.mgrid[:60, :100] + 0.5
    # This is 1 in the corners, for any shape of the photo.
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
    off = np.array([lens.distortion for lens in lenses]) - [-0.08, 0.02, 0.0, 0.0, 0.0]
    np.testing.assert_allclose(np.abs(off).max(axis=0), [0.01, 0.005, 5e-4, 5e-4, 0.0], rtol=0.07)


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
            # The axis intersects the wall at the target, at the planned distance.
            along = (sides[0].foot - camera.centre_world) @ sides[0].normal
            reach = along / (camera.rotation[2] @ sides[0].normal)
            assert taken.gsd_m == pytest.approx(reach / camera.fx)
            aimed = camera.centre_world + reach * camera.rotation[2] - sides[0].foot
            off = np.array([aimed @ sides[0].axis_a, aimed @ sides[0].axis_b]) - target
            assert (np.abs(off) <= np.array([0.02 * 2.4, 0.02 * 1.8]) + 1e-9).all()
            rolls.append(taken.roll_deg)
            tilts.append(tilt)
    assert 2.8 < np.abs(rolls).max() <= 3.0
    # The angles are at least 0.4 of the maximum, except where the position is not free.
    assert np.quantile(tilts, 0.5) < 8.0
    assert np.mean((np.array(tilts) > 3.19) & (np.array(tilts) < 8.01)) > 0.5
    assert planned_shots("none", rng(0), gsd_m=0.01, obliquity_deg=8.0) == ()


@pytest.mark.parametrize("exposures", [0.0, 0.3])
def test_exposures_vary_and_focal_lengths_are_inexact(tmp_path: Path, exposures: float) -> None:
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
