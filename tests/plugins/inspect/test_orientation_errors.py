"""Errors of poses and ties, computed from given numbers."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.inspect.orientation_errors import (
    PoseError,
    error_on_walls,
    most_shown,
    pose_findings,
    tie_errors_cells,
    tie_findings,
)

from orthoflow.errors import GeometryError, MethodError
from orthoflow.geometry import CylinderBend, WallFrame
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.slabs import Slab
from orthoflow.products import TieRole
from tests import samples

# Walls at y = 4, seen from the south.
GSD_M: Final = 0.01
FACING: Final = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def frame_at(
    left_m: float, top_m: float, *, depth_m: float = 4.0, size_m: float = 2.0
) -> WallFrame:
    cells = round(size_m / GSD_M)
    return samples.facing_south(GSD_M, cells, cells, (left_m, depth_m, top_m))


def camera_at(centre: NDArray[np.float64], rotation: NDArray[np.float64] = FACING) -> ViewingCamera:
    return samples.camera(
        rotation, centre, fx=800.0, fy=820.0, cx=500.0, cy=400.0, width=1000, height=800
    )


def findings_of(errors: list[PoseError]) -> dict[str, tuple[float, str]]:
    return {item.name: (item.value, item.unit) for item in pose_findings(errors)}


def ok(centre_m: float, deg: float, wall_m: float | None, sigma_m: float | None) -> PoseError:
    return PoseError(
        photo="a", status="ok", centre_m=centre_m, rotation_deg=deg, wall_m=wall_m,
        sigma_wall_m=sigma_m,
    )  # fmt: skip


ERRORS: Final = [
    ok(0.001, 0.1, 0.002, 0.001),
    ok(0.004, 0.2, 0.004, None),
    ok(0.002, 0.4, 0.006, 0.001),
    ok(0.003, 0.3, math.inf, 0.001),
    ok(0.005, 0.5, None, None),
    PoseError(photo="b", status="few ties"),
]


def test_poses_that_are_off_by_five_stated_deviations_are_wrong() -> None:
    assert [error.is_wrong for error in ERRORS] == [False, False, True, True, False, False]
    assert not ok(0.0, 0.0, 0.005, 0.001).is_wrong
    assert not PoseError(photo="b", status="far off", wall_m=1.0, sigma_wall_m=0.1).is_wrong


def test_errors_of_poses_are_summed_up_over_those_called_ok() -> None:
    found = findings_of(ERRORS)
    expected = {
        "n_photos": (6, "1"),
        "n_oriented": (5, "1"),
        "n_misoriented": (2, "1"),
        "pose_centre_max_mm": (5.0, "mm"),
        "pose_centre_median_mm": (3.0, "mm"),
        "pose_rotation_max_deg": (0.5, "deg"),
        "pose_rotation_median_deg": (0.3, "deg"),
        "pose_wall_max_mm": (6.0, "mm"),
        "pose_wall_median_mm": (4.0, "mm"),
        "pose_wall_rms_mm": (math.sqrt(56.0 / 3.0), "mm"),
        "pose_error_over_sigma": (math.sqrt(20.0), "1"),
    }
    assert found.keys() == expected.keys()
    for name, (value, unit) in expected.items():
        assert found[name][0] == pytest.approx(value), name
        assert found[name][1] == unit
    assert findings_of([]).keys() == {"n_photos", "n_oriented", "n_misoriented"}


# --- on the walls ---


def one_wall(frame: WallFrame, *, front_m: float, behind_m: float) -> Any:
    slab = Slab(frame=frame, front_m=front_m, behind_m=behind_m)
    return SimpleNamespace(walls=(SimpleNamespace(frame=frame),), slab=lambda _: slab)


def no_rays(_: NDArray[np.float64]) -> NDArray[np.float64]:
    raise GeometryError("the lens model cannot be undone there")


@pytest.mark.parametrize("turned", [False, True])
def test_a_displaced_camera_is_off_on_the_walls_by_its_displacement(turned: bool) -> None:
    scene: Any = SimpleNamespace(
        origin=np.array([10.0, 20.0, 30.0]),
        normals_at=lambda rectangle, _: np.repeat(-FACING[2:], len(rectangle), axis=0),
    )
    frame = frame_at(6.0, 34.0, depth_m=24.0, size_m=8.0)
    walls = one_wall(frame, front_m=0.1, behind_m=0.1)
    true = camera_at(np.zeros(3) + scene.origin)
    asked = []

    def trace(_: ViewingCamera, pixels: NDArray[np.float64]) -> Any:
        asked.append(pixels)
        rays = (pixels - (500.0, 400.0)) / (800.0, 820.0)
        points = np.column_stack([4.0 * rays[:, 0], np.full(len(rays), 4.0), -4.0 * rays[:, 1]])
        return SimpleNamespace(points=points, rectangle=np.zeros(len(points), dtype=int))

    views: Any = SimpleNamespace(trace=trace)
    shift = np.array([0.003, 0.0, 0.004])
    found = camera_at(scene.origin + shift)
    if turned:
        # The camera looks away from the wall.
        found = camera_at(scene.origin, FACING * [[1.0], [-1.0], [-1.0]])
    error = error_on_walls(found, true, walls, scene, views)
    # Root mean square per coordinate.
    assert error == (math.inf if turned else pytest.approx(0.005 / math.sqrt(2.0), rel=1e-9))
    # Pixels are in the centres of 24 x 18 equal parts of the photo.
    (pixels,) = asked
    assert pixels.shape == (24 * 18, 2)
    np.testing.assert_allclose(np.unique(pixels[:, 0]), 1000.0 * (np.arange(24) + 0.5) / 24.0)
    np.testing.assert_allclose(np.unique(pixels[:, 1]), 800.0 * (np.arange(18) + 0.5) / 18.0)
    unknown: Any = SimpleNamespace(shifted=lambda _: SimpleNamespace(rays_world=no_rays))
    assert error_on_walls(unknown, true, walls, scene, views) == math.inf
    nothing = one_wall(frame, front_m=0.1, behind_m=-1.0)
    assert error_on_walls(found, true, nothing, scene, views) is None


def test_errors_on_a_curved_wall_are_measured_in_its_tangent_planes() -> None:
    bend = CylinderBend(along="u", radius_m=4.0)
    frame = replace(
        frame_at(0.0, 4.0, size_m=8.0),
        origin_world=np.array([-4.0, 0.0, 4.0]),
        u_world=np.array([0.0, 1.0, 0.0]),
        normal_world=np.array([1.0, 0.0, 0.0]),
        width=1250,
        bend=bend,
    )
    slopes = []

    def trace(_: ViewingCamera, pixels: NDArray[np.float64]) -> Any:
        x, z = ((pixels - (500.0, 400.0)) / (800.0, 820.0)).T
        rays = np.column_stack([x, np.ones(len(x)), -z]) / np.hypot(x, 1.0)[:, None]
        slopes.append(rays)
        return SimpleNamespace(points=4.0 * rays, rectangle=np.zeros(len(x), dtype=int))

    scene: Any = SimpleNamespace(
        origin=np.zeros(3), normals_at=lambda _, points: points.T * [-0.25, -0.25, 0.0]
    )
    true, found = camera_at(np.zeros(3)), camera_at(np.array([0.004, 0.0, 0.0]))
    walls = one_wall(frame, front_m=0.1, behind_m=0.1)
    error = error_on_walls(found, true, walls, scene, SimpleNamespace(trace=trace))
    # The shift less its component along the normal, which is along the ray on the surface.
    off = 0.004 * (np.array([1.0, 0.0, 0.0]) - slopes[0][:, :1] * slopes[0])
    assert error == pytest.approx(np.sqrt(0.5 * (off**2).sum(axis=1).mean()), rel=1e-9)


def test_a_photo_shows_most_of_the_nearest_wall_that_faces_it() -> None:
    camera = camera_at(np.zeros(3))
    behind, before = frame_at(-3.0, 3.0, size_m=6.0), frame_at(0.2, 3.0, depth_m=2.0, size_m=6.0)
    walls: Any = [SimpleNamespace(frame=frame) for frame in (behind, before)]
    # The near wall hides the right part; two thirds of the photo show the far wall.
    assert most_shown(camera, walls) == 0
    nearer = [walls[0], SimpleNamespace(frame=frame_at(-0.4, 3.0, depth_m=2.0, size_m=6.0))]
    assert most_shown(camera, nearer) == 1
    assert most_shown(camera, nearer[::-1]) == 0
    assert most_shown(camera_at(np.array([0.0, 9.0, 0.0])), walls) == -1
    assert most_shown(camera, [SimpleNamespace(frame=frame_at(50.0, 3.0))]) == -1
    assert most_shown(camera, []) == -1


# --- ties ---


def ties_off(
    off_m: NDArray[np.float64], role: NDArray[np.uint8], wall: NDArray[np.int32]
) -> tuple[Any, Any, Any]:
    """Return ties of one photo, walls and truth.

    The pixels of the ties show points at given offsets from those of the ties.
    """
    camera = camera_at(np.zeros(3))
    frames = [frame_at(-2.0, 1.0, size_m=4.0), frame_at(2.0, 1.0, depth_m=4.0)]
    rng = np.random.default_rng(0)
    n = len(off_m)
    points = np.column_stack([rng.uniform(-1, 1, n), np.full(n, 4.0), rng.uniform(-1, 1, n)])
    beside = points + off_m[:, :1] * (1.0, 0.0, 0.0) + off_m[:, 1:] * (0.0, 0.0, -1.0)
    ties = SimpleNamespace(
        photo=np.zeros(n, dtype=np.int32),
        wall=wall,
        points_world=points,
        pixels_photo=camera.project(beside)[:, :2],
        photo_names=("a", "unused"),
        role=role,
    )
    walls = SimpleNamespace(walls=tuple(SimpleNamespace(frame=frame) for frame in frames))
    of_truth = SimpleNamespace(photo="a", viewing=lambda: camera)
    return ties, walls, SimpleNamespace(cameras=SimpleNamespace(cameras=(of_truth,)))


def test_wrong_ties_are_told_of_all_and_of_those_kept() -> None:
    lengths = np.array([0.0, 0.5, 1.0, 2.0, 3.0, 9.0])
    role = np.full(6, TieRole.CONTROL, dtype=np.uint8)
    role[2:4], role[5] = TieRole.CHECK, TieRole.REJECTED
    wall = np.array([0, 0, 0, 0, 1, 1], dtype=np.int32)
    off_m = GSD_M * lengths[:, None] * (0.6, 0.8)
    ties, walls, truth = ties_off(off_m, role, wall)
    cameras: Any = SimpleNamespace(ties=ties)
    found = {item.name: item.value for item in tie_findings(cameras, walls, truth)}
    assert found == {
        "match_wrong_share": pytest.approx(3.0 / 6.0),
        "n_ties_kept": 5,
        # The photo shows most of wall 0.
        "match_wrong_share_own_wall": pytest.approx(1.0 / 4.0),
        "tie_wrong_share": pytest.approx(2.0 / 5.0),
    }


def test_ties_that_nobody_kept_have_no_errors_of_their_own() -> None:
    role = np.full(2, TieRole.REJECTED, dtype=np.uint8)
    ties, walls, truth = ties_off(np.zeros((2, 2)), role, np.ones(2, dtype=np.int32))
    cameras: Any = SimpleNamespace(ties=ties)
    found = {item.name: item.value for item in tie_findings(cameras, walls, truth)}
    assert found == {"match_wrong_share": 0.0, "n_ties_kept": 0}
    ties.photo_names = ("b",)
    with pytest.raises(MethodError, match="the truth does not contain the photo b: connect"):
        tie_errors_cells(ties, walls, truth)
