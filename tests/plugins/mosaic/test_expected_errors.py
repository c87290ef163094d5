"""Expected errors of orthoimages, compared with those of poses and depths that are off."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from orthoflow_plugins.mosaic.agreement import Overlaps
from orthoflow_plugins.mosaic.expected_errors import expected_errors_m, ties_on
from orthoflow_plugins.mosaic.seams import MosaicSeams
from orthoflow_plugins.raster.surfaces import denoised

from orthoflow.geometry.bands import in_memory
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.frames import cross_matrix, rotation_from_vector
from orthoflow.products import Camera, Cameras, Intrinsics, LayerMask, Layers, SurfaceMask, TieRole
from tests import samples
from tests.method_runs import run
from tests.raster_scenes import context

SURVEY = np.array([4_512_345.25, 5_300_210.5, 187.125])
GSD_M = 0.02
FRAME = samples.facing_south(GSD_M, 150, 100, SURVEY)
TURN_RAD, SHIFT_M = 2e-4, 1e-3


def stated_m(
    *cameras: Camera,
    source: NDArray[np.int16] | None = None,
    overlaps: Overlaps | None = None,
    wall: Any = None,
) -> NDArray[np.float32]:
    """Return the errors of an orthoimage whose cells are all from the first photo by default."""
    return expected_errors_m(
        samples.wall(FRAME) if wall is None else wall,
        np.zeros(FRAME.shape, np.int16) if source is None else source,
        tuple(each.photo for each in cameras),
        {each.photo: each for each in cameras},
        overlaps or Overlaps(shifts_cells=np.zeros((0, 2)), centres=np.zeros((0, 2)), photos=()),
        allocate=in_memory,
    )


def oblique() -> ViewingCamera:
    """Return a camera 3 m in front of the wall and 2 m beside its middle, aimed at the middle."""
    middle = FRAME.world_from_wall(np.array([[75.0, 50.0]]))[0]
    centre = middle + 3.0 * FRAME.normal_world - 2.0 * FRAME.u_world
    return samples.aimed(centre, middle, 1800.0, (3000, 2000))


def camera(viewing: ViewingCamera, **known: Any) -> Camera:
    # The translation is that of a camera that rotates about its centre.
    by_turn = np.vstack([np.eye(3), -cross_matrix(viewing.translation)])
    covariance = TURN_RAD**2 * by_turn @ by_turn.T
    covariance[3:, 3:] += SHIFT_M**2 * np.eye(3)
    given = {
        "photo": "a.jpg",
        "status": "ok",
        "intrinsics": Intrinsics.of(viewing, source="given"),
        "rotation_camera_from_world": viewing.rotation,
        "translation_camera_from_world": viewing.translation,
        "covariance": covariance,
    }
    return Camera(**{**given, **known})


def shown_m(
    viewing: ViewingCamera, moved: ViewingCamera, places: NDArray[np.float64], depth_m: ArrayLike
) -> NDArray[np.float64]:
    """Return the distance between a cell and the point that another camera shows there."""
    near, other = viewing.shifted(SURVEY), moved.shifted(SURVEY)
    points = FRAME.world_from_wall(places, depth_m) - SURVEY
    pixels = near.project(points)[:, :2]
    rays = np.column_stack([(pixels - [1500.0, 1000.0]) / 1800.0, np.ones(len(pixels))])
    rays = rays @ other.rotation
    centre = other.centre_world
    along = -(centre @ FRAME.normal_world) / (rays @ FRAME.normal_world)
    met = centre + along[:, None] * rays
    return np.asarray((points - met) @ np.array([FRAME.u_world, FRAME.v_world]).T)


@pytest.mark.parametrize(("noise_m", "is_denoised", "rtol"), [
    (0.0, False, 0.002),
    (0.01, False, 0.04),
    (0.02, True, 0.1),
])  # fmt: skip
def test_errors_of_poses_and_depths_are_propagated_to_the_wall(
    noise_m: float, is_denoised: bool, rtol: float
) -> None:
    points = np.random.default_rng(5).normal(0.0, 2.0 * noise_m, (4, *FRAME.shape))
    sigma_m, depth_m = points.std(axis=0, ddof=1), points.mean(axis=0).astype(np.float32)
    if is_denoised:
        depth_m = denoised(depth_m, noise_m)
    count, mask = np.full(FRAME.shape, 4, np.uint32), np.full(FRAME.shape, 1, np.uint8)
    # The second place is interpolated between three others, and the third contains an edge.
    sigma_m[80, 130], mask[50, 75] = 8.0 * noise_m, SurfaceMask.RECOVERED
    wall = samples.wall(FRAME, depth_m=depth_m, sigma_m=sigma_m, mask=mask, count=count)
    between = 1.0 if is_denoised else np.sqrt(0.5)
    off_m = np.array([depth_m.std(), between * depth_m.std(), sigma_m[80, 130]])
    viewing = oblique()
    places = np.array([[20.5, 20.5], [75.5, 50.5], [130.5, 80.5]])
    errors_m = [shown_m(viewing, viewing, places, off_m)]
    for axis in np.eye(3):
        turn = rotation_from_vector(TURN_RAD * axis)
        rotation, translation = turn @ viewing.rotation, turn @ viewing.translation
        turned = replace(viewing, rotation=rotation, translation=translation)
        shifted = replace(viewing, translation=viewing.translation + SHIFT_M * axis)
        errors_m += [shown_m(viewing, moved, places, 0.0) for moved in (turned, shifted)]
    expected = np.sqrt(np.square(errors_m).sum(axis=0).mean(axis=1))
    columns, rows = places.T.astype(int)
    stated = stated_m(camera(viewing), wall=wall)
    np.testing.assert_allclose(stated[rows, columns], expected, rtol=rtol)


def test_depth_errors_that_neighbours_share_are_stated() -> None:
    """As of a stereo cloud: 5 mm over 5 cm, and 0.2 mm of single cells."""
    rng, side = np.random.default_rng(6), round(0.05 / GSD_M)
    patches_m = rng.normal(0.0, 0.005, (FRAME.height // side + 1, FRAME.width // side + 1))
    shared_m = np.kron(patches_m, np.ones((side, side)))[: FRAME.height, : FRAME.width]
    depth_m = (shared_m + rng.normal(0.0, 2e-4, FRAME.shape)).astype(np.float32)
    found, flat = (
        stated_m(camera(oblique()), wall=samples.wall(FRAME, depth_m=depths))[80, 130]
        for depths in (depth_m, 0.0 * depth_m)
    )
    off_m = shown_m(oblique(), oblique(), np.array([[130.5, 80.5]]), np.array([0.005]))
    assert found**2 - flat**2 == pytest.approx(np.square(off_m).mean(), rel=0.3)


def test_a_lens_that_was_estimated_adds_what_its_photo_states() -> None:
    plain, wider = (stated_m(camera(oblique(), **known)) for known in ({}, {"sigma_wall_m": 0.01}))
    assert np.median(wider) == pytest.approx(0.01, rel=0.1)
    np.testing.assert_allclose(wider / plain, np.median(wider / plain), rtol=1e-4)


def overlaps(shifts_m: NDArray[np.float64], photos: tuple[str, str]) -> Overlaps:
    """Return displacements at positions distributed over the wall."""
    rng = np.random.default_rng(3)
    centres = rng.uniform((10.0, 10.0), (140.0, 90.0), (len(shifts_m), 2))
    return Overlaps(
        shifts_cells=shifts_m / GSD_M, centres=centres, photos=(photos,) * len(shifts_m)
    )


def test_photos_that_lie_apart_by_more_than_they_state_are_no_better_than_that() -> None:
    shifts_m = np.random.default_rng(2).normal(0.0, GSD_M, (400, 2))
    errors = stated_m(camera(oblique()), overlaps=overlaps(shifts_m, ("a.jpg", "a.jpg")))
    rms_m = float(np.sqrt(np.mean(errors.astype(np.float64) ** 2)))
    assert rms_m == pytest.approx(GSD_M / np.sqrt(2.0), rel=0.1)


@pytest.mark.parametrize(("position_m", "depth_m"), [(0.004, 0.0), (0.0, 0.012), (0.004, 0.012)])
def test_overlaps_separate_errors_of_depths_and_poses(position_m: float, depth_m: float) -> None:
    left = oblique()
    # A camera on the other side.
    centre = left.centre_world + 4.0 * FRAME.u_world
    right = replace(left, translation=-left.rotation @ centre)
    cameras = [
        replace(posed, photo=name, covariance=1e-8 * posed.covariance)
        for name, posed in (("a.jpg", camera(left)), ("b.jpg", camera(right)))
    ]
    rng = np.random.default_rng(4)
    place = overlaps(np.zeros((200, 2)), ("a.jpg", "b.jpg"))
    # The tangents differ by 4/3 to the right.
    shifts_m = rng.normal(0.0, depth_m, (200, 1)) * [4.0 / 3.0, 0.0]
    shifts_m += rng.normal(0.0, position_m, (200, 2)) - rng.normal(0.0, position_m, (200, 2))
    shifts_m += rng.normal(0.0, 0.1 * GSD_M, (200, 2))
    # Some are false matches.
    shifts_m[::20] = 1.0
    stated = stated_m(*cameras, overlaps=replace(place, shifts_cells=shifts_m / GSD_M))
    for column, row in ((30, 20), (120, 80)):
        across, down = (GSD_M * (np.array([column, row]) + 0.5 - [75.0, 50.0]) + [2.0, 0.0]) / 3.0
        expected = np.hypot(position_m, depth_m * np.sqrt(0.5 * (across**2 + down**2)))
        assert stated[row, column] == pytest.approx(expected, rel=0.15, abs=0.0007)


def test_nothing_is_stated_of_cells_whose_photo_is_not_known() -> None:
    source = np.full(FRAME.shape, -1, np.int16)
    source[:10], source[10:20] = 0, 1
    known = camera(oblique())
    errors = stated_m(known, replace(known, photo="b.jpg", covariance=None), source=source)
    assert np.isfinite(errors[:10]).all()
    assert np.isnan(errors[10:]).all()


@pytest.mark.parametrize("number", [0, 1])
def test_only_a_wall_with_ties_states_errors(tmp_path: Path, number: int) -> None:
    known = {"points_world": np.zeros((1, 3)), "sigma_px": np.ones(1), "sigma_m": np.zeros(1)}
    ties = samples.ties(np.zeros((1, 2)), wall=np.array([number], np.int32), **known)
    layer = samples.layer(
        np.full(FRAME.shape, LayerMask.PAINTED, np.uint8), frame=FRAME, source="a.jpg"
    )
    ctx = context(tmp_path)
    inputs: dict[str, Any] = {
        "layers": Layers(layers=(layer,)),
        "walls": samples.walls(samples.wall(FRAME)),
        "cameras": Cameras(cameras=(camera(oblique()),), ties=ties),
    }
    (image,) = run(MosaicSeams, ctx, inputs).orthoimages.images
    assert bool(np.isfinite(image.error_m).any()) == (number == 0)
    assert ("accuracy-not-checked" in [one.code for one in ctx.diagnostics]) == (number == 1)


def test_ties_are_counted_on_their_own_wall() -> None:
    roles = [TieRole.CONTROL, TieRole.CHECK, TieRole.CHECK, TieRole.CHECK, TieRole.REJECTED]
    ties = samples.ties(
        np.zeros((5, 2)),
        points_world=np.zeros((5, 3)),
        sigma_px=np.ones(5),
        sigma_m=np.zeros(5),
        wall=np.array([0, 0, 1, -1, 1], np.int32),
        role=np.array(roles, np.uint8),
    )
    cameras = Cameras(cameras=(), ties=ties)
    assert [ties_on(cameras, number) for number in (0, 1, 2)] == [(1, 1), (0, 1), (0, 0)]
    assert ties_on(None, 0) == ties_on(Cameras(cameras=()), 0) == (0, 0)
