"""Every detector on real scans that lie beside the checkout."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane.hough2d import Hough2d
from orthoflow_plugins.plane.hough3d import Hough3d
from orthoflow_plugins.plane.ransac import Ransac
from orthoflow_plugins.plane.region import Region

from orthoflow.geometry import angle_between_deg
from orthoflow.geometry.slabs import read_only
from orthoflow.products import PointCloud
from tests.plane_scenes import cloud_of, detect


def points_of(path: Path) -> NDArray[np.float64]:
    import laspy

    scan = laspy.read(path)
    return np.column_stack([scan.x, scan.y, scan.z])


# Reference: RANSAC at 2 cm, stated to a centimetre; panels lie some millimetres about the wall.
MAIN = np.array([0.9998, -0.018, 0.0]) / np.linalg.norm([0.9998, -0.018, 0.0])
ON_MAIN = np.array([-2.865, -1.1, 1.4])


@pytest.fixture(scope="module")
def hall(shared_data: Path) -> PointCloud:
    points = points_of(shared_data / "heritage-hall-west-wall" / "west_wall.laz")[::4]
    centre = np.floor(points.mean(axis=0))
    return cloud_of(points - centre, origin=tuple(centre))


@pytest.mark.parametrize("method", [Hough2d, Hough3d, Ransac, Region])
def test_walls_cases_recesses_floor_and_ceiling_of_the_hall_are_found(
    method: type, hall: PointCloud, tmp_path: Path
) -> None:
    planes = detect(method, hall, tmp_path)[0].planes
    assert angle_between_deg(planes.normal[0], MAIN) < 0.1
    assert planes.plane(0).distances_m(ON_MAIN[None])[0] == pytest.approx(0.0, abs=0.01)
    assert (planes.names[0], planes.viewpoint) == ("wall 0", "guess")
    in_front = planes.plane(0).distances_m(planes.corners.mean(axis=1))
    # Cases lean, and recesses are not all of one depth: 0.30 to 0.38 m.
    faces_hall = planes.normal @ planes.normal[0] > np.cos(np.radians(1.5))
    for in_front_m in (0.25, -0.36):
        assert np.abs(in_front - in_front_m)[faces_hall].min() < 0.03
    kinds = [name.split()[0] for name in planes.names]
    assert {"floor", "ceiling"} <= set(kinds)
    assert angle_between_deg(planes.normal[kinds.index("floor")], np.array([0, 0, 1.0])) < 0.2


def test_the_exactness_stated_of_a_real_wall_holds_between_its_halves(
    hall: PointCloud, tmp_path: Path
) -> None:
    found = []
    for part in (slice(0, None, 2), slice(1, None, 2)):
        # In one piece and read-only, as methods get them: kernels would be compiled once more.
        pieces = (np.ascontiguousarray(getattr(hall, name)[part]) for name in "xyz")
        columns: dict[str, Any] = dict(zip("xyz", read_only(*pieces), strict=True))
        half = replace(hall, **columns)
        found.append(detect(Ransac, half, tmp_path, n_planes_max=1)[0].planes)
    first, second = found
    middle = first.corners[0].mean(axis=0)
    apart_m = float(second.plane(0).distances_m(middle[None])[0])
    assert abs(apart_m) < 3.0 * first.sigma_offset_m(0)
    # Panels and painted plaster, 25 x 5 m: not micrometres.
    assert 1e-4 < first.sigma_offset_m(0) < 2e-3


def test_levels_of_a_building_with_y_up_are_found(shared_data: Path, tmp_path: Path) -> None:
    points = points_of(shared_data / "indoor-laz" / "indoor.laz")
    planes = detect(Hough2d, cloud_of(points, up=(0.0, 1.0, 0.0)), tmp_path)[0].planes
    rises = np.abs(planes.normal[:, 1])
    # Two ceilings and the floor, three metres apart, in coordinates rounded to a centimetre.
    assert np.count_nonzero(rises > 0.99) >= 3
    assert {"floor", "ceiling"} <= {name.split()[0] for name in planes.names}
    assert np.count_nonzero(rises < 0.1) >= 4
