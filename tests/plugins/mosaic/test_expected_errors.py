"""Expected errors of orthoimages: as large as drawn errors of poses and depths make them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.mosaic.agreement import Overlaps
from orthoflow_plugins.mosaic.expected_errors import expected_errors_m, ties_on

from orthoflow.geometry import WallFrame
from orthoflow.geometry.bands import in_memory
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.frames import cross_matrix, rotation_from_vector
from orthoflow.products import Camera, Cameras, Intrinsics, SurfaceMask, TieRole, Wall
from tests import samples

SURVEY = np.array([4_512_345.25, 5_300_210.5, 187.125])
GSD_M = 0.02
FRAME = samples.facing_south(GSD_M, 150, 100, SURVEY)
TURN_RAD, SHIFT_M = 2e-4, 1e-3
NO_OVERLAPS = Overlaps(shifts_cells=np.zeros((0, 2)), centres=np.zeros((0, 2)), photos=())


def wall(frame: WallFrame = FRAME, *, spread_m: float = 0.0) -> Wall:
    plain = samples.wall(frame, depth_m=np.zeros(frame.shape, np.float32))
    return replace(
        plain,
        sigma_m=np.full(frame.shape, spread_m, np.float32),
        count=np.full(frame.shape, 4, np.uint32),
        mask=np.full(frame.shape, SurfaceMask.MEASURED, np.uint8),
    )


def oblique() -> ViewingCamera:
    """A camera 3 m before the wall and 2 m beside its middle, that looks at the middle."""
    middle = FRAME.world_from_wall(np.array([[75.0, 50.0]]))[0]
    centre = middle + 3.0 * FRAME.normal_world - 2.0 * FRAME.u_world
    ahead = (middle - centre) / np.linalg.norm(middle - centre)
    right = np.cross(ahead, np.array([0.0, 0.0, 1.0]))
    right /= np.linalg.norm(right)
    rotation = np.array([right, np.cross(ahead, right), ahead])
    inner = Intrinsics(
        width=3000, height=2000, fx=1800.0, fy=1800.0, cx=1500.0, cy=1000.0, source="given"
    )
    return inner.posed(rotation, -rotation @ centre)


def camera(viewing: ViewingCamera, **known: object) -> Camera:
    turns = np.diag([TURN_RAD**2] * 3)
    # The translation is that of a camera which turns about its own centre.
    cross = cross_matrix(viewing.translation)
    by_turn = np.vstack([np.eye(3), -cross])
    covariance = by_turn @ turns @ by_turn.T
    covariance[3:, 3:] += SHIFT_M**2 * np.eye(3)
    given: dict[str, object] = {
        "photo": "a.jpg",
        "status": "ok",
        "intrinsics": Intrinsics(
            width=3000, height=2000, fx=1800.0, fy=1800.0, cx=1500.0, cy=1000.0, source="given"
        ),
        "rotation_camera_from_world": viewing.rotation,
        "translation_camera_from_world": viewing.translation,
        "covariance": covariance,
    }
    return Camera(**{**given, **known})  # type: ignore[arg-type]


def shown_m(
    viewing: ViewingCamera, drawn: ViewingCamera, places: NDArray[np.float64], depth_m: float
) -> NDArray[np.float64]:
    """How far from its cell a place lies that a drawn camera shows there, at a drawn depth."""
    near, other = viewing.shifted(SURVEY), drawn.shifted(SURVEY)
    points = FRAME.world_from_wall(places, depth_m) - SURVEY
    pixels = near.project(points)[:, :2]
    rays = np.column_stack([(pixels - [1500.0, 1000.0]) / 1800.0, np.ones(len(pixels))])
    rays = rays @ other.rotation
    centre = other.centre_world
    along = -(centre @ FRAME.normal_world) / (rays @ FRAME.normal_world)
    met = centre + along[:, None] * rays
    return np.asarray((points - met) @ np.array([FRAME.u_world, FRAME.v_world]).T)


@pytest.mark.parametrize("spread_m", [0.0, 0.02])
def test_errors_are_as_large_as_drawn_poses_and_depths_make_them(spread_m: float) -> None:
    viewing = oblique()
    rng = np.random.default_rng(5)
    places = np.array([[20.0, 20.0], [75.0, 50.0], [130.0, 80.0]])
    drawn_m = []
    for _ in range(3000):
        turn = rotation_from_vector(rng.normal(0.0, TURN_RAD, 3))
        rotation = turn @ viewing.rotation
        translation = turn @ viewing.translation + rng.normal(0.0, SHIFT_M, 3)
        moved = replace(viewing, rotation=rotation, translation=translation)
        # A median of four points errs by half of what they spread.
        drawn_m.append(shown_m(viewing, moved, places, rng.normal(0.0, 0.5 * spread_m)))
    scattered = np.sqrt(np.mean(np.array(drawn_m) ** 2, axis=(0, 2)))
    stated = expected_errors_m(
        wall(spread_m=spread_m),
        np.zeros(FRAME.shape, np.int16),
        ("a.jpg",),
        {"a.jpg": camera(viewing)},
        NO_OVERLAPS,
        allocate=in_memory,
    )
    columns, rows = places.T.astype(int)
    np.testing.assert_allclose(stated[rows, columns], scattered, rtol=0.05)


def test_a_lens_that_was_estimated_adds_what_its_photo_states() -> None:
    viewing = oblique()
    source = np.zeros(FRAME.shape, np.int16)
    plain, wider = (
        expected_errors_m(
            wall(), source, ("a.jpg",), {"a.jpg": item}, NO_OVERLAPS, allocate=in_memory
        )
        for item in (camera(viewing), camera(viewing, sigma_wall_m=0.01))
    )
    assert np.median(wider) == pytest.approx(0.01, rel=0.1)
    np.testing.assert_allclose(wider / plain, np.median(wider / plain), rtol=1e-4)


def overlaps(shifts_m: NDArray[np.float64], photos: tuple[str, str]) -> Overlaps:
    """Displacements at places all over the wall."""
    rng = np.random.default_rng(3)
    centres = rng.uniform((10.0, 10.0), (140.0, 90.0), (len(shifts_m), 2))
    return Overlaps(
        shifts_cells=shifts_m / GSD_M, centres=centres, photos=(photos,) * len(shifts_m)
    )


def test_photos_that_lie_apart_by_more_than_they_state_are_no_better_than_that() -> None:
    shifts_m = np.random.default_rng(2).normal(0.0, GSD_M, (400, 2))
    errors = expected_errors_m(
        wall(),
        np.zeros(FRAME.shape, np.int16),
        ("a.jpg",),
        {"a.jpg": camera(oblique())},
        overlaps(shifts_m, ("a.jpg", "a.jpg")),
        allocate=in_memory,
    )
    rms_m = float(np.sqrt(np.mean(errors.astype(np.float64) ** 2)))
    assert rms_m == pytest.approx(GSD_M / np.sqrt(2.0), rel=0.1)


@pytest.mark.parametrize(("position_m", "depth_m"), [(0.004, 0.0), (0.0, 0.012), (0.004, 0.012)])
def test_overlaps_tell_errors_of_depths_from_those_of_poses(
    position_m: float, depth_m: float
) -> None:
    names = ("a.jpg", "b.jpg")
    left = oblique()
    # The same from the other side.
    centre = left.centre_world + 4.0 * FRAME.u_world
    right = replace(left, translation=-left.rotation @ centre)
    cameras = {
        name: replace(posed, photo=name, covariance=1e-8 * posed.covariance)
        for name, posed in zip(names, (camera(left), camera(right)), strict=True)
    }
    rng = np.random.default_rng(4)
    place = overlaps(np.zeros((200, 2)), names)
    at_m = GSD_M * (place.centres - [75.0, 50.0])
    tangents = [(at_m - [side, 0.0]) / 3.0 for side in (-2.0, 2.0)]
    depths_m = rng.normal(0.0, depth_m, (200, 1)) if depth_m else np.zeros((200, 1))
    shifts_m = depths_m * (tangents[0] - tangents[1])
    shifts_m += rng.normal(0.0, position_m, (200, 2)) - rng.normal(0.0, position_m, (200, 2))
    shifts_m += rng.normal(0.0, 0.1 * GSD_M, (200, 2))
    # Some are matches of something else.
    shifts_m[::20] = 1.0
    stated = expected_errors_m(
        wall(),
        np.zeros(FRAME.shape, np.int16),
        names[:1],
        cameras,
        replace(place, shifts_cells=shifts_m / GSD_M),
        allocate=in_memory,
    )
    for column, row in ((30, 20), (120, 80)):
        across, down = (GSD_M * (np.array([column, row]) + 0.5 - [75.0, 50.0]) + [2.0, 0.0]) / 3.0
        expected = np.hypot(position_m, depth_m * np.sqrt(0.5 * (across**2 + down**2)))
        assert stated[row, column] == pytest.approx(expected, rel=0.15, abs=0.0007)


def test_nothing_is_stated_of_cells_whose_photo_is_not_known() -> None:
    source = np.full(FRAME.shape, -1, np.int16)
    source[:10], source[10:20] = 0, 1
    poseless = replace(camera(oblique()), covariance=None)
    errors = expected_errors_m(
        wall(),
        source,
        ("a.jpg", "b.jpg"),
        {"a.jpg": camera(oblique()), "b.jpg": poseless},
        NO_OVERLAPS,
        allocate=in_memory,
    )
    assert np.isfinite(errors[:10]).all()
    assert np.isnan(errors[10:]).all()


def test_ties_are_counted_on_their_own_wall() -> None:
    ties = samples.ties(
        np.zeros((5, 2)),
        points_world=np.zeros((5, 3)),
        sigma_px=np.ones(5),
        sigma_m=np.zeros(5),
        wall=np.array([0, 0, 1, -1, 1], np.int32),
        role=np.array(
            [TieRole.CONTROL, TieRole.CHECK, TieRole.CHECK, TieRole.CHECK, TieRole.REJECTED],
            np.uint8,
        ),
    )
    cameras = Cameras(cameras=(), ties=ties)
    assert [ties_on(cameras, number) for number in (0, 1, 2)] == [(1, 1), (0, 1), (0, 0)]
    assert ties_on(None, 0) == ties_on(Cameras(cameras=()), 0) == (0, 0)
