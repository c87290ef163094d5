"""`simulate.room`: its scans agree with the truth; its reports."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from orthoflow_plugins.simulate import deliverables
from orthoflow_plugins.simulate.room import SimulateRoom

from orthoflow.files.images import decode_image, encode_png
from orthoflow.geometry import UpDirection, basis_from_up
from orthoflow.geometry.frames import rotation_from_vector
from orthoflow.products import Photo, Photos, PointCloud, Truth
from orthoflow.sdk import StepContext
from tests import samples, scenes
from tests.method_runs import run
from tests.plane_scenes import cloud_of
from tests.scene_rays import cast, colours_at

COARSE = {"scan_step_m": 0.06, "photo_layout": "none"}
CLEAN = {**COARSE, "noise_m": 0.0, "outlier_share": 0.0, "beam_m": 0.0, "colour_noise_grey": 0.0}


# Rooms are made once for each set of parameters.
made: dict[str, SimulateRoom.Out] = {}


def simulate(folder: Path, *, seed: int = 1, cores: int = 2, **params: object) -> SimulateRoom.Out:
    numbers = repr((seed, cores, sorted(params.items())))
    if numbers not in made:
        folder.mkdir(parents=True, exist_ok=True)
        context = StepContext(rng=np.random.default_rng(seed), cores=cores, scratch=folder)
        made[numbers] = run(SimulateRoom, context, {}, **params)
    return made[numbers]


def distances_m(cloud: PointCloud, truth: Truth, plane: int) -> np.ndarray:
    chosen = np.flatnonzero(truth.labels == plane)
    return truth.planes.plane(plane).distances_m(cloud.points_world(chosen))


@pytest.mark.parametrize(
    ("up", "turn_deg", "shift_m"),
    [("z", 0.0, np.zeros(3)), ("-z", 0.0, np.zeros(3)), ("x", 33.3, scenes.SURVEY_SHIFT_M)],
)
def test_points_planes_and_colours_are_those_of_the_scene_in_any_world(
    tmp_path: Path, up: UpDirection, turn_deg: float, shift_m: np.ndarray
) -> None:
    out = simulate(tmp_path, **CLEAN, up=up, turn_deg=turn_deg, shift_world_m=tuple(shift_m))
    cloud, truth, planes = out.cloud, out.truth, out.truth.planes
    chosen = np.arange(0, len(cloud), 37)
    points = cloud.points_world(chosen)
    starts = cloud.stations[cloud.scan[chosen]]
    hits = cast(truth.scene, starts, points - starts)
    np.testing.assert_allclose(hits.t, 1.0, atol=1e-5)
    np.testing.assert_array_equal(truth.scene.plane_index[hits.rectangle], truth.labels[chosen])
    rgb = colours_at(truth.scene, hits.rectangle, points).rgb
    # Allow one grey level for rounding; float32 errors of a micrometre may cross a painted edge.
    wrong = np.abs(rgb - cloud.rgb[chosen]).max(axis=1) > 1.0
    assert wrong.mean() < 0.002
    # Columns of the first station's panorama begin at the room's first axis, rows at the bottom.
    first = np.flatnonzero(cloud.scan == 0)
    rays, turn = cloud.points_world(first) - cloud.stations[0], np.radians([0.0, 0.0, turn_deg])
    rays = rays @ basis_from_up(cloud.up).T @ rotation_from_vector(turn)
    azimuth = (np.arctan2(rays[:, 1], rays[:, 0]) + 1e-3) % (2.0 * np.pi) - 1e-3
    elevation = np.arctan2(rays[:, 2], np.hypot(rays[:, 0], rays[:, 1])) + np.radians(62.0)
    for angle, number in ((azimuth, cloud.column[first]), (elevation, cloud.row[first])):
        step = angle @ number / (number.astype(float) @ number)
        np.testing.assert_allclose(angle, step * number, atol=2e-6)
    counts = np.bincount(truth.labels[truth.labels >= 0], minlength=len(planes))
    np.testing.assert_array_equal(planes.n_points, counts)
    assert (np.diff(counts) <= 0).all()
    np.testing.assert_allclose(planes.normal[planes.names.index("floor")], cloud.up, atol=0.002)
    for plane, normal in enumerate(planes.normal):
        # The tolerance is in metres, for float32 offsets of a few metres.
        np.testing.assert_allclose(distances_m(cloud, truth, plane), 0.0, atol=2e-6)
        # Corners are counter-clockwise for the viewer, beginning at the top left, and enclose all
        # points of the plane.
        corner, low, _, right = planes.corners[plane]
        sides = np.array([right - corner, low - corner])
        assert np.cross(*sides) @ normal < -0.999 * np.prod(np.linalg.norm(sides, axis=1))
        assert abs(normal @ cloud.up) > 0.5 or sides[1] @ cloud.up < 0.0
        own = cloud.points_world(np.flatnonzero(truth.labels == plane)) - corner
        shares = own @ (sides / np.sum(sides**2, axis=1)[:, None]).T
        assert -1e-5 < shares.min() < shares.max() < 1.0 + 1e-5


def test_a_drawn_geometry_moves_planes_and_stations_and_keeps_the_truth(tmp_path: Path) -> None:
    designed, *drawn = (
        simulate(tmp_path / f"{geometry}-{seed}", seed=seed, **CLEAN, geometry=geometry)
        for geometry, seed in (("designed", 1), ("drawn", 1), ("drawn", 2))
    )
    for out in drawn:
        assert set(out.truth.planes.names) == set(designed.truth.planes.names)
        for plane in range(len(out.truth.planes)):
            np.testing.assert_allclose(distances_m(out.cloud, out.truth, plane), 0.0, atol=2e-6)
    truths = [out.truth for out in (designed, *drawn)]
    for name in ("main wall", "left wall", "niche", "floor", "ceiling"):
        planes = [truth.planes.plane(truth.planes.names.index(name)) for truth in truths]
        leans = [np.degrees(np.arcsin(plane.normal[2])) for plane in planes]
        # The limits, in degrees and metres, are far above rounding errors.
        assert np.diff(sorted(leans)).min() > 0.005, name
        assert np.diff(sorted(plane.offset_m for plane in planes)).min() > 0.0005, name
    spans_m2 = [np.sum(np.ptp(truth.stations, axis=0) ** 2) for truth in truths]
    assert np.diff(sorted(spans_m2)).min() > 0.001


def test_plaques_give_drawn_walls_check_points_at_edges(tmp_path: Path) -> None:
    drawn = {**COARSE, "decoration": "drawn", "check_points_most": 20}
    bare = simulate(tmp_path / "bare", **drawn)
    hung = simulate(tmp_path / "hung", **drawn, n_plaques=24)
    assert hung.checkpoints.classes.count("vertical edge") == 20
    # Nothing else has moved, so planes are the same, and rectangles include those of the bare room.
    np.testing.assert_array_equal(hung.truth.planes.normal, bare.truth.planes.normal)
    rectangles = [
        {tuple(row) for row in np.column_stack([room.truth.scene.centre, room.truth.scene.extent])}
        for room in (bare, hung)
    ]
    assert rectangles[0] < rectangles[1]
    with pytest.raises(ValueError, match="n_plaques 3 is for drawn walls"):
        SimulateRoom.Params(n_plaques=3)


@pytest.mark.usefixtures("charts")
def test_the_main_wall_is_reported_where_the_floor_has_more_points(tmp_path: Path) -> None:
    context = StepContext(rng=np.random.default_rng(1), cores=2, scratch=tmp_path)
    truth = run(SimulateRoom, context, {}, scan_step_m=0.02, panorama_step_m=0.02).truth
    main = truth.planes.names.index("main wall")
    assert main > 0
    metrics = {metric.name: metric.value for metric in context.metrics}
    assert metrics["main_wall_points"] == truth.planes.n_points[main]
    # 0.4 % of the points are gross outliers, and distances are mixed at edges.
    assert 0.0035 < metrics["outlier_share"] < 0.03
    # Panoramas and detail scans of two stations cover most of the wall.
    assert 12.0 < metrics["scan_step_median_mm"] < 16.0
    assert metrics["scan_step_p90_mm"] < 20.0
    (figure,) = context.figures
    assert figure.name == "main_wall"
    shown = decode_image(figure.path.read_bytes(), "main_wall")
    assert shown.shape == (312, 540, 3)
    assert shown.std() > 30.0


def test_a_design_has_a_seed_of_its_own_and_errors_have_that_of_the_cell(tmp_path: Path) -> None:
    drawn = {"decoration": "drawn", **COARSE}
    rooms = {
        (seed, design): simulate(
            tmp_path / f"{seed}-{design}", seed=seed, design_seed=design, **drawn
        )
        for seed, design in ((1, 7), (2, 7), (1, 8))
    }

    centres = {key: room.truth.scene.centre for key, room in rooms.items()}
    np.testing.assert_array_equal(centres[1, 7], centres[2, 7])
    assert not np.array_equal(centres[1, 7], centres[1, 8])
    assert not np.array_equal(rooms[1, 7].cloud.x[:1000], rooms[2, 7].cloud.x[:1000])
    with pytest.raises(ValueError, match="design_seed 7 applies only to drawn rooms"):
        SimulateRoom.Params(design_seed=7)


@pytest.mark.parametrize("step_m", [0.005, 0.02])
def test_the_step_of_a_square_grid_is_its_spacing(step_m: float) -> None:
    at = np.arange(step_m / 2, 2.0, step_m)
    u, v = (grid.ravel() for grid in np.meshgrid(at, at))
    # Add some points of another plane in front of it.
    beside = np.column_stack([u[:50], np.full(50, -0.3), v[:50]])
    cloud = cloud_of(np.vstack([np.column_stack([u, np.zeros(u.size), v]), beside]))
    planes = samples.planes(
        normal=np.array([[0.0, -1.0, 0.0]]),
        offset=np.zeros(1),
        corners=np.array([[[0.0, 0, 2], [0, 0, 0], [2, 0, 0], [2, 0, 2]]]),
        n_points=np.array([u.size]),
        names=("wall",),
    )
    truth: Any = SimpleNamespace(planes=planes, labels=np.repeat([0, -1], [u.size, 50]))
    step = deliverables.measured_step(truth, cloud, 0)
    assert step == pytest.approx((step_m, step_m), rel=1e-6)


@pytest.mark.usefixtures("charts")
def test_photos_are_reported_by_their_shots(tmp_path: Path) -> None:
    context = StepContext(rng=np.random.default_rng(1), cores=1, scratch=tmp_path)
    shots: Any = tuple(
        SimpleNamespace(taken=SimpleNamespace(gsd_m=gsd_m, obliquity_deg=obliquity))
        for gsd_m, obliquity in ((0.002, 5.0), (0.004, 30.0))
    )
    picture = encode_png(np.full((480, 640, 3), 90, dtype=np.uint8))
    photos = [Photo(name=name, encoded=picture, width=640, height=480) for name in "ab"]
    deliverables.report_photos(Photos(photos=tuple(photos)), shots, context)
    assert {metric.name: metric.value for metric in context.metrics} == {
        "n_photos": 2.0,
        "photo_megapixels": pytest.approx(2 * 0.3072),
        "photo_gsd_mm": pytest.approx(3.0),
        "photo_obliquity_max_deg": 30.0,
    }
    assert [figure.name for figure in context.figures] == ["photos"]
    silent = StepContext(rng=np.random.default_rng(1), cores=1, scratch=tmp_path)
    deliverables.report_photos(Photos(photos=()), (), silent)
    assert (silent.metrics, silent.figures) == ([], [])
