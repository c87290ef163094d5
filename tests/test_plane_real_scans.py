"""`plane.hough2d` on real scans that lie beside the checkout."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane.hough2d import Hough2d

from orthoflow.geometry import angle_between_deg
from orthoflow.products import Planes
from tests.plane_scenes import cloud_of, context


def points_of(path: Path) -> NDArray[np.float64]:
    import laspy

    scan = laspy.read(path)
    return np.column_stack([scan.x, scan.y, scan.z])


@pytest.fixture(scope="module")
def hall(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Planes:
    points = points_of(shared_data / "heritage-hall-west-wall" / "west_wall.laz")
    centre = np.floor(points.mean(axis=0))
    cloud = cloud_of(points - centre, origin=tuple(centre))
    folder = tmp_path_factory.mktemp("hall")
    return Hough2d().run(Hough2d.In(cloud=cloud), Hough2d.Params(), context(folder)).planes


@pytest.mark.slow
def test_the_main_wall_of_the_hall_is_found(hall: Planes) -> None:
    # Reference: RANSAC at 2 cm; the wall's panels lie some millimetres about the plane.
    expected = np.array([0.9998, -0.018, 0.0]) / np.linalg.norm([0.9998, -0.018, 0.0])
    assert angle_between_deg(hall.normal[0], expected) < 0.1
    normal, offset = hall.normal[0], hall.offset[0]
    x_m = (offset + 1.1 * normal[1] - 1.4 * normal[2]) / normal[0]
    assert x_m == pytest.approx(-2.865, abs=0.01)
    assert hall.names[0] == "wall 0"
    assert hall.viewpoint == "guess"


@pytest.mark.slow
@pytest.mark.parametrize("in_front_m", [0.25, -0.36], ids=["cases", "recesses"])
def test_parallel_planes_of_the_hall_are_found_and_face_the_hall(
    in_front_m: float, hall: Planes
) -> None:
    on_plane = np.array([-2.865 + in_front_m, -1.1, 1.4])
    misses = np.abs(hall.normal @ on_plane - hall.offset)
    faces_hall = hall.normal[:, 0] > 0.99
    assert misses[faces_hall].min() < 0.02  # the reference is given to a centimetre


@pytest.mark.slow
def test_floor_and_ceiling_of_the_hall_are_found(hall: Planes) -> None:
    assert {"floor", "ceiling"} <= set(hall.names)
    floor = hall.names.index("floor")
    assert angle_between_deg(hall.normal[floor], np.array([0, 0, 1.0])) < 0.2


@pytest.mark.slow
def test_levels_of_a_building_with_y_up_are_found(shared_data: Path, tmp_path: Path) -> None:
    points = points_of(shared_data / "indoor-laz" / "indoor.laz")
    cloud = cloud_of(points, up=(0.0, 1.0, 0.0))
    planes = Hough2d().run(Hough2d.In(cloud=cloud), Hough2d.Params(), context(tmp_path)).planes
    levels = np.abs(planes.normal[:, 1]) > 0.99
    # Two ceilings and the floor, three metres apart, in coordinates rounded to a centimetre.
    assert levels.sum() >= 3
    assert {"floor", "ceiling"} <= set(planes.names)
    walls = np.abs(planes.normal[:, 1]) < 0.1
    assert walls.sum() >= 4
